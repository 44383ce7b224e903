//! The folder of a run and its files.

use std::ffi::{OsStr, OsString};
use std::fs::{self, DirEntry};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use anyhow::{Context, Result, bail, ensure};

use super::checkpoints::{CHECKPOINTS, Checkpoints, expect_no_link, modified};
use super::hparams::HPARAMS;
use crate::os::{
    Cannot, Folder, LOCK, Locked, is_abandoned, nicety, read_text, same_file, shown, sync_folder,
    unused_name, write_whole,
};

/// The default folder of runs.
pub const RUNS: &str = "runs/shadow-hand-repose";

pub const CONFIG: &str = "config.toml";
pub const VERSION: &str = "version.txt";
pub const POLICY: &str = "policy.safetensors";
pub const DIVERGED: &str = "diverged";
/// A file with this name asks the training run to stop.
const STOP: &str = "stop";
/// A file with this name says that the training run is not to be continued.
pub const FINISHED: &str = "finished";
/// A file or folder that is not complete yet.
const PARTIAL: &str = ".shadow-repose-*";
/// The names of a run's files and folders. A star stands for anything.
pub const OURS: [&str; 11] = [
    CONFIG,
    VERSION,
    POLICY,
    LOCK,
    METRICS,
    DIVERGED,
    HPARAMS,
    "metrics.before-*.csv",
    "events.out.*",
    CHECKPOINTS,
    PARTIAL,
];

/// The most files in the folder `diverged`. More would not help to find the cause, but would fill the disk.
const MOST_DUMPS: usize = 1000;
pub const METRICS: &str = "metrics.csv";

/// Whether a name is one of these, in which a star stands for anything.
pub fn is_one_of(name: &OsStr, patterns: &[&str]) -> bool {
    let name = name.to_string_lossy();
    patterns
        .iter()
        .any(|pattern| match pattern.split_once('*') {
            Some((begin, end)) => name.starts_with(begin) && name.ends_with(end),
            None => name == *pattern,
        })
}

/// A run folder: `config.toml`, `version.txt`, `metrics.csv`, event files, `policy.safetensors`, checkpoints. A training run holds
/// its folder and the checkpoints open from [`RunFolder::lock`] on, so that it writes into no other.
#[derive(Clone, Debug)]
pub struct RunFolder {
    folder: Folder,
    /// Its checkpoints.
    pub checkpoints: Checkpoints,
    /// The time of a file `stop` that was there before this session.
    stop_before: Option<SystemTime>,
}

impl RunFolder {
    pub(super) fn at(path: PathBuf) -> Self {
        Self {
            checkpoints: Checkpoints {
                folder: Folder::at(path.join(CHECKPOINTS)),
            },
            stop_before: modified(&path.join(STOP)),
            folder: Folder::at(path),
        }
    }

    /// The path by which its files are reached.
    pub fn path(&self) -> &Path {
        &self.folder.path
    }

    /// The path where it lies now.
    pub fn place(&self) -> PathBuf {
        self.folder.place()
    }

    /// Where it lies now, and where its checkpoints lie if that is elsewhere.
    pub fn whereabouts(&self) -> String {
        let mut text = self.place().display().to_string();
        let checkpoints = shown(&self.checkpoints.folder.place());
        if !same_file(&checkpoints, &self.path().join(CHECKPOINTS)) {
            text += &format!(", and its checkpoints lie in {}", checkpoints.display());
        }
        text
    }

    /// Creates the folder of a new run: `path`, or runs/shadow-hand-repose/DATE-TIME[-NAME].
    ///
    /// # Errors
    /// Fails if the folder already holds a run, lies inside one, or cannot be written to.
    pub fn create(path: Option<&Path>, name: Option<&str>) -> Result<(Self, Locked)> {
        let mut run = Self::at(match path {
            Some(path) => path.to_owned(),
            None => create_unused(name)?,
        });
        run.expect_free()?;
        let lock = run.lock()?;
        sync_folder(&run.place());
        // Another training run may have started and ended in the meantime.
        run.expect_free()?;
        let lock = run.claim(lock)?;
        Ok((run, lock))
    }

