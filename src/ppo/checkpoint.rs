//! A checkpoint as bytes: safetensors whose metadata carry the whole configuration and the progress of the run.
//!
//! Reading is strict: the tensors must be those of the policy that the configuration describes, no more and no fewer, of
//! the same shapes and finite.

use std::collections::{BTreeMap, HashMap};

use anyhow::{Context, Result, anyhow, bail, ensure};
use candle_core::{Device, Tensor};
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};

use super::backend::Moments;
use super::{Normalizer, Policy, Ppo};

/// The value of the metadata key `format`.
const FORMAT: &str = "shadow-repose checkpoint 1";

/// How far a run has come.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Progress {
    /// Iterations finished.
    pub iteration: u64,
    /// Control steps over all environments.
    pub env_steps: u64,
    /// The number of the first training episode that was not yet begun.
    pub next_episode: u64,
    /// Goals per episode and rotation error (rad) of the best evaluation.
    pub best: Option<[f64; 2]>,
}

/// A checkpoint that has been read but not yet laid into a policy.
pub struct Checkpoint {
    /// The configuration of the run, as TOML.
    pub config: String,
    /// How far the run had come.
    pub progress: Progress,
    learner: Learner,
    tensors: BTreeMap<String, Stored>,
}

/// What the optimizer needs besides tensors.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Learner {
    learning_rate: f64,
    adam_steps: u64,
}

enum Stored {
    F32(Vec<usize>, Vec<f32>),
    F64(Vec<usize>, Vec<f64>),
}

impl Checkpoint {
    /// Reads a checkpoint from the bytes of a file.
    ///
    /// # Errors
    /// Bytes that are no whole checkpoint of this program.
    pub fn parse(bytes: &[u8]) -> Result<Self> {
        let (_, header) = SafeTensors::read_metadata(bytes)
            .map_err(|error| anyhow!("not a whole safetensors file ({error}); it may be cut off"))?;
        let metadata = header.metadata().as_ref().context("no metadata: not a checkpoint of this program")?;
        let entry = |key: &str| metadata.get(key).with_context(|| format!("its metadata lack `{key}`"));
        let format = entry("format")?;
        ensure!(format == FORMAT, "its format is `{format}`, this program reads `{FORMAT}`");
        let files = SafeTensors::deserialize(bytes).map_err(|error| anyhow!("damaged: {error}"))?;
        let mut tensors = BTreeMap::new();
        for (name, view) in files.iter() {
            tensors.insert(name.to_owned(), Stored::read(&view).with_context(|| format!("tensor `{name}`"))?);
        }
        Ok(Self {
            config: entry("config")?.clone(),
            progress: serde_json::from_str(entry("progress")?).context("its metadata `progress`")?,
            learner: serde_json::from_str(entry("learner")?).context("its metadata `learner`")?,
            tensors,
        })
    }

    fn take(&mut self, name: &str, shape: &[usize]) -> Result<Stored> {
        let stored = self.tensors.remove(name).with_context(|| format!("tensor `{name}` is missing"))?;
        let found = stored.shape();
        ensure!(found == shape, "tensor `{name}` has the shape {found:?}, expected {shape:?}");
        Ok(stored)
    }

    fn take_tensor(&mut self, name: &str, shape: &[usize]) -> Result<Tensor> {
        match self.take(name, shape)? {
            Stored::F32(shape, values) => Ok(Tensor::from_vec(values, shape, &Device::Cpu)?),
            Stored::F64(..) => bail!("tensor `{name}` must be of type F32"),
        }
    }

    fn take_doubles(&mut self, name: &str, size: usize) -> Result<Vec<f64>> {
        match self.take(name, &[size])? {
            Stored::F64(_, values) => Ok(values),
            Stored::F32(..) => bail!("tensor `{name}` must be of type F64"),
        }
    }

    fn take_policy(&mut self, policy: &mut Policy) -> Result<()> {
        for (name, var) in policy.parameters() {
            var.set(&self.take_tensor(name, var.dims())?)?;
        }
        let size = policy.observation_size();
        let count = self.take_doubles("normalizer.count", 1)?[0];
        policy.normalizer = Normalizer {
            mean: self.take_doubles("normalizer.mean", size)?,
            variance: self.take_doubles("normalizer.variance", size)?,
            count,
        };
        let sound = count >= 0.0 && policy.normalizer.variance.iter().all(|&v| v >= 0.0);
        ensure!(sound, "tensor `normalizer.variance` or `normalizer.count` has a negative value");
        Ok(())
    }
}

impl Policy {
    /// Takes over weights and normaliser of a checkpoint.
    ///
    /// # Errors
    /// A tensor that is missing, of another shape or type, not finite, or not one of a checkpoint of this policy.
    pub fn restore(&mut self, mut checkpoint: Checkpoint) -> Result<()> {
        checkpoint.take_policy(self)?;
        checkpoint.tensors.retain(|name, _| !name.starts_with("adam."));
        checkpoint.finish()
    }
}

