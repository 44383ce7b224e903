//! What a checkpoint holds of a learner, and what a policy alone: weights, normaliser, optimizer, learning rate; with the whole
//! configuration and the progress of the run, and with whatever else the training needs to go on.
//!
//! Reading is strict: the arrays must be those that the configuration describes, no more and no fewer, of the same shapes.

use anyhow::{Context, Result, bail, ensure};
use candle_core::{Device, Tensor};
use serde::{Deserialize, Serialize};

use super::backend::Moments;
use super::format::{Array, Content};
use super::policy::parameter_shapes;
use super::{Normalizer, Policy, Ppo};
use crate::config::PpoConfig;

/// The text `format` of a file.
const FORMAT: &str = "shadow-repose checkpoint 2";

/// Ours takes a thousand bytes.
const LONGEST_CONFIG: usize = 1 << 16;

/// The name of the learning rate as it has been adapted.
const LEARNING_RATE: &str = "learning_rate";

/// How far a run has come.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Progress {
    /// Iterations finished.
    pub iteration: u64,
    /// Control steps over all environments.
    pub env_steps: u64,
    /// Goals per episode and rotation error (rad) of the best evaluation.
    pub best: Option<[f64; 2]>,
}

/// A checkpoint, or a policy alone, outside of any learner.
#[derive(Clone, Debug)]
pub struct Checkpoint {
    /// The configuration of the run, as TOML.
    pub config: String,
    /// How far the run had come.
    pub progress: Progress,
    content: Content,
}

impl Checkpoint {
    /// Reads the bytes of a file.
    ///
    /// # Errors
    /// Bytes that are no whole checkpoint of this program.
    pub fn parse(bytes: &[u8]) -> Result<Self> {
        let mut content = Content::parse(bytes)?;
        let mut text = |key: &str| content.texts.remove(key).with_context(|| format!("its metadata lack `{key}`"));
        let format = text("format")?;
        ensure!(format == FORMAT, "its format is `{format}`, this program reads `{FORMAT}`");
        let config = text("config")?;
        ensure!(
            config.len() <= LONGEST_CONFIG,
            "its configuration has {} bytes, at most {LONGEST_CONFIG} are read",
            config.len()
        );
        let progress = serde_json::from_str(&text("progress")?).context("its metadata `progress`")?;
        if let Some(key) = content.texts.keys().next() {
            bail!("its metadata hold an unknown `{key}`");
        }
        Ok(Self { config, progress, content })
    }

    /// The bytes of a file.
    ///
    /// # Errors
    /// Numbers that are not finite.
    pub fn to_bytes(&self) -> Result<Vec<u8>> {
        let mut content = self.content.clone();
        for (key, text) in
            [("format", FORMAT), ("config", &self.config), ("progress", &serde_json::to_string(&self.progress)?)]
        {
            content.texts.insert(key.into(), text.into());
        }
        content.to_bytes()
    }

    /// What playing needs of it.
    pub fn policy_alone(&self) -> Self {
        let Self { config, progress, content } = self;
        let needed =
            |name: &str| ["actor.", "critic.", "normalizer.", "log_std"].iter().any(|part| name.starts_with(part));
        let arrays = content.arrays.iter().filter(|(name, _)| needed(name));
        let arrays = arrays.map(|(name, array)| (name.clone(), array.clone())).collect();
        Self { config: config.clone(), progress: *progress, content: Content { arrays, ..Content::default() } }
    }

    /// Adds an array.
    pub fn insert(&mut self, name: &str, array: Array) {
        self.content.arrays.insert(name.to_owned(), array);
    }

    /// The shape of an array, if it is there.
    pub fn shape(&self, name: &str) -> Option<&[usize]> {
        self.content.arrays.get(name).map(Array::shape)
    }

    fn take(&mut self, name: &str) -> Result<Array> {
        self.content.arrays.remove(name).with_context(|| format!("tensor `{name}` is missing"))
    }

    /// Takes out doubles of any shape.
    ///
    /// # Errors
    /// The array is missing or of another type.
    pub fn take_doubles(&mut self, name: &str) -> Result<Vec<f64>> {
        match self.take(name)? {
            Array::F64(_, values) => Ok(values),
            _ => bail!("tensor `{name}` must be of type F64"),
        }
    }

    /// Takes out whole numbers of any shape.
    ///
    /// # Errors
    /// The array is missing or of another type.
    pub fn take_counters(&mut self, name: &str) -> Result<Vec<u64>> {
        match self.take(name)? {
            Array::U64(_, values) => Ok(values),
            _ => bail!("tensor `{name}` must be of type U64"),
        }
    }

