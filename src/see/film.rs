//! Films of consecutive episodes, and single pictures, without a display.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use anyhow::{Result, ensure};

use crate::cli::Shot;
use crate::draw::{FilmFormat, FilmWriter, Frame, gif_of, write_png};
use crate::env::Env;
use crate::evaluate::{Actor, Episodes, Moment, Player, Trial};
use crate::os::{Bar, OutputFile, progress_bar};
use crate::repose::{Repose, Task};
use crate::run::Animation;
use crate::sim::{Quality, Renderer};

use super::task_for_display;

/// The frames of episodes: frame k of an episode shows it k / fps seconds after its start.
struct Frames {
    renderer: Renderer,
    fps: u32,
    /// The most frames of an episode.
    longest: u64,
    /// The frames of the current episode so far.
    drawn: u64,
}

impl Frames {
    /// Draws the frames that are due at `moment`, each with a caption.
    ///
    /// # Errors
    /// Fails if OpenGL does.
    fn draw_due(&mut self, moment: &Moment, mut take: impl FnMut(Frame)) -> Result<()> {
        let env = moment.env;
        if moment.step.is_none() {
            self.drawn = 0;
        }
        let time = f64::from(env.episode().length) * env.config().ctrl_dt;
        // A frame exactly at the end belongs to what follows.
        let until = time + if moment.ends() { -1e-9 } else { 1e-9 };
        while self.drawn < self.longest && self.drawn as f64 / f64::from(self.fps) <= until {
            take((self.renderer.draw(env.simulation())?.to_vec(), caption(env, moment.episode, time)));
            self.drawn += 1;
        }
        Ok(())
    }
}

/// A film of episodes played one after another.
pub struct Film {
    frames: Frames,
    writer: FilmWriter,
    all_frames: u64,
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
        let writer = FilmWriter::create(path, FilmFormat { size: renderer.size(), fps, longest: all as usize })?;
        let frames = Frames { renderer, fps, longest, drawn: 0 };
        Ok(Self { frames, writer, all_frames: 0, bar: progress_bar(all, "frames", "film"), begun: Instant::now() })
    }

    /// Adds the frames that are due at `moment`.
    ///
    /// # Errors
    /// Fails if OpenGL, the encoder or the file does. [`Film::abandon`] returns the cause if it was the encoder or the file.
    pub fn observe(&mut self, moment: &Moment) -> Result<()> {
        ensure!(!self.writer.failed(), "the film cannot be continued");
        self.frames.draw_due(moment, |frame| {
            self.writer.push(frame);
            self.all_frames += 1;
            self.bar.inc(1);
        })?;
        if moment.ends() {
            self.bar.dec_length(self.frames.longest.saturating_sub(self.frames.drawn));
            self.bar.set_message(format!("{} goals in episode {}", moment.env.episode().goals, moment.episode));
        }
        Ok(())
    }

    /// Discards the film, keeping any existing file. Returns why the film failed, if it did.
    pub fn abandon(self) -> Option<anyhow::Error> {
        self.writer.finish(false).err()
    }

    /// Completes the file and returns a summary to print.
    ///
    /// # Errors
    /// Fails if the encoder or the file does.
    pub fn finish(self) -> Result<String> {
        self.writer.finish(true)?;
        let ([width, height], frames) = (self.frames.renderer.size(), self.all_frames);
        let seconds = frames as f64 / f64::from(self.frames.fps);
        let rate = frames as f64 / self.begun.elapsed().as_secs_f64();
        Ok(format!("{width}x{height}, {frames} frames, {seconds:.2} s, rendered at {rate:.1} frames/s"))
    }
}

/// Width, height and frames per second of an animation, and its most frames, for 20 s: it is kept in memory and in a log.
const ANIMATION: FilmFormat = FilmFormat { size: [320, 240], fps: 10, longest: 200 };

/// Films single episodes of a task for a log.
pub struct EpisodeFilms {
    task: Arc<Task>,
    frames: Frames,
}

impl EpisodeFilms {
    /// Prepares films of a task.
    ///
    /// # Errors
    /// Fails if there is no EGL.
    pub fn new(task: &Task) -> Result<Self> {
        // Primitives, since a training should not need the hand's meshes.
        let shot = Shot { size: None, camera: None, quality: None, plain: true };
        let task = task_for_display(task, &shot, ANIMATION.size, Quality::Fast)?;
        let renderer = Renderer::new(task.scene())?;
        let frames = Frames { renderer, fps: ANIMATION.fps, longest: ANIMATION.longest as u64, drawn: 0 };
        Ok(Self { task, frames })
    }

    /// Plays the first of `episodes` as an evaluation of `task` does, which may only smooth actions differently. Returns its first
    /// 20 s, or `None` if `stop` was set meanwhile. Calls `meanwhile` in each step.
    ///
    /// # Errors
    /// Fails if OpenGL does.
    pub fn film(
        &mut self,
        task: &Task,
        actor: &Actor,
        episodes: Episodes,
        stop: &AtomicBool,
        meanwhile: &mut dyn FnMut(),
    ) -> Result<Option<Animation>> {
        let mut frames = Vec::new();
        let mut observe = |moment: Moment| {
            meanwhile();
            self.frames.draw_due(&moment, |frame| frames.push(frame))
        };
        let one = Episodes { count: 1, ..episodes };
        let task = self.task.smoothed_as_in(task.config());
        let played = Trial { task: &task, actor, episodes: one, stop }.play(&mut observe)?;
        played.map(|_| Ok(Animation { size: ANIMATION.size, gif: gif_of(frames, ANIMATION)? })).transpose()
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
    write_png(output, size, picture)?;
    Ok(size)
}
