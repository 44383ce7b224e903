//! TensorBoard event files, from the parts of tensorboard-rs that return their errors.

use std::fs::File;
use std::io::BufWriter;
use std::path::Path;
use std::time::{SystemTime, UNIX_EPOCH};

use anyhow::{Context, Result};
use protobuf::Message;
use tensorboard_proto::event::{Event, SessionLog, SessionLog_SessionStatus};
use tensorboard_proto::summary::{Summary, Summary_Value};
use tensorboard_rs::record_writer::RecordWriter;

/// An event file that is being written.
pub struct EventFile {
    writer: RecordWriter<BufWriter<File>>,
}

impl EventFile {
    /// A new event file in `folder`. TensorBoard reads all such files of a folder as one run, in the order of their names,
    /// and forgets what earlier ones say of `first_step` and later.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn create(folder: &Path, first_step: u64) -> Result<Self> {
        let seconds = now() as u64;
        let path = folder.join(format!("events.out.tfevents.{seconds:010}.{:07}.shadow-repose", std::process::id()));
        let file = File::create_new(&path).with_context(|| format!("cannot create {}", path.display()))?;
        let mut events = Self { writer: RecordWriter::new(BufWriter::new(file)) };
        let mut version = Event::new();
        version.set_file_version("brain.Event:2".into());
        events.write(version, 0)?;
        let mut start = Event::new();
        let mut session = SessionLog::new();
        session.set_status(SessionLog_SessionStatus::START);
        start.set_session_log(session);
        events.write(start, first_step)?;
        Ok(events)
    }

    /// Adds the values of one step and flushes; values that are `NaN` are left out.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn scalars(&mut self, step: u64, values: &[(&str, f64)]) -> Result<()> {
        let mut summary = Summary::new();
        for (tag, number) in values.iter().filter(|(_, number)| !number.is_nan()) {
            let mut value = Summary_Value::new();
            value.set_tag((*tag).to_owned());
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
        self.writer.write(&event.write_to_bytes()?)?;
        self.writer.flush()?;
        Ok(())
    }
}

/// Seconds since 1970.
fn now() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |elapsed| elapsed.as_secs_f64())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_event_file_holds_its_version_the_first_step_and_the_values_that_are_known() {
        let place = tempfile::tempdir().unwrap();
        let mut events = EventFile::create(place.path(), 7).unwrap();
        events.scalars(9, &[("reward/fall", 0.25), ("eval/goals", f64::NAN)]).unwrap();
        let path = std::fs::read_dir(place.path()).unwrap().next().unwrap().unwrap().path();
        let bytes = std::fs::read(path).unwrap();
        let (mut rest, mut found) = (&bytes[..], Vec::new());
        // A record: length, its checksum, the event, its checksum.
        while !rest.is_empty() {
            let length = u64::from_le_bytes(rest[..8].try_into().unwrap()) as usize;
            found.push(Event::parse_from_bytes(&rest[12..12 + length]).unwrap());
            rest = &rest[16 + length..];
        }
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
