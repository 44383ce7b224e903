//! The files written while playing: a trace, and an HTML file.

use std::path::Path;

use anyhow::{Result, ensure};

use crate::cli::PlayArgs;
use crate::evaluate::Moment;
use crate::os::{self, OutputFile};
use crate::repose::Task;
use crate::see::{self, About, Replay};
use crate::sim::Quality;
use crate::trace::Trace;

/// The files that the user wants. They are opened before playing, so that an unwritable path is found before the score is computed.
pub(super) struct Files {
    trace: Option<(OutputFile, Trace)>,
    page: Option<PageFile>,
}

impl Files {
    /// Begins the files of episodes of this task, played by the `actor` of this name and the policy in `checkpoint`.
    ///
    /// # Errors
    /// Fails if one of them cannot be written.
    pub(super) fn begin(task: &Task, actor: &str, checkpoint: Option<&str>, args: &PlayArgs) -> Result<Self> {
        let trace = args.trace.as_deref().map(OutputFile::create).transpose()?;
        for (option, other) in [("--video", &args.video), ("--html", &args.html)] {
            if let (Some(trace), Some(other)) = (&trace, other) {
                ensure!(!trace.is_of(other), "--trace {0} {option} {0}: one file cannot be both", other.display());
            }
        }
        let page = args.html.as_deref().map(|path| PageFile::begin(path, task, args)).transpose()?;
        if let (Some(page), Some(video)) = (&page, &args.video) {
            ensure!(!page.output.is_of(video), "--html {0} --video {0}: one file cannot be both", video.display());
        }
        Ok(Self { trace: trace.map(|output| (output, Trace::new(task, actor, checkpoint, args.seed))), page })
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
}

/// An HTML file that is being made.
pub(super) struct PageFile {
    output: OutputFile,
    replay: Replay,
}

impl PageFile {
    /// Begins a file of episodes of this task.
    ///
    /// # Errors
    /// Fails if it cannot be written, or if the episodes are too long for it.
    pub(super) fn begin(path: &Path, task: &Task, args: &PlayArgs) -> Result<Self> {
        let output = OutputFile::create(path)?;
        // The size of a film. A page has none.
        let task = see::task_for_display(task, &args.shot, [1280, 720], Quality::Fast)?;
        let episodes = if args.from_trace.is_some() { 0 } else { args.episodes.unwrap_or(1) as usize };
        Ok(Self { output, replay: Replay::new(&task, args.shot.camera, episodes)? })
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
        let path = self.output.path().display().to_string();
        self.output.finish(html.as_bytes())?;
        os::say(&format!("{path}: {} kB", html.len().div_ceil(1000)));
        Ok(())
    }
}
