//! The content of checkpoints: weights, normaliser, optimizer and learning rate of a learner, the whole configuration,
//! and the progress of the run. Whatever else a training run needs to resume is added. A policy alone contains only
//! weights, normaliser, configuration and progress.
//!
//! Reading is strict: the arrays and their shapes must be exactly as the configuration describes.

use std::mem;

use anyhow::{Context, Result, anyhow, bail, ensure};

use super::format::{self, Array, Arrays};
use super::normalizer::{CLIP, EPSILON};
use super::parameters::{ParameterLayout, View};
use super::{Normalizer, Policy, Ppo, Progress};
use crate::config::PpoConfig;
use crate::os::shortened;
use crate::spaces::Spaces;

/// The text `format` of a file.
const FORMAT: &str = "shadow-repose checkpoint 5";

/// The most bytes of a configuration that are read. Ours take one to two thousand.
const LONGEST_CONFIG: usize = 1 << 16;

/// The name of the logarithms of the standard deviations, one for each action.
const LOG_STD: &str = "log_std";

/// The beginning of the names of the critic's tensors. The policy of another program has none.
const CRITIC: &str = "critic.";

/// The name of what is added to variances and of the limit of normalised values, in a file where they are not [`EPSILON`] and [`CLIP`].
const CONSTANTS: &str = "normalizer.constants";

/// A checkpoint, or a policy alone, independent of a learner.
#[derive(Clone, Default)]
pub struct Checkpoint {
    /// The configuration of the run, as TOML.
    pub config: String,
    /// The progress of the run.
    pub progress: Progress,
    /// How a published policy was made, as JSON: commands, seed, commit, machine, minutes. `scripts/provenance.py` writes it.
    pub provenance: Option<String>,
    /// The fingerprint of the physics of its scene.
    pub scene: String,
    /// The hand and the object that it was trained with, as JSON.
    pub hand: String,
    arrays: Arrays,
}

impl Checkpoint {
    /// Parses the bytes of a file.
    ///
    /// # Errors
    /// Fails if the bytes are not a complete checkpoint of this program.
    pub fn parse(bytes: &[u8]) -> Result<Self> {
        let (mut texts, arrays) = format::parse(bytes)?;
        let mut text = |key: &str| {
            texts
                .remove(key)
                .with_context(|| format!("its metadata has no `{key}`"))
        };
        let format = text("format")?;
        ensure!(
            format == FORMAT,
            "its format is `{}`; this program reads `{FORMAT}`",
            shortened(&format)
        );
        let config = text("config")?;
        let long = config.len();
        ensure!(
            long <= LONGEST_CONFIG,
            "its configuration has {long} bytes; at most {LONGEST_CONFIG} are allowed"
        );
        let progress = serde_json::from_str(&text("progress")?).map_err(|error| {
            anyhow!("its metadata `progress`: {}", shortened(&error.to_string()))
        })?;
        let scene = text("scene")?;
        let hand = text("hand")?;
        let provenance = texts.remove("provenance");
        if let Some(key) = texts.keys().next() {
            bail!("its metadata has an unknown `{}`", shortened(key));
        }
        Ok(Self {
            config,
            progress,
            provenance,
            scene,
            hand,
            arrays,
        })
    }

    /// The bytes of a file.
    ///
    /// # Errors
    /// Fails if a value is not finite.
    pub fn to_bytes(&self) -> Result<Vec<u8>> {
        let progress = serde_json::to_string(&self.progress)?;
        let always = [
            ("format", FORMAT),
            ("config", &self.config),
            ("progress", &progress),
            ("scene", &self.scene),
            ("hand", &self.hand),
        ];
        let provenance = self
            .provenance
            .iter()
            .map(|text| ("provenance", text.as_str()));
        let texts = always.into_iter().chain(provenance);
        let texts = texts.map(|(key, text)| (key.into(), text.into()));
        format::to_bytes(texts.collect(), &self.arrays)
    }

    /// Only the parts that playing needs. The path of a fork's checkpoint is left out. The path of an own scene stays in the
    /// settings, where it tells scenes apart.
    pub fn policy_alone(&self) -> Self {
        let mut alone = self.clone();
        alone.arrays.retain(|name, _| {
            ["actor.", CRITIC, "normalizer.", LOG_STD]
                .iter()
                .any(|part| name.starts_with(part))
        });
        alone.progress.fork = None;
        alone
    }

