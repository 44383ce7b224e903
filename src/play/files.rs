//! The files written while playing: a trace, and an HTML file.

use anyhow::Result;

use super::plan::Outputs;
use super::stage::Stage;
use crate::evaluate::{Episodes, Moment};
use crate::os::{OutputFile, say};
use crate::see::{About, Replay};
use crate::trace::Trace;

/// The files that the user wants. They are opened before playing, so that an unwritable path is found before the score is computed.
pub struct Files {
    trace: Option<(OutputFile, Trace)>,
    page: Option<Replay>,
}

impl Files {
    /// Begins the files of these episodes.
    ///
    /// # Errors
    /// Fails if one of them cannot be written.
    pub fn begin(stage: &Stage, episodes: Episodes, outputs: &Outputs) -> Result<Self> {
        let task = &stage.task;
        let trace = outputs.trace.as_ref().map(|to| {
            let trace = Trace::new(
                task,
                stage.actor().name(),
                stage.origin().as_deref(),
                episodes.seed,
            );
            OutputFile::create(&to.path).map(|output| (output, trace))
        });
        let page = outputs
            .page
            .as_ref()
            .map(|to| Replay::begin(to, task, &outputs.shot, episodes.count));
        Ok(Self {
            trace: trace.transpose()?,
            page: page.transpose()?,
        })
    }

    pub fn observe(&mut self, moment: &Moment) {
        if let Some((_, trace)) = &mut self.trace {
            trace.record(moment);
        }
        if let Some(page) = &mut self.page {
            page.observe(moment);
        }
    }

    /// Writes the files.
    ///
    /// # Errors
    /// Fails if one of them cannot be written.
    pub fn finish(self, about: &About) -> Result<()> {
        if let Some((output, trace)) = self.trace {
            output.finish(trace.finish().as_bytes())?;
        }
        self.page.map_or(Ok(()), |page| page.finish(about))
    }

    /// Says that the files are not written, since playing was interrupted.
    pub fn give_up(self) {
        let trace = self.trace.map(|(output, _)| output);
        for output in trace.into_iter().chain(self.page.map(|page| page.output)) {
            say!("{}: interrupted, not written", output.path.display());
        }
    }
}