    fn take_vector(&mut self, name: &str, size: usize) -> Result<Vec<f64>> {
        let values = self.take_doubles(name)?;
        ensure!(values.len() == size, "tensor `{name}` has {} numbers, expected {size}", values.len());
        Ok(values)
    }

    fn take_tensor(&mut self, name: &str) -> Result<Tensor> {
        match self.take(name)? {
            Array::F32(shape, values) => Ok(Tensor::from_vec(values, shape, &Device::Cpu)?),
            _ => bail!("tensor `{name}` must be of type F32"),
        }
    }

    /// Makes sure that it holds the parameters of the policy that `config` describes, before anything is allocated by what
    /// `config` says.
    ///
    /// # Errors
    /// A tensor that is missing, or of another shape.
    pub fn expect_policy(&self, config: &PpoConfig, observation_size: usize, action_size: usize) -> Result<()> {
        for (name, shape) in parameter_shapes(config, observation_size, action_size) {
            self.expect(&name, &shape)?;
        }
        Ok(())
    }

    fn expect(&self, name: &str, shape: &[usize]) -> Result<()> {
        let found = self.shape(name).with_context(|| format!("tensor `{name}` is missing"))?;
        ensure!(found == shape, "tensor `{name}` has the shape {found:?}, expected {shape:?}");
        Ok(())
    }

    fn take_policy(&mut self, policy: &mut Policy) -> Result<()> {
        for (name, var) in policy.parameters() {
            var.set(&self.take_tensor(name)?)?;
        }
        let size = policy.observation_size();
        let count = self.take_vector("normalizer.count", 1)?[0];
        policy.normalizer = Normalizer {
            mean: self.take_vector("normalizer.mean", size)?,
            variance: self.take_vector("normalizer.variance", size)?,
            count,
        };
        let Normalizer { mean, variance, .. } = &policy.normalizer;
        let small = |x: f64| x.abs() < 1e18;
        let sound = small(count) && mean.iter().chain(variance).copied().all(small);
        ensure!(sound, "a tensor `normalizer.…` has a value that no observations have");
        let positive = count >= 0.0 && variance.iter().all(|&v| v >= 0.0);
        ensure!(positive, "tensor `normalizer.variance` or `normalizer.count` has a negative value");
        Ok(())
    }

    /// Makes sure that everything was taken out.
    ///
    /// # Errors
    /// Something is left, by its name.
    pub fn finish(self) -> Result<()> {
        match self.content.arrays.keys().next() {
            Some(name) => bail!("tensor `{name}` is not one of this policy"),
            None => Ok(()),
        }
    }
}

impl Policy {
    /// The policy of a checkpoint, or of a policy alone.
    ///
    /// # Errors
    /// A tensor that is missing, of another shape or type, or not one of this policy.
    pub fn load(
        config: &PpoConfig,
        observation_size: usize,
        action_size: usize,
        checkpoint: &Checkpoint,
    ) -> Result<Self> {
        checkpoint.expect_policy(config, observation_size, action_size)?;
        let mut policy = Self::new(config, observation_size, action_size, 0)?;
        let mut alone = checkpoint.policy_alone();
        alone.take_policy(&mut policy)?;
        alone.finish()?;
        Ok(policy)
    }
}

impl Ppo {
    /// The policy and all that is needed to go on learning, with the configuration (TOML) and the progress of the run.
    ///
    /// # Errors
    /// Only if candle cannot allocate.
    pub fn checkpoint(&self, config: &str, progress: Progress) -> Result<Checkpoint> {
        let mut checkpoint = Checkpoint { config: config.to_owned(), progress, content: Content::default() };
        let floats = |tensor: &Tensor| -> Result<Array> {
            Ok(Array::F32(tensor.dims().to_vec(), tensor.flatten_all()?.to_vec1()?))
        };
        let vector = |values: &[f64]| Array::F64(vec![values.len()], values.to_vec());
        let moments = self.backend.moments(&self.policy)?;
        for ((name, var), [mean, square]) in self.policy.parameters().iter().zip(&moments.tensors) {
            checkpoint.insert(name, floats(var.as_tensor())?);
            checkpoint.insert(&format!("adam.mean.{name}"), floats(mean)?);
            checkpoint.insert(&format!("adam.square.{name}"), floats(square)?);
        }
        checkpoint.insert("adam.steps", Array::U64(vec![1], vec![moments.steps]));
        checkpoint.insert(LEARNING_RATE, vector(&[self.learning_rate]));
        let normalizer = &self.policy.normalizer;
        checkpoint.insert("normalizer.mean", vector(&normalizer.mean));
        checkpoint.insert("normalizer.variance", vector(&normalizer.variance));
        checkpoint.insert("normalizer.count", vector(&[normalizer.count]));
        Ok(checkpoint)
    }

