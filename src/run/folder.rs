//! The folder of a run and what lies in it; files are written whole or not at all.

use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};

/// Where runs go when nothing else is said.
const RUNS: &str = "runs/shadow-hand-repose";

const CONFIG: &str = "config.toml";
const CHECKPOINTS: &str = "checkpoints";
const LATEST: &str = "latest";
const BEST: &str = "best";

/// `config.toml`, `version.txt`, `metrics.csv`, event files, `checkpoints/{latest,best}.safetensors`.
#[derive(Clone, Debug)]
pub struct RunFolder {
    path: PathBuf,
}

impl RunFolder {
    /// A new run's folder: `path`, or runs/shadow-hand-repose/DATE-TIME[-NAME].
    ///
    /// # Errors
    /// A folder that already holds a run, or cannot be written to.
    pub fn create(path: Option<&Path>, name: Option<&str>) -> Result<Self> {
        let path = match path {
            Some(path) => path.to_owned(),
            None => unused_path(name)?,
        };
        let holds_run = path.join(CONFIG).exists() || path.join(CHECKPOINTS).exists();
        ensure!(
            !holds_run,
            "{} already holds a run; go on with it by --resume {0}, or name another folder",
            path.display()
        );
        let checkpoints = path.join(CHECKPOINTS);
        fs::create_dir_all(&checkpoints)
            .with_context(|| format!("cannot create the run folder {}", checkpoints.display()))?;
        Ok(Self { path })
    }

    /// The folder of an existing run that `place` is, or that the checkpoint `place` lies in.
    ///
    /// # Errors
    /// Nothing there, or a file outside a run folder.
    pub fn containing(place: &Path) -> Result<Self> {
        ensure!(place.exists(), "{}: there is no such run folder or checkpoint", place.display());
        let path = if place.is_dir() {
            place.to_owned()
        } else {
            let place = place.canonicalize().with_context(|| format!("cannot read {}", place.display()))?;
            let checkpoints = place.parent().filter(|parent| parent.ends_with(CHECKPOINTS));
            match checkpoints.and_then(Path::parent) {
                Some(run) => run.to_owned(),
                None => bail!("{} does not lie in the {CHECKPOINTS} folder of a run", place.display()),
            }
        };
        Ok(Self { path })
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The checkpoint to go on from by default.
    pub fn latest(&self) -> PathBuf {
        self.checkpoint(LATEST)
    }

    /// The checkpoint that scored best.
    pub fn best(&self) -> PathBuf {
        self.checkpoint(BEST)
    }

    fn checkpoint(&self, name: &str) -> PathBuf {
        self.path.join(CHECKPOINTS).join(format!("{name}.safetensors"))
    }

    /// Writes the configuration and the facts about the program.
    ///
    /// # Errors
    /// A folder that cannot be written to.
    pub fn describe(&self, config: &str, version: &str) -> Result<()> {
        write_whole(&self.path.join(CONFIG), config.as_bytes())?;
        write_whole(&self.path.join("version.txt"), version.as_bytes())
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
    let run = RunFolder::containing(place)?;
    let found = [run.best(), run.latest()].into_iter().find(|path| path.exists());
    found.with_context(|| format!("{} holds no checkpoint", place.display()))
}

/// The checkpoint of the newest run that has one.
///
/// # Errors
/// There is none.
pub fn newest_checkpoint() -> Result<PathBuf> {
    let runs = fs::read_dir(RUNS).into_iter().flatten().flatten().map(|entry| entry.path());
    // By the time of the checkpoint, so that a run that was resumed counts as new.
    let newest = runs
        .filter_map(|run| resolve_checkpoint(&run).ok())
        .max_by_key(|path| fs::metadata(path).and_then(|facts| facts.modified()).ok());
    newest.with_context(|| {
        format!("there is no run with a checkpoint in {RUNS}; train one first, or name one with --ckpt")
    })
}

/// The text of a file.
///
/// # Errors
/// A file that cannot be read or is not UTF-8.
pub fn read_text(path: &Path) -> Result<String> {
    fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))
}

/// The bytes of a file.
///
/// # Errors
/// A file that cannot be read.
pub fn read_bytes(path: &Path) -> Result<Vec<u8>> {
    fs::read(path).with_context(|| format!("cannot read {}", path.display()))
}

/// Writes a file under another name, and renames it when it is complete and on the disk: whoever looks finds the whole old
/// file or the whole new one.
///
/// # Errors
/// A place that cannot be written to.
pub fn write_whole(path: &Path, bytes: &[u8]) -> Result<()> {
    let mut partial = path.as_os_str().to_owned();
    partial.push(".partial");
    let write = || {
        let mut file = File::create(&partial)?;
        file.write_all(bytes)?;
        file.sync_all()?;
        fs::rename(&partial, path)
    };
    write().with_context(|| format!("cannot write {}", path.display()))
}

fn unused_path(name: Option<&str>) -> Result<PathBuf> {
    let plain = |c: char| c.is_alphanumeric() || "-_.".contains(c);
    let name = name.unwrap_or_default();
    ensure!(name.chars().all(plain), "--name {name}: may hold letters, digits, `-`, `_` and `.` only");
    let time = jiff::Zoned::now().strftime("%Y-%m-%d_%H-%M-%S").to_string();
    let suffix = if name.is_empty() { String::new() } else { format!("-{name}") };
    let candidates = (1..).map(|attempt| match attempt {
        1 => format!("{time}{suffix}"),
        _ => format!("{time}{suffix}-{attempt}"),
    });
    let mut paths = candidates.map(|candidate| Path::new(RUNS).join(candidate));
    Ok(paths.find(|path| !path.exists()).expect("the attempts do not end"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_that_holds_a_run_is_not_taken_again() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("run");
        RunFolder::create(Some(&path), None).unwrap().describe("a = 1", "1").unwrap();
        let refusal = RunFolder::create(Some(&path), None).unwrap_err().to_string();
        assert!(refusal.contains("already holds a run"), "{refusal}");
        assert_eq!(fs::read_to_string(path.join("config.toml")).unwrap(), "a = 1");
    }

    #[test]
    fn a_run_folder_means_its_best_checkpoint_and_before_there_is_one_its_latest() {
        let place = tempfile::tempdir().unwrap();
        let run = RunFolder::create(Some(place.path()), None).unwrap();
        assert!(resolve_checkpoint(place.path()).is_err());
        write_whole(&run.latest(), b"latest").unwrap();
        assert_eq!(resolve_checkpoint(place.path()).unwrap(), run.latest());
        write_whole(&run.best(), b"best").unwrap();
        assert_eq!(resolve_checkpoint(place.path()).unwrap(), run.best());
        assert_eq!(RunFolder::containing(&run.latest()).unwrap().path(), place.path().canonicalize().unwrap());
    }

    #[test]
    fn a_file_that_is_written_leaves_nothing_else_behind() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("x.safetensors");
        write_whole(&path, b"one").unwrap();
        write_whole(&path, b"two").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"two");
        assert_eq!(fs::read_dir(place.path()).unwrap().count(), 1);
    }

    #[test]
    fn names_of_runs_cannot_leave_the_folder_of_runs() {
        assert!(unused_path(Some("../elsewhere")).is_err());
        assert!(unused_path(Some("good-name_1.0")).is_ok());
    }
}
