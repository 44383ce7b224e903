//! A loaded scene and its names: each lookup gives an index that stays valid, or an error with file and name.

use std::path::Path;
use std::sync::Arc;

use anyhow::{Result, anyhow, bail, ensure};
use mujoco_rs::prelude::{
    MjData, MjModel, MjtBias, MjtEnableBit, MjtGain, MjtIntegrator, MjtJoint, MjtObjBase, MjtTrn, MjtWrap,
};

use super::Look;
use super::fatal::quieten_mujoco;
use super::finite::not_finite;

/// The scene that is built into the program.
const BUILTIN: &str = include_str!("../../assets/shadow_hand/scene.xml");

/// A compiled MuJoCo model that any number of simulations share.
#[derive(Clone)]
pub struct Scene {
    pub(super) model: Arc<MjModel>,
    origin: String,
}

/// What of the physics is set from outside; the rest is said by the scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Variation {
    /// The physics timestep, s.
    pub timestep: f64,
    /// The coefficients of friction of every geom and every pair of them are multiplied by it.
    pub friction: f64,
    /// The mass and the inertia of this body, with all that hangs on it, are multiplied by this.
    pub load: (&'static str, f64),
}

impl Variation {
    /// The scene's own physics, with this timestep in s.
    pub fn none(timestep: f64) -> Self {
        Self { timestep, friction: 1.0, load: ("", 1.0) }
    }

    fn apply(self, model: &mut MjModel) {
        model.opt_mut().timestep = self.timestep;
        let scale = |factors: &mut [f64]| factors.iter_mut().for_each(|x| *x *= self.friction);
        scale(model.geom_friction_mut().as_flattened_mut());
        scale(model.pair_friction_mut().as_flattened_mut());
        let (name, load) = self.load;
        if load != 1.0 {
            // Bodies are numbered so that each comes after the one that it hangs on.
            let mut loaded = vec![false; model.nbody() as usize];
            for body in 0..loaded.len() {
                let named = model.id_to_name(MjtObjBase::mjOBJ_BODY, body) == Some(name);
                loaded[body] = named || loaded[model.body_parentid()[body] as usize];
                if loaded[body] {
                    model.body_mass_mut()[body] *= load;
                    model.body_inertia_mut()[body].iter_mut().for_each(|x| *x *= load);
                }
            }
            // What MuJoCo works out from the masses once, as the scale of contact forces, must follow them.
            let mut data = MjData::new(Box::new(model.clone()));
            data.set_const();
            *model = data.model().clone();
        }
    }
}

/// A hinge joint with limits.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hinge {
    /// Index of its angle in `qpos`.
    pub qpos: usize,
    /// Index of its velocity in `qvel`.
    pub dof: usize,
    /// Limits, rad.
    pub range: [f64; 2],
}

/// A free joint: position and orientation w,x,y,z from `qpos`, linear (world) and angular (body frame) velocity from `dof`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FreeJoint {
    /// First of its seven numbers in `qpos`.
    pub qpos: usize,
    /// First of its six numbers in `qvel`.
    pub dof: usize,
}

/// A body.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Body(pub(super) usize);

/// A mocap body, which is drawn where it is put.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mocap(pub(super) usize);

/// An actuator with one control.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Actuator {
    /// Index of its control in `ctrl`.
    pub ctrl: usize,
    /// Control limits, rad.
    pub range: [f64; 2],
}

impl Scene {
    /// Loads the built-in scene (`None`) or a user's MJCF file, with this variation of its physics.
    ///
    /// # Errors
    /// MuJoCo's own message, with the file's name, where it refuses the scene.
    pub fn load(file: Option<&Path>, variation: Variation) -> Result<Self> {
        quieten_mujoco();
        let model = match file {
            None => MjModel::from_xml_string(BUILTIN),
            Some(path) => {
                ensure!(
                    path.is_file(),
                    "{}: env.model must name a MuJoCo scene, but there is no such file",
                    path.display()
                );
                MjModel::from_xml(path)
            }
        };
        let origin = file.map_or("the built-in scene".into(), |path| path.display().to_string());
        let model = model.map_err(|error| anyhow!("{origin}: MuJoCo refuses this scene: {error}"))?;
        Self::of(model, origin, variation)
    }