    /// Begins with the policy of a checkpoint, or of a policy alone.
    ///
    /// # Errors
    /// Another policy than the one of the configuration.
    pub fn begin_with(&mut self, checkpoint: &Checkpoint) -> Result<()> {
        let sizes = [self.policy.observation_size(), self.policy.action_size()];
        self.policy = Policy::load(&self.config, sizes[0], sizes[1], checkpoint)?;
        Ok(())
    }

    /// Goes on from a checkpoint, and takes out of it what it needs.
    ///
    /// # Errors
    /// A policy alone; a tensor that is missing, or of another shape or type, or with values that it cannot have.
    pub fn restore(&mut self, checkpoint: &mut Checkpoint) -> Result<()> {
        let [observation_size, action_size] = [self.policy.observation_size(), self.policy.action_size()];
        checkpoint.expect_policy(&self.config, observation_size, action_size)?;
        checkpoint.take_policy(&mut self.policy)?;
        let mut tensors = Vec::new();
        for (name, var) in self.policy.parameters() {
            let mut moment = |kind: &str| -> Result<(String, Tensor)> {
                let name = format!("adam.{kind}.{name}");
                checkpoint.expect(&name, var.dims())?;
                let moment = checkpoint.take_tensor(&name)?;
                Ok((name, moment))
            };
            let (_, mean) = moment("mean")?;
            let (name, square) = moment("square")?;
            ensure!(square.flatten_all()?.min(0)?.to_scalar::<f32>()? >= 0.0, "tensor `{name}` has a negative value");
            tensors.push([mean, square]);
        }
        let steps = checkpoint.take_counters("adam.steps")?;
        // The kernels count them in 32 bits: 10¹³ environment steps of the default training.
        ensure!(steps.len() == 1 && steps[0] <= i32::MAX as u64, "tensor `adam.steps` is no number of steps");
        let learning_rate = checkpoint.take_vector(LEARNING_RATE, 1)?[0];
        ensure!(learning_rate > 0.0, "its learning rate is {learning_rate}");
        self.backend.restore(Moments { tensors, steps: steps[0] })?;
        self.learning_rate = learning_rate;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Backend, Config};
    use crate::ppo::Rollout;

    fn config(backend: Backend, hidden: &[usize]) -> PpoConfig {
        let mut config = Config::resolve(None, &[]).unwrap().ppo;
        (config.backend, config.hidden) = (backend, hidden.to_vec());
        config
    }

    fn learner(hidden: &[usize]) -> Ppo {
        Ppo::new(&config(Backend::Fused, hidden), 3, 2, 0).unwrap()
    }

    fn saved(ppo: &Ppo) -> Checkpoint {
        ppo.checkpoint("[env]", Progress { iteration: 7, env_steps: 99, best: Some([1.5, 0.25]) }).unwrap()
    }

    fn refusal(mut checkpoint: Checkpoint, into: &mut Ppo) -> String {
        let restored = into.restore(&mut checkpoint).and_then(|()| checkpoint.finish());
        format!("{:#}", restored.expect_err("must be refused"))
    }

    /// A learner that has taken a step of its optimizer.
    fn learnt(backend: Backend, seed: u64) -> Ppo {
        let mut ppo = Ppo::new(&config(backend, &[8]), 3, 2, seed).unwrap();
        ppo.policy.normalizer.update(&[&[1.0, 2.0, 3.0, 5.0, 7.0, 11.0]]);
        ppo.learning_rate = 0.123;
        let rollout = Rollout::new(4, &[8], 3, 2);
        let samples: Vec<u32> = (0..32).collect();
        ppo.backend.begin(&ppo.policy, &rollout).unwrap();
        ppo.backend.gradient(&ppo.policy, &rollout, &samples).unwrap();
        ppo.backend.step(&ppo.policy, [0.01; 2], 1.0).unwrap();
        ppo
    }

