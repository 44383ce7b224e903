//! The learner on a task without physics, where learning can be tested in seconds.

use std::sync::atomic::AtomicBool;

use shadow_repose::agent::Agent;
use shadow_repose::config::{Backend, Geometric, PpoConfig, Precision, Ramp};
use shadow_repose::env::{End, Env, Transition};
use shadow_repose::os::Interrupted;
use shadow_repose::ppo::Ppo;
use shadow_repose::ranks::Exchange;
use shadow_repose::rng::{self, Rng};
use shadow_repose::spaces::Spaces;

use crate::support::config;

const STEPS: u32 = 20;

static NEVER: AtomicBool = AtomicBool::new(false);

/// A point in the plane that moves by up to 0.2 per step and axis and should reach the origin.
pub(crate) struct PointMass {
    position: [f64; 2],
    age: u32,
    /// The age at which it panics.
    trap: Option<u32>,
    /// The number of steps after which the goal is replaced by the same one.
    redirects: u32,
}

impl PointMass {
    fn write(&self, observation: &mut [f32]) {
        observation.copy_from_slice(&self.position.map(|x| x as f32));
    }

    fn distance(&self) -> f64 {
        self.position[0].hypot(self.position[1])
    }
}

const SPACES: Spaces = Spaces {
    observation_size: 2,
    action_size: 2,
    object_and_goal: None,
    distance: |_, observation| observation[0].hypot(observation[1]),
};

impl Env for PointMass {
    /// The distance at the end of the episode.
    type Episode = f64;
    type Lesson = ();
    fn spaces(&self) -> Spaces {
        SPACES
    }

    fn set_lesson(&mut self, (): ()) {}

    fn reset(&mut self, mut rng: Rng, observation: &mut [f32]) {
        self.position = [0.0; 2].map(|_| rng::uniform(&mut rng, -1.0, 1.0));
        self.age = 0;
        self.write(observation);
    }

    fn skip_ahead(&mut self, fraction: f64) {
        self.age = (fraction * f64::from(STEPS)) as u32;
    }

    fn step(&mut self, action: &[f32], observation: &mut [f32]) -> Transition {
        for (x, &a) in self.position.iter_mut().zip(action) {
            *x += 0.2 * f64::from(a.clamp(-1.0, 1.0));
        }
        self.age += 1;
        assert_ne!(self.trap, Some(self.age), "the trap");
        self.write(observation);
        let end = match self.age {
            _ if self.distance() > 3.0 => Some(End::Terminated),
            STEPS.. => Some(End::Truncated),
            age => (age % self.redirects == 0).then_some(End::Redirected),
        };
        Transition {
            reward: -self.distance() as f32,
            end,
        }
    }

    fn redirect(&mut self, observation: &mut [f32]) {
        self.write(observation);
    }

    fn episode(&self) -> f64 {
        self.distance()
    }
}

fn agent(settings: &PpoConfig, seed: u64) -> Agent<PointMass> {
    agent_of(64, settings, seed)
}

fn agent_of(envs: usize, settings: &PpoConfig, seed: u64) -> Agent<PointMass> {
    of_ranks(envs, settings, seed, Exchange::alone(1))
}

/// Returns the agent of one of several ranks, with this number of its own points.
pub(crate) fn of_ranks(
    envs: usize,
    settings: &PpoConfig,
    seed: u64,
    exchange: Exchange,
) -> Agent<PointMass> {
    let point = |_| PointMass {
        position: [0.0; 2],
        age: 0,
        trap: None,
        redirects: STEPS,
    };
    Agent::new(
        (0..envs).map(point).collect(),
        settings,
        seed,
        exchange,
        |_| (),
    )
    .unwrap()
}

pub(crate) fn settings() -> PpoConfig {
    let settings = [
        "ppo.hidden=[32,32]",
        "ppo.reward_scale=0.2",
        "ppo.std={from=0.5,to=0.2,steps=25_000_000}",
        "ppo.gamma=0.9",
    ];
    config(&settings).ppo
}

/// Trains for 60 iterations. Returns the mean distance at the end of episodes, for the first and the last iteration with any.
fn distances(settings: &PpoConfig, seed: u64) -> [f64; 2] {
    let mut agent = agent(settings, seed);
    let mut distances = Vec::new();
    for _ in 1..=60 {
        agent.iterate(&NEVER).unwrap();
        let finished = agent.pool.take_finished();
        if !finished.is_empty() {
            distances.push(finished.iter().sum::<f64>() / finished.len() as f64);
        }
    }
    [distances[0], distances[distances.len() - 1]]
}

#[test]
fn ppo_learns_to_bring_the_point_home_on_three_seeds_in_floats_and_in_bf16() {
    for precision in [Precision::F32, Precision::Bf16Rounded] {
        for seed in 0..3 {
            let [first, last] = distances(
                &PpoConfig {
                    precision,
                    ..settings()
                },
                seed,
            );
            assert!(
                first > 0.5 && last < 0.15,
                "{precision:?}, seed {seed}: {first} → {last}"
            );
        }
    }
}