    /// The same scene, with the same physics, to be looked at.
    ///
    /// # Errors
    /// As [`Scene::load`], and meshes that cannot be read.
    pub fn load_to_see(file: Option<&Path>, variation: Variation, look: &Look) -> Result<Self> {
        let mut scene = Self::load(file, variation)?;
        if file.is_none() && !look.meshes.is_empty() {
            scene = Self::of(look.dress(BUILTIN)?, scene.origin, variation)?;
        }
        look.set_up(Arc::get_mut(&mut scene.model).expect("a new scene is not shared"));
        Ok(scene)
    }

    fn of(mut model: MjModel, origin: String, variation: Variation) -> Result<Self> {
        if let Some(culprit) = not_finite(&model) {
            bail!("{origin}: {culprit} is not a finite number");
        }
        variation.apply(&mut model);
        let scene = Self { model: Arc::new(model), origin };
        if scene.model.opt().integrator == MjtIntegrator::mjINT_RK4 as i32 {
            bail!("{}: the RK4 integrator cannot be stepped in halves; use implicitfast", scene.origin);
        }
        if scene.model.opt().enableflags & MjtEnableBit::mjENBL_SLEEP as i32 != 0 {
            bail!(
                "{}: what sleeps is not part of the state that MuJoCo can save; leave sleep switched off",
                scene.origin
            );
        }
        Ok(scene)
    }

    /// A number that is another one for a scene that differs in anything.
    ///
    /// # Errors
    /// Only if MuJoCo cannot write the scene into memory.
    pub fn fingerprint(&self) -> Result<u64> {
        let mut bytes = vec![0; self.model.size()];
        self.model.save_to_buffer(&mut bytes)?;
        Ok(crc32fast::hash(&bytes).into())
    }

    /// Number of controls.
    pub fn controls(&self) -> usize {
        self.model.nu() as usize
    }

    /// The limited hinge joint `name`.
    ///
    /// # Errors
    /// No such joint, another kind of joint, or no limits.
    pub fn hinge(&self, name: &str) -> Result<Hinge> {
        let id = self.find(MjtObjBase::mjOBJ_JOINT, "joint", name)?;
        let kind = self.model.jnt_type()[id];
        ensure!(kind == MjtJoint::mjJNT_HINGE, "{}: joint `{name}` must be a hinge, but is {kind:?}", self.origin);
        ensure!(self.model.jnt_limited()[id], "{}: joint `{name}` must have a range", self.origin);
        Ok(Hinge {
            qpos: self.model.jnt_qposadr()[id] as usize,
            dof: self.model.jnt_dofadr()[id] as usize,
            range: self.model.jnt_range()[id],
        })
    }

    /// The free joint of body `name`.
    ///
    /// # Errors
    /// No such body, or its only joint is not a free joint.
    pub fn free_body(&self, name: &str) -> Result<FreeJoint> {
        let Body(body) = self.body(name)?;
        let joint = usize::try_from(self.model.body_jntadr()[body]).ok();
        let free = joint.filter(|&j| self.model.jnt_type()[j] == MjtJoint::mjJNT_FREE);
        let joint = free.ok_or_else(|| anyhow!("{}: body `{name}` must have a free joint", self.origin))?;
        Ok(FreeJoint { qpos: self.model.jnt_qposadr()[joint] as usize, dof: self.model.jnt_dofadr()[joint] as usize })
    }

    /// The body `name`.
    ///
    /// # Errors
    /// No such body.
    pub fn body(&self, name: &str) -> Result<Body> {
        Ok(Body(self.find(MjtObjBase::mjOBJ_BODY, "body", name)?))
    }

