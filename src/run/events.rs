//! TensorBoard event files, written with those parts of tensorboard-rs that return errors.

use std::fs::{self, File, OpenOptions};
use std::io::{BufReader, BufWriter};
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use anyhow::Result;
use protobuf::Message;
use tensorboard_proto::event::{
    Event, Event_oneof_what as What, SessionLog, SessionLog_SessionStatus,
};
use tensorboard_proto::summary::{Summary, Summary_Value, Summary_Value_oneof_value as Content};
use tensorboard_rs::record_writer::RecordWriter;

use super::checkpoints::numbered_files;
use super::histogram::Histogram;
use super::records::length_up_to;
use super::summary::{Descriptions, layout, text, value};
use crate::os::{Cannot, expect_named, make_own, sync, sync_folder};

/// The prefix and the suffix of the names of event files.
const NAME: [&str; 2] = ["events.out.tfevents.", ".shadow-repose"];

/// An event file being written.
pub struct EventFile {
    path: PathBuf,
    file: File,
    /// The descriptions of the tags that have no value in the file yet.
    undescribed: Descriptions,
}

/// The tag of the settings.
pub const SETTINGS: &str = "settings";

impl EventFile {
    /// Creates an event file in `folder` that begins with the `settings` of the run (TOML), if there are any. TensorBoard reads all
    /// event files of a folder as one run, in the order of their names. It discards values from earlier files at `first_step` and
    /// later.
    ///
    /// # Errors
    /// Fails if the file cannot be written.
    pub fn create(
        folder: &Path,
        first_step: u64,
        tags: &Descriptions,
        settings: &str,
    ) -> Result<Self> {
        let [begin, end] = NAME;
        // Readers take the files in the order of their names, and clocks are unreliable.
        let seconds = event_files(folder)?
            .iter()
            .map(|(begun, _)| begun + 1)
            .fold(now() as u64, u64::max);
        let path = folder.join(format!(
            "{begin}{seconds:010}.{:07}{end}",
            std::process::id()
        ));
        let file = File::create_new(&path).cannot("create", &path)?;
        let mut events = Self {
            path,
            file,
            undescribed: tags.clone(),
        };
        events
            .begin(first_step, settings)
            .inspect_err(|_| drop(fs::remove_file(&events.path)))?;
        Ok(events)
    }

    fn begin(&mut self, first_step: u64, settings: &str) -> Result<()> {
        self.write(What::file_version("brain.Event:2".into()), 0)?;
        let session = SessionLog {
            status: SessionLog_SessionStatus::START,
            ..SessionLog::default()
        };
        self.write(What::session_log(session), first_step)?;
        if !settings.is_empty() {
            let settings = Content::tensor(text(format!("```\n{settings}\n```\n")));
            let settings = value(SETTINGS, settings, self.undescribed.remove(SETTINGS));
            self.values(vec![settings, layout()], first_step)?;
        }
        sync_folder(&self.path);
        Ok(())
    }

