//! Pools of many environments.

use std::sync::atomic::AtomicBool;

use rand::RngExt;
use shadow_repose::env::{Autoreset, End, EnvBlock, EnvPool, Member};
use shadow_repose::ppo::RolloutBlock;
use shadow_repose::ranks::Exchange;
use shadow_repose::repose::{Lesson, Repose, Task};
use shadow_repose::rng;
use shadow_repose::schedule::in_rounds;

use crate::support::{OBSERVATION_SIZE, config, started_agent, task};

struct Played {
    /// Observations of all environments after each step.
    observations: Vec<f32>,
    rewards: Vec<f32>,
    lengths: Vec<u32>,
}

/// A block of environments with the buffers that it reads and writes.
struct Block<'a> {
    envs: &'a mut EnvBlock<Repose>,
    first: usize,
    observations: Vec<f32>,
    rewards: Vec<f32>,
    seen: Vec<(Vec<f32>, Vec<f32>)>,
    truncated: usize,
}

impl Block<'_> {
    /// Steps the block. `actions` belong to all environments.
    fn step(&mut self, actions: &[f32]) {
        let actions = &actions[self.first * 20..][..self.rewards.len() * 20];
        self.envs
            .step(actions, &mut self.rewards, &mut self.observations)
            .unwrap();
        self.seen
            .push((self.observations.clone(), self.rewards.clone()));
        for (i, member) in self.envs.members.iter().enumerate() {
            let end = member.end;
            let rows = i * OBSERVATION_SIZE..(i + 1) * OBSERVATION_SIZE;
            let previous_action = &self.observations[rows][OBSERVATION_SIZE - 20..];
            // Where an episode ended, a new one has begun: only there is the previous action zero.
            assert_eq!(end.is_some(), previous_action.iter().all(|&a| a == 0.0));
            if end.is_some() {
                // The final observation belongs to this environment: it shows its last action.
                let action = &actions[i * 20..][..20];
                let last: Vec<f32> = action.iter().map(|a| a.clamp(-1.0, 1.0)).collect();
                assert_eq!(member.final_observation[OBSERVATION_SIZE - 20..], last);
                self.truncated += usize::from(end == Some(End::Truncated));
            }
        }
    }
}

/// Steps a new pool with these actions on `threads` threads.
fn play(
    threads: usize,
    envs: usize,
    steps: usize,
    settings: &[&str],
    action: impl Fn(usize, usize) -> f32,
) -> Played {
    let threads = rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .unwrap();
    let task = task(settings);
    let actions: Vec<Vec<f32>> = (0..steps)
        .map(|step| (0..envs * 20).map(|i| action(step, i)).collect())
        .collect();
    threads.install(|| {
        let mut pool = EnvPool::new(
            5,
            (0..envs).map(|_| Repose::new(&task)).collect(),
            &Exchange::alone(1),
        );
        let sizes = pool.block_sizes();
        let mut observations: Vec<Vec<f32>> = sizes
            .iter()
            .map(|n| vec![0.0; n * OBSERVATION_SIZE])
            .collect();
        let blocks = observations.iter_mut();
        pool.reset(blocks.flat_map(|rows| rows.chunks_exact_mut(OBSERVATION_SIZE)));
        let mut first = 0;
        let blocks = pool
            .blocks
            .iter_mut()
            .zip(observations)
            .map(|(envs, observations)| {
                let n = envs.members.len();
                first += n;
                Block {
                    envs,
                    first: first - n,
                    observations,
                    rewards: vec![0.0; n],
                    seen: Vec::new(),
                    truncated: 0,
                }
            });
        let blocks: Vec<Block> = blocks.collect();
        let blocks = in_rounds(blocks, steps, |block, step| block.step(&actions[step]));
        let truncated: usize = blocks.iter().map(|block| block.truncated).sum();
        assert!(truncated > 0 || steps < 30, "no episode was truncated");
        let seen = |step: usize| blocks.iter().map(move |block| &block.seen[step]);
        let observations = (0..steps)
            .flat_map(seen)
            .flat_map(|(observations, _)| observations)
            .copied()
            .collect();
        let rewards = (0..steps)
            .flat_map(seen)
            .flat_map(|(_, rewards)| rewards)
            .copied()
            .collect();
        drop(blocks);
        let lengths = pool
            .take_finished()
            .iter()
            .map(|episode| episode.length)
            .collect();
        Played {
            observations,
            rewards,
            lengths,
        }
    })
}

