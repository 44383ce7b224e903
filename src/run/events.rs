//! TensorBoard event files, written with those parts of tensorboard-rs that return errors.

use std::fs::{self, File, OpenOptions};
use std::io::{BufReader, BufWriter, ErrorKind};
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use anyhow::{Context, Result};
use protobuf::Message;
use tensorboard_proto::event::{Event, SessionLog, SessionLog_SessionStatus};
use tensorboard_proto::summary::{Summary, Summary_Value};
use tensorboard_rs::record_writer::RecordWriter;

use super::file::expect_named;
use super::output::{make_own, sync_folder};
use super::records::length_up_to;

/// The prefix and the suffix of the names of event files.
const NAME: [&str; 2] = ["events.out.tfevents.", ".shadow-repose"];

/// An event file being written.
pub(super) struct EventFile {
    path: PathBuf,
    /// The file that `writer` writes to.
    file: File,
    writer: RecordWriter<BufWriter<File>>,
}

impl EventFile {
    /// Creates an event file in `folder`. TensorBoard reads all event files of a folder as one run, in the order of their names,
    /// and discards values from earlier files at `first_step` and later.
    ///
    /// # Errors
    /// Fails if the file cannot be written.
    pub(super) fn create(folder: &Path, first_step: u64) -> Result<Self> {
        let [begin, end] = NAME;
        // Readers take the files in the order of their names, and clocks are unreliable.
        let mut seconds = event_files(folder)?.iter().map(|(begun, _)| begun + 1).fold(now() as u64, u64::max);
        let (path, file) = loop {
            let path = folder.join(format!("{begin}{seconds:010}.{:07}{end}", std::process::id()));
            match File::create_new(&path) {
                Err(error) if error.kind() == ErrorKind::AlreadyExists => seconds += 1,
                file => break (path.clone(), file.with_context(|| format!("cannot create {}", path.display()))?),
            }
        };
        let writer = RecordWriter::new(BufWriter::new(file.try_clone()?));
        let mut events = Self { path, file, writer };
        match events.begin(first_step).and_then(|()| Ok(sync_folder(&events.path)?)) {
            Ok(()) => Ok(events),
            Err(error) => {
                let _ = fs::remove_file(&events.path);
                Err(error)
            }
        }
    }

    fn begin(&mut self, first_step: u64) -> Result<()> {
        let mut version = Event::new();
        version.set_file_version("brain.Event:2".into());
        self.write(version, 0)?;
        let mut start = Event::new();
        let mut session = SessionLog::new();
        session.set_status(SessionLog_SessionStatus::START);
        start.set_session_log(session);
        self.write(start, first_step)
    }

    /// Adds the values of one step and flushes. `NaN` values are left out.
    ///
    /// # Errors
    /// Fails if the file cannot be written.
    pub(super) fn scalars(&mut self, step: u64, values: &[(impl AsRef<str>, f64)]) -> Result<()> {
        let mut summary = Summary::new();
        for (tag, number) in values.iter().filter(|(_, number)| !number.is_nan()) {
            let mut value = Summary_Value::new();
            value.set_tag(tag.as_ref().to_owned());
            value.set_simple_value(*number as f32);
            summary.mut_value().push(value);
        }
        let mut event = Event::new();
        event.set_summary(summary);
        self.write(event, step)
    }

    fn write(&mut self, mut event: Event, step: u64) -> Result<()> {
        event.set_wall_time(now());
        event.set_step(step as i64);
        let bytes = event.write_to_bytes()?;
        let written = self.writer.write(&bytes).and_then(|()| self.writer.flush());
        written.with_context(|| format!("cannot write {}", self.path.display()))
    }

    /// Ensures that all events are on the disk, in a file that still has its name.
    ///
    /// # Errors
    /// Fails if the file cannot be written, or was deleted.
    pub(super) fn sync(&self) -> Result<()> {
        expect_named(&self.path, &self.file)?;
        self.file.sync_data().with_context(|| format!("cannot write {}", self.path.display()))
    }
}