    /// Adds an array.
    pub fn insert(&mut self, name: &str, array: Array) {
        self.arrays.insert(name.to_owned(), array);
    }

    /// The shape of an array, if it exists.
    pub fn shape(&self, name: &str) -> Option<&[usize]> {
        self.arrays.get(name).map(Array::shape)
    }

    fn take(&mut self, name: &str) -> Result<Array> {
        self.arrays
            .remove(name)
            .with_context(|| format!("tensor `{name}` is missing"))
    }

    /// Removes an f64 array of any shape and returns its values.
    ///
    /// # Errors
    /// Fails if the array is missing or of another type.
    pub fn take_doubles(&mut self, name: &str) -> Result<Vec<f64>> {
        let Array::F64(_, values) = self.take(name)? else {
            bail!("tensor `{name}` must be of type F64")
        };
        Ok(values)
    }

    /// Removes a u64 array of any shape and returns its values.
    ///
    /// # Errors
    /// Fails if the array is missing or of another type.
    pub fn take_counters(&mut self, name: &str) -> Result<Vec<u64>> {
        let Array::U64(_, values) = self.take(name)? else {
            bail!("tensor `{name}` must be of type U64")
        };
        Ok(values)
    }

    fn take_vector(&mut self, name: &str, size: usize) -> Result<Vec<f64>> {
        let values = self.take_doubles(name)?;
        ensure!(
            values.len() == size,
            "tensor `{name}` has {} values, expected {size}",
            values.len()
        );
        Ok(values)
    }

    fn take_floats(&mut self, name: &str, shape: &[usize]) -> Result<Vec<f32>> {
        self.expect(name, shape)?;
        let Array::F32(_, values) = self.take(name)? else {
            bail!("tensor `{name}` must be of type F32")
        };
        Ok(values)
    }

    /// Checks that it contains the parameters of such nets, before the sizes in `config` determine an allocation.
    ///
    /// # Errors
    /// Fails if a tensor is missing or of another shape.
    pub fn expect_policy(&self, config: &PpoConfig, spaces: &Spaces) -> Result<()> {
        ParameterLayout::new(&config.hidden, spaces)
            .views()
            .iter()
            .filter(|view| self.has_critic() || !view.name.starts_with(CRITIC))
            .try_for_each(|View { name, shape, .. }| self.expect(name, shape))?;
        self.expect(LOG_STD, &[spaces.action_size])
    }

    /// Whether it has a value function, or a part of one.
    fn has_critic(&self) -> bool {
        self.arrays.keys().any(|name| name.starts_with(CRITIC))
    }

    fn expect(&self, name: &str, shape: &[usize]) -> Result<()> {
        let found = self
            .shape(name)
            .with_context(|| format!("tensor `{name}` is missing"))?;
        let [said, expected] = [found, shape].map(|sizes| shortened(&format!("{sizes:?}")));
        ensure!(
            found == shape,
            "tensor `{name}` has the shape {said}, expected {expected}"
        );
        Ok(())
    }

    fn take_policy(&mut self, config: &PpoConfig, spaces: Spaces) -> Result<Policy> {
        self.expect_policy(config, &spaces)?;
        let mut policy = Policy::new(config, spaces);
        policy.has_critic = self.has_critic();
        for View { name, shape, range } in policy.layout.views() {
            if policy.has_critic || !name.starts_with(CRITIC) {
                policy.parameters[range].copy_from_slice(&self.take_floats(&name, &shape)?);
            }
        }
        policy.log_std = self.take_floats(LOG_STD, &[spaces.action_size])?;
        let size = spaces.observation_size;
        let count = self.take_vector("normalizer.count", 1)?[0];
        let mean = self.take_vector("normalizer.mean", size)?;
        let variance = self.take_vector("normalizer.variance", size)?;
        let [epsilon, clip] = match self.shape(CONSTANTS) {
            Some(_) => *self.take_vector(CONSTANTS, 2)?.first_chunk().expect("two"),
            None => [EPSILON, CLIP],
        };
        ensure!(
            mean.iter()
                .chain(&variance)
                .chain([&count, &epsilon])
                .all(|x| x.abs() < 1e18),
            "a tensor `normalizer.…` has a value that no observations can produce"
        );
        ensure!(
            count >= 0.0 && variance.iter().all(|&v| v >= 0.0),
            "tensor `normalizer.variance` or `normalizer.count` has a negative value"
        );
        ensure!(
            epsilon >= 0.0 && clip > 0.0 && variance.iter().all(|&v| v + epsilon > 0.0),
            "tensor `{CONSTANTS}` has a value that nothing can be divided or clipped by"
        );
        policy.normalizer = Normalizer {
            mean,
            variance,
            count,
            epsilon,
            clip,
        };
        Ok(policy)
    }

