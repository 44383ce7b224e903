//! The losses of one minibatch, as pure functions of tensors. A minibatch has M samples, an action A values.

use candle_core::{D, Result, Tensor};

use super::super::backend::Losses;
use crate::config::PpoConfig;

/// The data of a minibatch.
pub struct Batch {
    /// `[M, O]`: as the nets see them
    pub observations: Tensor,
    /// `[M, A]`
    pub actions: Tensor,
    /// `[M, A]`: means of the distributions that the actions were drawn from
    pub old_means: Tensor,
    /// `[A]`: logarithms of the policy's standard deviations
    pub log_std: Tensor,
    /// `[M, 1]`: factors on the policy's standard deviations
    pub scales: Tensor,
    /// `[M, 1]`: log-densities of the actions under those distributions
    pub old_log_probs: Tensor,
    /// `[M, 1]`: values of the critic at that time
    pub old_values: Tensor,
    /// `[M, 1]`
    pub advantages: Tensor,
    /// `[M, 1]`
    pub returns: Tensor,
}

impl Batch {
    /// The log-density of the actions for each sample, `[M, 1]`, under Gaussians with these means `[M, A]`. It omits the logarithm
    /// of the scales, here and where the actions were drawn, since only ratios are used.
    ///
    /// # Errors
    /// Fails if the shapes do not match.
    fn log_prob(&self, means: &Tensor) -> Result<Tensor> {
        let z = (&self.actions - means)?
            .broadcast_div(&self.log_std.exp()?)?
            .broadcast_div(&self.scales)?;
        let constant = 0.5 * std::f64::consts::TAU.ln() * self.log_std.elem_count() as f64;
        let log_scale = (self.log_std.sum_all()? + constant)?;
        (z.sqr()?.sum_keepdim(D::Minus1)? * -0.5)?.broadcast_sub(&log_scale)
    }

    /// The mean over the samples of the KL divergence of Gaussians with these means `[M, A]` from those that the actions were
    /// drawn from.
    ///
    /// # Errors
    /// Fails if the shapes do not match.
    fn kl(&self, means: &Tensor) -> Result<Tensor> {
        let moved = (&self.old_means - means.detach())?
            .broadcast_div(&self.scales)?
            .sqr()?
            .mean(0)?;
        (moved / (&self.log_std * 2.0)?.exp()?)?.sum_all()? * 0.5
    }
}

