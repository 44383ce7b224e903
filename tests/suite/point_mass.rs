//! The learner on a task without physics: learning can be tested in seconds.

use std::sync::atomic::AtomicBool;

use shadow_repose::collect::{Scratch, collect};
use shadow_repose::config::{Backend, Config, PpoConfig, Precision};
use shadow_repose::env::{End, Env, EnvPool, Transition};
use shadow_repose::ppo::Ppo;
use shadow_repose::rng::{self, Rng};

use crate::support::config;

const STEPS: u32 = 20;

static NEVER: AtomicBool = AtomicBool::new(false);

/// A point in the plane that is moved by up to 0.2 a step and should come to the origin.
struct PointMass {
    position: [f64; 2],
    age: u32,
    /// Where it panics.
    trap: Option<u32>,
    /// The steps after which its goal is replaced, by the same one.
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

impl Env for PointMass {
    /// The distance at the end.
    type Episode = f64;

    fn observation_size(&self) -> usize {
        2
    }

    fn action_size(&self) -> usize {
        2
    }

    fn distance(observation: &[f32]) -> f32 {
        observation[0].hypot(observation[1])
    }

    fn reset(&mut self, mut rng: Rng, observation: &mut [f32]) {
        self.position = [0.0; 2].map(|_| rng::uniform(&mut rng, -1.0, 1.0));
        self.age = 0;
        self.write(observation);
    }

    fn skip_ahead(&mut self, share: f64) {
        self.age = (share * f64::from(STEPS)) as u32;
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
        Transition { reward: -self.distance() as f32, end }
    }

    fn redirect(&mut self, observation: &mut [f32]) {
        self.write(observation);
    }

    fn episode(&self) -> f64 {
        self.distance()
    }
}

fn pool(seed: u64) -> EnvPool<PointMass> {
    pool_of(64, seed)
}

fn pool_of(envs: usize, seed: u64) -> EnvPool<PointMass> {
    EnvPool::new(
        seed,
        (0..envs).map(|_| PointMass { position: [0.0; 2], age: 0, trap: None, redirects: STEPS }).collect(),
    )
}

fn settings() -> PpoConfig {
    let settings = ["ppo.hidden=[32,32]", "ppo.reward_scale=0.2", "ppo.init_std=0.5", "ppo.gamma=0.9"];
    config(&settings).ppo
}

/// Mean distances at the end of the episodes of the first and of the last of 60 iterations.
fn distances(settings: &PpoConfig, seed: u64) -> [f64; 2] {
    let (mut pool, mut ppo) = (pool(seed), Ppo::new(settings, 2, 2, seed).unwrap());
    let (mut rollout, mut scratch) = (ppo.rollout(&pool.block_sizes()), Scratch::new(&pool, &ppo));
    pool.reset(rollout.first_observations_mut());
    let mut distances = Vec::new();
    for iteration in 1..=60 {
        collect(&mut pool, &ppo, &mut rollout, iteration, &mut scratch, &NEVER).unwrap();
        ppo.update(&mut rollout, iteration, &NEVER).unwrap().unwrap();
        rollout.carry_over();
        let finished = pool.take_finished();
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
            let [first, last] = distances(&PpoConfig { precision, ..settings() }, seed);
            assert!(first > 0.5 && last < 0.15, "{precision:?}, seed {seed}: {first} → {last}");
        }
    }
}

#[test]
fn ppo_learns_with_candles_tensors_too() {
    let [first, last] = distances(&PpoConfig { backend: Backend::Candle, ..settings() }, 0);
    assert!(first > 0.5 && last < 0.15, "{first} → {last}");
}

/// On a processor with tiles for bf16; elsewhere the refusal is tested with the program.
#[test]
fn ppo_learns_on_tiles_where_there_are_any() {
    let settings = PpoConfig { precision: Precision::Bf16, ..settings() };
    if Ppo::new(&settings, 2, 2, 0).is_ok() {
        let [first, last] = distances(&settings, 0);
        assert!(first > 0.5 && last < 0.15, "{first} → {last}");
    }
}

