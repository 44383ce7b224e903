//! Films of consecutive episodes, and single pictures, without a display.

use std::sync::Arc;

use anyhow::Result;

use crate::draw::{FilmFormat, FilmWriter, write_png};
use crate::env::Env;
use crate::evaluate::{Actor, Episodes, Moment, Player};
use crate::os::{Bar, Destination, OutputFile, progress_bar};
use crate::repose::{Repose, Task};
use crate::sim::Renderer;

/// A film of episodes played one after another.
pub struct Film {
    renderer: Renderer,
    writer: FilmWriter,
    fps: u32,
    /// The most frames of an episode.
    longest: u64,
    /// The frames of the current episode so far: frame k shows it k / fps seconds after its start.
    drawn: u64,
    bar: Bar,
}

impl Film {
    /// Starts a film of up to `episodes` episodes of `task`, which must have been loaded for display.
    ///
    /// # Errors
    /// Fails if there is no EGL, if it is no kind of film, or if the path cannot be written to.
    pub fn create(to: &Destination, task: &Task, fps: u32, episodes: u64) -> Result<Self> {
        let config = &task.config;
        let seconds = f64::from(config.max_episode_steps()) * config.ctrl_dt;
        let longest = ((seconds * f64::from(fps)).ceil() as u64).saturating_add(1);
        let all = episodes.saturating_mul(longest);
        let renderer = Renderer::new(&task.scene)?;
        let writer = FilmWriter::create(
            to,
            FilmFormat {
                size: renderer.size(),
                fps,
                longest: all as usize,
            },
        )?;
        Ok(Self {
            renderer,
            writer,
            fps,
            longest,
            drawn: 0,
            bar: progress_bar(all, "frames", "film"),
        })
    }

    /// Adds the frames that are due at `moment`, each with a caption.
    ///
    /// # Errors
    /// Fails if OpenGL, the encoder or the file does. [`Film::abandon`] returns the cause if it was the encoder or the file.
    pub fn observe(&mut self, moment: &Moment) -> Result<()> {
        let env = moment.env;
        if moment.step.is_none() {
            self.drawn = 0;
        }
        let time = f64::from(env.episode().length) * env.task.config.ctrl_dt;
        // A frame exactly at the end belongs to what follows.
        let until = time + if moment.ends() { -1e-9 } else { 1e-9 };
        while self.drawn < self.longest && self.drawn as f64 / f64::from(self.fps) <= until {
            let picture = self.renderer.draw(&env.sim)?.to_vec();
            self.writer
                .push((picture, caption(env, moment.episode, time)))?;
            self.drawn += 1;
            self.bar.inc(1);
        }
        if moment.ends() {
            self.bar.dec_length(self.longest.saturating_sub(self.drawn));
            self.bar.set_message(format!(
                "{} goals in episode {}",
                env.episode().goals,
                moment.episode
            ));
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
        let [width, height] = self.renderer.size();
        let frames = self.bar.position();
        let seconds = frames as f64 / f64::from(self.fps);
        let rate = frames as f64 / self.bar.elapsed().as_secs_f64();
        Ok(format!(
            "{width}x{height}, {frames} frames, {seconds:.2} s, rendered at {rate:.1} frames/s"
        ))
    }
}

/// The lines of text for a frame.
fn caption(env: &Repose, episode: usize, time: f64) -> Vec<String> {
    let tolerance = env.task.config.success_tolerance.to_degrees();
    vec![
        format!("episode {episode}  {time:5.2} s"),
        format!(
            "goals {}  held {}/{}",
            env.episode().goals,
            env.held,
            env.task.config.max_consecutive_successes
        ),
        format!(
            "error {:5.1}° (goal {tolerance:.1}°)",
            env.rot_dist().to_degrees()
        ),
    ]
}

/// Draws one picture of `task`, which must have been loaded for display, after `seconds` of the first of `episodes`. Returns its width
/// and height in pixels.
///
/// # Errors
/// Fails if there is no EGL, or if the file cannot be written.
pub fn screenshot(
    output: OutputFile,
    task: &Arc<Task>,
    actor: &Actor,
    episodes: Episodes,
    seconds: f64,
) -> Result<[u32; 2]> {
    let mut renderer = Renderer::new(&task.scene)?;
    let mut player = Player::new(task, episodes);
    for _ in 0..(seconds / task.config.ctrl_dt).round() as u64 {
        if player.step(actor).is_some() {
            break;
        }
    }
    let size = renderer.size();
    write_png(output, size, renderer.draw(&player.lane.env.sim)?)?;
    Ok(size)
}