    /// Checks that the folder contains nothing of a run, and that it does not lie inside a run.
    fn expect_free(&self) -> Result<()> {
        let names: Vec<OsString> = self.entries()?.iter().map(DirEntry::file_name).collect();
        // A training run was killed here before its first checkpoint was complete: the same command may begin again.
        let is_half_begun = names
            .iter()
            .all(|name| is_one_of(name, &[LOCK, POLICY, CHECKPOINTS, PARTIAL]))
            && self.path().join(LOCK).exists()
            && !self.checkpoints.begun();
        // An unfinished trace does not belong to a run.
        if let Some(name) = names.iter().find(|name| !is_one_of(name, &[PARTIAL]))
            && !is_half_begun
        {
            bail!(
                "{} already holds a run, or part of one ({}); resume it, or choose another folder",
                self.place().display(),
                name.to_string_lossy()
            );
        }
        let whole = std::path::absolute(self.place()).cannot("find", self.path())?;
        let there = whole
            .ancestors()
            .find_map(|folder| folder.canonicalize().ok())
            .unwrap_or_default();
        let above = there.ancestors().skip(usize::from(whole.exists()));
        for folder in above.map(|path| Self::at(path.to_owned())) {
            ensure!(
                !folder.holds_a_run(),
                "{} lies inside the run {}",
                self.place().display(),
                folder.path().display()
            );
        }
        Ok(())
    }

    /// Whether a run has saved anything here, or was locked here.
    pub(super) fn holds_a_run(&self) -> bool {
        self.checkpoints.begun() || self.path().join(LOCK).exists()
    }

    /// Creates a run folder among the temporary files, for a run whose own folder cannot be written to.
    ///
    /// # Errors
    /// Fails if the folder cannot be created.
    pub fn for_now() -> Result<Self> {
        let folder = tempfile::Builder::new()
            .prefix("shadow-repose-")
            .tempdir()
            .cannot("create a folder in", &std::env::temp_dir())?;
        let mut run = Self::at(folder.keep());
        run.checkpoints.hold()?;
        Ok(run)
    }

    /// Removes the files of a run that could not start, and its folder if nothing else is in it.
    pub fn clear(&self) {
        for entry in self.entries().into_iter().flatten() {
            nicety(fs::remove_file(entry.path()));
        }
        for folder in [CHECKPOINTS, HPARAMS, ""] {
            nicety(fs::remove_dir(self.place().join(folder)));
        }
    }

    /// Removes a folder in which nothing could be saved.
    pub fn remove(self) {
        nicety(fs::remove_dir_all(self.place()));
    }

    /// The existing run folder that `place` belongs to: `place` is the folder itself, its checkpoints folder, or a
    /// checkpoint in it.
    ///
    /// # Errors
    /// Fails if `place` does not exist, or is a file outside a run folder.
    pub fn containing(place: &Path) -> Result<Self> {
        ensure!(
            place.exists(),
            "{}: no such run folder or checkpoint",
            place.display()
        );
        let whole = place.canonicalize().cannot("read", place)?;
        let folder = if place.is_dir() {
            Some(&*whole)
        } else {
            whole.parent()
        };
        let run = match folder
            .filter(|folder| folder.ends_with(CHECKPOINTS))
            .and_then(Path::parent)
        {
            Some(run) => Self::at(run.to_owned()),
            None if place.is_dir() => Self::at(place.to_owned()),
            None => bail!(
                "{} does not lie in the checkpoints folder of a run",
                whole.display()
            ),
        };
        // A folder that may not be listed or entered would look empty.
        let folder = &run.checkpoints.folder.path;
        match fs::read_dir(folder).and_then(|_| fs::metadata(folder.join("."))) {
            Err(error) if error.kind() != ErrorKind::NotFound => Err(error).cannot("read", folder),
            _ => Ok(run),
        }
    }

