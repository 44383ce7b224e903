//! A training on several ranks computes the same bits as on one.

use std::ops::Range;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Barrier, Mutex};

use shadow_repose::agent::Agent;
use shadow_repose::config::Config;
use shadow_repose::env::Env;
use shadow_repose::evaluate::{Actor, Episodes, Trial};
use shadow_repose::ppo::{Checkpoint, Ppo};
use shadow_repose::ranks::{Exchange, Ranks};
use shadow_repose::repose::{EpisodeStats, Lesson, Repose, Task};

use crate::point_mass::{of_ranks, settings};
use crate::support::{config, started_agent};

/// A rank that is a thread of this process.
struct Seat {
    rank: usize,
    table: Arc<Table>,
}

struct Table {
    barrier: Barrier,
    /// What each rank has sent.
    put: Mutex<Vec<Vec<u8>>>,
}

impl Seat {
    /// Returns the floats of all ranks, in their order.
    fn floats(&self, own: &[f32]) -> Vec<Vec<f32>> {
        let all = self.all_gather(own.iter().flat_map(|x| x.to_le_bytes()).collect());
        all.iter()
            .map(|bytes| {
                bytes
                    .as_chunks()
                    .0
                    .iter()
                    .map(|x| f32::from_le_bytes(*x))
                    .collect()
            })
            .collect()
    }
}

impl Ranks for Seat {
    fn all_to_all(&self, numbers: &[f32], slices: &[Range<usize>]) -> Vec<f32> {
        let own = slices[self.rank].clone();
        self.floats(numbers)
            .iter()
            .flat_map(|of_rank| of_rank[own.clone()].to_vec())
            .collect()
    }

    fn all_gather_slices(&self, numbers: &mut [f32], slices: &[Range<usize>]) {
        for (of_rank, slice) in self.floats(numbers).iter().zip(slices) {
            numbers[slice.clone()].copy_from_slice(&of_rank[slice.clone()]);
        }
    }

    fn all_gather(&self, bytes: Vec<u8>) -> Vec<Vec<u8>> {
        self.table.put.lock().unwrap()[self.rank] = bytes;
        self.table.barrier.wait();
        let all = self.table.put.lock().unwrap().clone();
        self.table.barrier.wait();
        all
    }

    fn abort(&self) -> ! {
        panic!("rank {} ends all", self.rank)
    }
}

/// Returns the results of this number of ranks, each with its part of the `shards` and with its own threads.
fn on_ranks<T: Send>(
    ranks: usize,
    shards: usize,
    work: impl Fn(usize, Exchange) -> T + Sync,
) -> Vec<T> {
    let table = Arc::new(Table {
        barrier: Barrier::new(ranks),
        put: Mutex::new(vec![Vec::new(); ranks]),
    });
    std::thread::scope(|scope| {
        let start = |rank| {
            let (table, work) = (table.clone(), &work);
            scope.spawn(move || {
                let threads = rayon::ThreadPoolBuilder::new()
                    .num_threads(1 + rank % 2)
                    .build()
                    .unwrap();
                threads.install(|| {
                    work(
                        rank,
                        Exchange::new(rank, ranks, Arc::new(Seat { rank, table }))
                            .over(shards)
                            .unwrap(),
                    )
                })
            })
        };
        let all: Vec<_> = (0..ranks).map(start).collect();
        all.into_iter()
            .map(|thread| thread.join().unwrap())
            .collect()
    })
}

/// The weights as bits, figures of each update and the statistics of the normaliser as bits, and the episodes that ended.
type Learnt<T> = (Vec<u32>, Vec<u64>, Vec<T>);

fn learnt<E: Env>(agent: &mut Agent<E>, iterations: usize) -> Learnt<E::Episode> {
    let never = AtomicBool::new(false);
    let mut figures = Vec::new();
    for _ in 0..iterations {
        let stats = agent.iterate(&never).unwrap().update;
        figures.extend(stats.named().map(|(_, value)| value));
    }
    let policy = &agent.ppo.policy;
    figures.extend(
        policy
            .normalizer
            .mean
            .iter()
            .chain(&policy.normalizer.variance),
    );
    let weights = policy.parameters.iter().map(|x| x.to_bits()).collect();
    (
        weights,
        figures.into_iter().map(f64::to_bits).collect(),
        agent.pool.take_finished(),
    )
}

