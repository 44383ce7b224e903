//! Fetching the meshes: what Python runs, and with which arguments and variables.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use shadow_repose::see::mesh_files;

use crate::support::{command, names, stderr};

/// Writes an executable script.
fn write_script(path: &Path, text: &str) {
    fs::write(path, format!("#!/bin/sh\n{text}\n")).unwrap();
    fs::set_permissions(path, fs::Permissions::from_mode(0o755)).unwrap();
}

/// Draws a picture, for which the meshes are fetched, and returns what the program says. What the folder and the variables contain
/// is hostile.
fn draw(folder: &Path, cache: &Path, variables: &[(&str, &str)]) -> String {
    let args = [
        "view",
        "--out",
        "hand.png",
        "--size",
        "64x64",
        "--quality",
        "fast",
    ];
    let mut command = command(folder, &args);
    command
        .env("XDG_CACHE_HOME", cache)
        .envs(variables.iter().copied());
    stderr(&command.output().unwrap())
}

#[test]
fn no_file_in_the_users_folder_or_on_the_users_path_of_modules_is_executed() {
    let (place, cache) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let folder = place.path();
    for module in [
        "pip",
        "zipfile",
        "typing",
        "random",
        "sitecustomize",
        "usercustomize",
    ] {
        fs::write(
            folder.join(format!("{module}.py")),
            "open('/proc/self/cwd/PWNED', 'w')\nraise SystemExit(0)\n",
        )
        .unwrap();
    }
    let before = names(folder);
    let here = folder.to_str().unwrap();
    // Nothing is fetched from an index where nobody listens.
    let nowhere = ("PIP_INDEX_URL", "http://127.0.0.1:9/simple");
    let startup = folder.join("pip.py");
    draw(
        folder,
        cache.path(),
        &[
            nowhere,
            ("PYTHONPATH", here),
            ("PYTHONSTARTUP", startup.to_str().unwrap()),
        ],
    );
    let made: Vec<String> = names(folder)
        .into_iter()
        .filter(|name| !before.contains(name))
        .collect();
    assert!(made.iter().all(|name| name == "hand.png"), "{made:?}");
}

#[test]
fn python_is_isolated_and_pip_is_told_only_where_packages_come_from() {
    let place = tempfile::tempdir().unwrap();
    let [folder, bin, cache] = ["user", "bin", "cache"].map(|name| place.path().join(name));
    [&folder, &bin, &cache]
        .iter()
        .for_each(|path| fs::create_dir(path).unwrap());
    // A python3 that writes down how it was called, and answers as pip does.
    let (python, log) = (bin.join("python3"), place.path().join("log"));
    let script = format!(
        "#!/bin/sh\n{{ echo \"RUN $*\"; echo \"IN $PWD\"; env | grep -E '^(PIP|PYTHON)'; }} >> '{}'\n\
         [ \"$5\" = list ] || exit 1\n\
         printf \"global.proxy='http://other'\\ndownload.proxy='http://proxy'\\nglobal.constraint='c'\\n\"\n\
         printf \"global.extra-index-url='\\\\\\\\nhttp://a\\\\\\\\nhttp://b'\\n\"\n",
        log.display()
    );
    fs::write(&python, script).unwrap();
    fs::set_permissions(&python, fs::Permissions::from_mode(0o755)).unwrap();
    let path = format!("{}:{}", bin.display(), std::env::var("PATH").unwrap());
    fs::create_dir(folder.join("wheels")).unwrap();
    fs::write(folder.join("ca.pem"), "").unwrap();
    let kept = [
        ("PIP_INDEX_URL", "http://index"),
        ("PIP_NO_INDEX", "1"),
        ("PIP_FIND_LINKS", "wheels http://links"),
        ("PIP_CERT", "ca.pem"),
        ("PIP_CONFIG_FILE", "pip.conf"),
        ("PATH", &path),
    ];
    let dropped = [
        ("PIP_CONSTRAINT", "c"),
        ("PIP_REQUIRE_VIRTUALENV", "1"),
        ("PIP_TARGET", "t"),
        ("PYTHONPATH", "p"),
        ("PYTHONHOME", "h"),
    ];
    draw(&folder, &cache, &[&kept[..], &dropped].concat());
    let log = fs::read_to_string(&log).unwrap();
    let runs: Vec<&str> = log.split("RUN ").skip(1).collect();
    let [list, download] = runs[..] else {
        panic!("{log}")
    };
    for run in [list, download] {
        assert!(run.starts_with("-I -m pip "), "{run}");
        let place = run
            .lines()
            .find_map(|line| line.strip_prefix("IN "))
            .unwrap();
        assert!(
            Path::new(place).starts_with(cache.canonicalize().unwrap()),
            "{run}"
        );
        assert!(
            dropped
                .iter()
                .all(|(name, _)| !run.contains(&format!("{name}="))),
            "{run}"
        );
    }
    let conf = folder.join("pip.conf");
    assert!(
        list.contains(&format!("PIP_CONFIG_FILE={}\n", conf.display())),
        "{list}"
    );
    let told = [
        "CONFIG_FILE=/dev/null",
        "INDEX_URL=http://index",
        "EXTRA_INDEX_URL=http://a http://b",
        "NO_INDEX=1",
        &format!(
            "FIND_LINKS={} http://links",
            folder.join("wheels").display()
        ),
        &format!("CERT={}", folder.join("ca.pem").display()),
        "PROXY=http://proxy",
    ];
    for line in told.map(|line| format!("PIP_{line}\n")) {
        assert!(download.contains(&line), "{line}{download}");
    }
}