    /// Locks the folder against other training processes for as long as the result lives, and holds it open. Creates the folder, the
    /// folder of checkpoints and the lock file if they are missing, and changes nothing else.
    ///
    /// # Errors
    /// Fails if another training process uses the folder, if it contains a link, or if it cannot be written to. Fails if the folder
    /// was held and deleted, and something else lies there now.
    pub fn lock(&mut self) -> Result<Locked> {
        self.folder.hold()?;
        // The folder is untrusted, and will be written to.
        for entry in self.entries()? {
            let path = entry.path();
            let kind = entry.file_type().cannot("read", &path)?;
            ensure!(
                kind.is_file() || kind.is_dir(),
                "{}: neither a file nor a folder; links in a run folder are not followed",
                shown(&path).display()
            );
        }
        let lock = Locked::acquire(self.path())?;
        self.checkpoints.folder.name = self.path().join(CHECKPOINTS);
        self.checkpoints.hold()?;
        Ok(lock)
    }

    /// Prepares a locked folder for writing: removes files that a crash left incomplete, and signs the lock.
    ///
    /// # Errors
    /// Fails if the folder cannot be written to.
    pub fn claim(&self, lock: Locked) -> Result<Locked> {
        for entry in self.entries()? {
            if is_abandoned(&entry) {
                nicety(fs::remove_file(entry.path()));
            }
        }
        lock.sign()
    }

    /// The files of the run: files with the names of a run's files, and all in `checkpoints`, `diverged` and `hparams`.
    /// Other files in the folder are left out.
    fn entries(&self) -> Result<Vec<DirEntry>> {
        let mut found = Vec::new();
        for name in ["", CHECKPOINTS, DIVERGED, HPARAMS] {
            let folder = self.path().join(name);
            if !folder.is_dir() {
                continue;
            }
            for entry in fs::read_dir(&folder).cannot("read", &folder)? {
                let entry = entry.cannot("read", &folder)?;
                if !name.is_empty() || is_one_of(&entry.file_name(), &OURS) {
                    found.push(entry);
                }
            }
        }
        Ok(found)
    }

    /// Whether the user asks by an empty file `stop` to end the training run. The file is then removed. Any other file of that name,
    /// and one that was there before, is the user's.
    pub fn take_stop(&self) -> bool {
        let path = self.path().join(STOP);
        let is_request =
            fs::symlink_metadata(&path).is_ok_and(|facts| facts.is_file() && facts.len() == 0);
        is_request && modified(&path) != self.stop_before && fs::remove_file(path).is_ok()
    }

    /// Writes or removes the file that marks a training run as not to be continued: all steps are made, or a file `stop` has ended
    /// it. If that fails, a script at most continues what is finished.
    pub fn mark_finished(&self, finished: bool) {
        let path = self.path().join(FINISHED);
        // A file with content is the user's.
        if fs::metadata(&path).is_ok_and(|facts| facts.len() > 0) {
            return;
        }
        nicety(if finished {
            write_whole(&path, b"")
        } else {
            fs::remove_file(path).map_err(Into::into)
        });
    }

    /// The path of the policy without its training state: the best one, or the latest if none was scored yet.
    pub fn policy(&self) -> PathBuf {
        self.path().join(POLICY)
    }

    /// Writes a report of what led to a diverged state, unless there are very many already.
    ///
    /// # Errors
    /// Fails if the folder cannot be written to.
    pub fn dump(&self, name: &str, text: &str) -> Result<()> {
        let folder = self.path().join(DIVERGED);
        expect_no_link(&folder)?;
        fs::create_dir_all(&folder).cannot("create", &folder)?;
        if fs::read_dir(&folder).is_ok_and(|entries| entries.count() >= MOST_DUMPS) {
            return Ok(());
        }
        write_whole(&folder.join(name), text.as_bytes())
    }

    /// The path and the text of the configuration in the folder, or `None` if there is none.
    ///
    /// # Errors
    /// Fails if the file cannot be read.
    pub fn config(&self) -> Result<Option<(PathBuf, String)>> {
        let path = self.path().join(CONFIG);
        if !path.exists() {
            return Ok(None);
        }
        Ok(Some((shown(&path), read_text(&path)?)))
    }

