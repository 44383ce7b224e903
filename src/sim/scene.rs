//! A loaded scene and its names. Each lookup returns an index that stays valid, or an error with the name.

use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, Result, bail, ensure};
use mujoco_rs::prelude::{MjModel, MjtDisableBit, MjtObjBase};

use super::Look;
use super::compilation::{Compilation, Cone, origin};
use super::constants::*;
use super::fingerprint::fingerprint;
use super::finite::not_finite;
use super::furnish::furnished;
use super::placing::{frames_within, geoms_within, touches};
use crate::os::shortened;

/// What a scene may not disable: nothing could be held without it.
const NEEDED: [(&str, MjtDisableBit); 3] = [
    ("constraint", mjDSBL_CONSTRAINT),
    ("contact", mjDSBL_CONTACT),
    ("actuation", mjDSBL_ACTUATION),
];

/// A compiled MuJoCo model that any number of simulations can share.
#[derive(Clone)]
pub struct Scene {
    pub(super) model: Arc<MjModel>,
    /// The timestep in its file, s, in whose place another is used.
    pub own_timestep: f64,
}

/// A hinge joint with limits.
#[derive(Clone, Copy)]
pub struct Hinge {
    /// Index of its angle in `qpos`.
    pub qpos: usize,
    /// Index of its velocity in `qvel`.
    pub dof: usize,
    /// Limits, rad.
    pub range: [f64; 2],
    /// Whether a connect or weld constraint makes it part of a loop.
    pub is_in_loop: bool,
}

/// A free joint: position and orientation w,x,y,z from `qpos`, linear (world) and angular (body frame) velocity from `dof`.
#[derive(Clone, Copy)]
pub struct FreeJoint {
    /// The body that it moves.
    pub body: Body,
    /// Index of the first of its seven values in `qpos`.
    pub qpos: usize,
    /// Index of the first of its six values in `qvel`.
    pub dof: usize,
    /// The moment of inertia of what it moves, kg m²: the mean over its axes.
    pub inertia: f64,
}

/// A body.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Body(pub(super) usize);

/// A body or a site, whose pose and velocity can be read.
#[derive(Clone, Copy)]
pub enum Frame {
    /// A body.
    Body(Body),
    /// A site, by its number.
    Site(usize),
}

/// A mocap body, whose pose is set directly, by its number among the mocap bodies.
#[derive(Clone, Copy)]
pub struct Mocap(pub usize);

/// An actuator with one control.
#[derive(Clone, Copy)]
pub struct Actuator {
    /// Its number.
    pub(super) id: usize,
    /// Index of its control in `ctrl`.
    pub ctrl: usize,
    /// Control limits, rad, or m for a tendon along a path in space.
    pub range: [f64; 2],
}

impl Scene {
    /// Loads the built-in scene (`None`) or a user's MJCF file.
    ///
    /// # Errors
    /// Fails with the file's name and MuJoCo's own message if MuJoCo refuses the scene.
    pub fn load(file: Option<&Path>, compilation: &Compilation) -> Result<Self> {
        let checked = |model| {
            // The built-in scene is known to be finite.
            if file.is_some()
                && let Some(culprit) = not_finite(&model)?
            {
                bail!("{culprit} is not a finite number");
            }
            Self::checked(model, compilation)
        };
        compilation
            .compile(file)
            .and_then(checked)
            .with_context(|| origin(file))
    }

    /// Loads the same scene, with the same physics, and with what is needed for display. The goal is shown at `goal`, m.
    ///
    /// # Errors
    /// Fails like [`Scene::load`], or if meshes cannot be read.
    pub fn load_for_display(
        file: Option<&Path>,
        compilation: &Compilation,
        look: &Look,
        goal: [f64; 3],
    ) -> Result<Self> {
        let compilation = &Compilation {
            physics_only: false,
            ..compilation.clone()
        };
        let scene = Self::load(file, compilation)?;
        let changed = match file {
            None => look
                .dress
                .as_ref()
                .map(|dress| dress.compile(compilation))
                .transpose()?,
            // A scene to which nothing can be added is shown as it is.
            Some(file) => furnished(file, &scene.model, compilation, goal).unwrap_or_default(),
        };
        changed.map_or(Ok(scene), |model| Self::checked(model, compilation))
    }

    /// Sets the camera, and the size and quality of pictures, for a variation of the scene `nominal` that is not shared yet.
    ///
    /// # Panics
    /// Panics if the scene is shared.
    pub fn set_look(&mut self, look: &Look, nominal: &Self) {
        let model = Arc::get_mut(&mut self.model).expect("a new scene is not shared");
        // MuJoCo computes these anew with masses, but the picture stays as it is.
        let nominal = nominal.model.stat();
        model.stat_mut().center = nominal.center;
        model.stat_mut().extent = nominal.extent;
        look.set_up(model);
    }

