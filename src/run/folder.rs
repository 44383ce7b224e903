//! The folder of a run and what lies in it.

use std::ffi::OsString;
use std::fs::{self, DirEntry};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use anyhow::{Context, Result, bail, ensure};

use super::checkpoints::Checkpoints;
use super::file::{read_text, same_file};
use super::lock::{LOCK, Locked};
use super::output::{OUR_PARTIAL, PARTIAL, is_abandoned, sync_folder, write_whole};

/// Where runs go when nothing else is said.
const RUNS: &str = "runs/shadow-hand-repose";

const CONFIG: &str = "config.toml";
const VERSION: &str = "version.txt";
const POLICY: &str = "policy.safetensors";
const DIVERGED: &str = "diverged";
/// How the names of a run's files begin.
const OURS: [&[u8]; 9] = [
    b"config.toml",
    b"version.txt",
    b"policy.safetensors",
    b"run.lock",
    b"metrics.csv",
    b"metrics.before-",
    b"events.out.",
    b"checkpoints",
    b"diverged",
];

/// Files in the folder `diverged`; whoever has so many needs no more to find the cause, but may need the disk.
const MOST_DUMPS: usize = 1000;
pub(super) const METRICS: &str = "metrics.csv";

/// `config.toml`, `version.txt`, `metrics.csv`, event files, `policy.safetensors`, checkpoints.
#[derive(Clone, Debug)]
pub struct RunFolder {
    path: PathBuf,
}

impl RunFolder {
    /// A new run's folder: `path`, or runs/shadow-hand-repose/DATE-TIME[-NAME].
    ///
    /// # Errors
    /// A folder that already holds a run, or cannot be written to.
    pub fn create(path: Option<&Path>, name: Option<&str>) -> Result<(Self, Locked)> {
        let path = match path {
            Some(path) => path.to_owned(),
            None => create_unused(name)?,
        };
        let run = Self { path };
        run.expect_free(None)?;
        let created = fs::create_dir_all(&run.path).and_then(|()| sync_folder(&run.path));
        created.with_context(|| format!("cannot create the run folder {}", run.path.display()))?;
        let lock = run.lock()?;
        // Another training may have begun and ended meanwhile.
        run.expect_free(Some(LOCK))?;
        run.checkpoints().create_folder()?;
        let lock = run.claim(lock)?;
        Ok((run, lock))
    }

    /// Makes sure that nothing of a run is in the folder, `but` for this, and that it is not a folder of one.
    fn expect_free(&self, but: Option<&str>) -> Result<()> {
        let mut names = self.entries()?.into_iter().map(|entry| entry.file_name());
        // A trace that was never finished is not of a run.
        let of_a_run = |name: &OsString| !name.as_encoded_bytes().starts_with(OUR_PARTIAL.as_bytes());
        if let Some(name) = names.find(|name| of_a_run(name) && but.is_none_or(|but| name != but)) {
            bail!(
                "{} already holds a run, or a part of one ({}); resume it with --resume, or name another folder",
                self.path.display(),
                name.to_string_lossy()
            );
        }
        let whole = std::path::absolute(&self.path).with_context(|| format!("cannot find {}", self.path.display()))?;
        let there = whole.ancestors().find_map(|folder| folder.canonicalize().ok()).unwrap_or_default();
        let above = there.ancestors().skip(usize::from(whole.exists()));
        for folder in above.map(|path| Self { path: path.to_owned() }) {
            let holds_a_run = folder.checkpoints().begun() || folder.path.join(LOCK).exists();
            ensure!(!holds_a_run, "{} lies inside the run {}", self.path.display(), folder.path.display());
        }
        Ok(())
    }

    /// A new run folder among the temporary files, where its own cannot be written to.
    ///
    /// # Errors
    /// A place that cannot be written to.
    pub fn for_now() -> Result<Self> {
        let folder = tempfile::Builder::new().prefix("shadow-repose-").tempdir();
        let context = || format!("cannot create a folder in {}", std::env::temp_dir().display());
        Ok(Self { path: folder.with_context(context)?.keep() })
    }

    /// Removes what a run that could not begin has made in its folder, and the folder if nothing else is in it.
    pub fn clear(&self) {
        for entry in self.entries().into_iter().flatten() {
            let _ = fs::remove_file(entry.path());
        }
        for folder in [self.checkpoints().folder(), &self.path] {
            let _ = fs::remove_dir(folder);
        }
    }

    /// Removes a folder in which nothing could be saved.
    pub fn remove(self) {
        let _ = fs::remove_dir_all(self.path);
    }