#[test]
fn damaged_meshes_are_fetched_again_and_where_that_fails_the_folder_to_delete_is_named() {
    let (place, cache) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let meshes = cache.path().join("shadow-repose/shadow-hand-meshes");
    fs::create_dir_all(&meshes).unwrap();
    mesh_files()
        .into_iter()
        .for_each(|name| fs::write(meshes.join(name), "v nan nan nan").unwrap());
    // Without a program named python3 nothing can be fetched.
    let said = draw(
        place.path(),
        cache.path(),
        &[("PATH", place.path().to_str().unwrap())],
    );
    assert!(
        said.contains("fetching the meshes") && said.contains("python3 could not be started"),
        "{said}"
    );
    let advice = format!(
        "the meshes in {} are damaged; deleting this folder may help",
        meshes.display()
    );
    assert!(said.contains(&advice), "{said}");
}

#[test]
fn what_python_says_is_cut_and_where_it_says_nothing_its_status_is_told() {
    let place = tempfile::tempdir().unwrap();
    let path = format!(
        "{}:{}",
        place.path().display(),
        std::env::var("PATH").unwrap()
    );
    for (script, told) in [
        (
            "head -c 1000000 /dev/zero | tr '\\0' x >&2; exit 1",
            "python3 failed: xxx",
        ),
        (
            "for i in 1 2 3; do head -c 100000 /dev/zero | tr '\\0' $i >&2; echo >&2; done; exit 1",
            " / 333",
        ),
        ("exit 3", "python3 failed: exit status: 3"),
    ] {
        write_script(&place.path().join("python3"), script);
        let cache = tempfile::tempdir().unwrap();
        let said = draw(place.path(), cache.path(), &[("PATH", &path)]);
        assert!(
            said.len() < 1500 && said.contains(told),
            "{script}: {} bytes",
            said.len()
        );
    }
}