    fn checked(mut model: MjModel, compilation: &Compilation) -> Result<Self> {
        let own_timestep = model.opt().timestep;
        model.opt_mut().timestep = compilation.timestep;
        match compilation.cone {
            Cone::Scene => {}
            Cone::Pyramidal => model.opt_mut().cone = mjCONE_PYRAMIDAL as i32,
            Cone::Elliptic => model.opt_mut().cone = mjCONE_ELLIPTIC as i32,
        }
        ensure!(
            model.opt().integrator != mjINT_RK4 as i32,
            "the RK4 integrator cannot be stepped in halves; use implicitfast"
        );
        for (flag, bit) in NEEDED {
            ensure!(
                model.opt().disableflags & bit as i32 == 0,
                "{flag} must not be disabled in its <flag>"
            );
        }
        ensure!(
            model.opt().enableflags & mjENBL_SLEEP as i32 == 0,
            "sleep is not part of the state that MuJoCo can save; leave sleep switched off"
        );
        Ok(Self {
            model: Arc::new(model),
            own_timestep,
        })
    }

    /// The size of the compiled scene in bytes.
    pub fn size(&self) -> usize {
        self.model.size()
    }

    /// The radius of a sphere about the origin of a body that holds its shapes, and those of the bodies that it carries, m.
    pub fn radius(&self, Body(id): Body) -> f64 {
        let model = &*self.model;
        let shapes = geoms_within(model, &frames_within(model, id)).into_iter();
        let radii = shapes
            .filter(|&(geom, _)| touches(model, geom))
            .map(|(geom, ([x, y, z], _))| model.geom_rbound()[geom] + x.hypot(y).hypot(z));
        radii.fold(0.0, f64::max)
    }

    /// The mass of a body and of those that it carries, kg.
    pub fn mass(&self, Body(id): Body) -> f64 {
        self.model.body_subtreemass()[id]
    }

    /// A checksum of everything that changes its motion.
    pub fn fingerprint(&self) -> String {
        fingerprint(&self.model)
    }

    /// The number of controls.
    pub fn controls(&self) -> usize {
        self.model.nu() as usize
    }

    /// Finds the limited hinge joint `name`.
    ///
    /// # Errors
    /// Fails if there is no such joint, it is not a hinge, or it has no limits.
    pub fn hinge(&self, name: &str) -> Result<Hinge> {
        let id = self.find(mjOBJ_JOINT, "joint", name)?;
        let name = shortened(name);
        let kind = self.model.jnt_type()[id];
        ensure!(
            kind == mjJNT_HINGE,
            "joint `{name}` must be a hinge: remove slides and ball joints, and what drives them, from the hand"
        );
        ensure!(
            self.model.jnt_limited()[id],
            "joint `{name}` must have a range"
        );
        Ok(Hinge {
            qpos: self.model.jnt_qposadr()[id] as usize,
            dof: self.model.jnt_dofadr()[id] as usize,
            range: self.model.jnt_range()[id],
            is_in_loop: self.is_in_loop(id),
        })
    }

    /// Finds the free joint of body `name`.
    ///
    /// # Errors
    /// Fails if there is no such body or its first joint is not a free joint.
    pub fn free_body(&self, name: &str) -> Result<FreeJoint> {
        let body = self.body(name)?;
        let joint = self
            .free_joint(body.0)
            .with_context(|| format!("body `{}` must have a free joint", shortened(name)))?;
        let dof = self.model.jnt_dofadr()[joint] as usize;
        Ok(FreeJoint {
            body,
            qpos: self.model.jnt_qposadr()[joint] as usize,
            dof,
            inertia: self.model.dof_m0()[dof + 3..dof + 6].iter().sum::<f64>() / 3.0,
        })
    }

    /// The number of the first joint of a body if it is a free joint.
    pub(super) fn free_joint(&self, body: usize) -> Option<usize> {
        let joint = usize::try_from(self.model.body_jntadr()[body]).ok();
        joint.filter(|&joint| self.model.jnt_type()[joint] == mjJNT_FREE)
    }

    /// The names of its keyframes.
    pub fn keyframes(&self) -> Vec<String> {
        ids(self.model.nkey())
            .map(|id| {
                self.model
                    .id_to_name(mjOBJ_KEY, id)
                    .unwrap_or_default()
                    .to_owned()
            })
            .collect()
    }