    /// Checks that every array was removed.
    ///
    /// # Errors
    /// Fails if one is left, and names it.
    pub fn finish(self) -> Result<()> {
        match self.arrays.keys().next() {
            Some(name) => bail!("tensor `{}` is not part of this policy", shortened(name)),
            None => Ok(()),
        }
    }
}

impl Policy {
    /// Loads the policy of a checkpoint, or a policy alone.
    ///
    /// # Errors
    /// Fails if a tensor is missing, of another shape or type, or not part of this policy.
    pub fn load(config: &PpoConfig, spaces: Spaces, checkpoint: &Checkpoint) -> Result<Self> {
        let mut alone = checkpoint.policy_alone();
        let policy = alone.take_policy(config, spaces)?;
        alone.finish()?;
        Ok(policy)
    }
}

impl Ppo {
    /// Adds the policy and everything that is needed to resume learning. All ranks call it together.
    pub fn save(&self, checkpoint: &mut Checkpoint) {
        let vector = |values: &[f64]| Array::F64(vec![values.len()], values.to_vec());
        let adam = &self.adam;
        let [mean, square] = [&adam.mean, &adam.square].map(|own| {
            let mut moment = own.clone();
            self.slices.all_gather(&mut moment);
            moment
        });
        let kinds = [
            ("", &self.policy.parameters[..]),
            ("adam.mean.", &mean),
            ("adam.square.", &square),
        ];
        for View { name, shape, range } in self.policy.layout.views() {
            for (prefix, numbers) in kinds {
                let array = Array::F32(shape.clone(), numbers[range.clone()].to_vec());
                checkpoint.insert(&format!("{prefix}{name}"), array);
            }
        }
        let log_std = self.policy.log_std.clone();
        checkpoint.insert(LOG_STD, Array::F32(vec![log_std.len()], log_std));
        checkpoint.insert("adam.steps", Array::U64(vec![1], vec![adam.steps]));
        checkpoint.insert("learning_rate", vector(&[self.learning_rate]));
        let normalizer = &self.policy.normalizer;
        checkpoint.insert("normalizer.mean", vector(&normalizer.mean));
        checkpoint.insert("normalizer.variance", vector(&normalizer.variance));
        checkpoint.insert("normalizer.count", vector(&[normalizer.count]));
        let constants = [normalizer.epsilon, normalizer.clip];
        if constants != [EPSILON, CLIP] {
            checkpoint.insert(CONSTANTS, vector(&constants));
        }
    }

    /// Starts with the policy of a checkpoint, or with a policy alone. If that has no critic, the own one stays.
    ///
    /// # Errors
    /// Fails if it is not the policy that the configuration describes.
    pub fn begin_with(&mut self, checkpoint: &Checkpoint) -> Result<()> {
        let loaded = Policy::load(&self.config, self.policy.spaces, checkpoint)?;
        let random = mem::replace(&mut self.policy, loaded);
        if !self.policy.has_critic {
            let [_, critic] = self.policy.layout.nets();
            self.policy.parameters[critic.clone()].copy_from_slice(&random.parameters[critic]);
            self.policy.has_critic = true;
        }
        Ok(())
    }

