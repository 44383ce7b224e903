//! How a scene is compiled: what MuJoCo cannot change in a compiled model, and the options.

#![expect(unsafe_code, reason = "the wrapper cuts off what MuJoCo says of a file")]

use std::ffi::{CStr, CString};
use std::fmt::Display;
use std::path::Path;
use std::ptr;

use anyhow::{Context, Error, Result, anyhow, bail, ensure};
use mujoco_rs::mujoco_c::{mj_deleteSpec, mj_parseXML};
use mujoco_rs::prelude::{MjModel, MjSpec, MjtCone, MjtGeomBase};
use mujoco_rs::wrappers::SpecItem;
use mujoco_rs::wrappers::mj_editing::{MjsBody, MjtGeomInertia};
use serde::{Deserialize, Serialize};

/// The group of geoms that are drawn and by convention collide with nothing.
pub(super) const VISUAL: i32 = 2;

/// The scene built into the program.
pub(super) const BUILTIN: &str = include_str!("../../assets/shadow_hand/scene.xml");

/// The shape of friction cones.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Cone {
    /// The cones that the scene sets.
    Scene,
    /// Four-sided pyramids inside the cones: faster.
    Pyramidal,
    /// The cones themselves.
    Elliptic,
}

/// How a scene is compiled.
#[derive(Clone, Debug, PartialEq)]
pub struct Compilation {
    /// The physics timestep, s.
    pub timestep: f64,
    /// The friction cones.
    pub cone: Cone,
    /// The name of the body that `size` and `shifts` are about.
    pub object: String,
    /// The factor on the lengths of the object: its shapes, and the places of what is attached to it. Its mass stays the same.
    pub size: f64,
    /// Whether the object's centre of mass may later be shifted. MuJoCo has a shortcut for bodies whose centre of mass is the
    /// origin of their frame. Without it, results differ in rounding.
    pub shifts: bool,
    /// The name of a mocap body that is added to show the goal: it looks like the object, and touches nothing.
    pub adds_goal: Option<&'static str>,
}

impl Compilation {
    /// Returns the compilation that keeps all of a scene but its timestep in s and its friction cones.
    pub fn plain(timestep: f64, cone: Cone) -> Self {
        Self { timestep, cone, object: String::new(), size: 1.0, shifts: false, adds_goal: None }
    }

    /// Returns whether it keeps all of a scene but its options.
    pub fn keeps_all(&self) -> bool {
        self.size == 1.0 && !self.shifts && self.adds_goal.is_none()
    }

    /// Compiles the built-in scene (`None`) or a user's file.
    ///
    /// # Errors
    /// Fails with MuJoCo's own message if MuJoCo refuses the scene, or if the object cannot be resized.
    pub(super) fn compile(&self, file: Option<&Path>) -> Result<MjModel> {
        let is_folder = file.is_some_and(Path::is_dir);
        ensure!(!is_folder, "env.model must name a MuJoCo scene, but this is a folder");
        let exists = file.is_none_or(Path::is_file);
        ensure!(exists, "env.model must name a MuJoCo scene, but there is no such file");
        if self.keeps_all() {
            let model = file.map_or_else(|| MjModel::from_xml_string(BUILTIN), MjModel::from_xml);
            if let Ok(model) = model {
                return Ok(model);
            }
            // The wrapper cuts off this message at 100 bytes. The way below gives it whole.
        }
        self.spec(file)?.compile().map_err(refused)
    }

    /// Reads a scene that is about to be compiled, and resizes its object.
    ///
    /// # Errors
    /// Fails if MuJoCo cannot read the scene, if it has no such body, or if the body has a mesh.
    pub(super) fn spec(&self, file: Option<&Path>) -> Result<MjSpec> {
        let spec = file.map_or_else(|| MjSpec::from_xml_string(BUILTIN), MjSpec::from_xml);
        let mut spec = spec.map_err(|error| match file.and_then(parse_error) {
            Some(whole) => refused(whole),
            None => refused(error),
        })?;
        if self.keeps_all() {
            return Ok(spec);
        }
        let name = &self.object;
        let body = spec.body_mut(name).with_context(|| format!("has no body `{name}`"))?;
        if self.shifts {
            body.set_simple(false);
        }
        if self.size != 1.0 {
            resize(body, self.size).map_err(|error| anyhow!("body `{name}` {error}"))?;
        }
        if let Some(goal) = self.adds_goal {
            add_goal(&mut spec, name, goal)?;
        }
        Ok(spec)
    }