    /// The folder of an existing run that `place` is, or whose checkpoints it is, or that the checkpoint `place` lies in.
    ///
    /// # Errors
    /// Nothing there, or a file outside a run folder.
    pub fn containing(place: &Path) -> Result<Self> {
        ensure!(place.exists(), "{}: there is no such run folder or checkpoint", place.display());
        let path = if place.is_dir() {
            run_of(place)
        } else {
            let place = place.canonicalize().with_context(|| format!("cannot read {}", place.display()))?;
            let run = place.parent().and_then(Path::parent);
            match run.map(|run| (run, Checkpoints::of(run))) {
                Some((run, checkpoints)) if place.parent() == Some(checkpoints.folder()) => run.to_owned(),
                _ => bail!("{} does not lie in the checkpoints folder of a run", place.display()),
            }
        };
        Ok(Self { path })
    }

    /// Keeps every other training out of it for as long as the result lives; changes nothing in it.
    ///
    /// # Errors
    /// Another training uses it, or it cannot be written to.
    pub fn lock(&self) -> Result<Locked> {
        self.expect_plain()?;
        Locked::take(&self.path)
    }

    /// Begins to write into a folder that is locked: removes what a crash in the middle of writing left.
    ///
    /// # Errors
    /// A folder that cannot be written to.
    pub fn claim(&self, lock: Locked) -> Result<Locked> {
        for entry in self.entries()? {
            let (path, name) = (entry.path(), entry.file_name());
            // Those of 0.1.0 had the name of the file that they were to become.
            let left = path.extension().is_some_and(|extension| extension == PARTIAL);
            if left && (is_abandoned(&name.to_string_lossy()) || !name.as_encoded_bytes().starts_with(b".")) {
                fs::remove_file(&path).with_context(|| format!("cannot remove {}", path.display()))?;
            }
        }
        lock.sign()
    }

    /// Makes sure that nothing in the folder leads out of it: it may come from somebody else, and will be written into.
    fn expect_plain(&self) -> Result<()> {
        for entry in self.entries()? {
            let path = entry.path();
            let kind = entry.file_type().with_context(|| format!("cannot read {}", path.display()))?;
            ensure!(
                kind.is_file() || kind.is_dir(),
                "{}: neither a file nor a folder; no link in a run folder is followed",
                path.display()
            );
        }
        Ok(())
    }

    /// What lies in it under the names of a run's files; there may be other things beside.
    fn entries(&self) -> Result<Vec<DirEntry>> {
        let begins: Vec<&[u8]> = OURS.into_iter().chain([OUR_PARTIAL.as_bytes()]).collect();
        let mut found = Vec::new();
        for folder in [&self.path, self.checkpoints().folder(), &self.path.join(DIVERGED)] {
            if folder.exists() {
                let context = || format!("cannot read {}", folder.display());
                for entry in fs::read_dir(folder).with_context(context)? {
                    found.push(entry.with_context(context)?);
                }
            }
        }
        let ours = |entry: &DirEntry| {
            let name = entry.file_name();
            entry.path().parent() != Some(&self.path)
                || begins.iter().any(|begin| name.as_encoded_bytes().starts_with(begin))
        };
        found.retain(ours);
        Ok(found)
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Its checkpoints.
    pub fn checkpoints(&self) -> Checkpoints {
        Checkpoints::of(&self.path)
    }

    /// The best policy, or the latest where none was scored yet, alone.
    pub fn policy(&self) -> PathBuf {
        self.path.join(POLICY)
    }

    /// Writes what led to a diverged state, unless there are very many of these already.
    ///
    /// # Errors
    /// A folder that cannot be written to.
    pub fn dump(&self, name: &str, text: &str) -> Result<()> {
        let folder = self.path.join(DIVERGED);
        fs::create_dir_all(&folder).with_context(|| format!("cannot create {}", folder.display()))?;
        if fs::read_dir(&folder).is_ok_and(|entries| entries.count() >= MOST_DUMPS) {
            return Ok(());
        }
        write_whole(&folder.join(name), text.as_bytes())
    }

    /// The configuration as it stands in the folder, with its file; `None` if it is not there.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn config(&self) -> Result<Option<(PathBuf, String)>> {
        let path = self.path.join(CONFIG);
        if path.exists() { read_text(&path).map(|text| Some((path, text))) } else { Ok(None) }
    }

    /// Writes the configuration and the facts about the program, if they are not there.
    ///
    /// # Errors
    /// A folder that cannot be written to.
    pub fn describe(&self, config: &str, version: &str) -> Result<()> {
        for (name, text) in [(CONFIG, config), (VERSION, version)] {
            let path = self.path.join(name);
            if read_text(&path).ok().as_deref() != Some(text) {
                write_whole(&path, text.as_bytes())?;
            }
        }
        Ok(())
    }
}

