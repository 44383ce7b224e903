//! What computes gradients and steps: our own kernels, or candle's tensors.

use anyhow::Result;
use candle_core::Tensor;

use super::fused::{Arithmetic, Fused};
use super::reference::Reference;
use super::{Policy, Rollout};
use crate::config::{self, PpoConfig};

/// Of Adam: the decay of the mean of the gradient.
pub const BETA1: f64 = 0.9;

/// Of Adam: the decay of the mean of its square.
pub const BETA2: f64 = 0.999;

/// Of Adam: against a division by zero.
pub const EPSILON: f64 = 1e-8;

/// Figures of one minibatch.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Losses {
    /// What is minimised.
    pub total: f64,
    /// The clipped surrogate, negated.
    pub policy: f64,
    /// The clipped squared error of the values.
    pub value: f64,
    /// Mean squared distance of the means from [-1, 1], beyond which actions are clipped.
    pub excess: f64,
    /// Mean entropy of the action distribution, nats.
    pub entropy: f64,
    /// Mean KL divergence of the present distribution from the one that acted, nats.
    pub kl: f64,
    /// Fraction of the samples whose ratio was clipped.
    pub clip_fraction: f64,
    /// The largest |ratio - 1|.
    pub ratio_error: f64,
    /// Norm of all gradients together.
    pub grad_norm: f64,
}

/// The optimizer's running means of the gradient and of its square for each parameter, and the steps taken.
pub struct Moments {
    /// In the order of the policy's parameters.
    pub tensors: Vec<[Tensor; 2]>,
    /// Steps of Adam.
    pub steps: u64,
}

/// A way to compute gradients and to follow them.
pub trait Backend: Send {
    /// Prepares for the minibatches of a rollout, before any step on it.
    ///
    /// # Errors
    /// Only if candle cannot allocate.
    fn begin(&mut self, policy: &Policy, rollout: &Rollout) -> Result<()>;

    /// Computes and keeps the gradient of the losses of these samples, all of which lie in the rollout.
    ///
    /// # Errors
    /// Only if candle cannot allocate.
    fn gradient(&mut self, policy: &Policy, rollout: &Rollout, samples: &[u32]) -> Result<Losses>;

    /// Moves the parameters one step of Adam against that gradient, which is first multiplied by `scale`; the critic's with the
    /// second of the learning rates, the others with the first.
    ///
    /// # Errors
    /// Only if candle cannot allocate.
    fn step(&mut self, policy: &Policy, learning_rates: [f64; 2], scale: f64) -> Result<()>;

    /// The optimizer's state.
    ///
    /// # Errors
    /// Only if candle cannot allocate.
    fn moments(&self, policy: &Policy) -> Result<Moments>;

    /// Goes on from a saved state.
    ///
    /// # Errors
    /// Only if candle cannot allocate.
    fn restore(&mut self, moments: Moments) -> Result<()>;
}

