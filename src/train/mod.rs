//! The training loop: collect, learn, evaluate, report, save.

mod duties;
mod hints;
mod lockstep;
mod log;
mod memory;
mod outcome;
mod saver;
mod session;
mod start;

use std::process::ExitCode;

use anyhow::{Context, Result, anyhow, ensure};

use crate::check::Check;
use crate::cli::TrainArgs;
use crate::config::Config;
use crate::evaluate::{Actor, Episodes, Trial};
use crate::os::{self, Interrupted, Requests, say};
use crate::ppo::{Rise, beats};
use crate::ranks::{self, Exchange};
use crate::repose::{EpisodeStats, HEADLINE, Repose, Score, StepSums};
use crate::run::Histogram;
use crate::schedule;
use duties::{CONFIRMED_BY, Lead};
use hints::hints;
use log::histograms;
use memory::need;
use outcome::{Outcome, Stop};
use session::Session;

/// Trains until all steps are made or a stop is requested, and returns the exit code of the program. If a launcher has started
/// several processes, they train together.
///
/// # Errors
/// Fails if settings, files or the scene cannot be used, if a loss is not finite, or after a panic. Fails if the run folder
/// cannot be written to at the start or at the end. One of several processes then ends all others, and does not return.
pub fn train(args: &TrainArgs, requests: &Requests) -> Result<ExitCode> {
    ranks::together(|exchange| match exchange.is_first() {
        true => lead(args, requests, exchange),
        false => follow(requests, exchange),
    })
}

/// Trains, reports and saves.
fn lead(args: &TrainArgs, requests: &Requests, exchange: &Exchange) -> Result<ExitCode> {
    let (mut session, saver) = Session::lead(args, exchange)?;
    let place = saver.held.folder.place().display().to_string();
    if session.finished() {
        let advice = match session.is_flat() {
            true => "its evaluations no longer rise; use --fork to continue",
            false => "use a larger --total-steps to continue",
        };
        // It may have been killed before it could write the mark. A total that is given may be a mistake.
        if args.total_steps.is_none() {
            saver.held.folder.mark_finished(true);
        }
        say!("{place} is finished: {}; {advice}", saver.held.steps_made());
        return Ok(ExitCode::SUCCESS);
    }
    if let Some(limit) = args.stop_after {
        requests.stop_after(limit)?;
    }
    requests.wait_for_end();
    say!("run folder: {place}");
    session.task.say_warnings();
    let need = need(&session);
    if let Some([needed, has]) = need
        && needed > has
    {
        say!(
            "warning: this training needs about {needed:.1} GiB of memory, but this machine has {has:.1} GiB: fewer environments \
             (env.num_envs) need less"
        );
    }
    let default = Config::default();
    if session.config.env.model_file().is_some() && args.resume.is_none() {
        let check = Check::of(&session.task, &default.env);
        if !args.quiet {
            say!("{}", check.table.trim_end());
        }
        for text in &check.warnings {
            say!("warning: {text}");
        }
    }
    if !args.quiet {
        let mut notes = session.task.notes();
        notes.extend(hints(&session.config, args, &default));
        notes.extend(need.map(|[needed, has]| {
            format!("memory: at most about {needed:.1} GiB; this machine has {has:.1} GiB")
        }));
        for note in notes {
            say!("note: {note}");
        }
    }
    let mut lead = Lead::new(&session.config, saver, args.quiet);
    if args.resume.is_none() {
        lead.open_folder()?;
    }
    session.lead = Some(lead);
    conduct(session, requests)
}

/// Computes, and leaves reporting and saving to the first rank.
fn follow(requests: &Requests, exchange: &Exchange) -> Result<ExitCode> {
    let session = Session::follow(exchange)?;
    if session.finished() {
        return Ok(ExitCode::SUCCESS);
    }
    requests.wait_for_end();
    conduct(session, requests)
}

