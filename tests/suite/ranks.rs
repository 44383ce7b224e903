//! A divided training computes the same bits, however it is divided.

use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Barrier, Mutex};

use shadow_repose::agent::Agent;
use shadow_repose::env::{Env, EpisodeStats, Lesson, Repose, Task};
use shadow_repose::ranks::{Division, Ranks, tree_sum};

use crate::point_mass::{divided, settings};
use crate::support::config;

/// A rank that is a thread of this process.
struct Seat {
    rank: usize,
    table: Arc<Table>,
}

struct Table {
    barrier: Barrier,
    floats: Mutex<Vec<Vec<f32>>>,
    doubles: Mutex<Vec<Vec<f64>>>,
}

impl Ranks for Seat {
    fn size(&self) -> usize {
        self.table.floats.lock().unwrap().len()
    }

    fn rank(&self) -> usize {
        self.rank
    }

    fn add_up(&self, numbers: &mut [f32]) {
        self.table.floats.lock().unwrap()[self.rank] = numbers.to_vec();
        self.table.barrier.wait();
        let all = self.table.floats.lock().unwrap().clone();
        tree_sum(numbers, &all.iter().map(|part| &part[..]).collect::<Vec<_>>());
        self.table.barrier.wait();
    }

    fn gather(&self, numbers: Vec<f64>) -> Vec<f64> {
        self.table.doubles.lock().unwrap()[self.rank] = numbers;
        self.table.barrier.wait();
        let all = self.table.doubles.lock().unwrap().concat();
        self.table.barrier.wait();
        all
    }
}

/// Returns the results of this number of ranks, each with its part of the `shards` and with its own threads.
fn on_ranks<T: Send>(ranks: usize, shards: usize, work: impl Fn(usize, Division) -> T + Sync) -> Vec<T> {
    let (floats, doubles) = (Mutex::new(vec![Vec::new(); ranks]), Mutex::new(vec![Vec::new(); ranks]));
    let table = Arc::new(Table { barrier: Barrier::new(ranks), floats, doubles });
    std::thread::scope(|scope| {
        let start = |rank| {
            let (table, work) = (table.clone(), &work);
            scope.spawn(move || {
                let threads = rayon::ThreadPoolBuilder::new().num_threads(1 + rank % 2).build().unwrap();
                threads.install(|| work(rank, Division::new(shards, Box::new(Seat { rank, table }))))
            })
        };
        let all: Vec<_> = (0..ranks).map(start).collect();
        all.into_iter().map(|thread| thread.join().unwrap()).collect()
    })
}

/// The weights as bits; figures of each update and the statistics of the normaliser, as bits; and the episodes that ended.
type Learnt<T> = (Vec<u32>, Vec<u64>, Vec<T>);

fn learnt<E: Env>(agent: &mut Agent<E>, iterations: usize) -> Learnt<E::Episode> {
    let never = AtomicBool::new(false);
    let mut figures = Vec::new();
    for _ in 0..iterations {
        let stats = agent.iterate(&never).unwrap().expect("nothing stops it").update;
        figures.extend([stats.kl, stats.value_loss, stats.explained_variance, stats.grad_norm, stats.learning_rate]);
    }
    let policy = agent.ppo.policy();
    figures.extend(policy.normalizer.mean.iter().chain(&policy.normalizer.variance));
    let weights = policy.parameters.iter().map(|x| x.to_bits()).collect();
    (weights, figures.into_iter().map(f64::to_bits).collect(), agent.pool.take_finished())
}

/// Fails unless all ranks hold the weights and figures of a single one, and together its episodes.
fn assert_same<T: PartialEq>(one: Learnt<T>, ranks: Vec<Learnt<T>>, what: &str, order: impl Fn(&mut Vec<T>)) {
    let (weights, figures, mut episodes) = one;
    let mut together = Vec::new();
    for (rank, (other_weights, other_figures, other_episodes)) in ranks.into_iter().enumerate() {
        assert!(other_weights == weights && other_figures == figures, "{what}, rank {rank}");
        together.extend(other_episodes);
    }
    order(&mut episodes);
    order(&mut together);
    assert!(together == episodes && !episodes.is_empty(), "{what}: the episodes differ");
}

#[test]
fn the_shards_of_a_training_come_to_the_same_bits_on_any_number_of_ranks() {
    let points = 8 * 5;
    let work = |ranks: usize| {
        on_ranks(ranks, 8, |_, division| learnt(&mut divided(points / ranks, &settings(), 5, division), 6))
    };
    for ranks in [1, 2, 4, 8] {
        let alone = learnt(&mut divided(points, &settings(), 5, Division::alone(8)), 6);
        assert_same(alone, work(ranks), &format!("{ranks} ranks"), |all| all.sort_by(f64::total_cmp));
    }
}

#[test]
fn hands_that_are_dealt_to_ranks_learn_the_same_bits() {
    let sets = ["env.num_envs=16", "ppo.hidden=[16]", "ppo.horizon=8", "env.max_episode_seconds=0.1"];
    let config = config(&sets);
    let task = Task::new(&config.env).unwrap();
    let work = |ranks: usize| {
        on_ranks(ranks, 8, |_, division| {
            let (envs, training) = ((0..16 / ranks).map(|_| Repose::new(&task)).collect(), config.training.clone());
            let lessons = move |env_steps| Lesson::at(env_steps, &training);
            learnt(&mut Agent::new(envs, &config.ppo, 3, division, lessons).unwrap(), 3)
        })
    };
    let order = |all: &mut Vec<EpisodeStats>| all.sort_by(|a, b| a.rot_dist_sum.total_cmp(&b.rot_dist_sum));
    for ranks in [2, 8] {
        assert_same(work(1).remove(0), work(ranks), &format!("{ranks} ranks"), order);
    }
}

#[test]
fn trainings_of_any_number_of_hands_work() {
    let task = Task::new(&config(&[]).env).unwrap();
    for hands in [1, 7, 16, 100] {
        let config = config(&[&format!("env.num_envs={hands}"), "ppo.hidden=[16]"]);
        let mut agent = Agent::of_task(&task, &config).unwrap();
        let (_, figures, _) = learnt(&mut agent, 2);
        let figures: Vec<f64> = figures.into_iter().map(f64::from_bits).collect();
        assert!(figures.iter().all(|x| x.is_finite()), "{hands} hands: {:?}", &figures[..10]);
        assert_eq!((agent.env_steps, agent.rollout.samples()), (2 * 16 * hands, 16 * hands as usize));
    }
}

#[test]
fn the_number_of_shards_is_the_largest_power_of_two_that_fits_or_the_one_that_is_asked_for() {
    let shards = |hands: usize, more: &[&str]| {
        let hands = format!("env.num_envs={hands}");
        config(&[&[hands.as_str(), "ppo.horizon=16", "ppo.minibatches=4"], more].concat()).shards()
    };
    assert_eq!([1024, 1, 7, 16, 100].map(|hands| shards(hands, &[])), [16, 1, 1, 16, 4]);
    // 24 samples per minibatch.
    assert_eq!(shards(16, &["ppo.horizon=6"]), 8);
    assert_eq!(shards(1024, &["run.shards=64"]), 64);
    for wrong in ["run.shards=3", "run.shards=2048"] {
        let sets = [wrong.parse().unwrap()];
        let refused = shadow_repose::config::Config::resolve(None, &sets).unwrap_err().to_string();
        assert!(refused.contains("run.shards") && refused.contains("a power of two that divides"), "{refused}");
    }
}
