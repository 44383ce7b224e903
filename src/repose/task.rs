//! The task that all environments of a run share.

use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, Result, ensure};

use super::mirror::Mirror;
use super::observation::KNOWN;
use super::physics::Physics;
use super::prediction::Predictor;
use super::sensing::{NoiseStd, expect_names};
use super::{Hand, Record};
use crate::config::{Config, EnvConfig, FARTHEST};
use crate::os;
use crate::quat::CUBE_ROTATIONS;
use crate::sim::{Compilation, Look, Parts, Scene, SceneFiles, origin};
use crate::spaces::Spaces;

/// The name of the body that shows the goal where a scene has none.
const GOAL: &str = "goal of shadow-repose";

/// A scene, the hand in it, and the settings.
#[derive(Clone)]
pub struct Task {
    /// The scene.
    pub scene: Scene,
    compilation: Compilation,
    /// The hand in the scene.
    pub hand: Hand,
    /// The settings.
    pub config: EnvConfig,
    /// The standard deviation of white noise on an observation.
    pub(super) noise: NoiseStd,
    /// The standard deviation of the offset of an observation that lasts an episode.
    pub(super) bias: NoiseStd,
    /// The rotations of a cube, by number, that the policy treats as the same. By default, these are the symmetries of the object.
    pub(super) symmetry: Vec<usize>,
    /// What turns observations into observations of the policy's hand, if that is on the other side.
    pub(super) mirror: Option<Mirror>,
    /// What predicts the observations of the policy, if they are predicted.
    pub(super) predictor: Option<Arc<Predictor>>,
    /// The number of actuators, joints and bodies that have no name in the scene.
    unnamed: usize,
    /// Where the policy does not fit well.
    pub warnings: Vec<String>,
}

impl Task {
    /// Loads the scene that `all` settings name, and binds the hand in it.
    ///
    /// # Errors
    /// Fails with the scene's file if the scene cannot be loaded or lacks something, or if a setting does not fit the hand.
    pub fn new(all: &Config) -> Result<Arc<Self>> {
        Self::with_files(all, &Arc::default())
    }

    /// Loads the scene that `all` settings name, from `known` files if they are those of this scene, and binds the hand in it.
    ///
    /// # Errors
    /// Fails as [`Task::new`] does.
    pub fn with_files(all: &Config, known: &Arc<SceneFiles>) -> Result<Arc<Self>> {
        let file = all.env.model_file();
        let mut config = all.env.clone();
        let plain = Compilation::plain(config.sim_dt, config.cone).in_memory(file, known)?;
        let (plain, as_it_is, unnamed) = named(file, plain)?;
        let mut parts = Hand::find(&as_it_is, &all.hand).with_context(|| origin(file))?;
        let compilation = Compilation {
            object: parts.object.clone(),
            size: config.cube_size_scale,
            shifts: config.cube_com != [0.0; 3],
            adds_goal: parts.goal.is_empty().then_some(GOAL),
            physics_only: true,
            ..plain
        };
        if parts.goal.is_empty() {
            parts.goal = GOAL.into();
        }
        let nominal = Scene::load(file, &compilation)?;
        let mut hand =
            Hand::bind(&nominal, parts, !config.known.is_empty()).with_context(|| origin(file))?;
        let scene = nominal.varied(&Physics::of_task(&config).changes(&hand));
        hand.object.inertia *= config.cube_mass_scale;
        config.goal_position.settle(hand.place());
        let mut place = config.goal_position.value.iter();
        ensure!(
            place.all(|x| x.abs() <= FARTHEST),
            "{}: `{}` starts more than {FARTHEST} m away",
            origin(file),
            hand.parts.object
        );
        settle_sizes(&mut config, &hand, file)?;
        expect_names(&config.known, &KNOWN).context("env.known")?;
        let noise = NoiseStd::new(&config.noise, &hand.layout).context("env.noise")?;
        let bias = NoiseStd::new(&config.bias, &hand.layout).context("env.bias")?;
        Ok(Arc::new(Self {
            predictor: Predictor::new(&scene, &hand, &config)?,
            symmetry: scene.symmetry(hand.object.body),
            scene,
            compilation,
            hand,
            config,
            noise,
            bias,
            mirror: None,
            unnamed,
            warnings: Vec::new(),
        }))
    }

    /// Loads the same task in a scene for display.
    ///
    /// # Errors
    /// Fails if the scene or meshes cannot be read any more.
    pub fn for_display(&self, look: &Look) -> Result<Arc<Self>> {
        let nominal = Scene::load_for_display(
            self.config.model_file(),
            &self.compilation,
            look,
            self.goal_place(),
        )?;
        let hand = Hand::bind(&nominal, self.hand.parts.clone(), self.hand.layout.told)?;
        let mut scene = nominal.varied(&Physics::of_task(&self.config).changes(&hand));
        scene.set_look(look, &nominal);
        Ok(Arc::new(Self {
            scene,
            hand,
            ..self.clone()
        }))
    }

