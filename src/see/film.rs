//! Films of consecutive episodes, and single pictures, without a display.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use anyhow::{Result, ensure};

use crate::cli::Shot;
use crate::config::EnvConfig;
use crate::draw::{self, Clip, FilmFormat, FilmWriter};
use crate::env::Env;
use crate::evaluate::{Actor, Episodes, Moment, Player, evaluate};
use crate::os::{Bar, OutputFile, progress_bar};
use crate::repose::{Repose, Task};
use crate::run::Animation;
use crate::sim::{Quality, Renderer};

use super::task_for_display;

/// A film of episodes played one after another.
pub struct Film {
    renderer: Renderer,
    writer: FilmWriter,
    fps: u32,
    /// Frames of the current episode.
    frames: u64,
    all_frames: u64,
    /// The maximum number of frames of an episode.
    longest: u64,
    bar: Bar,
    begun: Instant,
}

impl Film {
    /// Starts the film `path` of up to `episodes` episodes of `task`, which must have been loaded for display.
    ///
    /// # Errors
    /// Fails if there is no EGL, the name does not end in .mp4 or .gif, or the path cannot be written to.
    pub fn create(path: &Path, task: &Task, fps: u32, episodes: u64) -> Result<Self> {
        let config = task.config();
        let seconds = f64::from(config.max_episode_steps()) * config.ctrl_dt;
        let longest = ((seconds * f64::from(fps)).ceil() as u64).saturating_add(1);
        let all = episodes.saturating_mul(longest);
        let renderer = Renderer::new(task.scene())?;
        let format = FilmFormat { size: renderer.size(), fps, longest: all as usize };
        let writer = FilmWriter::create(path, format)?;
        let bar = progress_bar(all, "frames", "film");
        Ok(Self { renderer, writer, fps, frames: 0, all_frames: 0, longest, bar, begun: Instant::now() })
    }

    /// Adds the frames that are due at `moment`: frame k of an episode shows it k / fps seconds after its start.
    ///
    /// # Errors
    /// Fails if OpenGL, the encoder or the file does; [`Film::abandon`] returns the cause if it was the encoder or the file.
    pub fn observe(&mut self, moment: &Moment) -> Result<()> {
        let env = moment.env;
        if moment.step.is_none() {
            self.frames = 0;
        }
        ensure!(!self.writer.failed(), "the film cannot be continued");
        let time = f64::from(env.episode().length) * env.config().ctrl_dt;
        let ended = moment.ends();
        loop {
            let due = self.frames as f64 / f64::from(self.fps);
            // A frame exactly at the end belongs to what follows.
            if due > time + 1e-9 || ended && due > time - 1e-9 {
                break;
            }
            let picture = self.renderer.draw(env.simulation())?;
            self.writer.push(picture, caption(env, moment.episode, time));
            self.frames += 1;
            self.all_frames += 1;
            self.bar.inc(1);
        }
        if ended {
            self.bar.dec_length(self.longest.saturating_sub(self.frames));
            self.bar.set_message(format!("{} goals in episode {}", env.episode().goals, moment.episode));
        }
        Ok(())
    }

    /// Discards the film, keeping any existing file. Returns why the film failed, if it did.
    pub fn abandon(self) -> Option<anyhow::Error> {
        self.writer.abandon()
    }

    /// Completes the file and returns a summary to print.
    ///
    /// # Errors
    /// Fails if the encoder or the file does.
    pub fn finish(self) -> Result<String> {
        self.writer.finish()?;
        let [width, height] = self.renderer.size();
        let seconds = self.all_frames as f64 / f64::from(self.fps);
        let goal_times = self.all_frames as f64 / self.begun.elapsed().as_secs_f64();
        Ok(format!(
            "{width}x{height}, {} frames, {seconds:.2} s, rendered at {goal_times:.1} frames/s",
            self.all_frames
        ))
    }
}

/// Width, height and frames per second of an animation, and its longest duration, s: it is kept in memory and in a log.
const ANIMATION: ([u32; 2], u32, f64) = ([320, 240], 10, 20.0);

/// Films single episodes of a task for a log.
pub struct EpisodeFilms {
    task: Arc<Task>,
    renderer: Renderer,
}

impl EpisodeFilms {
    /// Prepares films of the task with these settings.
    ///
    /// # Errors
    /// Fails if there is no EGL.
    pub fn new(config: &EnvConfig) -> Result<Self> {
        // Primitives, since a training should not need the hand's meshes.
        let shot = Shot { size: None, camera: None, quality: None, plain: true };
        let task = task_for_display(config, &shot, ANIMATION.0, Quality::Fast)?;
        let renderer = Renderer::new(task.scene())?;
        Ok(Self { task, renderer })
    }

    /// Plays the first of `episodes` as an evaluation does and returns its first 20 s; `None` if `stop` was set meanwhile.
    ///
    /// # Errors
    /// Fails if OpenGL does.
    pub fn film(&mut self, actor: &Actor, episodes: Episodes, stop: &AtomicBool) -> Result<Option<Animation>> {
        let (size, fps, seconds) = ANIMATION;
        let longest = (seconds * f64::from(fps)) as usize;
        let mut clip = Clip::new(FilmFormat { size, fps, longest });
        let (task, renderer, ctrl_dt) = (&self.task, &mut self.renderer, self.task.config().ctrl_dt);
        let mut frames = 0;
        let mut observe = |moment: Moment| {
            let time = f64::from(moment.env.episode().length) * ctrl_dt;
            let over = moment.ends();
            while !over && frames < longest && frames as f64 / f64::from(fps) <= time + 1e-9 {
                let picture = renderer.draw(moment.env.simulation())?;
                clip.push(picture, &caption(moment.env, moment.episode, time))?;
                frames += 1;
            }
            Ok(())
        };
        let played = evaluate(task, actor, Episodes { count: 1, ..episodes }, stop, &mut observe)?;
        played.map(|_| Ok(Animation { size, gif: clip.finish()? })).transpose()
    }
}

/// Returns the lines of text for a frame.
fn caption(env: &Repose, episode: usize, time: f64) -> Vec<String> {
    let tolerance = env.config().success_tolerance.to_degrees();
    vec![
        format!("episode {episode}  {time:5.2} s"),
        format!("goals {}  held {}/{}", env.episode().goals, env.held(), env.config().max_consecutive_successes),
        format!("error {:5.1}° (goal {tolerance:.1}°)", env.rot_dist().to_degrees()),
    ]
}

/// Draws one picture of `task`, which must have been loaded for display, after `seconds` of the first of `episodes`.
///
/// # Errors
/// Fails if there is no EGL, the name does not end in .png, or the path cannot be written to.
pub fn screenshot(path: &Path, task: &Arc<Task>, actor: &Actor, episodes: Episodes, seconds: f64) -> Result<[u32; 2]> {
    let output = OutputFile::create(path)?;
    let mut renderer = Renderer::new(task.scene())?;
    let mut player = Player::new(task, episodes);
    for _ in 0..(seconds / task.config().ctrl_dt).round() as u64 {
        if player.step(actor).is_some() {
            break;
        }
    }
    let size = renderer.size();
    let picture = renderer.draw(player.env().simulation())?;
    draw::write_png(output, size, picture)?;
    Ok(size)
}