/// Runs the training to its end. All ranks do so together.
fn conduct(mut session: Session, requests: &Requests) -> Result<ExitCode> {
    let ended = match run(&mut session, requests) {
        Err(error) if error.is::<Interrupted>() => Ok(Some(Stop {
            by_file: false,
            signal: requests.signal(),
        })),
        ended => ended,
    };
    match session.lead.take() {
        Some(lead) => lead.end(&session.config, session.is_flat(), ended),
        None => Ok(os::exit_code(ended?.map_or(0, |stop| stop.signal))),
    }
}

/// Iterates until all steps are made, or until the ranks agree on a stop, which is returned.
fn run(session: &mut Session, requests: &Requests) -> Result<Option<Stop>> {
    session.begin(requests)?;
    while !session.finished() {
        let outcome = session.iterate(requests)?;
        // All ranks put it together.
        let state = outcome.decision.hand_over.then(|| session.checkpoint());
        if let Some(lead) = &mut session.lead {
            lead.report(&session.config, &session.agent, &outcome, state)?;
        }
        if outcome.decision.stop.is_some() {
            return Ok(outcome.decision.stop);
        }
    }
    Ok(None)
}

impl Session {
    /// Runs one iteration: collects, learns, evaluates when that is due, and decides what follows. If the
    /// iteration does not complete, only the state at the end of the previous one can be used.
    ///
    /// # Errors
    /// Fails if a loss is not finite, after a panic, or if others do not have the same weights. Fails as interrupted if a stop was
    /// requested meanwhile.
    fn iterate(&mut self, requests: &Requests) -> Result<Outcome> {
        let number = self.agent.iteration + 1;
        let now = self.requests_now(requests);
        let iterate = || {
            // What was exchanged since the last iteration is not counted.
            self.agent.exchange.take_traffic();
            let iteration = self.agent.iterate(&now.stop)?;
            let traffic = self.agent.exchange.take_traffic();
            let due = evaluates(self.agent.iteration, self.config.run.eval_every);
            let (evaluation, improved) = self.evaluate(due, &now)?;
            let (ended, steps) = self.take_results();
            Ok(Outcome {
                iteration,
                ended,
                steps,
                evaluation,
                traffic,
                histograms: self.histograms(),
                dumps: self.dumps(),
                decision: self.decide(requests, improved)?,
            })
        };
        caught(iterate).with_context(|| format!("iteration {number}"))
    }

    /// What may end an iteration early: with other ranks nothing, because they wait for what is computed here.
    fn requests_now(&self, requests: &Requests) -> Requests {
        if self.agent.exchange.is_alone() {
            requests.clone()
        } else {
            Requests::none()
        }
    }

    /// The episodes that ended on any rank since the last call, and the sums over all steps.
    fn take_results(&mut self) -> (Vec<EpisodeStats>, StepSums) {
        let pool = &mut self.agent.pool;
        let exchange = &self.agent.exchange;
        let ended = exchange.all_gather(pool.take_finished()).concat();
        let sums: Vec<StepSums> = pool.envs_mut().map(Repose::take_sums).collect();
        let add = |mut sum: StepSums, more| {
            sum += more;
            sum
        };
        let total = |sums: &[StepSums]| sums.iter().copied().fold(StepSums::default(), add);
        (ended, exchange.sum(&sums, total, add))
    }

    /// The histograms that are due after this iteration. Only the first rank has some.
    fn histograms(&self) -> Vec<(&'static str, Histogram)> {
        let agent = &self.agent;
        if agent.exchange.is_first() && agent.iteration.is_multiple_of(HISTOGRAMS_EVERY) {
            histograms(&agent.rollout)
        } else {
            Vec::new()
        }
    }