/// The checkpoint that `place` means: itself, or of a run folder its best, or its latest where there is none yet.
///
/// # Errors
/// Nothing there.
pub fn resolve_checkpoint(place: &Path) -> Result<PathBuf> {
    if !place.is_dir() {
        ensure!(place.exists(), "{}: there is no such checkpoint or run folder", place.display());
        return Ok(place.to_owned());
    }
    let checkpoints = RunFolder::containing(place)?.checkpoints();
    let found = [checkpoints.best(), checkpoints.latest()].into_iter().find(|path| path.exists());
    found.with_context(|| format!("{} holds no checkpoint", place.display()))
}

/// The run that a folder is, or whose folder of checkpoints it is.
fn run_of(folder: &Path) -> PathBuf {
    let run = folder.canonicalize().ok().and_then(|whole| Some(whole.parent()?.to_owned()));
    let inside = run.filter(|run| same_file(Checkpoints::of(run).folder(), folder));
    inside.unwrap_or_else(|| folder.to_owned())
}

/// The checkpoint of the newest run that has one, if any does.
pub fn newest_checkpoint() -> Option<PathBuf> {
    let runs = fs::read_dir(RUNS).into_iter().flatten().flatten().map(|entry| RunFolder { path: entry.path() });
    // By the time of the latest checkpoint, so that a run that was resumed counts as new.
    runs.filter_map(|run| Some((modified(&run.checkpoints().latest())?, resolve_checkpoint(&run.path).ok()?)))
        .max()
        .map(|(_, checkpoint)| checkpoint)
}

fn modified(path: &Path) -> Option<SystemTime> {
    fs::metadata(path).and_then(|facts| facts.modified()).ok()
}