/// The backend that the configuration asks for.
///
/// # Errors
/// Only if candle cannot allocate.
pub fn new(config: &PpoConfig, policy: &Policy, arithmetic: Arithmetic) -> Result<Box<dyn Backend>> {
    Ok(match config.backend {
        config::Backend::Fused => Box::new(Fused::new(config, policy, arithmetic)),
        config::Backend::Candle => Box::new(Reference::new(config, policy)?),
    })
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicBool;

    use super::super::Ppo;
    use super::*;
    use crate::config::{Activation, Config, Precision};
    use crate::rng;

    /// A learner of that kind, and a rollout that it could have collected with a slightly different policy.
    fn learner(backend: config::Backend, activation: Activation) -> (Ppo, Rollout) {
        let mut config = Config::resolve(None, &[]).unwrap().ppo;
        (config.backend, config.activation, config.hidden) = (backend, activation, vec![64, 33]);
        (config.entropy_coef, config.bounds_coef) = (0.01, 0.1);
        let mut ppo = Ppo::new(&config, 157, 20, 3).unwrap();
        ppo.policy.normalizer.update(&[&[[0.3; 157], [0.9; 157]].concat()]);
        let mut rollout = Rollout::new(16, &[32, 32, 21], 157, 20);
        let mut rng = rng::stream(0, "test", 0);
        let mut fill = |numbers: &mut [f32], scale: f64| {
            numbers.iter_mut().for_each(|x| *x = rng::uniform(&mut rng, -scale, scale) as f32);
        };
        for block in &mut rollout.blocks {
            fill(&mut block.observations, 1.0);
            fill(&mut block.means, 0.2);
            fill(&mut block.actions, 0.7);
            fill(&mut block.values, 0.4);
            fill(&mut block.advantages, 2.0);
            fill(&mut block.returns, 1.0);
            // A few act with more noise than the others.
            block.noise_scales.iter_mut().step_by(3).for_each(|scale| *scale = 1.5);
            let means = block.means.chunks_exact(20).zip(block.actions.chunks_exact(20)).zip(&block.noise_scales);
            for (((means, actions), scale), log_prob) in means.zip(&mut block.log_probs) {
                let z = means.iter().zip(actions).map(|(mean, action)| (action - mean) / (0.5 * scale));
                *log_prob = -0.5 * z.map(|z| z * z).sum::<f32>() - 20.0 * (0.5f32.ln() + 0.918_938_5);
            }
        }
        ppo.backend.begin(&ppo.policy, &rollout).unwrap();
        (ppo, rollout)
    }

    fn parameters(policy: &Policy) -> Vec<(String, Vec<f32>)> {
        let numbers = |tensor: &Tensor| tensor.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        policy.parameters().iter().map(|(name, var)| (name.clone(), numbers(var))).collect()
    }

    #[track_caller]
    fn assert_close(found: f64, expected: f64, tolerance: f64, what: &str) {
        assert!((found - expected).abs() <= tolerance * expected.abs().max(1e-6), "{what}: {found} not {expected}");
    }

    #[test]
    fn losses_and_gradients_of_the_kernels_are_those_of_candle() {
        for activation in [Activation::Elu, Activation::Relu, Activation::Silu, Activation::Tanh] {
            // Three sizes of minibatches: one group, whole groups, and blocks that do not divide the last group.
            for samples in [20, 1024, 1301] {
                let found = [config::Backend::Fused, config::Backend::Candle].map(|backend| {
                    let (mut ppo, rollout) = learner(backend, activation);
                    let samples: Vec<u32> = (0..samples).map(|i| (i * 7) % rollout.samples() as u32).collect();
                    let losses = ppo.backend.gradient(&ppo.policy, &rollout, &samples).unwrap();
                    ppo.backend.step(&ppo.policy, [1e-3, 2e-3], 1.0).unwrap();
                    // After the first step the mean of the gradient is a tenth of it.
                    let moments = ppo.backend.moments(&ppo.policy).unwrap();
                    let gradient = moments.tensors.into_iter().map(|[mean, _]| {
                        mean.flatten_all().unwrap().to_vec1::<f32>().unwrap().iter().map(|x| 10.0 * x).collect()
                    });
                    (losses, gradient.collect::<Vec<Vec<f32>>>(), parameters(&ppo.policy))
                });
                let what = format!("{activation:?}, {samples} samples");
                let [fused, candle] = found.each_ref().map(|(losses, ..)| *losses);
                for (name, found, expected) in [
                    ("total", fused.total, candle.total),
                    ("policy", fused.policy, candle.policy),
                    ("value", fused.value, candle.value),
                    ("excess", fused.excess, candle.excess),
                    ("entropy", fused.entropy, candle.entropy),
                    ("kl", fused.kl, candle.kl),
                    ("ratio", fused.ratio_error, candle.ratio_error),
                    ("norm", fused.grad_norm, candle.grad_norm),
                ] {
                    assert_close(found, expected, 2e-4, &format!("{what}: {name}"));
                }
                assert_eq!(fused.clip_fraction, candle.clip_fraction, "{what}");
                assert!((0.05..0.98).contains(&fused.clip_fraction), "{what}: some are clipped, not all");
                for ((name, _), [a, b]) in
                    found[0].2.iter().zip(found[0].1.iter().zip(&found[1].1).map(|(a, b)| [a, b]))
                {
                    let largest = b.iter().fold(0.0f32, |most, x| most.max(x.abs()));
                    let error = a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
                    assert!(
                        largest > 0.0 && error < 1e-4 * largest,
                        "{what}: gradient of {name}: {error} of {largest}"
                    );
                }
            }
        }
    }

    #[test]
    fn many_steps_of_the_kernels_stay_with_candles() {
        let [fused, candle] = [config::Backend::Fused, config::Backend::Candle].map(|backend| {
            let (mut ppo, rollout) = learner(backend, Activation::Elu);
            for step in 0..20 {
                let samples: Vec<u32> = (0..256).map(|i| (i * 5 + step * 31) % rollout.samples() as u32).collect();
                let norm = ppo.backend.gradient(&ppo.policy, &rollout, &samples).unwrap().grad_norm;
                ppo.backend.step(&ppo.policy, [1e-3, 2e-3], (1.0 / (norm + 1e-6)).min(1.0)).unwrap();
            }
            parameters(&ppo.policy)
        });
        let first = parameters(&learner(config::Backend::Fused, Activation::Elu).0.policy);
        for (((name, a), (_, b)), (_, first)) in fused.iter().zip(&candle).zip(&first) {
            let difference =
                |x: &[f32], y: &[f32]| x.iter().zip(y).map(|(x, y)| f64::from(x - y).powi(2)).sum::<f64>().sqrt();
            let (apart, moved) = (difference(a, b), difference(a, first));
            assert!(apart < 1e-2 * moved, "{name} moved by {moved}, and is {apart} from candle's");
        }
    }

    /// How far the weights of actor and critic have moved at most in an update of one gradient step with these settings.
    fn one_step(set: impl FnOnce(&mut config::PpoConfig)) -> [f64; 2] {
        let (mut ppo, mut rollout) = learner(config::Backend::Fused, Activation::Elu);
        (ppo.config.epochs, ppo.config.minibatches, ppo.config.desired_kl) = (1, 1, 0.0);
        set(&mut ppo.config);
        ppo.learning_rate = ppo.config.learning_rate;
        let before = parameters(&ppo.policy);
        ppo.update(&mut rollout, 1, &AtomicBool::new(false)).unwrap().unwrap();
        let mut moved = [0.0f64; 2];
        for ((name, before), (_, after)) in before.iter().zip(&parameters(&ppo.policy)) {
            let most = &mut moved[usize::from(name.starts_with("critic."))];
            before.iter().zip(after).for_each(|(a, b)| *most = most.max(f64::from((a - b).abs())));
        }
        moved
    }

    #[test]
    fn actor_and_critic_learn_at_their_own_rates() {
        // Adam's first step moves a weight by the rate.
        for (rate, critic, expected) in [(1e-3, 4e-3, 4e-3), (1e-3, 1e-4, 1e-4), (2e-3, 0.0, 2e-3)] {
            let moved = one_step(|config| (config.learning_rate, config.critic_learning_rate) = (rate, critic));
            assert_close(moved[0], rate, 1e-2, "actor");
            assert_close(moved[1], expected, 1e-2, "critic");
        }
    }

    #[test]
    fn gradients_of_a_larger_norm_than_allowed_are_scaled_down_to_it() {
        // Gradients far below Adam's epsilon of 1e-8 hardly move anything.
        for (norm, most, least) in [(1e-12, 1e-6, 0.0), (1e3, 1.01e-3, 0.99e-3)] {
            let moved = one_step(|config| (config.learning_rate, config.max_grad_norm) = (1e-3, norm));
            assert!(moved.iter().all(|&moved| moved <= most && moved >= least), "{norm}: {moved:?}");
        }
    }

    #[test]
    fn gradients_are_the_same_bits_for_any_number_of_threads_and_whatever_came_before() {
        for precision in [Precision::F32, Precision::Bf16Rounded] {
            let run = |threads: &[usize]| {
                let (mut ppo, rollout) = learner(config::Backend::Fused, Activation::Silu);
                let arithmetic = Arithmetic::new(precision).unwrap();
                ppo.backend = Box::new(Fused::new(&ppo.config, &ppo.policy, arithmetic));
                ppo.backend.begin(&ppo.policy, &rollout).unwrap();
                let samples: Vec<u32> = (0..rollout.samples() as u32).collect();
                let mut losses = Vec::new();
                for (i, &number) in threads.iter().enumerate() {
                    // First a few samples, in the end all.
                    let samples = if i + 1 < threads.len() { &samples[..40] } else { &samples[..] };
                    let pool = rayon::ThreadPoolBuilder::new().num_threads(number).build().unwrap();
                    losses.push(pool.install(|| ppo.backend.gradient(&ppo.policy, &rollout, samples).unwrap()));
                }
                ppo.backend.step(&ppo.policy, [1e-3, 2e-3], 1.0).unwrap();
                (losses.pop(), parameters(&ppo.policy))
            };
            let one = run(&[1]);
            for threads in [&[2][..], &[8], &[1, 2], &[2, 8], &[8, 1]] {
                assert!(one == run(threads), "{precision:?}, {threads:?} threads");
            }
        }
    }

    #[test]
    fn the_smallest_nets_and_minibatches_agree_with_candle() {
        let found = [config::Backend::Fused, config::Backend::Candle].map(|backend| {
            let mut config = Config::resolve(None, &[]).unwrap().ppo;
            (config.backend, config.hidden) = (backend, vec![1]);
            let mut ppo = Ppo::new(&config, 1, 1, 3).unwrap();
            let mut rollout = Rollout::new(1, &[1], 1, 1);
            rollout.blocks[0].observations.fill(0.7);
            rollout.blocks[0].actions.fill(0.4);
            rollout.blocks[0].advantages.fill(1.5);
            rollout.blocks[0].returns.fill(0.3);
            ppo.backend.begin(&ppo.policy, &rollout).unwrap();
            let losses = ppo.backend.gradient(&ppo.policy, &rollout, &[0]).unwrap();
            ppo.backend.step(&ppo.policy, [1e-3, 2e-3], 1.0).unwrap();
            (losses, parameters(&ppo.policy))
        });
        assert_close(found[0].0.grad_norm, found[1].0.grad_norm, 1e-5, "norm");
        assert_close(found[0].0.total, found[1].0.total, 1e-5, "loss");
        for ((name, a), (_, b)) in found[0].1.iter().zip(&found[1].1) {
            assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-5), "{name}: {a:?} not {b:?}");
        }
    }
}