/// Returns a function of step and index that gives random actions, always the same.
fn noise() -> impl Fn(usize, usize) -> f32 {
    let mut noise = rng::stream(0, "test", 0);
    let numbers: Vec<f32> = (0..10_007)
        .map(|_| 3.0 * noise.random::<f32>() - 1.5)
        .collect();
    move |step, i| numbers[(step * 1311 + i) % numbers.len()]
}

#[test]
fn results_are_the_same_bits_for_any_number_of_threads() {
    let settings = ["env.max_episode_seconds=0.3"];
    let one = play(1, 48, 60, &settings, noise());
    assert!(
        one.lengths.len() > 48,
        "episodes must end and begin during the test: {}",
        one.lengths.len()
    );
    for threads in [2, 8] {
        let more = play(threads, 48, 60, &settings, noise());
        assert!(
            one.observations == more.observations && one.rewards == more.rewards,
            "{threads} threads differ"
        );
        assert_eq!(one.lengths, more.lengths);
    }
}

#[test]
fn the_first_episodes_start_at_random_ages() {
    let played = play(
        2,
        64,
        30,
        &["env.max_episode_seconds=0.3", "env.fall_dist=10"],
        noise(),
    );
    let mut lengths = played.lengths[..64].to_vec();
    lengths.sort_unstable();
    lengths.dedup();
    assert!(lengths.len() > 15, "only these lengths: {lengths:?}");
}

#[test]
fn an_environment_does_the_same_alone_as_among_others() {
    let action = |step: usize, i: usize| {
        if i < 20 {
            0.01 * (step + 1) as f32
        } else {
            1.0
        }
    };
    let first_row = |envs: usize| {
        let played = play(2, envs, 20, &["env.fall_dist=10"], action);
        let last = played.observations.len() - envs * OBSERVATION_SIZE;
        (
            played.observations[last..][..OBSERVATION_SIZE].to_vec(),
            played.rewards[19 * envs],
        )
    };
    assert_eq!(first_row(1), first_row(3));
    assert_eq!(first_row(1), first_row(20));
}

#[test]
fn a_pool_goes_on_from_its_saved_state_bit_for_bit_in_the_middle_of_episodes() {
    let task = task(&["env.max_episode_seconds=0.7"]);
    let threads = rayon::ThreadPoolBuilder::new()
        .num_threads(2)
        .build()
        .unwrap();
    threads.install(|| {
        let new_pool = |envs: usize| {
            EnvPool::new(
                5,
                (0..envs).map(|_| Repose::new(&task)).collect(),
                &Exchange::alone(1),
            )
        };
        let mut pool = new_pool(24);
        let rows: Vec<usize> = pool
            .block_sizes()
            .iter()
            .map(|n| n * OBSERVATION_SIZE)
            .collect();
        let mut observations: Vec<Vec<f32>> = rows.iter().map(|&n| vec![0.0; n]).collect();
        let blocks = observations.iter_mut();
        pool.reset(blocks.flat_map(|rows| rows.chunks_exact_mut(OBSERVATION_SIZE)));
        let action = noise();
        let step = |pool: &mut EnvPool<Repose>, observations: &mut [Vec<f32>], step: usize| {
            let mut first = 0;
            let mut seen = Vec::new();
            for (block, rows) in pool.blocks.iter_mut().zip(observations) {
                let n = block.members.len();
                let actions: Vec<f32> = (0..n * 20).map(|i| action(step, first + i)).collect();
                let mut rewards = vec![0.0; n];
                block.step(&actions, &mut rewards, rows).unwrap();
                first += n * 20;
                seen.push((rewards, ends_of(&block.members), rows.clone()));
            }
            seen
        };
        (0..100).for_each(|t| drop(step(&mut pool, &mut observations, t)));
        pool.take_finished();
        let state = pool.save();
        let mut again = new_pool(24);
        let mut restored: Vec<Vec<f32>> = rows.iter().map(|&n| vec![0.0; n]).collect();
        again
            .restore(
                &state,
                restored
                    .iter_mut()
                    .flat_map(|rows| rows.chunks_exact_mut(OBSERVATION_SIZE)),
            )
            .unwrap();
        assert!(restored == observations, "the observations to act on");
        assert!(again.save() == state);
        for t in 100..250 {
            let expected = step(&mut pool, &mut observations, t);
            assert!(step(&mut again, &mut restored, t) == expected, "step {t}");
        }
        let [ended, expected] = [again.take_finished(), pool.take_finished()];
        assert!(
            ended == expected && ended.len() > 24,
            "{} episodes ended",
            ended.len()
        );
        let other = new_pool(23).save();
        let rows = restored.iter_mut();
        let rows = rows.flat_map(|rows| rows.chunks_exact_mut(OBSERVATION_SIZE));
        assert!(
            again.restore(&other, rows).is_err(),
            "the state of fewer environments must be refused"
        );
    });
}

