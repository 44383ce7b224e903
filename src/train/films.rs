//! Films of evaluation episodes for the event file.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::AtomicBool;

use anyhow::{Error, anyhow};

use crate::config::Config;
use crate::evaluate::{Actor, Episodes};
use crate::os;
use crate::ppo::Policy;
use crate::run::{Animation, Report};
use crate::schedule::panic_message;
use crate::see::EpisodeFilms;

/// Films every so many iterations, as long as pictures can be drawn.
pub(super) struct Films {
    every: u64,
    episodes: Option<EpisodeFilms>,
}

impl Films {
    /// Prepares the films of a training. If pictures cannot be drawn, prints a warning, and there are none.
    pub(super) fn new(config: &Config) -> Self {
        let every = config.run.film_every;
        let mut films = Self { every, ..Self::none() };
        if every > 0 {
            match EpisodeFilms::new(&config.env) {
                Ok(episodes) => films.episodes = Some(episodes),
                Err(error) => os::say(&format!("warning: {}", absent(&error))),
            }
        }
        films
    }

    /// Returns the films of a training that has none.
    pub(super) fn none() -> Self {
        Self { every: 0, episodes: None }
    }

    /// Returns whether there is a film after this iteration.
    pub(super) fn due(&self, iteration: u64) -> bool {
        self.episodes.is_some() && iteration.is_multiple_of(self.every)
    }

    /// Films the first of `episodes` with the mean actions of `policy`. Returns `None` if that failed, after a warning, or if
    /// `stop` was set meanwhile.
    pub(super) fn film(
        &mut self,
        policy: &Policy,
        episodes: Episodes,
        stop: &AtomicBool,
        report: &Report,
    ) -> Option<Animation> {
        let films = self.episodes.as_mut()?;
        let film = || films.film(&Actor::Mean(policy.freeze()), episodes, stop);
        // A film that fails must not end the training, even by a panic.
        let made = catch_unwind(AssertUnwindSafe(film));
        let made = made.unwrap_or_else(|panic| Err(anyhow!("panic: {}", panic_message(&*panic))));
        made.unwrap_or_else(|error| {
            report.warn(&absent(&error));
            self.episodes = None;
            None
        })
    }
}

fn absent(error: &Error) -> String {
    format!("run.film_every: no films in this session: {error:#}")
}