#[test]
fn a_fetch_that_hangs_is_given_up_after_ten_seconds_and_not_tried_again_for_a_day() {
    let (place, cache) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let (folder, python) = (place.path(), place.path().join("python3"));
    write_script(&python, "echo x >> tried; exec sleep 100");
    let path = format!("{}:{}", folder.display(), std::env::var("PATH").unwrap());
    let timed = || {
        let began = Instant::now();
        let said = draw(folder, cache.path(), &[("PATH", &path)]);
        (said, began.elapsed())
    };
    let (said, time) = timed();
    assert!((9..30).contains(&time.as_secs()), "{time:?}");
    for part in [
        "cannot fetch the meshes",
        "within 9 s",
        "--plain",
        "view --fetch",
    ] {
        assert!(said.contains(part), "{said}");
    }
    assert!(folder.join("hand.png").exists(), "without them: {said}");
    write_script(&python, "exit 1");
    let (said, _) = timed();
    assert!(
        !said.contains("fetching") && said.contains("less than a day ago"),
        "{said}"
    );
    assert!(said.contains("--plain") && said.contains("view --fetch"));
    // Who asks for it tries again.
    let fetch = |args: &[&str]| {
        command(folder, args)
            .env("XDG_CACHE_HOME", cache.path())
            .env("PATH", &path)
            .output()
            .unwrap()
    };
    let failed = fetch(&["view", "--fetch"]);
    assert_eq!(failed.status.code(), Some(1));
    assert!(stderr(&failed).contains("exit status: 1"));
    assert_eq!(
        fetch(&["view", "--fetch", "--plain"]).status.code(),
        Some(2)
    );
    // Also a day later.
    let mark = cache.path().join("shadow-repose/shadow-hand-meshes.failed");
    let before = std::time::SystemTime::now() - Duration::from_secs(25 * 3600);
    fs::File::options()
        .append(true)
        .open(mark)
        .unwrap()
        .set_modified(before)
        .unwrap();
    assert!(timed().0.contains("fetching"));
}

#[test]
fn meshes_are_fetched_beforehand_by_a_command_that_says_where_they_are() {
    let place = tempfile::tempdir().unwrap();
    let output = command(place.path(), &["view", "--fetch"])
        .output()
        .unwrap();
    let said = stderr(&output);
    if !output.status.success() {
        eprintln!("not tested: the meshes cannot be fetched here: {said}");
        return;
    }
    let folder = said
        .lines()
        .find_map(|line| line.strip_prefix("the place of the hand's meshes is "))
        .unwrap();
    for name in mesh_files() {
        assert!(Path::new(folder).join(name).exists(), "{name}");
    }
}

#[test]
fn a_signal_ends_python_without_executing_a_file_named_kill() {
    let (place, cache) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let (folder, log) = (place.path(), cache.path().join("log"));
    write_script(&folder.join("kill"), "touch PWNED");
    fs::create_dir(folder.join("bin")).unwrap();
    write_script(
        &folder.join("bin/python3"),
        &format!(
            "echo $$ > '{0}.new'; mv '{0}.new' '{0}'; exec sleep 100",
            log.display()
        ),
    );
    let path = format!(
        ".:{}:{}",
        folder.join("bin").display(),
        std::env::var("PATH").unwrap()
    );
    let args = [
        "view",
        "--out",
        "hand.png",
        "--size",
        "64x64",
        "--quality",
        "fast",
    ];
    let mut child = command(folder, &args)
        .env("XDG_CACHE_HOME", cache.path())
        .env("PATH", path)
        .spawn()
        .unwrap();
    let begun = Instant::now();
    let within = |time: u64| begun.elapsed() < Duration::from_secs(time);
    while !log.exists() && within(60) {
        std::thread::sleep(Duration::from_millis(5));
    }
    let id = fs::read_to_string(&log).unwrap();
    assert!(
        Command::new("kill")
            .arg(child.id().to_string())
            .status()
            .unwrap()
            .success()
    );
    assert!(!child.wait().unwrap().success());
    // Dead, or waiting for whoever adopted it to notice.
    let status = || fs::read_to_string(format!("/proc/{}/status", id.trim())).unwrap_or_default();
    let runs = || !status().is_empty() && !status().contains("State:\tZ");
    while runs() && within(70) {
        std::thread::sleep(Duration::from_millis(5));
    }
    assert!(!runs() && !folder.join("PWNED").exists(), "{}", status());
}