    /// Sets the options of a compiled scene.
    pub(super) fn set_options(&self, model: &mut MjModel) {
        model.opt_mut().timestep = self.timestep;
        match self.cone {
            Cone::Scene => {}
            Cone::Pyramidal => model.opt_mut().cone = MjtCone::mjCONE_PYRAMIDAL as i32,
            Cone::Elliptic => model.opt_mut().cone = MjtCone::mjCONE_ELLIPTIC as i32,
        }
    }
}

/// Returns MuJoCo's whole message about a file that it cannot parse. The wrapper's message has at most 99 bytes.
fn parse_error(file: &Path) -> Option<String> {
    let name = CString::new(file.to_str()?).ok()?;
    let mut message = [0_u8; 4096];
    // SAFETY: the name ends with a zero, and MuJoCo writes no more than so many bytes. What it returns is deleted once.
    unsafe {
        let spec = mj_parseXML(name.as_ptr(), ptr::null(), message.as_mut_ptr().cast(), message.len() as i32);
        if !spec.is_null() {
            mj_deleteSpec(spec);
            return None;
        }
    }
    let message = CStr::from_bytes_until_nul(&message).ok()?;
    Some(message.to_string_lossy().trim().to_owned())
}

fn refused(error: impl Display) -> Error {
    // A name in the scene may have several lines.
    anyhow!("MuJoCo refuses this scene: {}", error.to_string().replace('\n', "\n  "))
}

/// Returns the name of a scene's file, for messages.
pub fn origin(file: Option<&Path>) -> String {
    file.map_or("the built-in scene".into(), |path| path.display().to_string())
}

/// Adds a mocap body in the shape of the body `name`, where that is, which touches nothing.
fn add_goal(spec: &mut MjSpec, name: &str, goal: &str) -> Result<()> {
    ensure!(spec.body_mut(goal).is_none(), "has a body `{goal}` that is no mocap body");
    let body = spec.body_mut(name).with_context(|| format!("has no body `{name}`"))?;
    let pos = *body.pos();
    let shapes: Vec<_> = body
        .geom_iter_mut(false)
        .map(|geom| (geom.type_(), *geom.size(), *geom.pos(), *geom.quat(), *geom.fromto(), geom.meshname().to_owned()))
        .collect();
    let shown = spec.world_body_mut().add_body();
    shown.with_name(goal).with_pos(pos).with_mocap(true);
    for (kind, size, pos, quat, fromto, mesh) in shapes {
        let geom = shown.add_geom();
        geom.with_type(kind).with_size(size).with_pos(pos).with_quat(quat).with_fromto(fromto).with_meshname(&mesh);
        geom.with_contype(0).with_conaffinity(0).with_group(VISUAL).with_mass(0.0).with_rgba([0.2, 0.8, 0.2, 0.4]);
    }
    Ok(())
}

/// Multiplies the lengths of a body and its descendants by `factor` and leaves their masses as they are.
fn resize(body: &mut MjsBody, factor: f64) -> Result<()> {
    let scale = |lengths: &mut [f64], by: f64| lengths.iter_mut().for_each(|x| *x *= by);
    // Values that a scene does not give are NaN and stay so.
    scale(body.ipos_mut(), factor);
    scale(body.inertia_mut(), factor * factor);
    scale(body.fullinertia_mut(), factor * factor);
    for geom in body.geom_iter_mut(false) {
        let kind = geom.type_();
        if matches!(kind, MjtGeomBase::mjGEOM_MESH | MjtGeomBase::mjGEOM_SDF | MjtGeomBase::mjGEOM_HFIELD) {
            bail!("has a mesh, whose size cannot be set here; scale the mesh in the scene");
        }
        scale(geom.pos_mut(), factor);
        scale(geom.size_mut(), factor);
        scale(geom.fromto_mut(), factor);
        let dimensions = if geom.typeinertia() == MjtGeomInertia::mjINERTIA_SHELL { 2 } else { 3 };
        geom.set_density(geom.density() / factor.powi(dimensions));
    }
    body.frame_iter_mut(false).for_each(|frame| scale(frame.pos_mut(), factor));
    body.site_iter_mut(false).for_each(|site| scale(site.pos_mut(), factor));
    body.joint_iter_mut(false).for_each(|joint| scale(joint.pos_mut(), factor));
    for child in body.body_iter_mut() {
        scale(child.pos_mut(), factor);
        resize(child, factor)?;
    }
    Ok(())
}