    #[test]
    fn what_is_saved_is_what_is_restored_by_either_backend() {
        for [backend, other] in [[Backend::Fused, Backend::Candle], [Backend::Candle, Backend::Fused]] {
            let from = learnt(backend, 1);
            let bytes = saved(&from).to_bytes().unwrap();
            for mut to in [learnt(backend, 2), learnt(other, 3)] {
                let mut checkpoint = Checkpoint::parse(&bytes).unwrap();
                let progress = Progress { iteration: 7, env_steps: 99, best: Some([1.5, 0.25]) };
                assert_eq!((checkpoint.config.as_str(), checkpoint.progress), ("[env]", progress));
                to.restore(&mut checkpoint).unwrap();
                checkpoint.finish().unwrap();
                assert_eq!(to.policy.normalizer, from.policy.normalizer);
                assert_eq!(to.learning_rate, 0.123);
                assert!(from.backend.moments(&from.policy).unwrap().tensors.iter().flatten().any(|moment| {
                    moment.flatten_all().unwrap().to_vec1::<f32>().unwrap().iter().any(|&x| x != 0.0)
                }));
                assert_eq!(saved(&to).content, saved(&from).content);
            }
        }
    }

    #[test]
    fn a_policy_alone_plays_and_cannot_be_trained_on() {
        let from = learnt(Backend::Fused, 1);
        let alone = saved(&from).policy_alone();
        let bytes = alone.to_bytes().unwrap();
        assert!(bytes.len() < saved(&from).to_bytes().unwrap().len() * 2 / 3);
        let read = Checkpoint::parse(&bytes).unwrap();
        let policy = Policy::load(&config(Backend::Fused, &[8]), 3, 2, &read).unwrap();
        assert_eq!(policy.normalizer, from.policy.normalizer);
        for ((_, a), (_, b)) in policy.parameters().iter().zip(from.policy.parameters()) {
            let numbers = |var: &Tensor| var.flatten_all().unwrap().to_vec1::<f32>().unwrap();
            assert_eq!(numbers(a), numbers(b));
        }
        assert!(refusal(read, &mut learner(&[8])).contains("`adam.mean.actor.0.weight` is missing"));
    }

    #[test]
    fn a_learner_begins_with_the_policy_of_another_and_nothing_else_of_it() {
        let from = learnt(Backend::Fused, 1);
        let mut to = Ppo::new(&config(Backend::Fused, &[8]), 3, 2, 5).unwrap();
        to.begin_with(&saved(&from)).unwrap();
        assert_eq!(saved(&to).policy_alone().content, saved(&from).policy_alone().content);
        let fresh = config(Backend::Fused, &[8]).learning_rate;
        assert_eq!((to.learning_rate, to.backend.moments(&to.policy).unwrap().steps), (fresh, 0));
        assert!(learner(&[9]).begin_with(&saved(&from)).is_err());
    }

    #[test]
    fn other_shapes_and_names_are_refused_by_name() {
        let checkpoint = saved(&learner(&[8]));
        let wider = refusal(checkpoint.clone(), &mut learner(&[9]));
        assert!(wider.contains("`actor.0.weight` has the shape [8, 3], expected [9, 3]"), "{wider}");
        let deeper = refusal(checkpoint.clone(), &mut learner(&[8, 2]));
        assert!(deeper.contains("`actor.1.weight` has the shape [2, 8]") || deeper.contains("is missing"), "{deeper}");
        let mut more = checkpoint.clone();
        more.insert("actor.9.weight", Array::F32(vec![1], vec![0.0]));
        let refused = refusal(more.clone(), &mut learner(&[8]));
        assert!(refused.contains("`actor.9.weight` is not one of this policy"), "{refused}");
        assert!(Policy::load(&config(Backend::Fused, &[8]), 3, 2, &more).is_err());
        let mut negative = checkpoint;
        negative.insert("adam.square.log_std", Array::F32(vec![2], vec![0.0, -1.0]));
        assert!(refusal(negative, &mut learner(&[8])).contains("`adam.square.log_std` has a negative value"));
    }

    #[test]
    fn a_policy_that_the_configuration_only_claims_is_not_allocated() {
        let checkpoint = saved(&learner(&[8]));
        // Terabytes, if they were.
        let claimed = config(Backend::Fused, &[1 << 20, 1 << 20, 1 << 20]);
        assert!(Policy::load(&claimed, 3, 2, &checkpoint).is_err());
    }

    #[test]
    fn weights_that_are_not_finite_are_not_saved() {
        let mut ppo = learner(&[8]);
        ppo.policy.normalizer.mean[0] = f64::NAN;
        assert!(saved(&ppo).to_bytes().unwrap_err().to_string().contains("normalizer.mean"));
    }
}