/// Cuts off the events after `last_step`, and those that a crash left incomplete, in every event file of `folder`, so that no
/// reader finds a step twice.
///
/// # Errors
/// Fails if a file cannot be read or written.
pub(super) fn cut_off_after(folder: &Path, last_step: u64) -> Result<()> {
    for (_, path) in event_files(folder)? {
        let cut = || {
            let file = File::open(&path)?;
            let kept = length_up_to(BufReader::new(&file), last_step)?;
            if kept == file.metadata()?.len() {
                return Ok(());
            }
            make_own(&path)?;
            OpenOptions::new().write(true).open(&path)?.set_len(kept)
        };
        cut().with_context(|| format!("cannot shorten {}", path.display()))?;
    }
    Ok(())
}

/// Returns this program's event files in `folder`, each with the seconds in its name.
fn event_files(folder: &Path) -> Result<Vec<(u64, PathBuf)>> {
    let [begin, end] = NAME;
    let entries = fs::read_dir(folder).with_context(|| format!("cannot read {}", folder.display()))?;
    let ours = entries.flatten().filter_map(|entry| {
        let name = entry.file_name();
        let (seconds, _) = name.to_str()?.strip_prefix(begin)?.strip_suffix(end)?.split_once('.')?;
        // Bounded, so that adding to it cannot overflow.
        let seconds = seconds.parse().ok().filter(|&seconds: &u64| seconds < 1 << 40)?;
        Some((seconds, entry.path()))
    });
    Ok(ours.collect())
}

/// Returns the seconds since 1970.
fn now() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |elapsed| elapsed.as_secs_f64())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(path: &Path) -> Vec<Event> {
        let bytes = fs::read(path).unwrap();
        let (mut rest, mut found) = (&bytes[..], Vec::new());
        while !rest.is_empty() {
            let length = u64::from_le_bytes(rest[..8].try_into().unwrap()) as usize;
            found.push(Event::parse_from_bytes(&rest[12..12 + length]).unwrap());
            rest = &rest[16 + length..];
        }
        found
    }

    #[test]
    fn steps_after_the_checkpoint_and_half_written_events_are_cut_off() {
        let place = tempfile::tempdir().unwrap();
        let mut events = EventFile::create(place.path(), 0).unwrap();
        (1..=4).for_each(|step| events.scalars(10 * step, &[("a", step as f64)]).unwrap());
        let path = events.path.clone();
        let half = [fs::read(&path).unwrap(), vec![9; 30]].concat();
        fs::write(&path, half).unwrap();
        for (last, expected) in [(40, 4), (25, 2)] {
            cut_off_after(place.path(), last).unwrap();
            let steps: Vec<i64> = read(&path)[2..].iter().map(Event::get_step).collect();
            assert_eq!(steps, (1..=expected).map(|step| 10 * step).collect::<Vec<i64>>());
        }
        // A second file of the same second and process.
        let more = EventFile::create(place.path(), 21).unwrap();
        assert_ne!(more.path, path);
    }

    #[test]
    fn an_event_file_holds_its_version_the_first_step_and_the_values_that_are_known() {
        let place = tempfile::tempdir().unwrap();
        let mut events = EventFile::create(place.path(), 7).unwrap();
        events.scalars(9, &[("reward/fall", 0.25), ("eval/goals", f64::NAN)]).unwrap();
        let path = std::fs::read_dir(place.path()).unwrap().next().unwrap().unwrap().path();
        let found = read(&path);
        assert_eq!(found.len(), 3);
        assert_eq!(found[0].get_file_version(), "brain.Event:2");
        assert_eq!(
            (found[1].get_step(), found[1].get_session_log().get_status()),
            (7, SessionLog_SessionStatus::START)
        );
        let values = found[2].get_summary().get_value();
        assert_eq!((found[2].get_step(), values.len()), (9, 1));
        assert_eq!((values[0].get_tag(), values[0].get_simple_value()), ("reward/fall", 0.25));
    }
}
