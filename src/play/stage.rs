//! Who acts, and the task.

use std::path::Path;
use std::rc::Rc;
use std::sync::Arc;

use anyhow::{Result, ensure};

use crate::cli::PlayArgs;
use crate::config::{Override, Settings};
use crate::evaluate::{Actor, Player};
use crate::load::Loaded;
use crate::os::{self, Destination, say};
use crate::ppo::{FrozenPolicy, Policy};
use crate::repose::Task;
use crate::run;
use crate::see::{LiveActor, Sliders};

/// Who acts, and the task.
pub struct Stage {
    /// The policy, unless the actor needs none.
    pub policy: Option<Loaded>,
    /// The number of the actor among [`Stage::actors`].
    pub choice: usize,
    pub task: Arc<Task>,
}

impl Stage {
    /// Prepares what these options say, and tells the user about it. The actor is at `place`.
    ///
    /// # Errors
    /// Fails as [`Stage::find`] does, or if an output replaces something.
    pub fn set(place: Option<&Path>, args: &PlayArgs) -> Result<Self> {
        let mut stage = Self::find(place, &args.set)?;
        if args.stochastic {
            ensure!(
                stage.policy.is_some(),
                "--stochastic samples from a policy: --ckpt names none"
            );
            stage.choice = 1;
        }
        let file = stage
            .policy
            .as_ref()
            .and_then(|policy| policy.origin.file());
        expect_outputs(&args.out, file, stage.task.config.model_file())?;
        os::start_threads(args.threads)?;
        if let Some(policy) = stage.policy.as_ref().filter(|_| !args.json) {
            say!("playing {}", policy.name);
        }
        stage.task.say_warnings();
        if !args.json {
            for note in stage.task.notes() {
                say!("note: {note}");
            }
        }
        Ok(stage)
    }

    /// Finds who acts at `place`, and loads the task with these settings.
    ///
    /// # Errors
    /// Fails as [`Loaded::find`] and [`Loaded::task`] do.
    pub fn find(place: Option<&Path>, set: &[Override]) -> Result<Self> {
        let (policy, choice) = match place.and_then(Actor::without_policy) {
            Some(choice) => (None, choice),
            None => (Some(Loaded::find(place, set)?), 0),
        };
        Ok(Self {
            task: task(policy.as_ref(), set)?,
            policy,
            choice,
        })
    }

    /// The kinds of actions between which a user may choose, by name.
    pub fn actors(&self) -> Vec<(&'static str, Actor<'_>)> {
        self.actors_of(Policy::freeze)
    }

    fn actors_of(
        &self,
        freeze: for<'a> fn(&'a Policy) -> FrozenPolicy<'a>,
    ) -> Vec<(&'static str, Actor<'_>)> {
        match &self.policy {
            Some(Loaded { policy, .. }) => {
                vec![
                    ("deterministic", Actor::Mean(freeze(policy))),
                    ("stochastic", Actor::Stochastic(freeze(policy))),
                ]
            }
            None => Actor::WITHOUT_POLICY.into(),
        }
    }

    pub fn actor(&self) -> Actor<'_> {
        self.actors().swap_remove(self.choice).1
    }

    /// Where the policy comes from.
    pub fn origin(&self) -> Option<String> {
        self.policy.as_ref().map(|policy| policy.origin.to_string())
    }

    /// Where the policy comes from, or the name of the actor.
    pub fn place(&self) -> String {
        self.origin().unwrap_or(self.actor().name().to_owned())
    }

    /// What a page says of the policy: its description, and where it does not fit well.
    pub fn described(&self) -> Option<String> {
        let warnings = self.task.warnings.iter().map(String::as_str);
        Some(with_warnings(&self.policy.as_ref()?.name, warnings))
    }

    /// The actor of a page that shows this task. The last of its sliders says whether the actions of a policy are drawn.
    pub fn acting(self: Rc<Self>, task: Arc<Task>, sliders: Sliders) -> LiveActor {
        LiveActor {
            policy: self.described(),
            step: Rc::new(move |player: &mut Player| {
                let choice = match self.policy {
                    Some(_) => usize::from(sliders.values().last() == Some(&1.0)),
                    None => self.choice,
                };
                let (_, actor) = &self.actors_of(Policy::freeze_briefly)[choice];
                player.step(actor)
            }),
            task,
        }
    }
}

/// Loads the task of a policy, or the one that these settings define.
///
/// # Errors
/// Fails as [`Loaded::task`] does.
pub fn task(policy: Option<&Loaded>, set: &[Override]) -> Result<Arc<Task>> {
    match policy {
        Some(policy) => policy.task(set),
        None => Task::new(&Settings::new().sets(set).resolve()?),
    }
}

/// Checks that each output has a file of its own, which holds nothing that is read.
fn expect_outputs(out: &[Destination], policy: Option<&Path>, scene: Option<&Path>) -> Result<()> {
    for (i, Destination { path, .. }) in out.iter().enumerate() {
        run::expect_output(path, policy, scene)?;
        let end = os::final_path(path);
        let mut others = out[..i].iter();
        let is_taken = end.is_some() && others.any(|other| os::final_path(&other.path) == end);
        ensure!(
            !is_taken,
            "--out {}: one file cannot be both",
            path.display()
        );
    }
    Ok(())
}

/// What a page says of a policy: its name, and where it does not fit well.
pub fn with_warnings<'a>(name: &str, warnings: impl Iterator<Item = &'a str>) -> String {
    warnings.fold(name.to_owned(), |text, warning| {
        text + "; warning: " + warning
    })
}