    /// The mocap body `name`.
    ///
    /// # Errors
    /// No such body, or no mocap body.
    pub fn mocap(&self, name: &str) -> Result<Mocap> {
        let Body(body) = self.body(name)?;
        let id = usize::try_from(self.model.body_mocapid()[body]).ok();
        Ok(Mocap(id.ok_or_else(|| anyhow!("{}: body `{name}` must have mocap=\"true\"", self.origin))?))
    }

    /// The actuator `name`, which must be a position servo with one limited control and drive the joint `target`, or the fixed
    /// tendon `target` that is the sum of the joints `summed`.
    ///
    /// # Errors
    /// No such actuator or target, or an actuator of another kind or that drives something else.
    pub fn actuator(&self, name: &str, target: &str, summed: &[String]) -> Result<Actuator> {
        let id = self.find(MjtObjBase::mjOBJ_ACTUATOR, "actuator", name)?;
        let (kind, transmission) = match summed {
            [] => (MjtObjBase::mjOBJ_JOINT, MjtTrn::mjTRN_JOINT),
            _ => (MjtObjBase::mjOBJ_TENDON, MjtTrn::mjTRN_TENDON),
        };
        let what = if summed.is_empty() { "joint" } else { "tendon" };
        let target_id = self.find(kind, what, target)?;
        let drives_it =
            self.model.actuator_trntype()[id] == transmission && self.model.actuator_trnid()[id][0] == target_id as i32;
        ensure!(drives_it, "{}: actuator `{name}` must drive the {what} `{target}`", self.origin);
        if !summed.is_empty() {
            self.check_sum(target, target_id, summed)?;
        }
        ensure!(
            self.is_position_servo(id),
            "{}: actuator `{name}` must be a position servo (<position>): its control is an angle",
            self.origin
        );
        let single = self.model.actuator_ctrlnum()[id] == 1;
        let ctrl = self.model.actuator_ctrladr()[id] as usize;
        ensure!(
            single && self.model.actuator_ctrllimited()[ctrl],
            "{}: actuator `{name}` must have one control with a ctrlrange",
            self.origin
        );
        Ok(Actuator { ctrl, range: self.model.actuator_ctrlrange()[ctrl] })
    }

    /// The file of the scene, for messages.
    pub fn origin(&self) -> &str {
        &self.origin
    }

    fn find(&self, kind: MjtObjBase, what: &str, name: &str) -> Result<usize> {
        self.model.name_to_id(kind, name).ok_or_else(|| anyhow!("{}: there is no {what} `{name}` in it", self.origin))
    }

    /// Whether the force is kp · (control - length), with or without damping.
    fn is_position_servo(&self, id: usize) -> bool {
        let kp = self.model.actuator_gainprm()[id][0];
        self.model.actuator_gaintype()[id] == MjtGain::mjGAIN_FIXED
            && self.model.actuator_biastype()[id] == MjtBias::mjBIAS_AFFINE
            && kp > 0.0
            && self.model.actuator_biasprm()[id][1] == -kp
    }

    fn check_sum(&self, tendon: &str, id: usize, joints: &[String]) -> Result<()> {
        let first = self.model.tendon_adr()[id] as usize;
        let path = first..first + self.model.tendon_num()[id] as usize;
        let mut parts: Vec<(usize, f64)> = path
            .filter(|&wrap| self.model.wrap_type()[wrap] == MjtWrap::mjWRAP_JOINT)
            .map(|wrap| (self.model.wrap_objid()[wrap] as usize, self.model.wrap_prm()[wrap]))
            .collect();
        let mut expected = Vec::new();
        for joint in joints {
            expected.push((self.find(MjtObjBase::mjOBJ_JOINT, "joint", joint)?, 1.0));
        }
        parts.sort_by_key(|&(joint, _)| joint);
        expected.sort_by_key(|&(joint, _)| joint);
        ensure!(parts == expected, "{}: tendon `{tendon}` must be the sum {}", self.origin, joints.join(" + "));
        Ok(())
    }
}