    /// Resumes from a checkpoint, and removes from it the arrays that it uses.
    ///
    /// # Errors
    /// Fails for a policy alone, or if a tensor is missing, of another shape or type, or has impossible values.
    pub fn restore(&mut self, checkpoint: &mut Checkpoint) -> Result<()> {
        self.policy = checkpoint.take_policy(&self.config, self.policy.spaces)?;
        for View { name, shape, range } in self.policy.layout.views() {
            for (kind, moment) in [
                ("mean", &mut self.adam.mean),
                ("square", &mut self.adam.square),
            ] {
                let found = checkpoint.take_floats(&format!("adam.{kind}.{name}"), &shape)?;
                moment[range.clone()].copy_from_slice(&found);
            }
            ensure!(
                self.adam.square[range].iter().all(|&x| x >= 0.0),
                "tensor `adam.square.{name}` has a negative value"
            );
        }
        // The optimizer counts steps in 32 bits, enough for 2 · 10¹² environment steps of the default configuration.
        match checkpoint.take_counters("adam.steps")?[..] {
            [steps] if steps <= i32::MAX as u64 => self.adam.steps = steps,
            _ => bail!("tensor `adam.steps` is not a step count"),
        }
        self.learning_rate = checkpoint.take_vector("learning_rate", 1)?[0];
        ensure!(
            self.learning_rate > 0.0,
            "its learning rate is {}",
            self.learning_rate
        );
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Backend, Config};
    use crate::ppo::Rollout;
    use crate::ppo::update::Stage;
    use crate::ranks::Exchange;

    const SPACES: Spaces = Spaces {
        observation_size: 3,
        action_size: 2,
        object_and_goal: None,
        distance: |_, _| 0.0,
    };

    fn config(backend: Backend, hidden: &[usize]) -> PpoConfig {
        let mut config = Config::default().ppo;
        (config.backend, config.hidden) = (backend, hidden.to_vec());
        config
    }

    fn learner(hidden: &[usize]) -> Ppo {
        Ppo::new(
            &config(Backend::Fused, hidden),
            SPACES,
            0,
            Exchange::alone(1),
        )
        .unwrap()
    }

    fn progress() -> Progress {
        Progress {
            iteration: 7,
            env_steps: 99,
            best: Some([1.5, 0.25]),
            fork: None,
            rise: None,
        }
    }

    fn saved(ppo: &Ppo) -> Checkpoint {
        let mut checkpoint = Checkpoint {
            config: "[env]".into(),
            progress: progress(),
            ..Checkpoint::default()
        };
        ppo.save(&mut checkpoint);
        checkpoint
    }

    fn refusal(mut checkpoint: Checkpoint, into: &mut Ppo) -> String {
        let restored = into
            .restore(&mut checkpoint)
            .and_then(|()| checkpoint.finish());
        format!("{:#}", restored.expect_err("must be refused"))
    }

    /// A learner that has taken one optimizer step.
    fn learnt(backend: Backend, seed: u64) -> Ppo {
        let mut ppo = Ppo::new(&config(backend, &[8]), SPACES, seed, Exchange::alone(1)).unwrap();
        ppo.policy
            .see(&[&[1.0, 2.0, 3.0, 5.0, 7.0, 11.0]], &ppo.exchange);
        ppo.learning_rate = 0.123;
        let rollout = Rollout::new(4, &[8], &SPACES);
        let samples: Vec<u32> = (0..32).collect();
        ppo.backend.begin(&ppo.policy, &rollout);
        ppo.minibatch_step(&rollout, &samples, Stage::First)
            .unwrap();
        ppo
    }

    #[test]
    fn what_is_saved_is_what_is_restored_by_either_backend() {
        for [backend, other] in [
            [Backend::Fused, Backend::Candle],
            [Backend::Candle, Backend::Fused],
        ] {
            let from = learnt(backend, 1);
            let bytes = saved(&from).to_bytes().unwrap();
            for mut to in [learnt(backend, 2), learnt(other, 3)] {
                let mut checkpoint = Checkpoint::parse(&bytes).unwrap();
                assert_eq!(
                    (checkpoint.config.as_str(), &checkpoint.progress),
                    ("[env]", &progress())
                );
                to.restore(&mut checkpoint).unwrap();
                checkpoint.finish().unwrap();
                assert_eq!(to.policy.normalizer, from.policy.normalizer);
                assert_eq!(to.learning_rate, 0.123);
                assert!(to.adam == from.adam && from.adam.mean.iter().any(|&x| x != 0.0));
                assert_eq!(saved(&to).arrays, saved(&from).arrays);
            }
        }
    }

