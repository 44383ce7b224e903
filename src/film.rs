//! Episodes as a film, one after the other, and single pictures; without a display.

use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use anyhow::{Result, ensure};

use crate::env::{Env, Repose, Task};
use crate::evaluate::{Actor, Episodes, Moment, Player};
use crate::run::{self, Bar, FilmFormat, FilmWriter, OutputFile};
use crate::sim::Renderer;

/// A film of episodes that are played one after the other.
pub struct Film {
    renderer: Renderer,
    writer: FilmWriter,
    fps: u32,
    /// Frames of the present episode.
    frames: u64,
    all_frames: u64,
    /// The most frames of an episode.
    longest: u64,
    bar: Bar,
    begun: Instant,
}

impl Film {
    /// Begins the film `path` of so many episodes of `task`, which must be one to see.
    ///
    /// # Errors
    /// No EGL, another name than .mp4 or .gif, a place that cannot be written to.
    pub fn create(path: &Path, task: &Task, fps: u32, episodes: u64) -> Result<Self> {
        let config = task.config();
        let seconds = f64::from(config.max_episode_steps()) * config.ctrl_dt;
        let longest = ((seconds * f64::from(fps)).ceil() as u64).saturating_add(1);
        let all = episodes.saturating_mul(longest);
        let renderer = Renderer::new(task.scene())?;
        let format = FilmFormat { size: renderer.size(), fps, longest: all as usize };
        let writer = FilmWriter::create(path, format)?;
        let bar = Bar::new(all, "frames");
        Ok(Self { renderer, writer, fps, frames: 0, all_frames: 0, longest, bar, begun: Instant::now() })
    }

    /// Adds the frames that are due at this moment: frame k of an episode shows it k / fps seconds after its start.
    ///
    /// # Errors
    /// OpenGL's; that the encoder or the file failed, of which [`Film::abandon`] tells more.
    pub fn observe(&mut self, moment: &Moment) -> Result<()> {
        let env = moment.env;
        if moment.step.is_none() {
            self.frames = 0;
        }
        ensure!(!self.writer.failed(), "the film cannot go on");
        let time = f64::from(env.episode().length) * env.config().ctrl_dt;
        let ended = moment.step.is_some_and(|(_, end)| end.is_some());
        loop {
            let due = self.frames as f64 / f64::from(self.fps);
            // The frame of the end would belong to what comes after it.
            if due > time + 1e-9 || ended && due > time - 1e-9 {
                break;
            }
            let picture = self.renderer.draw(env.simulation())?;
            self.writer.push(picture, caption(env, moment.episode, time));
            self.frames += 1;
            self.all_frames += 1;
            self.bar.count();
        }
        if ended {
            self.bar.shorten(self.longest.saturating_sub(self.frames));
            self.bar.say(format!("{} goals in episode {}", env.episode().goals, moment.episode));
        }
        Ok(())
    }

    /// Gives the film up, leaving what was there before; why it failed, if it was the film.
    pub fn abandon(self) -> Option<anyhow::Error> {
        self.writer.abandon()
    }

    /// Completes the file; returns what to say about it.
    ///
    /// # Errors
    /// The encoder's and the file's.
    pub fn finish(self) -> Result<String> {
        self.writer.finish()?;
        let [width, height] = self.renderer.size();
        let seconds = self.all_frames as f64 / f64::from(self.fps);
        let pace = self.all_frames as f64 / self.begun.elapsed().as_secs_f64();
        Ok(format!("{width}x{height}, {} frames, {seconds:.2} s, made at {pace:.1} frames/s", self.all_frames))
    }
}

/// What is written into a picture.
fn caption(env: &Repose, episode: usize, time: f64) -> Vec<String> {
    let tolerance = env.config().success_tolerance.to_degrees();
    vec![
        format!("episode {episode}  {time:5.2} s"),
        format!("goals {}  held {}/{}", env.episode().goals, env.held(), env.config().max_consecutive_successes),
        format!("error {:5.1}° (goal {tolerance:.1}°)", env.rot_dist().to_degrees()),
    ]
}

/// Draws one picture of `task`, which must be one to see, after `seconds` of the first of these episodes.
///
/// # Errors
/// No EGL, another name than .png, a place that cannot be written to.
pub fn screenshot(path: &Path, task: &Arc<Task>, actor: &Actor, episodes: Episodes, seconds: f64) -> Result<()> {
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
    run::write_png(output, size, picture)
}