    /// Evaluates before the first iteration, if the run ends when evaluations no longer rise.
    ///
    /// # Errors
    /// Fails as an evaluation does.
    fn begin(&mut self, requests: &Requests) -> Result<()> {
        if self.config.run.patience > 0 && self.rise.is_none() {
            let now = self.requests_now(requests);
            let before = caught(|| self.score(CONFIRMATION, &now))?;
            let known = figures(&before);
            ensure!(
                known.iter().all(|x| x.is_finite()),
                "run.patience: the physics of every evaluation episode diverges at once"
            );
            self.take_down(&before);
            self.rise = Some(Rise {
                before: known,
                best: known,
                since: 0,
            });
            let state = self.checkpoint();
            if let Some(lead) = &mut self.lead {
                lead.saver.keep(state);
            }
        }
        Ok(())
    }

    /// Evaluates, if that is `due`. Returns the score, which has no episodes if it is not, and whether this is the best policy so far.
    ///
    /// A policy whose score is the best so far was perhaps lucky. It is the best only if its score in other episodes confirms that.
    fn evaluate(&mut self, due: bool, requests: &Requests) -> Result<(Score, bool)> {
        if !due {
            return Ok((Score::of(&[], self.task.config.ctrl_dt), false));
        }
        let score = self.score(EVALUATION, requests)?;
        // After a resume from an older checkpoint, the best policy of the folder can be newer than what this run knows.
        let known = self
            .rise
            .map_or(self.best, |rise| Some([rise.best[0], rise.best[1]]));
        let judged = if beats(rank(&score), known) {
            self.score(CONFIRMATION, requests)?
        } else {
            score
        };
        let improved = self.take_down(&judged);
        // While the critic learns alone, an evaluation cannot rise.
        if !self.agent.ppo.is_critic_alone(self.agent.iteration)
            && let Some(rise) = &mut self.rise
        {
            rise.add(figures(&judged));
        }
        Ok((score, improved))
    }

    /// Records a score if it is the best so far, and returns whether it is.
    fn take_down(&mut self, score: &Score) -> bool {
        let improved = beats(rank(score), self.best);
        if improved {
            self.best = Some(rank(score));
        }
        improved
    }

    /// Plays so many evaluation episodes for this purpose, and shows their score.
    fn score(
        &mut self,
        (purpose, times): (&'static str, usize),
        requests: &Requests,
    ) -> Result<Score> {
        let task = self
            .task
            .at_the_stage_of(&self.config.env.at(self.agent.env_steps));
        let run = &self.config.run;
        let episodes = Episodes {
            seed: run.seed,
            purpose,
            first: 0,
            count: times * run.eval_episodes,
        };
        let actor = Actor::Mean(self.agent.ppo.policy.freeze());
        let trial = Trial {
            task: &task,
            actor: &actor,
            episodes,
            stop: &requests.stop,
        };
        let played = trial.play_together(&self.agent.exchange, &mut |_| {
            if let Some(lead) = &mut self.lead {
                lead.attend(requests);
            }
            Ok(())
        })?;
        let score = Score::of(&played, self.task.config.ctrl_dt);
        if let Some(lead) = &self.lead {
            lead.evaluated(self.agent.env_steps, &score);
        }
        Ok(score)
    }
}

/// Runs what may panic. A panic becomes an error.
fn caught<T>(run: impl FnOnce() -> Result<T>) -> Result<T> {
    schedule::caught(run).unwrap_or_else(|panic| Err(anyhow!("panic: {panic}")))
}

/// The purposes of evaluation episodes, and their number in multiples of `run.eval_episodes`.
const EVALUATION: (&str, usize) = ("evaluation", 1);
const CONFIRMATION: (&str, usize) = ("confirmation", CONFIRMED_BY);

/// The figures by which the best policy is chosen: goals per episode, and rotation error in rad.
fn rank(score: &Score) -> [f64; 2] {
    [score["goals"], score["rot_dist"]]
}

/// The figures by which a run that ends when evaluations no longer rise is compared with its start.
fn figures(score: &Score) -> [f64; 3] {
    HEADLINE.map(|column| score[column])
}

/// The iteration after which there is an early evaluation where the next one would come much later.
const EARLY: u64 = 50;

/// The iterations between two sets of histograms.
const HISTOGRAMS_EVERY: u64 = 50;

/// Whether there is an evaluation after this iteration. It depends on nothing else, so that a stop leaves no trace.
fn evaluates(iteration: u64, every: u64) -> bool {
    iteration.is_multiple_of(every) || iteration == EARLY && every > EARLY
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Override, Settings};
    use crate::os::Locked;
    use crate::ppo::Checkpoint;
    use crate::run::RunFolder;
    use crate::train::saver::Saver;
    use crate::train::start::Plan;