fn ends_of(members: &[Member<Repose>]) -> Vec<Option<End>> {
    members.iter().map(|member| member.end).collect()
}

/// A whole pool that is stepped at once.
struct AtOnce {
    pool: EnvPool<Repose>,
    observations: Vec<f32>,
    rewards: Vec<f32>,
    t: usize,
}

impl AtOnce {
    fn new(envs: usize, settings: &[&str], aged: bool) -> Self {
        let task = task(settings);
        let mut pool = EnvPool::new(
            5,
            (0..envs).map(|_| Repose::new(&task)).collect(),
            &Exchange::alone(1),
        );
        let mut observations = vec![0.0; envs * OBSERVATION_SIZE];
        pool.restart(&vec![true; envs], aged, &mut observations);
        Self {
            pool,
            observations,
            rewards: vec![0.0; envs],
            t: 0,
        }
    }

    /// Steps with actions that follow from the number of the step, and returns which episodes ended, by place and length.
    fn step(&mut self, autoreset: Autoreset) -> Vec<(usize, u32)> {
        let action = noise();
        let actions: Vec<f32> = (0..self.rewards.len() * 20)
            .map(|i| action(self.t, i))
            .collect();
        self.t += 1;
        let ended = self
            .pool
            .step(
                &actions,
                autoreset,
                &mut self.rewards,
                &mut self.observations,
            )
            .unwrap();
        ended
            .into_iter()
            .map(|(place, episode)| (place, episode.length))
            .collect()
    }

    fn row(&self, place: usize) -> &[f32] {
        &self.observations[place * OBSERVATION_SIZE..][..OBSERVATION_SIZE]
    }

    fn ends(&self) -> Vec<Option<End>> {
        self.pool
            .blocks
            .iter()
            .flat_map(|block| ends_of(&block.members))
            .collect()
    }
}

#[test]
fn a_pool_that_is_stepped_at_once_does_what_its_blocks_do_on_any_number_of_threads() {
    let settings = ["env.max_episode_seconds=0.3"];
    let expected = play(2, 48, 60, &settings, noise());
    for threads in [1, 2, 3, 8] {
        let threads = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        let mut at_once = threads.install(|| AtOnce::new(48, &settings, true));
        let (mut observations, mut rewards, mut ended) = (Vec::new(), Vec::new(), Vec::new());
        for _ in 0..60 {
            ended.extend(threads.install(|| at_once.step(Autoreset::SameStep)));
            observations.extend_from_slice(&at_once.observations);
            rewards.extend_from_slice(&at_once.rewards);
        }
        assert!(observations == expected.observations && rewards == expected.rewards);
        let mut lengths = [
            ended.iter().map(|(_, length)| *length).collect(),
            expected.lengths.clone(),
        ];
        lengths
            .iter_mut()
            .for_each(|lengths| lengths.sort_unstable());
        assert_eq!(lengths[0], lengths[1]);
    }
}

#[test]
fn an_environment_starts_its_next_episode_in_the_same_step_in_the_next_or_when_it_is_told() {
    // All episodes end by time in step 5.
    let settings = ["env.max_episode_seconds=0.05", "env.fall_dist=10"];
    let mut pools = [
        Autoreset::SameStep,
        Autoreset::NextStep,
        Autoreset::Disabled,
    ]
    .map(|when| {
        let mut pool = AtOnce::new(3, &settings, false);
        (0..4).for_each(|_| assert!(pool.step(when).is_empty()));
        assert_eq!(pool.step(when), [(0, 5), (1, 5), (2, 5)]);
        assert_eq!(pool.ends(), [Some(End::Truncated); 3]);
        pool
    });
    let [same, next, disabled] = &mut pools;
    let finals: Vec<f32> = same.pool.blocks[0]
        .members
        .iter()
        .flat_map(|member| member.final_observation.clone())
        .collect();
    assert!(
        next.observations == finals
            && disabled.observations == finals
            && same.observations != finals
    );
    // The action of this step is ignored.
    assert!(next.step(Autoreset::NextStep).is_empty());
    assert!(
        next.ends() == [None; 3]
            && next.rewards == [0.0; 3]
            && next.observations == same.observations
    );
    let mut shown = disabled.observations.clone();
    disabled
        .pool
        .restart(&[false, true, true], false, &mut shown);
    assert!(shown[..OBSERVATION_SIZE] == finals[..OBSERVATION_SIZE]);
    assert!(shown[OBSERVATION_SIZE..] == same.observations[OBSERVATION_SIZE..]);
    assert_eq!(disabled.ends(), [Some(End::Truncated), None, None]);
}