/// Creates a folder for a run among the others, named by the time, that no other run has.
fn create_unused(name: Option<&str>) -> Result<PathBuf> {
    let plain = |c: char| c.is_alphanumeric() || "-_.".contains(c);
    let name = name.unwrap_or_default();
    ensure!(name.chars().all(plain), "--name {name}: may hold letters, digits, `-`, `_` and `.` only");
    fs::create_dir_all(RUNS).with_context(|| format!("cannot create the folder of runs {RUNS}"))?;
    let time = jiff::Zoned::now().strftime("%Y-%m-%d_%H-%M-%S").to_string();
    let suffix = if name.is_empty() { String::new() } else { format!("-{name}") };
    for attempt in 1.. {
        let again = if attempt == 1 { String::new() } else { format!("-{attempt}") };
        let path = Path::new(RUNS).join(format!("{time}{suffix}{again}"));
        match fs::create_dir(&path) {
            Err(error) if error.kind() == ErrorKind::AlreadyExists => {}
            result => {
                result.with_context(|| format!("cannot create the run folder {}", path.display()))?;
                return Ok(path);
            }
        }
    }
    unreachable!("the attempts do not end")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_that_holds_a_run_is_not_taken_again() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("run");
        RunFolder::create(Some(&path), None).unwrap().0.describe("a = 1", "1").unwrap();
        let refusal = RunFolder::create(Some(&path), None).unwrap_err().to_string();
        assert!(refusal.contains("already holds a run"), "{refusal}");
        assert_eq!(fs::read_to_string(path.join("config.toml")).unwrap(), "a = 1");
    }

    #[test]
    fn no_link_in_a_run_folder_is_followed() {
        let place = tempfile::tempdir().unwrap();
        let victim = place.path().join("victim");
        fs::write(&victim, "precious").unwrap();
        for name in ["run.lock", "metrics.csv", "events.out.tfevents.1.2.shadow-repose", "checkpoints/x.partial"] {
            let run = RunFolder { path: place.path().join("run") };
            run.checkpoints().create_folder().unwrap();
            std::os::unix::fs::symlink(&victim, run.path.join(name)).unwrap();
            let refusal = run.lock().unwrap_err().to_string();
            assert!(refusal.contains(name) && refusal.contains("no link"), "{refusal}");
            fs::remove_dir_all(&run.path).unwrap();
        }
        // One that is laid later is replaced, not written through.
        std::os::unix::fs::symlink(&victim, place.path().join("config.toml.partial")).unwrap();
        RunFolder { path: place.path().into() }.describe("a = 1", "1").unwrap();
        assert_eq!(fs::read_to_string(&victim).unwrap(), "precious");
    }

    #[test]
    fn what_else_lies_in_the_folder_of_a_run_is_left_alone() {
        let place = tempfile::tempdir().unwrap();
        fs::write(place.path().join("download.partial"), "mine").unwrap();
        std::os::unix::fs::symlink("/nowhere", place.path().join("link")).unwrap();
        RunFolder::create(Some(place.path()), None).unwrap();
        assert_eq!(fs::read_to_string(place.path().join("download.partial")).unwrap(), "mine");
    }

    #[test]
    fn what_a_crash_left_half_written_is_removed() {
        let place = tempfile::tempdir().unwrap();
        let (run, lock) = RunFolder::create(Some(place.path()), None).unwrap();
        // As 0.1.0 named it, and now.
        let left = ["iteration-00000020.safetensors.partial", ".shadow-repose-999999999-0.partial"];
        let left = left.map(|name| run.checkpoints().folder().join(name));
        left.iter().for_each(|half| fs::write(half, "half").unwrap());
        let living = place.path().join(format!(".shadow-repose-{}-9999.partial", std::process::id()));
        fs::write(&living, "of a trace that is being written").unwrap();
        assert!(run.checkpoints().newest_first().is_empty());
        drop(lock);
        let lock = run.lock().unwrap();
        assert!(left.iter().all(|half| half.exists()), "who only looks changes nothing");
        run.claim(lock).unwrap();
        assert!(!left.iter().any(|half| half.exists()) && living.exists());
    }

    #[test]
    fn a_folder_with_any_part_of_a_run_or_inside_one_is_not_taken() {
        let place = tempfile::tempdir().unwrap();
        for name in ["policy.safetensors", "run.lock", "metrics.csv", "events.out.tfevents.1.1.x"] {
            let folder = place.path().join(format!("has-{name}"));
            fs::create_dir(&folder).unwrap();
            fs::write(folder.join(name), "foreign").unwrap();
            let refusal = RunFolder::create(Some(&folder), None).unwrap_err().to_string();
            assert!(refusal.contains("already holds a run") && refusal.contains(name), "{refusal}");
            assert_eq!(fs::read_to_string(folder.join(name)).unwrap(), "foreign");
            assert_eq!(fs::read_dir(&folder).unwrap().count(), 1);
        }
        for name in ["checkpoints", "diverged"] {
            let folder = place.path().join(format!("has-{name}"));
            fs::create_dir_all(folder.join(name)).unwrap();
            assert!(RunFolder::create(Some(&folder), None).is_err());
        }
        let (run, _lock) = RunFolder::create(Some(&place.path().join("run")), None).unwrap();
        let here = std::env::current_dir().unwrap();
        let up: PathBuf = here.ancestors().skip(1).map(|_| "..").collect();
        let relative = up.join(run.path.strip_prefix("/").unwrap()).join("new");
        assert!(RunFolder::create(Some(&relative), None).is_err() && !relative.exists());
        for inside in ["checkpoints", "new/deeper"] {
            let refusal = RunFolder::create(Some(&run.path.join(inside)), None).unwrap_err().to_string();
            assert!(refusal.contains("lies inside the run") && !run.path.join("new").exists(), "{refusal}");
        }
    }

    #[test]
    fn the_folder_of_its_checkpoints_means_the_run() {
        let place = tempfile::tempdir().unwrap();
        let (run, _lock) = RunFolder::create(Some(&place.path().join("run")), None).unwrap();
        write_whole(&run.checkpoints().latest(), b"latest").unwrap();
        let found = RunFolder::containing(run.checkpoints().folder()).unwrap();
        assert!(same_file(&found.path, &run.path), "{found:?}");
        assert!(same_file(&resolve_checkpoint(run.checkpoints().folder()).unwrap(), &run.checkpoints().latest()));
    }

    #[test]
    fn a_run_folder_means_its_best_checkpoint_and_before_there_is_one_its_latest() {
        let place = tempfile::tempdir().unwrap();
        let (run, _) = RunFolder::create(Some(place.path()), None).unwrap();
        assert!(resolve_checkpoint(place.path()).is_err());
        let checkpoints = run.checkpoints();
        write_whole(&checkpoints.latest(), b"latest").unwrap();
        assert_eq!(resolve_checkpoint(place.path()).unwrap(), checkpoints.latest());
        write_whole(&checkpoints.best(), b"best").unwrap();
        assert_eq!(resolve_checkpoint(place.path()).unwrap(), checkpoints.best());
        assert_eq!(RunFolder::containing(&checkpoints.latest()).unwrap().path(), place.path().canonicalize().unwrap());
    }

    #[test]
    fn names_of_runs_cannot_leave_the_folder_of_runs() {
        let refusal = create_unused(Some("../elsewhere")).unwrap_err().to_string();
        assert!(refusal.contains("--name ../elsewhere"), "{refusal}");
    }
}