#[test]
fn ppo_learns_with_candles_tensors_too() {
    let [first, last] = distances(
        &PpoConfig {
            backend: Backend::Candle,
            ..settings()
        },
        0,
    );
    assert!(first > 0.5 && last < 0.15, "{first} → {last}");
}

/// Only on a processor with a unit for bf16. On others, the tests of the program check the refusal.
#[test]
fn ppo_learns_in_bf16_where_the_processor_has_it() {
    let settings = PpoConfig {
        precision: Precision::Bf16,
        ..settings()
    };
    if Ppo::new(&settings, SPACES, 0, Exchange::alone(1)).is_ok() {
        let [first, last] = distances(&settings, 0);
        assert!(first > 0.5 && last < 0.15, "{first} → {last}");
    }
}

#[test]
fn the_standard_deviations_follow_their_ramp_by_equal_factors() {
    let std = Ramp {
        from: 0.5,
        to: 0.125,
        steps: 100,
        after: 0,
    };
    let settings = PpoConfig {
        std: Geometric(std),
        ..settings()
    };
    let mut ppo = Ppo::new(&settings, SPACES, 0, Exchange::alone(1)).unwrap();
    assert!((ppo.policy.std() - 0.5).abs() < 1e-6);
    for (env_steps, expected) in [
        (0, 0.5f32),
        (50, 0.25),
        (100, 0.125),
        (1000, 0.125),
        (0, 0.5),
    ] {
        ppo.follow_ramps(env_steps, &mut ppo.rollout(&[1]));
        assert!((ppo.policy.std() - expected).abs() < 1e-6, "{env_steps}");
    }
    let at_once = PpoConfig {
        std: Geometric(Ramp { steps: 0, ..std }),
        ..settings
    };
    let ppo = Ppo::new(&at_once, SPACES, 0, Exchange::alone(1)).unwrap();
    assert!(
        (ppo.policy.std() - 0.125).abs() < 1e-6,
        "0 steps: the final value from the start"
    );
}

#[test]
fn while_the_critic_learns_alone_the_policy_stands_still() {
    for backend in [Backend::Fused, Backend::Candle] {
        let mut agent = agent(
            &PpoConfig {
                backend,
                critic_first: 2,
                ..settings()
            },
            3,
        );
        let nets = |agent: &Agent<PointMass>| {
            let policy = &agent.ppo.policy;
            policy
                .layout
                .nets()
                .map(|net| policy.parameters[net].to_vec())
        };
        let [actor, mut critic] = nets(&agent);
        for iteration in 1..=3 {
            let stats = agent.iterate(&NEVER).unwrap().update;
            let [acts, values] = nets(&agent);
            let alone = iteration <= 2;
            assert_eq!(acts == actor, alone, "iteration {iteration}");
            assert!(values != critic, "iteration {iteration}");
            assert_eq!(
                stats.learning_rate == settings().learning_rate,
                alone,
                "no divergence leads the rate then"
            );
            critic = values;
        }
    }
}

#[test]
fn the_first_steps_of_an_actor_are_no_larger_after_the_critic_has_learnt_alone() {
    let moved = |critic_first: u64| {
        let settings = PpoConfig {
            critic_first,
            desired_kl: Geometric(Ramp::constant(0.0)),
            ..settings()
        };
        let mut agent = agent(&settings, 3);
        (0..critic_first).for_each(|_| assert!(agent.iterate(&NEVER).is_ok()));
        let actor = |agent: &Agent<PointMass>| {
            let policy = &agent.ppo.policy;
            let [actor, _] = policy.layout.nets();
            policy.parameters[actor].to_vec()
        };
        let before = actor(&agent);
        agent.iterate(&NEVER).unwrap();
        actor(&agent)
            .iter()
            .zip(before)
            .map(|(after, before)| f64::from(after - before).powi(2))
            .sum::<f64>()
            .sqrt()
    };
    let (at_once, later) = (moved(0), moved(20));
    assert!(later < 1.2 * at_once, "{later} after {at_once}");
}

#[test]
fn the_first_minibatch_sees_the_very_policy_that_acted() {
    for backend in [Backend::Fused, Backend::Candle] {
        let mut agent = agent(
            &PpoConfig {
                backend,
                ..settings()
            },
            3,
        );
        for iteration in 1..=5 {
            let stats = agent.iterate(&NEVER).unwrap().update;
            assert!(
                stats.first.kl.abs() < 1e-5,
                "iteration {iteration}: KL {}",
                stats.first.kl
            );
            assert!(
                stats.first.ratio_error < 1e-4,
                "iteration {iteration}: ratio off by {}",
                stats.first.ratio_error
            );
            assert!(
                stats.losses.kl > 1e-4,
                "the policy must have changed in later minibatches: {}",
                stats.losses.kl
            );
        }
    }
}