#[test]
fn the_episodes_of_a_seed_start_again_when_it_is_set_again() {
    let mut pool = AtOnce::new(4, &[], false);
    let mut restart = |seed: Option<u64>| {
        if let Some(seed) = seed {
            for member in pool.pool.members_mut() {
                member.seed = seed;
                member.next_episode = member.number as u64;
            }
        }
        pool.pool.restart(&[true; 4], false, &mut pool.observations);
        pool.row(2).to_vec()
    };
    let first = restart(Some(11));
    let second = restart(None);
    assert!(
        first != second
            && first != restart(Some(12))
            && first == restart(Some(11))
            && second == restart(None)
    );
}

#[test]
fn the_rewards_of_a_step_outlive_the_start_of_the_next_episode() {
    let mut pool = AtOnce::new(
        1,
        &["env.max_episode_seconds=0.02", "env.fall_dist=10"],
        false,
    );
    for _ in 0..4 {
        pool.step(Autoreset::SameStep);
        let last = pool
            .pool
            .envs_mut()
            .next()
            .unwrap()
            .last
            .reward
            .iter()
            .sum::<f64>();
        assert!(
            last != 0.0 && (last - f64::from(pool.rewards[0])).abs() < 1e-6,
            "{last} {:?}",
            pool.rewards
        );
    }
}

#[test]
fn a_pool_that_is_stepped_at_once_with_the_actions_of_a_rollout_sees_what_the_rollout_saw() {
    let config = config(&[
        "env.num_envs=32",
        "env.max_episode_seconds=0.1",
        "training.goal_lifetime=5",
    ]);
    let task = Task::new(&config).unwrap();
    let mut agent = started_agent(&task, &config);
    agent.collect(&AtomicBool::new(false)).unwrap();
    let envs = (0..32).map(|_| Repose::new(&task)).collect();
    let mut pool = EnvPool::new(config.run.seed, envs, &Exchange::alone(1));
    let (mut observations, mut rewards) = (vec![0.0; 32 * OBSERVATION_SIZE], vec![0.0; 32]);
    pool.set_lesson(Lesson::at(0, &config));
    pool.restart(&[true; 32], true, &mut observations);
    let rollout = &agent.rollout;
    let all = |of: fn(&RolloutBlock) -> &Vec<f32>, t: usize, width: usize| -> Vec<f32> {
        rollout
            .blocks
            .iter()
            .flat_map(|block| &of(block)[block.step(t, width)])
            .copied()
            .collect()
    };
    let (mut ends, mut redirected) = (0, 0);
    for t in 0..rollout.horizon {
        assert!(
            observations == all(|block| &block.observations, t, OBSERVATION_SIZE),
            "step {t}"
        );
        let actions = all(|block| &block.actions, t, 20);
        let scaled = all(|block| &block.rewards, t, 1);
        pool.step(
            &actions,
            Autoreset::SameStep,
            &mut rewards,
            &mut observations,
        )
        .unwrap();
        let found: Vec<Option<End>> = pool
            .blocks
            .iter()
            .flat_map(|block| ends_of(&block.members))
            .collect();
        for ((end, reward), scaled) in found.iter().zip(&rewards).zip(scaled) {
            // Elsewhere the rollout has added the value of the final observation.
            if !matches!(end, Some(End::Truncated | End::Redirected)) {
                assert_eq!(reward * config.ppo.reward_scale as f32, scaled);
            }
        }
        ends += found.iter().flatten().count();
        redirected += found
            .iter()
            .filter(|end| **end == Some(End::Redirected))
            .count();
    }
    assert!(
        redirected > 20 && ends > redirected + 20,
        "{redirected} of {ends}"
    );
}