/// The loss that is minimised, a mean over the samples of the minibatch, and the sums over these. The nets have returned
/// these `means` `[M, A]` and `values` `[M, 1]`.
///
/// Policy: J. Schulman et al., "Proximal policy optimization algorithms" (2017), eq. 7. The value is clipped in the same way.
///
/// # Errors
/// Fails if the shapes do not match.
pub fn losses(
    config: &PpoConfig,
    batch: &Batch,
    means: &Tensor,
    values: &Tensor,
) -> Result<(Tensor, Losses)> {
    let ratios = (batch.log_prob(means)? - &batch.old_log_probs)?.exp()?;
    let clipped = ratios.clamp(1.0 - config.clip, 1.0 + config.clip)?;
    let surrogate = (&ratios * &batch.advantages)?.minimum(&(clipped * &batch.advantages)?)?;
    let policy = surrogate.mean_all()?.neg()?;
    let step = (values - &batch.old_values)?.clamp(-config.value_clip(), config.value_clip())?;
    let clipped = (&batch.old_values + step)?;
    let value = (values - &batch.returns)?
        .sqr()?
        .maximum(&(clipped - &batch.returns)?.sqr()?)?
        .mean_all()?;
    let excess = (means - means.clamp(-1.0, 1.0)?.detach())?
        .sqr()?
        .sum(D::Minus1)?
        .mean_all()?;
    let total = ((&policy + (&value * config.value_coef)?)? + (&excess * config.bounds_coef)?)?;

    let ratios = ratios.flatten_all()?.to_vec1::<f32>()?;
    let errors = || ratios.iter().map(|ratio| f64::from((ratio - 1.0).abs()));
    let sum = |mean: &Tensor| -> Result<f64> {
        Ok(f64::from(mean.to_scalar::<f32>()?) * ratios.len() as f64)
    };
    let sums = Losses {
        surrogate: -sum(&policy)?,
        value_error: sum(&value)?,
        excess: sum(&excess)?,
        kl: sum(&batch.kl(means)?)?,
        clipped: errors().filter(|&error| error > config.clip).count() as f64,
        ratio_error: errors().fold(0.0, f64::max),
    };
    Ok((total, sums))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;
    use candle_core::{Device, Var};

    fn tensor(values: &[f32], shape: &[usize]) -> Tensor {
        Tensor::from_slice(values, shape, &Device::Cpu).unwrap()
    }

    /// A batch of Gaussians with standard deviations of e^-0.5 and e^0.2 times the scales, whose log-densities are -2.
    fn batch(
        actions: &[f32],
        old_means: &[f32],
        [scales, old_values, advantages, returns]: [&[f32]; 4],
    ) -> Batch {
        let column = |values: &[f32]| tensor(values, &[values.len(), 1]);
        Batch {
            observations: column(&vec![0.0; scales.len()]),
            actions: tensor(actions, &[scales.len(), 2]),
            old_means: tensor(old_means, &[scales.len(), 2]),
            log_std: tensor(&[-0.5, 0.2], &[2]),
            scales: column(scales),
            old_log_probs: column(&vec![-2.0; scales.len()]),
            old_values: column(old_values),
            advantages: column(advantages),
            returns: column(returns),
        }
    }

    #[track_caller]
    fn assert_close(found: &Tensor, expected: &[f32]) {
        let found: Vec<f32> = found.flatten_all().unwrap().to_vec1().unwrap();
        let close = found
            .iter()
            .zip(expected)
            .all(|(a, b)| (a - b).abs() < 2e-6 * (1.0 + b.abs()));
        assert!(
            close && found.len() == expected.len(),
            "{found:?} instead of {expected:?}"
        );
    }

    /// The expected values come from this program (PyTorch). Clipping takes effect on one ratio and one value. Each
    /// sample has its own noise scale:
    /// ```python
    /// import torch
    /// from torch.distributions import Normal, kl_divergence
    /// mean = torch.tensor([[0.1, -0.2], [0.5, 0.3], [-0.4, 0.8]], requires_grad=True)
    /// log_std = torch.tensor([-0.5, 0.2])
    /// value = torch.tensor([0.3, -0.6, 1.4], requires_grad=True)
    /// old_mean = torch.tensor([[-0.1, -0.1], [0.4, 0.5], [-0.5, 0.5]])
    /// scale = torch.tensor([[1.0], [1.5], [0.8]])
    /// old_value = torch.tensor([0.2, -0.1, 1.0])
    /// action = torch.tensor([[0.5, -1.0], [-0.3, 0.9], [0.2, 1.5]])
    /// advantage = torch.tensor([1.0, 0.5, -2.0])
    /// returns = torch.tensor([0.5, 0.1, 1.9])
    /// dist, old = [Normal(mean, scale * log_std.exp()) for mean in (mean, old_mean)]
    /// log_prob = dist.log_prob(action).sum(1)
    /// ratio = (log_prob - old.log_prob(action).sum(1)).exp()
    /// policy = -torch.min(ratio * advantage, ratio.clamp(0.8, 1.2) * advantage).mean()
    /// clipped = old_value + (value - old_value).clamp(-0.3, 0.3)
    /// critic = torch.max((value - returns) ** 2, (clipped - returns) ** 2).mean()
    /// kl = kl_divergence(old, dist).sum(1).mean()
    /// (policy + 2.0 * critic).backward()
    /// for x in (log_prob + 2 * scale.log()[:, 0], ratio, policy, critic, kl, mean.grad, value.grad):
    ///     print(x.tolist())
    /// ```
    #[test]
    fn losses_and_gradients_match_pytorch() {
        let mut config = Config::default().ppo;
        (config.clip, config.value_clip, config.value_coef) = (0.2, 0.3, 2.0);
        let mean = Var::from_tensor(&tensor(&[0.1, -0.2, 0.5, 0.3, -0.4, 0.8], &[3, 2])).unwrap();
        let value = Var::from_tensor(&tensor(&[0.3, -0.6, 1.4], &[3, 1])).unwrap();
        let mut batch = batch(
            &[0.5, -1.0, -0.3, 0.9, 0.2, 1.5],
            &[-0.1, -0.1, 0.4, 0.5, -0.5, 0.5],
            [
                &[1.0, 1.5, 0.8],
                &[0.2, -0.1, 1.0],
                &[1.0, 0.5, -2.0],
                &[0.5, 0.1, 1.9],
            ],
        );
        batch.old_log_probs = batch.log_prob(&batch.old_means).unwrap();
        let (total, sums) = losses(&config, &batch, &mean, &value).unwrap();
        let means = sums.means(3);
        assert_close(
            &batch.log_prob(&mean).unwrap(),
            &[-1.969_842_1, -1.978_102_7, -2.559_000_7],
        );
        let found = [
            means.ratio_error,
            -means.surrogate,
            means.value_error,
            means.kl,
        ]
        .map(|x| x as f32);
        assert_close(
            &tensor(&found, &[4]),
            &[0.721_431, 0.599_859_9, 0.296_666_7, 0.046_028_256],
        );
        let grads = total.backward().unwrap();
        let mean_grad = [
            0.0,
            0.0,
            0.142_810_8,
            -0.026_412_528,
            2.924_584_2,
            0.841_392_4,
        ];
        assert_close(grads.get(&mean).unwrap(), &mean_grad);
        assert_close(
            grads.get(&value).unwrap(),
            &[-0.266_666_65, -0.933_333_4, 0.0],
        );
    }

    #[test]
    fn means_beyond_the_bounds_of_actions_are_pulled_back() {
        let batch = batch(&[0.2, 1.5], &[-0.5, 0.5], [&[1.0], &[1.0], &[-2.0], &[0.9]]);
        let mean = Var::from_tensor(&tensor(&[1.5, -0.2], &[1, 2])).unwrap();
        let with = |bounds_coef: f64| {
            let mut config = Config::default().ppo;
            config.bounds_coef = bounds_coef;
            let (total, sums) = losses(&config, &batch, &mean, &tensor(&[1.4], &[1, 1])).unwrap();
            assert!((sums.excess - 0.25).abs() < 1e-6);
            total.backward().unwrap().get(&mean).unwrap().clone()
        };
        assert_close(&(with(0.5) - with(0.0)).unwrap(), &[0.5, 0.0]);
    }

    #[test]
    fn a_distribution_has_no_divergence_from_itself() {
        let batch = batch(&[0.0; 2], &[0.3, -2.0], [&[3.0], &[0.0], &[0.0], &[0.0]]);
        let kl = batch.kl(&batch.old_means).unwrap();
        assert!(kl.to_scalar::<f32>().unwrap().abs() < 1e-6);
    }
}