    fn from_scratch(sets: &[Override]) -> Session {
        let mut plan = Plan::new(
            Settings::new().sets(sets).resolve().unwrap(),
            &TrainArgs::default(),
        )
        .unwrap();
        let loaded = plan.load_task().unwrap();
        Session::new(plan, loaded, Exchange::alone(1)).unwrap()
    }

    #[test]
    fn the_memory_that_is_said_grows_with_the_longest_rollout_and_is_less_than_a_machine_has() {
        let session = |horizon: &str| {
            let sets = [
                "env.num_envs=8".parse().unwrap(),
                format!("ppo.horizon={horizon}").parse().unwrap(),
            ];
            from_scratch(&sets)
        };
        let [short, long] = ["16", "{from=16,to=160000,steps=1000}"].map(session);
        let of_samples = 8 * (160_000 - 16) * 4 * (2 * (157 + 20) + 8);
        assert_eq!(memory::growth(&long) - memory::growth(&short), of_samples);
        // Each of 16 groups of samples has a gradient of its own.
        let wide = from_scratch(&[
            "env.num_envs=8".parse().unwrap(),
            "ppo.horizon=16".parse().unwrap(),
            "ppo.hidden=[1024,1024]".parse().unwrap(),
        ]);
        let gradient = 4 * wide.agent.ppo.policy.layout.count();
        assert!(memory::growth(&wide) > 16 * gradient);
        // As many environments evaluate at once, however many episodes that takes.
        let many = from_scratch(&[
            "env.num_envs=8".parse().unwrap(),
            "ppo.horizon=16".parse().unwrap(),
            "run.eval_episodes=1000000".parse().unwrap(),
        ]);
        assert_eq!(memory::growth(&many), memory::growth(&short));
        let less = need(&short).is_none_or(|[needed, has]| 0.0 < needed && needed < has);
        assert!(less);
    }

    fn saver_of(session: &Session, place: (RunFolder, Locked)) -> Saver {
        Saver::new(
            place,
            &TrainArgs::default(),
            &session.config,
            session.checkpoint(),
        )
    }

    #[test]
    fn evaluations_come_at_the_multiples_and_once_early_where_they_are_rare() {
        let after = |every| {
            (1..=310)
                .filter(|&iteration| evaluates(iteration, every))
                .collect::<Vec<u64>>()
        };
        assert_eq!(after(150), [50, 150, 300]);
        assert_eq!(after(50), [50, 100, 150, 200, 250, 300]);
        assert_eq!(after(100), [50, 100, 200, 300]);
        assert_eq!(after(20)[..4], [20, 40, 60, 80]);
    }

