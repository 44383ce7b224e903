//! Fetches wheels with pip, by package name and hash. The build script includes this file too, so it uses only the standard
//! library.
//!
//! Neither the folder in which the program was started nor the user's settings of Python and pip change what is executed or
//! fetched. Only the sources of packages are taken from those settings.

use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::{env, fs, io};

/// The settings of pip that say where packages come from.
const SOURCES: [&str; 8] = [
    "index-url",
    "extra-index-url",
    "no-index",
    "find-links",
    "trusted-host",
    "cert",
    "client-cert",
    "proxy",
];

/// The variable that names pip's configuration file.
const CONFIG: &str = "PIP_CONFIG_FILE";

/// Downloads the wheel `package` (as `name==version`) with this sha256 and unpacks it into `folder`, which is recreated.
///
/// `selection` holds pip's options that choose between the wheels of a package.
///
/// # Errors
/// Fails if python3 or pip is missing, if the package cannot be reached or has another hash, or if the folder cannot be written
/// to.
pub(crate) fn unpack_wheel(
    package: &str,
    hash: &str,
    selection: &[&str],
    folder: &Path,
) -> Result<(), String> {
    let told = |error: io::Error| format!("{}: {error}", folder.display());
    let _ = fs::remove_dir_all(folder);
    fs::create_dir_all(folder).map_err(told)?;
    let requirement = folder.join("requirement.txt");
    fs::write(&requirement, format!("{package} --hash=sha256:{hash}\n")).map_err(told)?;
    let mut pip = python(folder, "pip");
    pip.args(
        "download --quiet --disable-pip-version-check --retries 2 --no-deps --only-binary=:all:"
            .split(' '),
    );
    pip.arg("--require-hashes")
        .args(selection)
        .arg("-r")
        .arg(&requirement)
        .arg("-d")
        .arg(folder);
    // With this name, pip reads no configuration file at all.
    run(pip.envs(sources(folder)).env(CONFIG, "/dev/null"))?;
    let mut found = fs::read_dir(folder)
        .map_err(told)?
        .flatten()
        .map(|entry| entry.path());
    let wheel = found.find(|path| path.extension().is_some_and(|e| e == "whl"));
    let wheel = wheel.ok_or("pip reported success but left no wheel")?;
    run(python(folder, "zipfile").arg("-e").arg(&wheel).arg(folder)).map(drop)
}

/// The variables that set where pip gets packages from: the user's own or, where there is none, the values in
/// the user's configuration files.
fn sources(folder: &Path) -> Vec<(String, String)> {
    let config = env::var_os(CONFIG).map(|file| std::path::absolute(&file).unwrap_or(file.into()));
    let listed = run(python(folder, "pip")
        .args(["config", "list"])
        .envs(config.map(|file| (CONFIG, file))));
    let listed = listed.unwrap_or_default();
    let in_files = |name: &str| {
        // One line is `section.name='value'`. A value for this command alone takes precedence.
        let of = |section: &str| {
            let key = format!("{section}.{name}=");
            let value = listed.lines().find_map(|line| line.strip_prefix(&key));
            value.map(|value| value.trim_matches(['\'', '"']))
        };
        // Several values are separated by line feeds, which are shown escaped.
        of("download")
            .or_else(|| of("global"))
            .map(|value| value.replace("\\n", " ").trim().to_owned())
    };
    let variable = |name: &str| format!("PIP_{}", name.replace('-', "_").to_uppercase());
    let found = SOURCES.into_iter().filter_map(|name| {
        let value = env::var(variable(name)).ok().or_else(|| in_files(name))?;
        let value = match name {
            "cert" | "client-cert" => absolute(&value),
            "find-links" => value
                .split_whitespace()
                .map(absolute)
                .collect::<Vec<_>>()
                .join(" "),
            _ => value,
        };
        Some((variable(name), value))
    });
    found.collect()
}

/// The absolute path of what exists here, since pip runs in another folder. Anything else, e.g. an address, stays as it is.
fn absolute(place: &str) -> String {
    let path = Path::new(place);
    let found = path
        .exists()
        .then(|| std::path::absolute(path).ok())
        .flatten();
    found.map_or_else(|| place.to_owned(), |path| path.display().to_string())
}

/// The id of the running process, or 0. It leads its own process group, since python3 may be a script that starts another one.
static AT_WORK: AtomicU32 = AtomicU32::new(0);

/// Kills the running processes, if any: they would keep writing to their folder after this program has ended. `kill` is built into
/// the shell, so that no file of this name is looked for.
#[allow(dead_code, reason = "build.rs includes this file and never stops it")]
pub(crate) fn stop() {
    let id = AT_WORK.load(Ordering::Relaxed);
    if id != 0 {
        let _ = Command::new("/bin/sh")
            .args(["-c", &format!("kill -KILL -{id}")])
            .env_clear()
            .status();
    }
}

/// The command that runs a module of Python, isolated from the user's folder, variables and own packages. It runs in
/// `folder`, since the python3 of a version manager may look for its settings there.
fn python(folder: &Path, module: &str) -> Command {
    let mut command = Command::new("python3");
    command.current_dir(folder).args(["-I", "-m", module]);
    for (name, _) in env::vars_os() {
        if ["PIP_", "PYTHON"]
            .iter()
            .any(|begin| name.as_encoded_bytes().starts_with(begin.as_bytes()))
        {
            command.env_remove(name);
        }
    }
    command
}

/// Runs a command and returns what it prints.
fn run(command: &mut Command) -> Result<String, String> {
    let told = |e: io::Error| format!("python3 could not be started ({e})");
    let child = command
        .process_group(0)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .map_err(told)?;
    AT_WORK.store(child.id(), Ordering::Relaxed);
    let output = child.wait_with_output();
    AT_WORK.store(0, Ordering::Relaxed);
    let output = output.map_err(told)?;
    if output.status.success() {
        return Ok(String::from_utf8_lossy(&output.stdout).into_owned());
    }
    let said = String::from_utf8_lossy(&output.stderr);
    let lines: Vec<String> = said
        .lines()
        .filter(|line| !line.trim().is_empty())
        .map(shortened)
        .collect();
    let status = output.status.to_string();
    let last = if lines.is_empty() {
        status
    } else {
        lines[lines.len().saturating_sub(3)..].join(" / ")
    };
    Err(format!("python3 failed: {last}"))
}

/// At most 100 characters of a line.
fn shortened(line: &str) -> String {
    let start: String = line.chars().take(100).collect();
    if start.len() < line.len() {
        format!("{start}…")
    } else {
        start
    }
}
