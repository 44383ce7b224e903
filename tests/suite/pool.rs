//! Many environments at once.

use rand::RngExt;
use shadow_repose::env::{ACTION_SIZE, End, EnvPool, OBSERVATION_SIZE, Repose, StepBuffers};
use shadow_repose::rng;

use crate::support::task;

struct Played {
    observations: Vec<f32>,
    rewards: Vec<f32>,
    lengths: Vec<u32>,
}

/// Steps a new pool with random actions on `threads` threads.
fn play(threads: usize, envs: usize, steps: usize, settings: &[&str]) -> Played {
    let threads = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    let task = task(settings);
    threads.install(|| {
        let mut pool = EnvPool::new(5, (0..envs).map(|_| Repose::new(&task)).collect());
        let mut observations = vec![0.0; envs * OBSERVATION_SIZE];
        let mut final_observations = observations.clone();
        let mut played = Played { observations: Vec::new(), rewards: Vec::new(), lengths: Vec::new() };
        pool.reset(0, &mut observations);
        let mut noise = rng::stream(0, "test", 0);
        let (mut rewards, mut ends) = (vec![0.0; envs], vec![None; envs]);
        let mut truncated = 0;
        for _ in 0..steps {
            let actions: Vec<f32> = (0..envs * ACTION_SIZE).map(|_| 3.0 * noise.random::<f32>() - 1.5).collect();
            let buffers = StepBuffers {
                rewards: &mut rewards,
                ends: &mut ends,
                observations: &mut observations,
                final_observations: &mut final_observations,
            };
            pool.step(&actions, buffers);
            played.observations.extend(&observations);
            played.rewards.extend(&rewards);
            for (i, end) in ends.iter().enumerate() {
                let rows = i * OBSERVATION_SIZE..(i + 1) * OBSERVATION_SIZE;
                let previous_action = &observations[rows.clone()][137..];
                // A new episode has begun where one ended: it has no previous action, its predecessor's end has.
                assert_eq!(end.is_some(), previous_action.iter().all(|&a| a == 0.0));
                if *end == Some(End::Truncated) {
                    // The final observation is that of this environment: it shows the action that was its last.
                    let last: Vec<f32> =
                        actions[i * ACTION_SIZE..][..ACTION_SIZE].iter().map(|a| a.clamp(-1.0, 1.0)).collect();
                    assert_eq!(final_observations[rows][137..], last);
                    truncated += 1;
                }
            }
        }
        assert!(truncated > 0 || steps < 30, "no episode was truncated");
        played.lengths = pool.take_finished().iter().map(|episode| episode.length).collect();
        played
    })
}

#[test]
fn results_are_the_same_bits_for_any_number_of_threads() {
    let settings = ["env.max_episode_seconds=0.3"];
    let one = play(1, 48, 60, &settings);
    assert!(one.lengths.len() > 48, "episodes must end and begin during the test: {}", one.lengths.len());
    for threads in [2, 8] {
        let more = play(threads, 48, 60, &settings);
        assert!(one.observations == more.observations && one.rewards == more.rewards, "{threads} threads differ");
        assert_eq!(one.lengths, more.lengths);
    }
}

#[test]
fn the_first_episodes_start_at_random_ages() {
    let played = play(2, 64, 30, &["env.max_episode_seconds=0.3", "env.fall_dist=10"]);
    let mut lengths = played.lengths[..64].to_vec();
    lengths.sort_unstable();
    lengths.dedup();
    assert!(lengths.len() > 15, "only these lengths: {lengths:?}");
}

#[test]
fn an_environment_does_the_same_alone_as_among_others() {
    let task = task(&["env.fall_dist=10"]);
    let first_row = |envs: usize| {
        let mut pool = EnvPool::new(5, (0..envs).map(|_| Repose::new(&task)).collect());
        let mut observations = vec![0.0; envs * OBSERVATION_SIZE];
        pool.reset(0, &mut observations);
        let (mut rewards, mut ends) = (vec![0.0; envs], vec![None; envs]);
        for step in 0..20 {
            let actions: Vec<f32> =
                (0..envs * ACTION_SIZE).map(|i| if i < ACTION_SIZE { 0.01 * step as f32 } else { 1.0 }).collect();
            let buffers = StepBuffers {
                rewards: &mut rewards,
                ends: &mut ends,
                observations: &mut observations,
                final_observations: &mut vec![0.0; envs * OBSERVATION_SIZE],
            };
            pool.step(&actions, buffers);
        }
        (observations[..OBSERVATION_SIZE].to_vec(), rewards[0])
    };
    assert_eq!(first_row(1), first_row(3));
}