    #[test]
    fn a_policy_is_the_best_only_if_its_score_in_other_episodes_confirms_that() {
        let now = Requests::none();
        let mut seeds = (0..).map(|seed| {
            let sets = [
                "env.num_envs=2",
                "ppo.hidden=[8]",
                "run.eval_episodes=1",
                &format!("run.seed={seed}"),
            ];
            let mut session = from_scratch(&sets.map(|set| set.parse().unwrap()));
            let scores = [EVALUATION, CONFIRMATION]
                .map(|episodes| rank(&session.score(episodes, &now).unwrap()));
            (session, scores)
        });
        let lucky = seeds.find(|(_, [score, confirmation])| beats(*score, Some(*confirmation)));
        let (mut session, [score, confirmation]) = lucky.unwrap();
        let between = [0.0, (score[1] + confirmation[1]) / 2.0];
        for (before, after) in [(between, between), ([0.0, 9.0], confirmation)] {
            session.best = Some(before);
            let (found, improved) = session.evaluate(true, &now).unwrap();
            assert_eq!((rank(&found), improved), (score, before != after));
            assert_eq!(session.best, Some(after));
        }
        // As in a resume of a checkpoint from before the best evaluation.
        session.best = Some([9.0, 0.0]);
        session.rise = Some(Rise {
            before: [0.0, 9.0, 0.0],
            best: [0.0, 9.0, 0.0],
            since: 3,
        });
        session.agent.iteration = 1;
        session.evaluate(true, &now).unwrap();
        assert_eq!(session.rise.unwrap().best[..2], confirmation);
    }

    #[test]
    fn an_evaluation_before_the_first_iteration_does_not_replace_a_better_best() {
        let sets = [
            "env.num_envs=2",
            "ppo.hidden=[8]",
            "run.eval_episodes=1",
            "run.patience=1",
        ];
        let mut session = from_scratch(&sets.map(|set| set.parse().unwrap()));
        // As in a resume of the first checkpoint of a run that found a better policy later.
        session.best = Some([9.0, 0.0]);
        session.begin(&Requests::none()).unwrap();
        assert!(session.rise.is_some());
        assert_eq!(session.best, Some([9.0, 0.0]));
    }

    #[test]
    fn a_panic_on_a_worker_thread_is_an_error_and_the_iteration_before_is_saved() {
        let place = tempfile::tempdir().unwrap();
        let sets = [
            "env.num_envs=9",
            "ppo.horizon=4",
            "ppo.hidden=[8]",
            "run.eval_every=1000",
        ];
        let sets: Vec<Override> = sets.map(|set| set.parse().unwrap()).into();
        let mut session = from_scratch(&sets);
        let saver = saver_of(
            &session,
            RunFolder::create(Some(place.path()), None).unwrap(),
        );
        let mut lead = Lead::new(&session.config, saver, true);
        lead.open_folder().unwrap();
        let never = Requests::none();
        session.iterate(&never).unwrap();
        lead.saver.keep(session.checkpoint());
        // A rollout with room for fewer environments than there are.
        session.agent.rollout = session.agent.ppo.rollout(&[7, 1]);
        let error = session.iterate(&never).unwrap_err();
        let error = format!(
            "{:#}",
            lead.end(&session.config, false, Err(error)).unwrap_err()
        );
        assert!(error.contains("iteration 2: panic: "), "{error}");
        let latest = place.path().join("checkpoints/latest.safetensors");
        let saved = os::read_bytes(&latest).unwrap();
        assert_eq!(Checkpoint::parse(&saved).unwrap().progress.iteration, 1);
    }

    #[test]
    fn a_run_that_cannot_begin_leaves_nothing_but_what_is_anothers() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("run");
        let sets =
            ["env.num_envs=9", "ppo.horizon=4", "ppo.hidden=[8]"].map(|set| set.parse().unwrap());
        let session = from_scratch(&sets);
        let begin = || {
            let saver = saver_of(&session, RunFolder::create(Some(&path), None).unwrap());
            let mut lead = Lead::new(&session.config, saver, true);
            lead.open_folder().unwrap();
            lead
        };
        begin().saver.give_back();
        assert!(!path.exists());
        let lost = begin();
        std::process::Command::new("rm")
            .arg("-r")
            .arg(&path)
            .status()
            .unwrap();
        let other = begin();
        lost.saver.give_back();
        assert!(path.join("checkpoints/latest.safetensors").exists());
        drop(other);
    }
}