    /// Its scene in memory.
    pub fn files(&self) -> &Arc<SceneFiles> {
        &self.compilation.files
    }

    /// The same task at the stage of a run in which `other` is: its actions are smoothed as there.
    #[must_use]
    pub fn at_the_stage_of(&self, other: &EnvConfig) -> Arc<Self> {
        Arc::new(Self {
            config: EnvConfig {
                act_moving_average: other.act_moving_average,
                ..self.config.clone()
            },
            ..self.clone()
        })
    }

    /// Notes on the side of the hand and on a user's scene: what the settings replace in it, and whether the goal and the start of its
    /// cube come from it.
    pub fn notes(&self) -> Vec<String> {
        let mut notes = Vec::new();
        if self.mirror.is_some() {
            notes
                .push("the policy is for the hand on the other side: it plays mirrored".to_owned());
        }
        let prediction = self.config.prediction;
        if prediction > 0 {
            let delay = self.config.action_delay;
            notes.push(format!(
                "{prediction} control steps are predicted; actions take effect {delay} control steps late"
            ));
        }
        let Some(file) = self.config.model_file() else {
            return notes;
        };
        let place = self.config.goal_position.value;
        let own = self.hand.place();
        let scene = file.display();
        let timestep = self.scene.own_timestep;
        let sim_dt = self.config.sim_dt;
        if timestep != sim_dt {
            notes.push(format!(
                "env.sim_dt = {sim_dt} s replaces the timestep of {scene}, {timestep} s"
            ));
        }
        if let Some(keyframe) = self.hand.keyframe {
            notes.push(format!(
                "episodes start in the keyframe `{}` of {scene}",
                os::shortened(&self.scene.keyframes()[keyframe])
            ));
        }
        if self.unnamed > 0 {
            notes.push(format!(
                "parts without a name in {scene}: {}. They are called `servo of`, `joint of` or `link of` their neighbours",
                self.unnamed
            ));
        }
        notes.extend(self.notes_on_object());
        let object = &self.hand.parts.object;
        notes.push(match place == own {
            true => {
                format!("`{object}` starts where {scene} has it: env.goal_position = {place:?}")
            }
            false => format!(
                "env.goal_position = {place:?} replaces the place of `{object}` in {scene}, {own:?}"
            ),
        });
        notes
    }

    /// What makes its object or its joints special.
    fn notes_on_object(&self) -> Vec<String> {
        let mut notes = Vec::new();
        let alike = self.scene.symmetry(self.hand.object.body).len();
        let object = &self.hand.parts.object;
        if alike < CUBE_ROTATIONS.len() {
            let mapping = if alike == 1 {
                "no rotation of a cube but the identity maps".into()
            } else {
                format!("{alike} of the 24 rotations of a cube map")
            };
            notes.push(format!(
                "{mapping} `{object}` onto itself (ppo.symmetry = \"object\")"
            ));
        }
        let round = self.scene.round_axes(self.hand.object.body);
        if !round.is_empty() {
            notes.push(format!(
                "turns of `{object}` about its axes {round} cannot be seen or felt, but goals include such turns, and scores count them"
            ));
        }
        let joints = self.hand.joints.iter();
        let looped = joints.filter(|joint| joint.is_in_loop).count();
        if looped > 0 {
            notes.push(format!(
                "{looped} joints are in loops, which equality constraints close: they start without noise"
            ));
        }
        notes
    }

    /// Tells the user where the policy does not fit well.
    pub fn say_warnings(&self) {
        for warning in &self.warnings {
            os::say!("warning: {warning}");
        }
    }

    /// A table of what was found in the scene, and in what order.
    pub fn table(&self) -> String {
        let Parts {
            joints,
            actuators,
            fingertips,
            object,
            goal,
            ..
        } = &self.hand.parts;
        let listed = |names: &[String]| format!("{}: {}", names.len(), names.join(" "));
        let alike = self.symmetry.len();
        let start = match self.hand.keyframe {
            Some(keyframe) => format!("keyframe `{}`", self.scene.keyframes()[keyframe]),
            None => "the default pose".into(),
        };
        [
            ("joints", listed(joints)),
            ("actuators", listed(actuators)),
            ("fingertips", listed(fingertips)),
            (
                "object",
                format!("{object}: {alike} of a cube's 24 rotations map it onto itself"),
            ),
            ("goal", goal.clone()),
            ("start", start),
        ]
        .map(|(what, found)| format!("{what:<11} {found}\n"))
        .concat()
    }