    /// Adds the values of one step and flushes. `NaN` values are left out.
    ///
    /// # Errors
    /// Fails if the file cannot be written.
    pub fn iteration(
        &mut self,
        step: u64,
        values: &[(impl AsRef<str>, f64)],
        histograms: &[(&'static str, Histogram)],
    ) -> Result<()> {
        let numbers = values
            .iter()
            .filter(|(_, number)| !number.is_nan())
            .map(|(tag, number)| (tag.as_ref(), Content::simple_value(*number as f32)));
        let histograms = histograms
            .iter()
            .map(|(tag, histogram)| (*tag, Content::histo(histogram.clone())));
        let values = numbers
            .chain(histograms)
            .map(|(tag, content)| value(tag, content, self.undescribed.remove(tag)))
            .collect();
        self.values(values, step)
    }

    /// Adds values as they are.
    ///
    /// # Errors
    /// Fails if the file cannot be written.
    pub fn values(&self, values: Vec<Summary_Value>, step: u64) -> Result<()> {
        self.write(
            What::summary(Summary {
                value: values.into(),
                ..Summary::default()
            }),
            step,
        )
    }

    fn write(&self, what: What, step: u64) -> Result<()> {
        let event = Event {
            wall_time: now(),
            step: step as i64,
            what: Some(what),
            ..Event::default()
        };
        let bytes = event.write_to_bytes()?;
        let mut writer = RecordWriter::new(BufWriter::new(&self.file));
        writer
            .write(&bytes)
            .and_then(|()| writer.flush())
            .cannot("write", &self.path)
    }

    /// Ensures that all events are on the disk, in a file that still has its name.
    ///
    /// # Errors
    /// Fails if the file cannot be written, or was deleted.
    pub fn sync(&mut self) -> Result<()> {
        expect_named(&self.path, &self.file)?;
        sync(&self.file).cannot("write", &self.path)
    }
}

/// Cuts off the events after `last_step`, and events that a crash left incomplete, in every event file of `folder`. So no
/// reader finds a step twice.
///
/// # Errors
/// Fails if a file cannot be read or written.
pub fn cut_off_after(folder: &Path, last_step: u64) -> Result<()> {
    for (_, path) in event_files(folder)? {
        let measure = || {
            let file = File::open(&path)?;
            let kept = length_up_to(BufReader::new(&file), last_step)?;
            Ok((kept, file.metadata()?.len()))
        };
        let (kept, length) = measure().cannot("read", &path)?;
        if kept < length {
            make_own(&path)?;
            let cut = OpenOptions::new().write(true).open(&path);
            cut.and_then(|file| file.set_len(kept))
                .cannot("shorten", &path)?;
        }
    }
    Ok(())
}

/// This program's event files in `folder`, each with the seconds in its name.
pub fn event_files(folder: &Path) -> Result<Vec<(u64, PathBuf)>> {
    let [begin, end] = NAME;
    let begun = |name: &str| {
        let rest = name.strip_prefix(begin)?.strip_suffix(end)?;
        let (seconds, _) = rest.split_once('.')?;
        let seconds: u64 = seconds.parse().ok()?;
        // Bounded, so that adding to it cannot overflow.
        (seconds < 1 << 40).then_some(seconds)
    };
    numbered_files(folder, begun).cannot("read", folder)
}

/// The seconds since 1970.
pub fn now() -> f64 {
    SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .map_or(0.0, |elapsed| elapsed.as_secs_f64())
}

#[cfg(test)]
mod tests {
    use super::super::histogram;
    use tensorboard_proto::layout::Layout;

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

    fn create(folder: &Path, first_step: u64) -> EventFile {
        let tags = ["reward/fall", "histogram/std", SETTINGS];
        let tags = tags.map(|name| (name.to_owned(), format!("of {name}")));
        EventFile::create(folder, first_step, &tags.into(), "[run]\nseed = 3\n").unwrap()
    }

    #[test]
    fn steps_after_the_checkpoint_and_half_written_events_are_cut_off() {
        let place = tempfile::tempdir().unwrap();
        let mut events = create(place.path(), 0);
        (1..=4).for_each(|step| {
            events
                .iteration(10 * step, &[("a", step as f64)], &[])
                .unwrap()
        });
        let path = events.path.clone();
        let half = [fs::read(&path).unwrap(), vec![9; 30]].concat();
        fs::write(&path, half).unwrap();
        for (last, expected) in [(40, 4), (25, 2)] {
            cut_off_after(place.path(), last).unwrap();
            let steps: Vec<i64> = read(&path)[3..].iter().map(Event::get_step).collect();
            assert_eq!(
                steps,
                (1..=expected).map(|step| 10 * step).collect::<Vec<i64>>()
            );
        }
        // A second file of the same second and process.
        let more = create(place.path(), 21);
        assert_ne!(more.path, path);
    }

    #[test]
    fn an_event_file_holds_its_version_the_settings_and_the_values_that_are_known_each_tag_described_once()
     {
        let place = tempfile::tempdir().unwrap();
        let mut events = create(place.path(), 7);
        let histograms = vec![("histogram/std", histogram([0.5_f32, 1.5].iter()))];
        let values = [("reward/fall", 0.25), ("eval/goals", f64::NAN)];
        events.iteration(9, &values, &histograms).unwrap();
        events.iteration(11, &values, &[]).unwrap();
        let path = std::fs::read_dir(place.path())
            .unwrap()
            .next()
            .unwrap()
            .unwrap()
            .path();
        let found = read(&path);
        assert_eq!(found.len(), 5);
        assert_eq!(found[0].get_file_version(), "brain.Event:2");
        assert_eq!(
            (found[1].get_step(), found[1].get_session_log().get_status()),
            (7, SessionLog_SessionStatus::START)
        );
        let settings = &found[2].get_summary().get_value()[0];
        let plugin = |value: &Summary_Value| {
            value
                .get_metadata()
                .get_plugin_data()
                .get_plugin_name()
                .to_owned()
        };
        assert_eq!(
            (
                found[2].get_step(),
                settings.get_tag(),
                &plugin(settings)[..]
            ),
            (7, "settings", "text")
        );
        assert_eq!(
            settings.get_tensor().get_string_val()[0],
            b"```\n[run]\nseed = 3\n\n```\n"
        );
        let page = &found[2].get_summary().get_value()[1];
        assert_eq!(plugin(page), "custom_scalars");
        let layout = &page.get_tensor().get_string_val()[0];
        let layout = Layout::parse_from_bytes(layout).unwrap();
        assert_eq!(layout.get_category()[0].get_title(), "Look at these first");
        let values = found[3].get_summary().get_value();
        assert_eq!((found[3].get_step(), values.len()), (9, 2));
        assert_eq!(
            (values[0].get_tag(), values[0].get_simple_value()),
            ("reward/fall", 0.25)
        );
        assert_eq!(
            (
                values[1].get_histo().get_num(),
                values[1].get_histo().get_max()
            ),
            (2.0, 1.5)
        );
        assert_eq!(
            [0, 1].map(|i| plugin(&values[i])),
            ["scalars", "histograms"]
        );
        let metadata = values[1].get_metadata();
        assert_eq!(metadata.get_summary_description(), "of histogram/std");
        assert_eq!(
            metadata.get_unknown_fields().get(4).unwrap().varint,
            [2],
            "the data class"
        );
        let again = &found[4].get_summary().get_value()[0];
        assert!(!again.has_metadata() && again.get_simple_value() == 0.25);
    }
}