#[test]
fn a_reward_that_is_not_finite_stops_the_learner_and_names_the_minibatch() {
    let Agent {
        mut ppo,
        mut rollout,
        ..
    } = {
        let mut agent = agent(&settings(), 0);
        agent.collect(&NEVER).unwrap();
        agent
    };
    rollout.blocks[2].rewards[5] = f32::NAN;
    let before = answer(&ppo);
    let error = format!("{:#}", ppo.update(&mut rollout, 17, &NEVER).unwrap_err());
    assert!(
        error.contains("epoch 0, minibatch") && error.contains("NaN"),
        "{error}"
    );
    assert_eq!(before, answer(&ppo), "nothing is learnt from it");
}

/// Returns the mean action of the policy for one observation.
fn answer(ppo: &Ppo) -> [f32; 2] {
    let (policy, mut means) = (ppo.policy.freeze(), [0.0; 2]);
    policy.compute(
        &[0.3, -0.4],
        [&mut means, &mut []],
        &mut policy.workspace(1),
    );
    means
}

#[test]
fn a_panic_in_an_environment_is_an_error_with_its_number_on_any_number_of_threads() {
    for threads in [1, 2, 8] {
        let threads = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        threads.install(|| {
            let mut agent = agent(&settings(), 0);
            let trapped = agent.pool.envs_mut().nth(43).unwrap();
            trapped.trap = Some(if trapped.age + 3 <= STEPS {
                trapped.age + 3
            } else {
                3
            });
            let said = format!("{:#}", agent.iterate(&NEVER).unwrap_err());
            assert!(
                said.contains("environment 43 panicked") && said.contains("the trap"),
                "{said}"
            );
        });
    }
}

#[test]
fn truncation_and_another_goal_bootstrap_from_the_final_observation_and_termination_does_not() {
    let mut agent = agent(&settings(), 1);
    // One point starts so far out that its episode terminates at once.
    agent.rollout.blocks[0].observations[..2].copy_from_slice(&[5.0, 5.0]);
    agent.pool.envs_mut().next().unwrap().position = [5.0, 5.0];
    agent
        .pool
        .envs_mut()
        .skip(1)
        .step_by(2)
        .for_each(|env| env.redirects = 7);
    agent.collect(&NEVER).unwrap();
    let policy = agent.ppo.policy.freeze();
    let mut work = policy.workspace(1);
    let (mut truncated, mut redirected, mut terminated) = (0, 0, 0);
    let blocks = agent.rollout.blocks.iter();
    for (block, i) in blocks.flat_map(|block| (0..block.samples()).map(move |i| (block, i))) {
        let moved = [0, 1].map(|axis| {
            block.observations[2 * i + axis] + 0.2 * block.actions[2 * i + axis].clamp(-1.0, 1.0)
        });
        let distance = moved[0].hypot(moved[1]);
        let mut expected = -0.2 * distance;
        if block.dones[i] && distance <= 3.0 {
            let mut value = [0.0];
            policy.compute(&moved, [&mut [], &mut value], &mut work);
            expected += 0.9 * value[0];
            let next = 2 * (i + block.step(0, 1).len());
            let goes_on =
                (0..2).all(|axis| (block.observations[next + axis] - moved[axis]).abs() < 1e-5);
            *if goes_on {
                &mut redirected
            } else {
                &mut truncated
            } += 1;
        } else if block.dones[i] {
            terminated += 1;
        }
        assert!(
            (block.rewards[i] - expected).abs() < 1e-5,
            "sample {i}: {} not {expected}",
            block.rewards[i]
        );
    }
    let found = format!("{truncated} truncated, {redirected} redirected, {terminated} terminated");
    assert!(
        truncated > 30 && redirected > 30 && terminated == 1,
        "{found}"
    );
}

#[test]
fn an_interrupted_collection_says_so() {
    let mut agent = agent(&settings(), 1);
    let interrupted = agent.collect(&AtomicBool::new(true)).unwrap_err();
    assert!(interrupted.is::<Interrupted>());
    assert!(agent.collect(&NEVER).is_ok());
}

#[test]
fn pools_of_any_size_learn_the_same_bits_on_any_number_of_threads() {
    for envs in [1, 9, 21] {
        let learn = |threads: usize| {
            let threads = rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .unwrap();
            threads.install(|| {
                let mut agent = agent_of(envs, &settings(), 5);
                (0..4).for_each(|_| assert!(agent.iterate(&NEVER).is_ok()));
                (answer(&agent.ppo), agent.pool.take_finished())
            })
        };
        let one = learn(1);
        assert!(one.1.len() >= 3 * envs, "episodes must end during the test");
        assert!(
            [2, 3, 8].into_iter().all(|threads| one == learn(threads)),
            "{envs} environments"
        );
    }
}

#[test]
fn iterations_and_steps_are_counted_where_they_are_made() {
    let mut agent = agent_of(
        9,
        &PpoConfig {
            horizon: Ramp::constant(8.0),
            ..settings()
        },
        0,
    );
    let made = agent.iterate(&NEVER).unwrap();
    assert_eq!((agent.iteration, agent.env_steps, made.steps), (1, 72, 72));
    let interrupted = agent.iterate(&AtomicBool::new(true)).unwrap_err();
    assert!(interrupted.is::<Interrupted>());
    assert_eq!(
        (agent.iteration, agent.env_steps),
        (1, 72),
        "an iteration that was stopped is not counted"
    );
}