    /// Writes the configuration and the facts about the program, each only if the folder does not hold the same text already.
    ///
    /// # Errors
    /// Fails if the folder cannot be written to.
    pub fn describe(&self, config: &str, version: &str) -> Result<()> {
        for (name, text) in [(CONFIG, config), (VERSION, version)] {
            let path = self.path().join(name);
            if read_text(&path).ok().as_deref() != Some(text) {
                write_whole(&path, text.as_bytes())?;
            }
        }
        Ok(())
    }
}

/// The checkpoint that `place` refers to: `place` itself, or the best checkpoint of a run folder. If there is no
/// best one yet, it is the latest.
///
/// # Errors
/// Fails if there is no checkpoint.
pub fn resolve_checkpoint(place: &Path) -> Result<PathBuf> {
    if !place.is_dir() {
        return Ok(place.to_owned());
    }
    let checkpoints = RunFolder::containing(place)?.checkpoints;
    [checkpoints.best(), checkpoints.latest()]
        .into_iter()
        .find(|path| path.exists())
        .with_context(|| format!("{} holds no checkpoint", place.display()))
}

/// The folder of the newest run that has a checkpoint, if any.
pub fn newest_run() -> Option<PathBuf> {
    let runs = fs::read_dir(RUNS)
        .into_iter()
        .flatten()
        .flatten()
        .map(|entry| RunFolder::at(entry.path()));
    // Ordered by the time of the latest checkpoint, so that a resumed run counts as new.
    runs.filter_map(|run| Some((modified(&run.checkpoints.latest())?, run.place())))
        .max()
        .map(|(_, path)| path)
}

