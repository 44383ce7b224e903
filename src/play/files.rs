//! The files written while playing: a trace, and an HTML file.

use anyhow::Result;

use super::plan::Outputs;
use super::stage::Stage;
use crate::evaluate::{Episodes, Moment};
use crate::os::{Destination, OutputFile, say};
use crate::repose::Task;
use crate::see::{self, About, Replay, Shot};
use crate::trace::Trace;

/// The files that the user wants. They are opened before playing, so that an unwritable path is found before the score is computed.
pub(super) struct Files {
    trace: Option<(OutputFile, Trace)>,
    page: Option<PageFile>,
}

impl Files {
    /// Begins the files of these episodes.
    ///
    /// # Errors
    /// Fails if one of them cannot be written.
    pub(super) fn begin(stage: &Stage, episodes: Episodes, outputs: &Outputs) -> Result<Self> {
        let task = &stage.task;
        let trace = outputs.trace.as_ref().map(|to| OutputFile::create(&to.path)).transpose()?;
        let place = stage.loaded().map(|loaded| loaded.origin.to_string());
        let new = || Trace::new(task, stage.actor().name(), place.as_deref(), episodes.seed);
        let page = outputs.page.as_ref().map(|to| PageFile::begin(to, task, &outputs.shot, episodes.count));
        Ok(Self { trace: trace.map(|output| (output, new())), page: page.transpose()? })
    }

    pub(super) fn observe(&mut self, moment: &Moment) {
        if let Some((_, trace)) = &mut self.trace {
            trace.record(moment);
        }
        if let Some(page) = &mut self.page {
            page.replay.observe(moment);
        }
    }

    /// Writes the files.
    ///
    /// # Errors
    /// Fails if one of them cannot be written.
    pub(super) fn finish(self, about: &About) -> Result<()> {
        if let Some((output, trace)) = self.trace {
            output.finish(trace.finish().as_bytes())?;
        }
        self.page.map_or(Ok(()), |page| page.finish(about))
    }

    /// Says that the files are not written, since playing was interrupted.
    pub(super) fn give_up(self) {
        let trace = self.trace.map(|(output, _)| output);
        for output in trace.into_iter().chain(self.page.map(|page| page.output)) {
            say!("{}: interrupted, not written", output.path.display());
        }
    }
}

/// An HTML file that is being made.
pub(super) struct PageFile {
    output: OutputFile,
    replay: Replay,
}

impl PageFile {
    /// Begins a file of so many episodes of this task.
    ///
    /// # Errors
    /// Fails if it cannot be written, or if the episodes are too many or too long for it.
    pub(super) fn begin(to: &Destination, task: &Task, shot: &Shot, episodes: usize) -> Result<Self> {
        let output = OutputFile::create(&to.path)?;
        let task = see::task_for_display(task, shot)?;
        Ok(Self { output, replay: Replay::new(&task, shot.camera, episodes)? })
    }

    /// Takes the episodes from a trace, and returns how many did not fit.
    ///
    /// # Errors
    /// Fails if the text is no trace, or one of another scene.
    pub(super) fn read(&mut self, trace: &str) -> Result<usize> {
        self.replay.read(trace)
    }

    /// Writes the file.
    ///
    /// # Errors
    /// Fails if it cannot be written.
    pub(super) fn finish(self, about: &About) -> Result<()> {
        let html = self.replay.page(about)?.html();
        let path = self.output.path.display().to_string();
        self.output.finish(html.as_bytes())?;
        say!("{path}: {} kB", html.len().div_ceil(1000));
        Ok(())
    }
}