#[test]
fn standard_deviations_stay_within_a_bound_that_falls_by_equal_factors() {
    let settings = PpoConfig { max_std: 0.125, max_std_steps: 100, min_std: 0.0, ..settings() };
    let mut ppo = Ppo::new(&settings, 2, 2, 0).unwrap();
    let mut std_at = |env_steps| {
        ppo.limit_std(env_steps).unwrap();
        ppo.policy().std().unwrap()
    };
    for (env_steps, expected) in [(0, 0.5f32), (50, 0.25), (100, 0.125), (1000, 0.125), (0, 0.125)] {
        assert!(std_at(env_steps).iter().all(|std| (std - expected).abs() < 1e-6), "{env_steps}");
    }
    let mut free = Ppo::new(&PpoConfig { max_std_steps: 0, ..settings }, 2, 2, 0).unwrap();
    free.limit_std(1000).unwrap();
    assert!(free.policy().std().unwrap().iter().all(|std| (std - 0.5).abs() < 1e-6));
}

#[test]
fn standard_deviations_stay_above_a_lower_bound_and_are_raised_to_it() {
    for (min_std, expected) in [(0.25, 0.5f32), (0.75, 0.75)] {
        let mut ppo = Ppo::new(&PpoConfig { min_std, max_std_steps: 0, ..settings() }, 2, 2, 0).unwrap();
        ppo.limit_std(1000).unwrap();
        assert!(ppo.policy().std().unwrap().iter().all(|std| (std - expected).abs() < 1e-6), "{min_std}");
    }
    // The default's upper bound falls to 0.2; a lower one above that would contradict it.
    let refused = Config::resolve(None, &["ppo.min_std=0.5".parse().unwrap()]).unwrap_err();
    assert!(format!("{refused:#}").contains("ppo.min_std = 0.5: must lie in [0, 0.2]"), "{refused:#}");
}

#[test]
fn the_first_minibatch_sees_the_very_policy_that_acted() {
    let settings = PpoConfig { exploring_share: 0.5, exploring_scale: 3.0, ..settings() };
    let (mut pool, mut ppo) = (pool(3), Ppo::new(&settings, 2, 2, 3).unwrap());
    let (mut rollout, mut scratch) = (ppo.rollout(&pool.block_sizes()), Scratch::new(&pool, &ppo));
    pool.reset(rollout.first_observations_mut());
    for iteration in 1..=5 {
        collect(&mut pool, &ppo, &mut rollout, iteration, &mut scratch, &NEVER).unwrap();
        let stats = ppo.update(&mut rollout, iteration, &NEVER).unwrap().unwrap();
        rollout.carry_over();
        assert!(stats.first_kl.abs() < 1e-5, "iteration {iteration}: KL {}", stats.first_kl);
        assert!(stats.first_ratio_error < 1e-4, "iteration {iteration}: ratio off by {}", stats.first_ratio_error);
        assert!(stats.kl > 1e-4, "later minibatches must have moved on: {}", stats.kl);
    }
}

