//! The folder of a run and what lies in it.

use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use anyhow::{Context, Result, bail, ensure};

use super::file::write_whole;

/// Where runs go when nothing else is said.
const RUNS: &str = "runs/shadow-hand-repose";

const CONFIG: &str = "config.toml";
const VERSION: &str = "version.txt";
pub(super) const METRICS: &str = "metrics.csv";
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
            None => create_unused(name)?,
        };
        let checkpoints = path.join(CHECKPOINTS);
        let begun = fs::read_dir(&checkpoints).is_ok_and(|mut entries| entries.next().is_some());
        let written = [CONFIG, VERSION, METRICS].iter().any(|file| path.join(file).exists());
        ensure!(
            !begun && !written,
            "{} already holds a run; go on with it by --resume, or name another folder",
            path.display()
        );
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
        write_whole(&self.path.join(VERSION), version.as_bytes())
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
    let runs = fs::read_dir(RUNS).into_iter().flatten().flatten().map(|entry| RunFolder { path: entry.path() });
    // By the time of the latest checkpoint, so that a run that was resumed counts as new.
    let newest = runs
        .filter_map(|run| Some((modified(&run.latest())?, resolve_checkpoint(&run.path).ok()?)))
        .max()
        .map(|(_, checkpoint)| checkpoint);
    newest.with_context(|| {
        format!("there is no run with a checkpoint in {RUNS}; train one first, or name one with --ckpt")
    })
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
    fn names_of_runs_cannot_leave_the_folder_of_runs() {
        let refusal = create_unused(Some("../elsewhere")).unwrap_err().to_string();
        assert!(refusal.contains("--name ../elsewhere"), "{refusal}");
    }
}