/// Fails unless all ranks hold the weights and figures of a single one, and together its episodes.
fn assert_same<T: PartialEq>(
    one: Learnt<T>,
    ranks: Vec<Learnt<T>>,
    what: &str,
    order: impl Fn(&mut Vec<T>),
) {
    let (weights, figures, mut episodes) = one;
    let mut together = Vec::new();
    for (rank, (other_weights, other_figures, other_episodes)) in ranks.into_iter().enumerate() {
        assert!(
            other_weights == weights && other_figures == figures,
            "{what}, rank {rank}"
        );
        together.extend(other_episodes);
    }
    order(&mut episodes);
    order(&mut together);
    assert!(
        together == episodes && !episodes.is_empty(),
        "{what}: the episodes differ"
    );
}

#[test]
fn the_shards_of_a_training_come_to_the_same_bits_on_any_number_of_ranks() {
    let points = 8 * 5;
    let work = |ranks: usize| {
        on_ranks(ranks, 8, |_, exchange| {
            learnt(&mut of_ranks(points / ranks, &settings(), 5, exchange), 6)
        })
    };
    for ranks in [1, 2, 4, 8] {
        let alone = learnt(&mut of_ranks(points, &settings(), 5, Exchange::alone(8)), 6);
        assert_same(alone, work(ranks), &format!("{ranks} ranks"), |all| {
            all.sort_by(f64::total_cmp)
        });
    }
}

#[test]
fn hands_that_are_dealt_to_ranks_learn_the_same_bits() {
    let sets = [
        "env.num_envs=16",
        "ppo.hidden=[16]",
        "ppo.horizon=8",
        "env.max_episode_seconds=0.1",
    ];
    let config = config(&sets);
    let task = Task::new(&config).unwrap();
    let work = |ranks: usize| {
        on_ranks(ranks, 8, |_, exchange| {
            let (envs, of_run) = (
                (0..16 / ranks).map(|_| Repose::new(&task)).collect(),
                config.clone(),
            );
            let lessons = move |env_steps| Lesson::at(env_steps, &of_run);
            learnt(
                &mut Agent::new(envs, &config.ppo, 3, exchange, lessons).unwrap(),
                3,
            )
        })
    };
    let order =
        |all: &mut Vec<EpisodeStats>| all.sort_by(|a, b| a.rot_dist_sum.total_cmp(&b.rot_dist_sum));
    for ranks in [2, 8] {
        assert_same(
            work(1).remove(0),
            work(ranks),
            &format!("{ranks} ranks"),
            order,
        );
    }
}

/// Makes this many more iterations on some ranks, from a checkpoint or from the start, and returns the checkpoint of the end.
fn continued(
    from: Option<&[u8]>,
    iterations: usize,
    ranks: usize,
    config: &Config,
    task: &Arc<Task>,
) -> Vec<u8> {
    let work = |_, exchange| {
        let mut agent = Agent::for_task(task, config, exchange).unwrap();
        if let Some(bytes) = from {
            agent
                .restore(&mut Checkpoint::parse(bytes).unwrap())
                .unwrap();
        }
        for _ in 0..iterations {
            agent.iterate(&AtomicBool::new(false)).unwrap();
        }
        let mut end = Checkpoint::default();
        agent.save(&mut end);
        end
    };
    on_ranks(ranks, 8, work).swap_remove(0).to_bytes().unwrap()
}

#[test]
fn a_checkpoint_does_not_know_how_many_ranks_have_saved_it() {
    // The parameters of the nets are not a whole number of chunks for any number of ranks.
    let sets = [
        "env.num_envs=16",
        "ppo.hidden=[40]",
        "ppo.horizon=8",
        "env.max_episode_seconds=0.1",
        "run.shards=8",
    ];
    let config = config(&sets);
    let task = Task::new(&config).unwrap();
    let expected = continued(None, 4, 1, &config, &task);
    for path in [[4, 1], [1, 4], [2, 8], [8, 2]] {
        let middle = continued(None, 2, path[0], &config, &task);
        let end = continued(Some(&middle), 2, path[1], &config, &task);
        assert!(end == expected, "on {path:?} ranks");
    }
}