#[test]
fn the_environments_that_explore_change_with_each_iteration_and_hold_a_larger_noise_through_it() {
    let settings = PpoConfig { exploring_share: 0.25, exploring_scale: 3.0, ..settings() };
    let (mut pool, ppo) = (pool_of(1024, 3), Ppo::new(&settings, 2, 2, 3).unwrap());
    let (mut rollout, mut scratch) = (ppo.rollout(&pool.block_sizes()), Scratch::new(&pool, &ppo));
    pool.reset(rollout.first_observations_mut());
    let scales = [1, 2].map(|iteration| {
        collect(&mut pool, &ppo, &mut rollout, iteration, &mut scratch, &NEVER).unwrap();
        // Squares of the distances from the mean, and numbers of them, of those that explore and of the others.
        let mut spread = [[0.0f64; 2]; 2];
        for block in &rollout.blocks {
            let envs = block.exploring_scales.len();
            let away = |i: usize| [0, 1].map(|j| block.actions[2 * i + j] - block.means[2 * i + j]);
            for i in 0..block.samples() {
                let explores = block.noise_scales[i] > 1.0;
                let [sum, count] = &mut spread[usize::from(explores)];
                *sum += f64::from(away(i)[0].powi(2) + away(i)[1].powi(2));
                *count += 2.0;
                let same = (away(i)[0] - away(i % envs)[0]).abs() < 1e-5;
                assert_eq!(same, explores || i < envs, "sample {i}: {:?} {:?}", away(i), away(i % envs));
            }
        }
        let [quiet, exploring] = spread;
        let share = exploring[1] / (quiet[1] + exploring[1]);
        assert!((0.2..0.3).contains(&share), "{share}");
        for ([sum, count], expected) in [(quiet, 0.5), (exploring, 1.5)] {
            let std = (sum / count).sqrt();
            assert!((std / expected - 1.0).abs() < 0.15, "{std} instead of {expected}");
        }
        rollout.blocks.iter().flat_map(|block| &block.noise_scales).copied().collect::<Vec<f32>>()
    });
    assert!(scales[0].iter().all(|&scale| scale == 1.0 || scale == 3.0) && scales[0] != scales[1]);
}

#[test]
fn a_reward_that_is_not_finite_stops_the_learner_and_names_the_minibatch() {
    let (mut pool, mut ppo) = (pool(0), Ppo::new(&settings(), 2, 2, 0).unwrap());
    let (mut rollout, mut scratch) = (ppo.rollout(&pool.block_sizes()), Scratch::new(&pool, &ppo));
    pool.reset(rollout.first_observations_mut());
    collect(&mut pool, &ppo, &mut rollout, 17, &mut scratch, &NEVER).unwrap();
    rollout.blocks[2].rewards[5] = f32::NAN;
    let answer = |ppo: &Ppo| {
        let (policy, mut means) = (ppo.policy().freeze().unwrap(), [0.0; 2]);
        policy.forward(&[0.3, -0.4], [Some(&mut means), None], &mut policy.workspace(1)).unwrap();
        means
    };
    let before = answer(&ppo);
    let error = format!("{:#}", ppo.update(&mut rollout, 17, &NEVER).unwrap_err());
    assert!(error.contains("epoch 0, minibatch") && error.contains("NaN"), "{error}");
    assert_eq!(before, answer(&ppo), "nothing is learnt from it");
}

#[test]
fn a_panic_in_an_environment_is_an_error_with_its_number_on_any_number_of_threads() {
    for threads in [1, 2, 8] {
        let threads = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        threads.install(|| {
            let (mut pool, ppo) = (pool(0), Ppo::new(&settings(), 2, 2, 0).unwrap());
            let (mut rollout, mut scratch) = (ppo.rollout(&pool.block_sizes()), Scratch::new(&pool, &ppo));
            pool.reset(rollout.first_observations_mut());
            let trapped = pool.envs_mut().nth(43).unwrap();
            trapped.trap = Some(if trapped.age + 3 <= STEPS { trapped.age + 3 } else { 3 });
            let error = collect(&mut pool, &ppo, &mut rollout, 1, &mut scratch, &NEVER).unwrap_err();
            let said = format!("{error:#}");
            assert!(said.contains("environment 43 panicked") && said.contains("the trap"), "{said}");
        });
    }
}

