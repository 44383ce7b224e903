//! Fetches wheels with pip, by package name and hash. The build script includes this file too, so it uses only the standard
//! library.

use std::ffi::OsStr;
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::{fs, io};

/// Downloads the wheel `package` (as `name==version`) with this sha256 and unpacks it into `folder`, which is recreated.
///
/// `selection` holds pip's options that choose between the wheels of a package.
///
/// # Errors
/// Fails if python3 or pip is missing, if the package cannot be reached or has another hash, or if the folder cannot be written
/// to.
pub(crate) fn unpack_wheel(package: &str, hash: &str, selection: &[&str], folder: &Path) -> Result<(), String> {
    let told = |error: io::Error| format!("{}: {error}", folder.display());
    let _ = fs::remove_dir_all(folder);
    fs::create_dir_all(folder).map_err(told)?;
    let requirement = folder.join("requirement.txt");
    fs::write(&requirement, format!("{package} --hash=sha256:{hash}\n")).map_err(told)?;
    let pip = "-m pip download --quiet --disable-pip-version-check --retries 2 --no-deps --only-binary=:all: --require-hashes";
    let places = ["-r".as_ref(), requirement.as_os_str(), "-d".as_ref(), folder.as_os_str()];
    python(pip.split_whitespace().chain(selection.iter().copied()).map(OsStr::new).chain(places))?;
    let mut found = fs::read_dir(folder).map_err(told)?.flatten().map(|entry| entry.path());
    let wheel = found.find(|path| path.extension().is_some_and(|e| e == "whl"));
    let wheel = wheel.ok_or("pip reported success but left no wheel")?;
    python(["-m".as_ref(), "zipfile".as_ref(), "-e".as_ref(), wheel.as_os_str(), folder.as_os_str()])
}

/// The id of the running process, or 0. It leads its own process group, since python3 may be a script that starts another one.
static AT_WORK: AtomicU32 = AtomicU32::new(0);

/// Kills the running processes, if any: they would keep writing to their folder after this program has ended.
#[allow(dead_code)]
pub(crate) fn stop() {
    let id = AT_WORK.load(Ordering::Relaxed);
    if id != 0 {
        let _ = Command::new("kill").args(["-KILL", "--", &format!("-{id}")]).status();
    }
}

/// Runs python3 with these arguments.
fn python<'a>(args: impl IntoIterator<Item = &'a OsStr>) -> Result<(), String> {
    let told = |e: io::Error| format!("python3 could not be started ({e})");
    let child = Command::new("python3")
        .args(args)
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
        return Ok(());
    }
    let said = String::from_utf8_lossy(&output.stderr);
    let lines: Vec<&str> = said.lines().filter(|l| !l.trim().is_empty()).collect();
    Err(format!("python3 failed: {}", lines[lines.len().saturating_sub(3)..].join(" / ")))
}