#[test]
fn evaluation_episodes_that_are_shared_out_have_the_same_results() {
    let config = config(&["env.max_episode_seconds=0.2", "ppo.hidden=[16]"]);
    let task = Task::new(&config).unwrap();
    let ppo = Ppo::new(&config.ppo, task.spaces(), 0, Exchange::alone(1)).unwrap();
    let never = AtomicBool::new(false);
    for count in [5, 100] {
        let episodes = Episodes {
            seed: 3,
            purpose: "evaluation",
            first: 10,
            count,
        };
        let alone = Actor::Mean(ppo.policy.freeze());
        let alone = Trial {
            task: &task,
            actor: &alone,
            episodes,
            stop: &never,
        }
        .play(&mut |_| Ok(()))
        .unwrap();
        assert_eq!(alone.len(), count);
        for ranks in [1, 4] {
            let work = |_, exchange: Exchange| {
                let ppo = Ppo::new(&config.ppo, task.spaces(), 0, Exchange::alone(1)).unwrap();
                let actor = Actor::Mean(ppo.policy.freeze());
                let trial = Trial {
                    task: &task,
                    actor: &actor,
                    episodes,
                    stop: &never,
                };
                trial.play_together(&exchange, &mut |_| Ok(())).unwrap()
            };
            let mut together = on_ranks(ranks, 4, work);
            assert!(
                together.swap_remove(0) == alone,
                "{count} episodes on {ranks} ranks"
            );
        }
    }
}

#[test]
fn all_ranks_together_send_no_more_than_a_ring_would() {
    let work = |_, exchange: Exchange| {
        let mut agent = of_ranks(8, &settings(), 5, exchange);
        agent.iterate(&AtomicBool::new(false)).unwrap();
        let steps = settings().epochs * settings().minibatches;
        (
            agent.exchange.take_traffic()[1].1,
            agent.ppo.policy.parameters.len(),
            steps,
        )
    };
    for ranks in [2, 4] {
        let all = on_ranks(ranks, 8, work);
        let sent = all.iter().map(|(bytes, _, _)| bytes).sum::<f64>() as u64;
        let (_, parameters, steps) = all[0];
        // A ring sends each value 2 (n - 1) times. The rest are losses, norms and statistics.
        let ring = (8 * (ranks - 1) * parameters * steps) as u64;
        assert!(
            (ring..ring + 2000 * (ranks * ranks * steps) as u64).contains(&sent),
            "{sent} against {ring}"
        );
    }
    assert!(
        on_ranks(1, 8, work)[0].0.is_nan(),
        "a single rank sends nothing"
    );
}

#[test]
fn trainings_of_any_number_of_hands_work() {
    let task = Task::new(&config(&[])).unwrap();
    for hands in [1, 7, 16, 100] {
        let config = config(&[&format!("env.num_envs={hands}"), "ppo.hidden=[16]"]);
        let mut agent = started_agent(&task, &config);
        let (_, figures, _) = learnt(&mut agent, 2);
        let figures: Vec<f64> = figures.into_iter().map(f64::from_bits).collect();
        assert!(
            figures.iter().all(|x| x.is_finite()),
            "{hands} hands: {:?}",
            &figures[..10]
        );
        assert_eq!(
            (agent.env_steps, agent.rollout.samples()),
            (2 * 16 * hands, 16 * hands as usize)
        );
    }
}

#[test]
fn the_number_of_shards_is_the_largest_power_of_two_that_fits_or_the_one_that_is_asked_for() {
    let shards = |hands: usize, more: &[&str]| {
        let hands = format!("env.num_envs={hands}");
        config(
            &[
                &[hands.as_str(), "ppo.horizon=16", "ppo.minibatches=4"],
                more,
            ]
            .concat(),
        )
        .shards()
    };
    assert_eq!(
        [1024, 1, 7, 16, 100].map(|hands| shards(hands, &[])),
        [16, 1, 1, 16, 4]
    );
    // 24 samples per minibatch.
    assert_eq!(shards(16, &["ppo.horizon=6"]), 8);
    assert_eq!(shards(1024, &["run.shards=64"]), 64);
    for wrong in ["run.shards=3", "run.shards=2048"] {
        let sets = [wrong.parse().unwrap()];
        let refused = shadow_repose::config::Settings::new()
            .sets(&sets)
            .resolve()
            .unwrap_err()
            .to_string();
        assert!(
            refused.contains("run.shards") && refused.contains("a power of two that divides"),
            "{refused}"
        );
    }
}
