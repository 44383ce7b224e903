//! Playing for a score, and for files.

use std::process::ExitCode;

use anyhow::Result;

use super::browser::about;
use super::figures::{json_score, table};
use super::plan::Outputs;
use super::stage::Stage;
use crate::evaluate::{Actor, Episodes, Moment, Trial};
use crate::goal_times::GoalTimes;
use crate::os::{self, Interrupted, OutputFile, Requests, say};
use crate::repose::Score;
use crate::see::{self, About, Replay};
use crate::trace::Trace;

/// Plays the episodes without a window, writes the outputs, and prints the score. Returns the exit code of the program.
///
/// # Errors
/// Fails if an output cannot be written, if an action is not finite, or if an episode panics.
pub fn score(
    stage: &Stage,
    episodes: Episodes,
    outputs: &Outputs,
    requests: &Requests,
) -> Result<ExitCode> {
    let task = &stage.task;
    let actor = &stage.actor();
    let place = stage.origin();
    let mut files = Files::begin(stage, episodes, outputs)?;
    let mut goal_times = GoalTimes::new(&task.config);
    let mut observe = |moment: &Moment| {
        goal_times.observe(moment);
        files.observe(moment);
    };
    let trial = Trial {
        task,
        actor,
        episodes,
        stop: &requests.stop,
    };
    let played = match &outputs.film {
        #[cfg(not(feature = "video"))]
        Some(_) => anyhow::bail!(see::NO_FILMS),
        #[cfg(feature = "video")]
        Some(to) => film(to, outputs, trial, requests, &mut observe),
        None => scored(trial, &mut observe),
    };
    if played
        .as_ref()
        .is_err_and(|error| error.is::<Interrupted>())
    {
        files.give_up();
        return Ok(os::exit_code(requests.signal()));
    }
    let played = played?;
    files.finish(&about(stage, episodes.seed))?;
    if let Some(warning) = played.divergence() {
        say!("warning: {warning}");
    }
    if outputs.json {
        os::print(&format!(
            "{}\n",
            json_score(&played, &goal_times, place.as_deref(), episodes.seed)
        ))?;
        return Ok(ExitCode::SUCCESS);
    }
    let mut columns = vec![(actor.name(), played)];
    if let Some(place) = place {
        os::print(&format!("checkpoint {place}\n"))?;
        if outputs.film.is_none() && outputs.page.is_none() {
            let zero = scored(
                Trial {
                    actor: &Actor::Zero,
                    ..trial
                },
                &mut |_| {},
            )?;
            columns.push((Actor::Zero.name(), zero));
        }
    }
    os::print(&table(&columns))?;
    Ok(ExitCode::SUCCESS)
}

/// Plays the episodes, several at a time.
fn scored(trial: Trial, observe: &mut dyn FnMut(&Moment)) -> Result<Score> {
    let bar = os::progress_bar(trial.episodes.count as u64, "episodes", trial.actor.name());
    trial.score(&bar, observe)
}

/// Plays the episodes one after another and films them. If interrupted, it leaves a film of what was played.
#[cfg(feature = "video")]
fn film(
    to: &os::Destination,
    Outputs { shot, fps, .. }: &Outputs,
    trial: Trial,
    requests: &Requests,
    observe: &mut dyn FnMut(&Moment),
) -> Result<Score> {
    let task = &see::task_for_display(trial.task, shot)?;
    let Episodes { first, count, .. } = trial.episodes;
    let mut film = see::Film::create(to, task, *fps, count as u64)?;
    // Unlike the other outputs, a film is worth keeping if it is interrupted.
    requests.wait_for_end();
    let mut played = Vec::new();
    for first in first..first + count {
        let one = Trial {
            task,
            episodes: Episodes {
                first,
                count: 1,
                ..trial.episodes
            },
            ..trial
        };
        let result = one.play(&mut |moment| {
            observe(&moment);
            film.observe(&moment)
        });
        match result {
            Ok(stats) => played.extend(stats),
            Err(error) if error.is::<Interrupted>() => break,
            Err(error) => return Err(film.abandon().unwrap_or(error)),
        }
    }
    say!("{}: {}", to.path.display(), film.finish()?);
    anyhow::ensure!(played.len() == count, Interrupted);
    Ok(Score::of(&played, task.config.ctrl_dt))
}

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
