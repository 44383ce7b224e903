//! Films of evaluation episodes for the event file.

use std::panic::{AssertUnwindSafe, catch_unwind};

use anyhow::{Error, anyhow};

use super::saver::Lead;
use crate::config::Config;
use crate::evaluate::{Actor, Episodes};
use crate::os::{self, Requests};
use crate::ppo::Policy;
use crate::repose::Task;
use crate::run::Animation;
use crate::schedule::panic_message;
use crate::see::EpisodeFilms;

/// Prepares the films of a training that wants some. If pictures cannot be drawn, prints a warning, and there are none.
pub(super) fn films(task: &Task, config: &Config) -> Option<EpisodeFilms> {
    let films = (config.run.film_every > 0).then(|| EpisodeFilms::new(task))?;
    films.inspect_err(|error| os::say(&format!("warning: {}", absent(error)))).ok()
}

/// Films the first of `episodes` of `task` with the mean actions of `policy`. Returns `None` if that failed, after a warning, or if a stop
/// was requested meanwhile. After a failure there are no more films.
pub(super) fn film(
    films: &mut Option<EpisodeFilms>,
    (task, policy, episodes): (&Task, &Policy, Episodes),
    requests: &Requests,
    lead: &mut Lead,
) -> Option<Animation> {
    let filming = films.as_mut()?;
    let mut meanwhile = || lead.save_if_asked(requests);
    let film = || filming.film(task, &Actor::Mean(policy.freeze()), episodes, requests.stop(), &mut meanwhile);
    // A film that fails must not end the training, even by a panic.
    let made = catch_unwind(AssertUnwindSafe(film));
    let made = made.unwrap_or_else(|panic| Err(anyhow!("panic: {}", panic_message(&*panic))));
    made.unwrap_or_else(|error| {
        lead.report.warn(&absent(&error));
        *films = None;
        None
    })
}

fn absent(error: &Error) -> String {
    format!("run.film_every: no films in this session: {error:#}")
}