    #[test]
    fn a_policy_alone_plays_and_cannot_be_trained_on() {
        let from = learnt(Backend::Fused, 1);
        let alone = Checkpoint {
            provenance: Some("{}".into()),
            ..saved(&from)
        }
        .policy_alone();
        let bytes = alone.to_bytes().unwrap();
        assert!(bytes.len() < saved(&from).to_bytes().unwrap().len() * 2 / 3);
        let read = Checkpoint::parse(&bytes).unwrap();
        assert_eq!(read.provenance.as_deref(), Some("{}"));
        let policy = Policy::load(&config(Backend::Fused, &[8]), SPACES, &read).unwrap();
        assert_eq!(policy.normalizer, from.policy.normalizer);
        assert_eq!(policy.parameters, from.policy.parameters);
        assert!(
            refusal(read, &mut learner(&[8])).contains("`adam.mean.actor.0.weight` is missing")
        );
    }

    #[test]
    fn a_learner_begins_with_the_policy_of_another_and_nothing_else_of_it() {
        let from = learnt(Backend::Fused, 1);
        let mut to =
            Ppo::new(&config(Backend::Fused, &[8]), SPACES, 5, Exchange::alone(1)).unwrap();
        to.begin_with(&saved(&from)).unwrap();
        assert_eq!(
            saved(&to).policy_alone().arrays,
            saved(&from).policy_alone().arrays
        );
        let fresh = config(Backend::Fused, &[8]).learning_rate;
        assert_eq!((to.learning_rate, to.adam.steps), (fresh, 0));
        assert!(learner(&[9]).begin_with(&saved(&from)).is_err());
    }

    #[test]
    fn other_shapes_and_names_are_refused_by_name() {
        let checkpoint = saved(&learner(&[8]));
        let wider = refusal(checkpoint.clone(), &mut learner(&[9]));
        assert!(
            wider.contains("`actor.0.weight` has the shape [8, 3], expected [9, 3]"),
            "{wider}"
        );
        let deeper = refusal(checkpoint.clone(), &mut learner(&[8, 2]));
        assert!(
            deeper.contains("`actor.1.weight` has the shape [2, 8]")
                || deeper.contains("is missing"),
            "{deeper}"
        );
        let mut more = checkpoint.clone();
        more.insert("actor.9.weight", Array::F32(vec![1], vec![0.0]));
        let refused = refusal(more.clone(), &mut learner(&[8]));
        assert!(
            refused.contains("`actor.9.weight` is not part of this policy"),
            "{refused}"
        );
        assert!(Policy::load(&config(Backend::Fused, &[8]), SPACES, &more).is_err());
        let mut negative = checkpoint;
        negative.insert(
            "adam.square.actor.1.bias",
            Array::F32(vec![2], vec![0.0, -1.0]),
        );
        let refused = refusal(negative.clone(), &mut learner(&[8]));
        assert!(
            refused.contains("`adam.square.actor.1.bias` has a negative value"),
            "{refused}"
        );
        negative.insert(CONSTANTS, Array::F64(vec![2], vec![0.0, 0.0]));
        let refused = refusal(negative, &mut learner(&[8]));
        assert!(refused.contains("nothing can be divided"), "{refused}");
    }

    #[test]
    fn a_policy_that_the_configuration_only_claims_is_not_allocated() {
        let checkpoint = saved(&learner(&[8]));
        // Terabytes, if it were allocated.
        let claimed = config(Backend::Fused, &[1 << 20, 1 << 20, 1 << 20]);
        assert!(Policy::load(&claimed, SPACES, &checkpoint).is_err());
    }

    #[test]
    fn weights_that_are_not_finite_are_not_saved() {
        let mut ppo = learner(&[8]);
        ppo.policy.normalizer.mean[0] = f64::NAN;
        assert!(
            saved(&ppo)
                .to_bytes()
                .unwrap_err()
                .to_string()
                .contains("normalizer.mean")
        );
    }
}