/// Creates a run folder in the default folder of runs, under a name from the current time that no other run has.
fn create_unused(name: Option<&str>) -> Result<PathBuf> {
    let plain = |c: char| c.is_alphanumeric() || "-_.".contains(c);
    let name = name.unwrap_or_default();
    ensure!(
        name.chars().all(plain),
        "the name {name} of a run may contain only letters, digits, `-`, `_` and `.`"
    );
    fs::create_dir_all(RUNS).cannot("create the folder of runs", Path::new(RUNS))?;
    let mut unique = jiff::Zoned::now().strftime("%Y-%m-%d_%H-%M-%S").to_string();
    if !name.is_empty() {
        unique += &format!("-{name}");
    }
    let path = Path::new(RUNS).join(unique);
    loop {
        let path = unused_name(&path);
        match fs::create_dir(&path) {
            Err(error) if error.kind() == ErrorKind::AlreadyExists => {}
            created => {
                return created
                    .cannot("create the run folder", &path)
                    .map(|()| path);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_that_holds_a_run_is_not_taken_again() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("run");
        RunFolder::create(Some(&path), None)
            .unwrap()
            .0
            .describe("a = 1", "1")
            .unwrap();
        let refusal = RunFolder::create(Some(&path), None)
            .unwrap_err()
            .to_string();
        assert!(refusal.contains("already holds a run"), "{refusal}");
        assert_eq!(
            fs::read_to_string(path.join("config.toml")).unwrap(),
            "a = 1"
        );
    }

    #[test]
    fn no_link_in_a_run_folder_is_followed() {
        let place = tempfile::tempdir().unwrap();
        let victim = place.path().join("victim");
        fs::write(&victim, "precious").unwrap();
        for name in [
            "run.lock",
            "metrics.csv",
            "events.out.tfevents.1.2.shadow-repose",
            "checkpoints/x.partial",
        ] {
            let mut run = RunFolder::at(place.path().join("run"));
            fs::create_dir_all(&run.checkpoints.folder.path).unwrap();
            std::os::unix::fs::symlink(&victim, run.path().join(name)).unwrap();
            let refusal = run.lock().unwrap_err().to_string();
            assert!(
                refusal.contains(name) && refusal.contains("not followed"),
                "{refusal}"
            );
            fs::remove_dir_all(run.place()).unwrap();
        }
        // A link that appears later is replaced, not written through.
        std::os::unix::fs::symlink(&victim, place.path().join("config.toml.partial")).unwrap();
        RunFolder::at(place.path().into())
            .describe("a = 1", "1")
            .unwrap();
        assert_eq!(fs::read_to_string(&victim).unwrap(), "precious");
    }

    #[test]
    fn what_else_lies_in_the_folder_of_a_run_is_left_alone() {
        let place = tempfile::tempdir().unwrap();
        fs::write(place.path().join("download.partial"), "mine").unwrap();
        std::os::unix::fs::symlink("/nowhere", place.path().join("link")).unwrap();
        RunFolder::create(Some(place.path()), None).unwrap();
        assert_eq!(
            fs::read_to_string(place.path().join("download.partial")).unwrap(),
            "mine"
        );
    }

    #[test]
    fn what_a_crash_left_half_written_is_removed() {
        let place = tempfile::tempdir().unwrap();
        let (mut run, lock) = RunFolder::create(Some(place.path()), None).unwrap();
        let left = run
            .checkpoints
            .folder
            .path
            .join(".shadow-repose-999999999-0.partial");
        fs::write(&left, "half").unwrap();
        let living = crate::os::OutputFile::create(&place.path().join("trace")).unwrap();
        assert!(run.checkpoints.newest_first().is_empty());
        drop(lock);
        let lock = run.lock().unwrap();
        assert!(left.exists(), "locking alone removes nothing");
        run.claim(lock).unwrap();
        assert!(!left.exists());
        living.finish(b"all of a trace").unwrap();
    }

    #[test]
    fn a_folder_with_any_part_of_a_run_or_inside_one_is_not_taken() {
        let place = tempfile::tempdir().unwrap();
        for name in [
            "policy.safetensors",
            "metrics.csv",
            "events.out.tfevents.1.1.x",
        ] {
            let folder = place.path().join(format!("has-{name}"));
            fs::create_dir(&folder).unwrap();
            fs::write(folder.join(name), "foreign").unwrap();
            let refusal = RunFolder::create(Some(&folder), None)
                .unwrap_err()
                .to_string();
            assert!(
                refusal.contains("already holds a run") && refusal.contains(name),
                "{refusal}"
            );
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
        let relative = up.join(run.place().strip_prefix("/").unwrap()).join("new");
        assert!(RunFolder::create(Some(&relative), None).is_err() && !relative.exists());
        for inside in ["checkpoints", "new/deeper"] {
            let refusal = RunFolder::create(Some(&run.place().join(inside)), None)
                .unwrap_err()
                .to_string();
            assert!(
                refusal.contains("lies inside the run") && !run.path().join("new").exists(),
                "{refusal}"
            );
        }
    }

    #[test]
    fn the_folder_of_its_checkpoints_means_the_run() {
        let place = tempfile::tempdir().unwrap();
        let (run, _lock) = RunFolder::create(Some(&place.path().join("run")), None).unwrap();
        write_whole(&run.checkpoints.latest(), b"latest").unwrap();
        let found = RunFolder::containing(&run.checkpoints.folder.path).unwrap();
        assert!(same_file(found.path(), run.path()), "{found:?}");
        assert!(same_file(
            &resolve_checkpoint(&run.checkpoints.folder.path).unwrap(),
            &run.checkpoints.latest()
        ));
    }

    #[test]
    fn a_run_folder_means_its_best_checkpoint_and_before_there_is_one_its_latest() {
        let place = tempfile::tempdir().unwrap();
        let (run, _) = RunFolder::create(Some(place.path()), None).unwrap();
        assert!(resolve_checkpoint(place.path()).is_err());
        let checkpoints = &run.checkpoints;
        write_whole(&checkpoints.latest(), b"latest").unwrap();
        let means = |path: &Path| same_file(&resolve_checkpoint(place.path()).unwrap(), path);
        assert!(means(&checkpoints.latest()));
        write_whole(&checkpoints.best(), b"best").unwrap();
        assert!(means(&checkpoints.best()));
        assert_eq!(
            RunFolder::containing(&checkpoints.latest())
                .unwrap()
                .place(),
            place.path().canonicalize().unwrap()
        );
    }

    #[test]
    fn names_of_runs_cannot_leave_the_folder_of_runs() {
        let refusal = create_unused(Some("../elsewhere")).unwrap_err().to_string();
        assert!(refusal.contains("the name ../elsewhere"), "{refusal}");
    }
}