impl Ppo {
    /// The policy and all that is needed to go on training it, with the configuration (TOML) and the progress of the run.
    ///
    /// # Errors
    /// Weights that are not finite.
    pub fn save(&self, config: &str, progress: &Progress) -> Result<Vec<u8>> {
        let mut tensors = Vec::new();
        let moments = self.backend.moments(&self.policy)?;
        for ((name, var), [mean, square]) in self.policy.parameters().iter().zip(&moments.tensors) {
            tensors.push((name.clone(), Stored::of(var.as_tensor())?));
            tensors.push((format!("adam.mean.{name}"), Stored::of(mean)?));
            tensors.push((format!("adam.square.{name}"), Stored::of(square)?));
        }
        let normalizer = &self.policy.normalizer;
        for (name, values) in
            [("mean", &normalizer.mean), ("variance", &normalizer.variance), ("count", &vec![normalizer.count])]
        {
            tensors.push((format!("normalizer.{name}"), Stored::F64(vec![values.len()], values.clone())));
        }
        for (name, stored) in &tensors {
            ensure!(stored.is_finite(), "`{name}` is not finite and is not saved");
        }
        let learner = Learner { learning_rate: self.learning_rate, adam_steps: moments.steps };
        let metadata = HashMap::from([
            ("format".to_owned(), FORMAT.to_owned()),
            ("config".to_owned(), config.to_owned()),
            ("progress".to_owned(), serde_json::to_string(progress)?),
            ("learner".to_owned(), serde_json::to_string(&learner)?),
        ]);
        let bytes: Vec<(String, Vec<u8>, Stored)> =
            tensors.into_iter().map(|(name, stored)| (name, stored.bytes(), stored)).collect();
        let mut views = Vec::new();
        for (name, bytes, stored) in &bytes {
            views.push((name, TensorView::new(stored.dtype(), stored.shape().to_vec(), bytes)?));
        }
        Ok(safetensors::serialize(views, Some(metadata))?)
    }

    /// Goes on from a checkpoint.
    ///
    /// # Errors
    /// As [`Policy::restore`].
    pub fn restore(&mut self, mut checkpoint: Checkpoint) -> Result<()> {
        checkpoint.take_policy(&mut self.policy)?;
        let mut tensors = Vec::new();
        for (name, var) in self.policy.parameters() {
            let mean = checkpoint.take_tensor(&format!("adam.mean.{name}"), var.dims())?;
            let square = checkpoint.take_tensor(&format!("adam.square.{name}"), var.dims())?;
            tensors.push([mean, square]);
        }
        let Learner { learning_rate, adam_steps } = checkpoint.learner;
        ensure!(learning_rate.is_finite() && learning_rate > 0.0, "its learning rate is {learning_rate}");
        checkpoint.finish()?;
        self.backend.restore(Moments { tensors, steps: adam_steps })?;
        self.learning_rate = learning_rate;
        Ok(())
    }
}

impl Checkpoint {
    fn finish(self) -> Result<()> {
        match self.tensors.keys().next() {
            Some(name) => bail!("tensor `{name}` is not one of this policy"),
            None => Ok(()),
        }
    }
}

impl Stored {
    fn of(tensor: &Tensor) -> Result<Self> {
        Ok(Self::F32(tensor.dims().to_vec(), tensor.flatten_all()?.to_vec1()?))
    }

    fn read(view: &TensorView) -> Result<Self> {
        let shape = view.shape().to_vec();
        let stored = match view.dtype() {
            Dtype::F32 => {
                let (words, _) = view.data().as_chunks::<4>();
                Self::F32(shape, words.iter().map(|word| f32::from_le_bytes(*word)).collect())
            }
            Dtype::F64 => {
                let (words, _) = view.data().as_chunks::<8>();
                Self::F64(shape, words.iter().map(|word| f64::from_le_bytes(*word)).collect())
            }
            other => bail!("has the type {other:?}, expected F32 or F64"),
        };
        ensure!(stored.is_finite(), "holds a number that is not finite");
        Ok(stored)
    }

    fn bytes(&self) -> Vec<u8> {
        match self {
            Self::F32(_, values) => values.iter().flat_map(|x| x.to_le_bytes()).collect(),
            Self::F64(_, values) => values.iter().flat_map(|x| x.to_le_bytes()).collect(),
        }
    }

    fn dtype(&self) -> Dtype {
        match self {
            Self::F32(..) => Dtype::F32,
            Self::F64(..) => Dtype::F64,
        }
    }

    fn shape(&self) -> &[usize] {
        match self {
            Self::F32(shape, _) | Self::F64(shape, _) => shape,
        }
    }

