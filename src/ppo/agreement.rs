//! Tests that the two backends compute the same.

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicBool;

    use super::super::backend::Losses;
    use super::super::fused::Fused;
    use super::super::kernels::Arithmetic;
    use super::super::{Policy, Ppo, Rollout};
    use crate::config::{self, Activation, Config, Geometric, Precision, Ramp};
    use crate::ranks::{Exchange, tree_sum};
    use crate::rng;
    use crate::spaces::{ObjectAndGoal, Spaces};

    const BACKENDS: [config::Backend; 2] = [config::Backend::Fused, config::Backend::Candle];

    const SPACES: Spaces = Spaces {
        observation_size: 75,
        action_size: 20,
        object_and_goal: Some(ObjectAndGoal {
            object: 51,
            goal: 64,
            relative: 0,
            rotations: 1,
        }),
        distance: |_, _| 0.0,
    };

    /// A learner with this backend, and a rollout that a slightly different policy could have collected.
    fn learner(backend: config::Backend, activation: Activation) -> (Ppo, Rollout) {
        let mut config = Config::default().ppo;
        (config.backend, config.activation, config.hidden) = (backend, activation, vec![64, 33]);
        config.bounds_coef = 0.1;
        let mut ppo = Ppo::new(&config, SPACES, 3, Exchange::alone(1)).unwrap();
        ppo.policy.see(
            &[&[0.3, 0.9].map(|x| [x; SPACES.observation_size]).concat()],
            &ppo.exchange,
        );
        let mut rollout = Rollout::new(16, &[32, 32, 21], &SPACES);
        let mut rng = rng::stream(0, "test", 0);
        let mut fill = |numbers: &mut [f32], scale: f64| {
            numbers
                .iter_mut()
                .for_each(|x| *x = rng::uniform(&mut rng, -scale, scale) as f32);
        };
        for block in &mut rollout.blocks {
            fill(&mut block.observations, 1.0);
            fill(&mut block.means, 0.2);
            fill(&mut block.actions, 0.7);
            fill(&mut block.values, 0.4);
            fill(&mut block.advantages, 2.0);
            fill(&mut block.returns, 1.0);
            // Every third sample acts with more noise.
            block
                .noise_scales
                .iter_mut()
                .step_by(3)
                .for_each(|scale| *scale = 1.5);
            let means = block
                .means
                .chunks_exact(20)
                .zip(block.actions.chunks_exact(20))
                .zip(&block.noise_scales);
            for (((means, actions), scale), log_prob) in means.zip(&mut block.log_probs) {
                let z = means
                    .iter()
                    .zip(actions)
                    .map(|(mean, action)| (action - mean) / (0.5 * scale));
                *log_prob =
                    -0.5 * z.map(|z| z * z).sum::<f32>() - 20.0 * (0.5f32.ln() + 0.918_938_5);
            }
        }
        ppo.backend.begin(&ppo.policy, &rollout);
        (ppo, rollout)
    }

    /// Takes one gradient step with a learning rate of 1e-3, without clipping.
    fn step(ppo: &mut Ppo) {
        ppo.adam.step(
            &mut ppo.policy.parameters,
            &ppo.gradient,
            0..ppo.gradient.len(),
            (1e-3, 1.0),
        );
    }

    /// Computes the gradient of these samples and leaves it in the learner.
    fn gradient(ppo: &mut Ppo, rollout: &Rollout, samples: &[u32]) -> Losses {
        let groups = ppo.exchange.groups(samples);
        let count = samples.len();
        let sums = ppo
            .backend
            .gradients(
                &ppo.policy,
                &ppo.config,
                rollout,
                &groups,
                count,
                &mut ppo.of_groups,
            )
            .unwrap();
        let add_up = |parameters, out: &mut [f32]| tree_sum(out, &ppo.of_groups, parameters);
        ppo.slices
            .reduce_scatter(&mut ppo.gradient, add_up, |_| 0.0);
        ppo.losses(&sums, count)
    }

    /// Splits these values by parameter tensor.
    fn by_name<'a>(policy: &Policy, numbers: &'a [f32]) -> Vec<(String, &'a [f32])> {
        policy
            .layout
            .views()
            .into_iter()
            .map(|view| (view.name, &numbers[view.range]))
            .collect()
    }

    #[track_caller]
    fn assert_close(found: f64, expected: f64, tolerance: f64, what: &str) {
        assert!(
            (found - expected).abs() <= tolerance * expected.abs().max(1e-6),
            "{what}: {found} not {expected}"
        );
    }

    #[test]
    fn losses_and_gradients_of_the_kernels_are_those_of_candle() {
        for activation in [Activation::Elu, Activation::Relu, Activation::Tanh] {
            // Three sizes of minibatches: one group, groups of equal size, and groups of unequal size.
            for samples in [60, 1024, 1301] {
                let what = format!("{activation:?}, {samples} samples");
                let [(fused, kernels), (candle, reference)] = BACKENDS.map(|backend| {
                    let (mut ppo, rollout) = learner(backend, activation);
                    let samples: Vec<u32> = (0..samples)
                        .map(|i| (i * 7) % rollout.samples() as u32)
                        .collect();
                    (gradient(&mut ppo, &rollout, &samples), ppo)
                });
                for (name, found, expected) in [
                    (
                        "total",
                        fused.total(&kernels.config),
                        candle.total(&kernels.config),
                    ),
                    ("surrogate", fused.surrogate, candle.surrogate),
                    ("value", fused.value_error, candle.value_error),
                    ("excess", fused.excess, candle.excess),
                    ("kl", fused.kl, candle.kl),
                    ("ratio", fused.ratio_error, candle.ratio_error),
                ] {
                    assert_close(found, expected, 2e-4, &format!("{what}: {name}"));
                }
                assert_eq!(fused.clipped, candle.clipped, "{what}");
                assert!(
                    fused.clipped > 0.0 && fused.clipped < 1.0,
                    "{what}: some are clipped, but not all"
                );
                let [a, b] = [&kernels, &reference].map(|ppo| by_name(&ppo.policy, &ppo.gradient));
                for ((name, a), (_, b)) in a.into_iter().zip(b) {
                    let largest = b.iter().fold(0.0f32, |most, x| most.max(x.abs()));
                    let error = a
                        .iter()
                        .zip(b)
                        .map(|(a, b)| (a - b).abs())
                        .fold(0.0, f32::max);
                    assert!(
                        largest > 0.0 && error < 1e-4 * largest,
                        "{what}: gradient of {name}: {error} of {largest}"
                    );
                }
            }
        }
    }

    #[test]
    fn the_gradient_of_a_minibatch_is_the_same_in_any_number_of_shards_but_for_rounding() {
        for backend in BACKENDS {
            let [one, eight] = [1, 8].map(|shards| {
                let (mut ppo, rollout) = learner(backend, Activation::Elu);
                ppo.exchange = Exchange::alone(shards);
                let samples: Vec<u32> = (0..1024).collect();
                (gradient(&mut ppo, &rollout, &samples), ppo)
            });
            let total = |(losses, ppo): &(Losses, Ppo)| losses.total(&ppo.config);
            for (found, expected) in [(total(&eight), total(&one)), (eight.0.kl, one.0.kl)] {
                assert_close(found, expected, 1e-4, "losses");
            }
            let largest = one
                .1
                .gradient
                .iter()
                .fold(0.0f32, |most, x| most.max(x.abs()));
            assert!(
                one.1
                    .gradient
                    .iter()
                    .zip(&eight.1.gradient)
                    .all(|(a, b)| (a - b).abs() < 1e-5 * largest)
            );
        }
    }

    #[test]
    fn many_steps_of_the_kernels_stay_with_candles() {
        let [fused, candle] = BACKENDS.map(|backend| {
            let (mut ppo, rollout) = learner(backend, Activation::Elu);
            for part in 0..20 {
                let samples: Vec<u32> = (0..256)
                    .map(|i| (i * 5 + part * 31) % rollout.samples() as u32)
                    .collect();
                gradient(&mut ppo, &rollout, &samples);
                step(&mut ppo);
            }
            ppo
        });
        let first = learner(config::Backend::Fused, Activation::Elu).0;
        let [fused, candle, first] =
            [&fused, &candle, &first].map(|ppo| by_name(&ppo.policy, &ppo.policy.parameters));
        for (((name, a), (_, b)), (_, first)) in fused.into_iter().zip(candle).zip(first) {
            let difference = |x: &[f32], y: &[f32]| {
                x.iter()
                    .zip(y)
                    .map(|(x, y)| f64::from(x - y).powi(2))
                    .sum::<f64>()
                    .sqrt()
            };
            let (apart, moved) = (difference(a, b), difference(a, first));
            assert!(
                apart < 1e-2 * moved,
                "{name} moved by {moved}, but is {apart} from candle's"
            );
        }
    }

    #[test]
    fn gradients_of_a_larger_norm_than_allowed_are_scaled_down_to_it() {
        // Adam's first step moves weights by the learning rate, but hardly if gradients are far below its epsilon,
        // 1e-8.
        for (norm, most, least) in [(1e-12, 1e-6, 0.0), (1e3, 1.01e-3, 0.99e-3)] {
            let (mut ppo, mut rollout) = learner(config::Backend::Fused, Activation::Elu);
            (ppo.config.epochs, ppo.config.minibatches) = (1, 1);
            ppo.config.desired_kl = Geometric(Ramp::constant(0.0));
            (ppo.learning_rate, ppo.config.max_grad_norm) = (1e-3, norm);
            let before = ppo.policy.parameters.clone();
            ppo.update(&mut rollout, 1, &AtomicBool::new(false))
                .unwrap();
            let moved = before
                .iter()
                .zip(&ppo.policy.parameters)
                .map(|(a, b)| (a - b).abs())
                .fold(0.0, f32::max);
            assert!(moved <= most && moved >= least, "{norm}: {moved}");
        }
    }

    #[test]
    fn gradients_are_the_same_bits_for_any_number_of_threads_and_whatever_came_before() {
        for precision in [Precision::F32, Precision::Bf16Rounded, Precision::Bf16] {
            // Not every processor has a unit for bf16.
            let Ok(arithmetic) = Arithmetic::new(precision) else {
                continue;
            };
            let run = |threads: &[usize]| {
                let (mut ppo, rollout) = learner(config::Backend::Fused, Activation::Tanh);
                ppo.backend = Box::new(Fused::new(arithmetic));
                ppo.backend.begin(&ppo.policy, &rollout);
                let samples: Vec<u32> = (0..rollout.samples() as u32).collect();
                let mut losses = Vec::new();
                for (i, &number) in threads.iter().enumerate() {
                    // A few samples at first, all of them in the end.
                    let samples = if i + 1 < threads.len() {
                        &samples[..40]
                    } else {
                        &samples[..]
                    };
                    let pool = rayon::ThreadPoolBuilder::new()
                        .num_threads(number)
                        .build()
                        .unwrap();
                    losses.push(pool.install(|| gradient(&mut ppo, &rollout, samples)));
                }
                step(&mut ppo);
                (losses.pop(), ppo.gradient, ppo.policy.parameters)
            };
            let one = run(&[1]);
            for threads in [&[2][..], &[8], &[1, 2], &[2, 8], &[8, 1]] {
                assert!(one == run(threads), "{precision:?}, {threads:?} threads");
            }
        }
    }

    #[test]
    fn the_smallest_nets_and_minibatches_agree_with_candle() {
        let spaces = Spaces {
            observation_size: 1,
            action_size: 1,
            object_and_goal: None,
            ..SPACES
        };
        let [fused, candle] = BACKENDS.map(|backend| {
            let mut config = Config::default().ppo;
            (config.backend, config.hidden) = (backend, vec![1]);
            let mut ppo = Ppo::new(&config, spaces, 3, Exchange::alone(1)).unwrap();
            let mut rollout = Rollout::new(1, &[1], &spaces);
            rollout.blocks[0].observations.fill(0.7);
            rollout.blocks[0].actions.fill(0.4);
            rollout.blocks[0].advantages.fill(1.5);
            rollout.blocks[0].returns.fill(0.3);
            ppo.backend.begin(&ppo.policy, &rollout);
            (
                gradient(&mut ppo, &rollout, &[0]).total(&ppo.config),
                ppo.gradient,
            )
        });
        assert_close(fused.0, candle.0, 1e-5, "loss");
        assert!(
            fused
                .1
                .iter()
                .zip(&candle.1)
                .all(|(a, b)| (a - b).abs() < 1e-5),
            "{:?} not {:?}",
            fused.1,
            candle.1
        );
    }
}