    /// Prepares the task for a policy with this record. Its [`Self::warnings`] say where the policy does not fit well. A policy for the
    /// hand on the other side observes in the mirror.
    ///
    /// # Errors
    /// Fails if the policy is for another hand.
    pub fn for_policy(self: Arc<Self>, policy: &Record) -> Result<Arc<Self>> {
        let here = self.record();
        let place = origin(self.config.model_file());
        let layout = &self.hand.layout;
        let mirror = match policy.expect_fits(&here, &place)? {
            true => Some(Mirror::new(&here, policy, layout).context(place.clone())?),
            false => Mirror::by_fingertips(&here, policy, layout),
        };
        let mut warnings = Vec::from_iter(policy.warning(&here));
        if !policy
            .symmetry
            .iter()
            .all(|rotation| here.symmetry.contains(rotation))
        {
            warnings.push(format!(
                "the policy treats {} orientations of an object as alike, but `{}` of {place} has only {} that are alike",
                policy.symmetry.len(),
                self.hand.parts.object,
                here.symmetry.len()
            ));
        }
        ensure!(
            policy.told || !here.told,
            "env.known: this policy is not told what is known"
        );
        let mut task = Self {
            mirror,
            symmetry: policy.symmetry.clone(),
            warnings,
            ..Arc::unwrap_or_clone(self)
        };
        task.hand.layout = policy.layout();
        Ok(Arc::new(task))
    }

    /// The record of its hand and object.
    pub fn record(&self) -> Record {
        Record::of(&self.hand, &self.scene, self.symmetry.clone())
    }

    /// What mirrors observations, as a matrix `[O, O]` that is multiplied from the right, if they are mirrored.
    pub fn mirror(&self) -> Option<Vec<f32>> {
        self.mirror
            .as_ref()
            .map(|mirror| mirror.matrix(self.hand.layout.size))
    }

    /// The same task, whose observations are predicted by the physics of another one.
    #[must_use]
    pub fn predicted_by(&self, model: &Self) -> Arc<Self> {
        Arc::new(Self {
            predictor: model.predictor.clone(),
            ..self.clone()
        })
    }

    /// The settings of the model that predicts its observations, if they are predicted.
    pub fn predicted_with(&self) -> Option<&EnvConfig> {
        self.predictor.as_ref().map(|predictor| &predictor.config)
    }

    /// Where the goal is shown.
    pub fn goal_place(&self) -> [f64; 3] {
        let [x, y, z] = self.config.goal_position.value;
        [x, y, z + self.config.target_height]
    }

    /// The description of observations and actions for a learner.
    pub fn spaces(&self) -> Spaces {
        self.hand.layout.spaces(&self.symmetry)
    }

    /// Loads this task's scene with its physics, but with another size of the object (a factor on the task's). With `shifts`,
    /// its centre of mass can be shifted.
    ///
    /// # Errors
    /// Fails like [`Task::new`].
    pub(super) fn scene_with(&self, size: f64, shifts: bool) -> Result<Scene> {
        let config = &self.config;
        let mut compilation = self.compilation.clone();
        compilation.size *= size;
        compilation.shifts |= shifts;
        Ok(Scene::load(config.model_file(), &compilation)?
            .varied(&Physics::of_task(config).changes(&self.hand)))
    }
}

/// Loads a scene in which each part has a name, and counts the parts that have none of their own.
///
/// # Errors
/// Fails as [`Scene::load`] does.
fn named(file: Option<&Path>, plain: Compilation) -> Result<(Compilation, Scene, usize)> {
    let scene = Scene::load(file, &plain)?;
    let unnamed = scene.unnamed();
    if unnamed == 0 {
        return Ok((plain, scene, 0));
    }
    let naming = Compilation {
        names_parts: true,
        ..plain
    };
    let scene = Scene::load(file, &naming)?;
    Ok((naming, scene, unnamed))
}

/// Takes the numbers of joints and actuators from the hand, unless they are named.
///
/// # Errors
/// Fails if another number is named.
fn settle_sizes(config: &mut EnvConfig, hand: &Hand, file: Option<&Path>) -> Result<()> {
    for (setting, key, what, found) in [
        (
            &mut config.num_hand_dofs,
            "num_hand_dofs",
            "joints",
            hand.joints.len(),
        ),
        (
            &mut config.num_actuators,
            "num_actuators",
            "actuators",
            hand.actuators.len(),
        ),
    ] {
        setting.settle(found);
        let named = setting.value;
        ensure!(
            named == found,
            "env.{key} = {named}: the hand of {} has {found} {what}",
            origin(file)
        );
    }
    Ok(())
}