    fn is_finite(&self) -> bool {
        match self {
            Self::F32(_, values) => values.iter().all(|x| x.is_finite()),
            Self::F64(_, values) => values.iter().all(|x| x.is_finite()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Backend, Config};
    use crate::ppo::Rollout;

    fn learner_with(backend: Backend, hidden: &[usize], seed: u64) -> Ppo {
        let mut config = Config::resolve(None, &[]).unwrap().ppo;
        (config.backend, config.hidden) = (backend, hidden.to_vec());
        Ppo::new(&config, 3, 2, seed).unwrap()
    }

    fn learner(hidden: &[usize], seed: u64) -> Ppo {
        learner_with(Backend::Fused, hidden, seed)
    }

    fn refusal(bytes: &[u8], into: &mut Ppo) -> String {
        match Checkpoint::parse(bytes).and_then(|checkpoint| into.restore(checkpoint)) {
            Ok(()) => panic!("must be refused"),
            Err(error) => format!("{error:#}"),
        }
    }

    /// A learner that has taken a step of its optimizer.
    fn learnt(backend: Backend, seed: u64) -> Ppo {
        let mut ppo = learner_with(backend, &[8], seed);
        ppo.policy.normalizer.update(&[&[1.0, 2.0, 3.0, 5.0, 7.0, 11.0]]);
        ppo.learning_rate = 0.123;
        let rollout = Rollout::new(4, &[8], 3, 2);
        let samples: Vec<u32> = (0..32).collect();
        ppo.backend.begin(&ppo.policy, &rollout).unwrap();
        ppo.backend.gradient(&ppo.policy, &rollout, &samples).unwrap();
        ppo.backend.step(&ppo.policy, 0.01, 1.0).unwrap();
        ppo
    }

    #[test]
    fn what_is_saved_is_what_is_restored_by_either_backend() {
        for [backend, other] in [[Backend::Fused, Backend::Candle], [Backend::Candle, Backend::Fused]] {
            let from = learnt(backend, 1);
            let progress = Progress { iteration: 7, env_steps: 99, next_episode: 5, best: Some([1.5, 0.25]) };
            let bytes = from.save("[env]", &progress).unwrap();
            for mut to in [learnt(backend, 2), learnt(other, 3)] {
                let checkpoint = Checkpoint::parse(&bytes).unwrap();
                assert_eq!((checkpoint.config.as_str(), checkpoint.progress), ("[env]", progress));
                to.restore(checkpoint).unwrap();
                assert_eq!(to.policy.normalizer, from.policy.normalizer);
                assert_eq!(to.learning_rate, 0.123);
                assert!(from.backend.moments(&from.policy).unwrap().tensors.iter().flatten().any(|moment| {
                    moment.flatten_all().unwrap().to_vec1::<f32>().unwrap().iter().any(|&x| x != 0.0)
                }));
                // The order of the metadata is not fixed.
                let saved = to.save("[env]", &progress).unwrap();
                let tensors = |bytes| SafeTensors::deserialize(bytes).unwrap();
                for (name, tensor) in tensors(&bytes).iter() {
                    assert!(tensors(&saved).tensor(name).unwrap().data() == tensor.data(), "{name} differs");
                }
            }
        }
    }

    #[test]
    fn other_shapes_and_names_are_refused_by_name() {
        let bytes = learner(&[8], 0).save("", &Progress::default()).unwrap();
        let wider = refusal(&bytes, &mut learner(&[9], 0));
        assert!(wider.contains("`actor.0.weight` has the shape [8, 3], expected [9, 3]"), "{wider}");
        let deeper = refusal(&bytes, &mut learner(&[8, 2], 0));
        assert!(deeper.contains("`actor.2.weight` is missing"), "{deeper}");
        let mut more = Checkpoint::parse(&bytes).unwrap();
        more.tensors.insert("actor.9.weight".into(), Stored::F32(vec![1], vec![0.0]));
        let more = learner(&[8], 0).restore(more).unwrap_err().to_string();
        assert!(more.contains("`actor.9.weight` is not one of this policy"), "{more}");
    }

    #[test]
    fn cut_off_and_foreign_files_are_refused() {
        let bytes = learner(&[8], 0).save("", &Progress::default()).unwrap();
        for length in [0, 7, 8, 100, bytes.len() / 2, bytes.len() - 1] {
            assert!(refusal(&bytes[..length], &mut learner(&[8], 0)).contains("cut off"));
        }
        let foreign = safetensors::serialize(Vec::<(String, TensorView)>::new(), None).unwrap();
        assert!(refusal(&foreign, &mut learner(&[8], 0)).contains("not a checkpoint of this program"));
    }

    #[test]
    fn weights_that_are_not_finite_are_neither_saved_nor_loaded() {
        let mut ppo = learner(&[8], 0);
        let bytes = ppo.save("", &Progress::default()).unwrap();
        let weight = ppo.policy.parameters()[0].1.flatten_all().unwrap().to_vec1::<f32>().unwrap()[0].to_le_bytes();
        let at = bytes.windows(4).position(|w| w == weight).unwrap();
        let mut damaged = bytes.clone();
        damaged[at..at + 4].copy_from_slice(&f32::NAN.to_le_bytes());
        assert!(refusal(&damaged, &mut learner(&[8], 0)).contains("not finite"));
        ppo.policy.normalizer.mean[0] = f64::NAN;
        assert!(ppo.save("", &Progress::default()).unwrap_err().to_string().contains("normalizer.mean"));
    }
}