#[test]
fn truncation_and_another_goal_bootstrap_from_the_final_observation_and_termination_does_not() {
    let (mut pool, ppo) = (pool(1), Ppo::new(&settings(), 2, 2, 1).unwrap());
    let (mut rollout, mut scratch) = (ppo.rollout(&pool.block_sizes()), Scratch::new(&pool, &ppo));
    pool.reset(rollout.first_observations_mut());
    // One point starts so far out that it is lost at once.
    rollout.blocks[0].first_observations_mut()[..2].copy_from_slice(&[5.0, 5.0]);
    pool.envs_mut().next().unwrap().position = [5.0, 5.0];
    pool.envs_mut().skip(1).step_by(2).for_each(|env| env.redirects = 7);
    collect(&mut pool, &ppo, &mut rollout, 1, &mut scratch, &NEVER).unwrap();
    let policy = ppo.policy().freeze().unwrap();
    let mut work = policy.workspace(1);
    let (mut truncated, mut redirected, mut terminated) = (0, 0, 0);
    for (block, i) in rollout.blocks.iter().flat_map(|block| (0..block.samples()).map(move |i| (block, i))) {
        let moved =
            [0, 1].map(|axis| block.observations[2 * i + axis] + 0.2 * block.actions[2 * i + axis].clamp(-1.0, 1.0));
        let distance = moved[0].hypot(moved[1]);
        let mut expected = -0.2 * distance;
        if block.dones[i] && distance <= 3.0 {
            let mut value = [0.0];
            policy.forward(&moved, [None, Some(&mut value)], &mut work).unwrap();
            expected += 0.9 * value[0];
            let next = 2 * (i + block.exploring_scales.len());
            let goes_on = (0..2).all(|axis| (block.observations[next + axis] - moved[axis]).abs() < 1e-5);
            *if goes_on { &mut redirected } else { &mut truncated } += 1;
        } else if block.dones[i] {
            terminated += 1;
        }
        assert!((block.rewards[i] - expected).abs() < 1e-5, "sample {i}: {} not {expected}", block.rewards[i]);
    }
    let found = format!("{truncated} truncated, {redirected} redirected, {terminated} terminated");
    assert!(truncated > 30 && redirected > 30 && terminated == 1, "{found}");
}

#[test]
fn an_interrupted_collection_says_so() {
    let (mut pool, ppo) = (pool(1), Ppo::new(&settings(), 2, 2, 1).unwrap());
    let (mut rollout, mut scratch) = (ppo.rollout(&pool.block_sizes()), Scratch::new(&pool, &ppo));
    pool.reset(rollout.first_observations_mut());
    let mut collected =
        |interrupted| collect(&mut pool, &ppo, &mut rollout, 1, &mut scratch, &AtomicBool::new(interrupted)).unwrap();
    assert!(!collected(true));
    assert!(collected(false));
}

#[test]
fn pools_of_any_size_learn_the_same_bits_on_any_number_of_threads() {
    for envs in [1, 9, 21] {
        let learn = |threads: usize| {
            let threads = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            threads.install(|| {
                let (mut pool, mut ppo) = (pool_of(envs, 5), Ppo::new(&settings(), 2, 2, 5).unwrap());
                let (mut rollout, mut scratch) = (ppo.rollout(&pool.block_sizes()), Scratch::new(&pool, &ppo));
                pool.reset(rollout.first_observations_mut());
                for iteration in 1..=4 {
                    let never = AtomicBool::new(false);
                    assert!(collect(&mut pool, &ppo, &mut rollout, iteration, &mut scratch, &never).unwrap());
                    ppo.update(&mut rollout, iteration, &NEVER).unwrap().unwrap();
                    rollout.carry_over();
                }
                let (policy, mut means) = (ppo.policy().freeze().unwrap(), [0.0; 2]);
                policy.forward(&[0.3, -0.4], [Some(&mut means), None], &mut policy.workspace(1)).unwrap();
                (means, pool.take_finished())
            })
        };
        let one = learn(1);
        assert!(one.1.len() >= 3 * envs, "episodes must end meanwhile");
        assert!(one == learn(2) && one == learn(8), "{envs} environments");
    }
}