    /// Finds the body `name`.
    ///
    /// # Errors
    /// Fails if there is no such body.
    pub fn body(&self, name: &str) -> Result<Body> {
        Ok(Body(self.find(mjOBJ_BODY, "body", name)?))
    }

    /// Finds the body or, if there is none, the site `name`.
    ///
    /// # Errors
    /// Fails if there is neither.
    pub fn frame(&self, name: &str) -> Result<Frame> {
        if let Ok(body) = self.body(name) {
            return Ok(Frame::Body(body));
        }
        Ok(Frame::Site(self.find(mjOBJ_SITE, "body or site", name)?))
    }

    /// The number of the keyframe in which an episode starts: `name`, else `start` or `home`, else the only one, if any.
    ///
    /// # Errors
    /// Fails if there is no keyframe `name`.
    pub fn start(&self, name: &str) -> Result<Option<usize>> {
        if !name.is_empty() {
            return self.find(mjOBJ_KEY, "keyframe", name).map(Some);
        }
        let known = ["start", "home"]
            .into_iter()
            .find_map(|name| self.model.name_to_id(mjOBJ_KEY, name));
        Ok(known.or((self.model.nkey() == 1).then_some(0)))
    }

    /// The generalised positions of a keyframe, by its number, or the default ones.
    pub fn pose_of(&self, keyframe: Option<usize>) -> Vec<f64> {
        let size = self.model.nq() as usize;
        keyframe
            .map_or(self.model.qpos0(), |key| {
                &self.model.key_qpos()[key * size..][..size]
            })
            .to_vec()
    }

    /// The first body of the kinematic tree to which a frame belongs.
    pub fn root(&self, frame: Frame) -> Body {
        let body = match frame {
            Frame::Body(Body(body)) => body,
            Frame::Site(site) => self.model.site_bodyid()[site] as usize,
        };
        Body(self.root_of(body))
    }

    /// Finds the mocap body `name`.
    ///
    /// # Errors
    /// Fails if there is no such body or it is not a mocap body.
    pub fn mocap(&self, name: &str) -> Result<Mocap> {
        let Body(body) = self.body(name)?;
        let id = usize::try_from(self.model.body_mocapid()[body]).ok();
        Ok(Mocap(id.with_context(|| {
            format!("body `{}` must have mocap=\"true\"", shortened(name))
        })?))
    }

    /// Finds the actuator `name`, which must be a position servo with one limited control that moves a joint or a tendon.
    ///
    /// # Errors
    /// Fails if there is no such actuator, or if it is of another kind.
    pub fn servo(&self, name: &str) -> Result<Actuator> {
        let id = self.find(mjOBJ_ACTUATOR, "actuator", name)?;
        let model = &self.model;
        let group = model.actuator_group()[id];
        let is_disabled = (0..31).contains(&group) && model.opt().disableactuator >> group & 1 == 1;
        let is_direct =
            model.actuator_dyntype()[id] == mjDYN_NONE && model.actuator_delay()[id] == 0.0;
        let ctrl = model.actuator_ctrladr()[id] as usize;
        let is_limited = model.actuator_ctrlnum()[id] == 1 && model.actuator_ctrllimited()[ctrl];
        // The force is kp · (control - length), with or without damping.
        let kp = model.actuator_gainprm()[id][0];
        let is_servo = model.actuator_gaintype()[id] == mjGAIN_FIXED
            && model.actuator_biastype()[id] == mjBIAS_AFFINE
            && kp > 0.0
            && model.actuator_biasprm()[id][..2] == [0.0, -kp];
        for (holds, what) in [
            (
                is_servo,
                "be a position servo (<position>): its control is an angle, and its force is kp times what is left to it",
            ),
            (
                !is_disabled,
                &format!("not be disabled by its group {group}"),
            ),
            (
                matches!(model.actuator_trntype()[id], mjTRN_JOINT | mjTRN_TENDON),
                "drive a joint or a tendon",
            ),
            (
                model.actuator_gear()[id][0] == 1.0,
                "have a gear of 1: its control is an angle",
            ),
            (
                is_direct,
                "act at once: without activation dynamics (timeconst) and delay",
            ),
            (is_limited, "have one control with a ctrlrange"),
        ] {
            ensure!(holds, "actuator `{}` must {what}", shortened(name));
        }
        Ok(Actuator {
            id,
            ctrl,
            range: model.actuator_ctrlrange()[ctrl],
        })
    }

    fn find(&self, kind: MjtObjBase, what: &str, name: &str) -> Result<usize> {
        self.model
            .name_to_id(kind, name)
            .with_context(|| format!("has no {what} `{}`", shortened(name)))
    }
}
