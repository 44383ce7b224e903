//! How a scene is compiled: what MuJoCo cannot change in a compiled model, and the options.

#![expect(
    unsafe_code,
    reason = "the wrapper cuts off what MuJoCo says of a file"
)]

use std::ffi::{CStr, CString};
use std::fmt::Display;
use std::iter;
use std::path::Path;
use std::ptr;
use std::sync::Arc;
use std::thread;

use anyhow::{Context, Error, Result, anyhow, bail, ensure};
use mujoco_rs::mujoco_c::{mj_deleteSpec, mj_parseXML};
use mujoco_rs::prelude::{MjModel, MjSpec};
use mujoco_rs::wrappers::mj_editing::{MjsBody, MjsGeom};
use mujoco_rs::wrappers::{SpecElement, SpecItem};
use serde::{Deserialize, Serialize};

use super::constants::*;
use super::fatal::quieten_mujoco;
use super::files::{SceneFiles, scene_files};
use super::fingerprint::fingerprint;
use super::placing::{colour_of, frames_within, geoms_within};
use crate::quat;

/// The group of geoms that are drawn and by convention collide with nothing.
pub const VISUAL: i32 = 2;

/// The scene built into the program.
pub const BUILTIN: &str = include_str!("../../assets/shadow_hand/scene.xml");

/// The shape of friction cones.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
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
#[derive(Clone)]
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
    /// Whether parts without a name get one.
    pub names_parts: bool,
    /// Whether it leaves out what is only seen, such as meshes that touch nothing, and textures.
    pub physics_only: bool,
    /// The scene in memory. What is not there is read from its file.
    pub files: Arc<SceneFiles>,
}

/// The most bytes of a name in a scene. Messages quote names.
const LONGEST_NAME: usize = 255;

impl Compilation {
    /// The compilation that keeps all of a scene but its timestep in s and its friction cones.
    pub fn plain(timestep: f64, cone: Cone) -> Self {
        Self {
            timestep,
            cone,
            object: String::new(),
            size: 1.0,
            shifts: false,
            adds_goal: None,
            names_parts: false,
            physics_only: false,
            files: Arc::default(),
        }
    }

    /// The same compilation of a user's scene in memory: of `known` files if they are those of this scene, and otherwise of its files
    /// as they are now. If MuJoCo makes something else of the files in memory, where it finds them by the last parts of their names as
    /// well, the scene stays on the disk.
    ///
    /// # Errors
    /// Fails as [`scene_files`] does.
    pub fn in_memory(self, file: Option<&Path>, known: &Arc<SceneFiles>) -> Result<Self> {
        let Some(scene) = file else { return Ok(self) };
        let of = |files| Self {
            files,
            ..self.clone()
        };
        if known.hold(scene) {
            return Ok(of(known.clone()));
        }
        let in_memory = of(Arc::new(SceneFiles::read(scene)?));
        let [there, here] = [&self, &in_memory].map(|own| bytes(&own.compile(file).ok()?));
        let is_same = there.is_some() && there == here;
        Ok(if is_same { in_memory } else { self })
    }

    /// Compiles the built-in scene (`None`) or a user's file.
    ///
    /// # Errors
    /// Fails with MuJoCo's own message if MuJoCo refuses the scene, or if the object cannot be resized. Fails if a name is not UTF-8,
    /// or if the scene names a pipe or a device.
    pub(super) fn compile(&self, file: Option<&Path>) -> Result<MjModel> {
        quieten_mujoco();
        ensure!(
            !file.is_some_and(Path::is_dir),
            "env.model must name a MuJoCo scene, but this is a folder"
        );
        if let Some(file) = file.filter(|file| !self.files.hold(file)) {
            ensure!(
                file.is_file(),
                "env.model must name a MuJoCo scene, but there is no such file"
            );
            scene_files(file)?;
        }
        let whole = self.finish(self.spec(file)?)?;
        if !self.physics_only {
            return Ok(whole);
        }
        let mut spec = self.spec(file)?;
        spec.discard_visual_with_vfs(&self.files.for_mujoco())
            .map_err(refused)?;
        let light = self.finish(spec)?;
        // They differ where something refers to shapes by their numbers, such as a tendon that winds around one.
        Ok(if fingerprint(&light) == fingerprint(&whole) {
            light
        } else {
            whole
        })
    }

    /// Compiles a scene that was read.
    ///
    /// # Errors
    /// Fails with MuJoCo's own message if MuJoCo refuses the scene, or if a name is not UTF-8 or very long.
    pub(super) fn finish(&self, mut spec: MjSpec) -> Result<MjModel> {
        // MuJoCo compiles on threads, and ends the process if the system refuses one.
        thread::Builder::new()
            .spawn(|| ())
            .context("the system refuses a thread")?;
        let model = spec
            .compile_with_vfs(&self.files.for_mujoco())
            .map_err(refused)?;
        // The wrapper returns names as text, whatever their bytes are.
        let names: Vec<u8> = model.names().iter().map(|&byte| byte as u8).collect();
        let mut names = names.split(|&byte| byte == 0);
        ensure!(
            names.all(|name| name.len() <= LONGEST_NAME && str::from_utf8(name).is_ok()),
            "a name in it is not UTF-8, or has more than {LONGEST_NAME} bytes"
        );
        Ok(model)
    }

    /// Reads a scene that is about to be compiled, and resizes its object.
    ///
    /// # Errors
    /// Fails if MuJoCo cannot read the scene, if it has no such body, or if the body has a mesh.
    pub(super) fn spec(&self, file: Option<&Path>) -> Result<MjSpec> {
        let spec = match file {
            None => MjSpec::from_xml_string(BUILTIN),
            Some(file) => MjSpec::from_xml_vfs(file, &self.files.for_mujoco()),
        };
        let mut spec = spec.map_err(|error| {
            let whole = file.and_then(parse_error);
            refused(whole.unwrap_or_else(|| error.to_string()))
        })?;
        if self.names_parts {
            name_parts(&mut spec);
        }
        if self.size == 1.0 && !self.shifts && self.adds_goal.is_none() {
            return Ok(spec);
        }
        let name = &self.object;
        let body = spec
            .body_mut(name)
            .with_context(|| format!("has no body `{name}`"))?;
        if self.shifts {
            body.set_simple(false);
        }
        if self.size != 1.0 {
            resize(body, self.size).map_err(|error| anyhow!("body `{name}` {error}"))?;
        }
        if let Some(goal) = self.adds_goal {
            let without_goal = Self {
                adds_goal: None,
                physics_only: false,
                ..self.clone()
            };
            add_goal(&mut spec, &without_goal.compile(file)?, name, goal)?;
        }
        Ok(spec)
    }
}

/// Names the actuators, bodies and joints that have no name: by what they drive, what moves them, or what they move.
fn name_parts(spec: &mut MjSpec) {
    for actuator in spec.actuator_iter_mut() {
        let target = actuator.target().to_owned();
        give(actuator, "servo of", &target);
    }
    name_within(spec.world_body_mut(), "the world");
}

fn name_within(body: &mut MjsBody, carrier: &str) {
    let mut movers = body.joint_iter(false).map(SpecElement::name);
    let mover = movers
        .find(|name| !name.is_empty())
        .unwrap_or(carrier)
        .to_owned();
    give(body, "link of", &mover);
    let name = body.name().to_owned();
    for joint in body.joint_iter_mut(false) {
        if joint.type_() != mjJNT_FREE {
            give(joint, "joint of", &name);
        }
    }
    for child in body.body_iter_mut() {
        name_within(child, &name);
    }
}

/// Names an item that has no name, unless the name would be very long. If another one has the name already, it gets a number.
fn give(item: &mut impl SpecItem, what: &str, of: &str) {
    if item.name().is_empty() && of.len() < LONGEST_NAME / 2 {
        let names = (2..99).map(|number| format!(" {number}"));
        let mut names = iter::once(String::new()).chain(names);
        names.find(|number| item.set_name(&format!("{what} {of}{number}")).is_ok());
    }
}

/// A compiled scene as a file.
fn bytes(model: &MjModel) -> Option<Vec<u8>> {
    let mut bytes = vec![0; model.size()];
    model.save_to_buffer(&mut bytes).ok()?;
    Some(bytes)
}

/// MuJoCo's whole message about a file that it cannot parse. The wrapper's message has at most 99 bytes.
fn parse_error(file: &Path) -> Option<String> {
    let name = CString::new(file.to_str()?).ok()?;
    let mut message = [0_u8; 4096];
    // SAFETY: the name ends with a zero, and MuJoCo writes no more than so many bytes. What it returns is deleted once.
    unsafe {
        let spec = mj_parseXML(
            name.as_ptr(),
            ptr::null(),
            message.as_mut_ptr().cast(),
            message.len() as i32,
        );
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
    anyhow!(
        "MuJoCo refuses this scene: {}",
        error.to_string().replace('\n', "\n  ")
    )
}

/// The name of a scene's file, for messages.
pub fn origin(file: Option<&Path>) -> String {
    file.map_or("the built-in scene".into(), |path| {
        path.display().to_string()
    })
}

/// Adds a mocap body that touches nothing, in the shape and at the place of the body `name` of the compiled scene. Only there do
/// all shapes have a position and an orientation: a file can give them in many ways.
fn add_goal(spec: &mut MjSpec, compiled: &MjModel, name: &str, goal: &str) -> Result<()> {
    ensure!(
        spec.body_mut(goal).is_none(),
        "has a body `{goal}` that is no mocap body"
    );
    let object = compiled
        .name_to_id(mjOBJ_BODY, name)
        .context("a body of the compiled scene")?;
    let shown = spec
        .world_body_mut()
        .add_body()
        .with_name(goal)
        .with_pos(compiled.body_pos()[object])
        .with_mocap(true);
    for (geom, (mut pos, mut quat)) in geoms_within(compiled, &frames_within(compiled, object)) {
        let kind = compiled.geom_type()[geom];
        let mut mesh_name = "";
        if matches!(kind, mjGEOM_MESH | mjGEOM_SDF) {
            // MuJoCo has moved the vertices of the mesh to its centre, and its geoms with them. It will do so with this one.
            let mesh = compiled.geom_dataid()[geom] as usize;
            mesh_name = compiled.id_to_name(mjOBJ_MESH, mesh).unwrap_or_default();
            quat = quat::mul(quat, quat::conj(compiled.mesh_quat()[mesh]));
            let moved = quat::rotate(quat, compiled.mesh_pos()[mesh]);
            pos = [0, 1, 2].map(|axis| pos[axis] - moved[axis]);
        }
        let material = usize::try_from(compiled.geom_matid()[geom]).ok();
        let material = material.and_then(|id| compiled.id_to_name(mjOBJ_MATERIAL, id));
        let mut colour = colour_of(compiled, geom);
        // It can be seen through.
        colour[3] = 0.5;
        only_seen(shown)
            .with_type(kind)
            .with_material(material.unwrap_or_default())
            .with_size(compiled.geom_size()[geom])
            .with_pos(pos)
            .with_quat(quat)
            .with_meshname(mesh_name)
            .with_group(compiled.geom_group()[geom])
            .with_rgba(colour);
    }
    Ok(())
}

/// Adds a geom that touches nothing and has no mass.
pub fn only_seen(body: &mut MjsBody) -> &mut MjsGeom {
    body.add_geom()
        .with_contype(0)
        .with_conaffinity(0)
        .with_mass(0.0)
        .with_density(0.0)
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
        if matches!(kind, mjGEOM_MESH | mjGEOM_SDF | mjGEOM_HFIELD) {
            bail!("has a mesh, whose size cannot be set here; scale the mesh in the scene");
        }
        scale(geom.pos_mut(), factor);
        scale(geom.size_mut(), factor);
        scale(geom.fromto_mut(), factor);
        let dimensions = if geom.typeinertia() == mjINERTIA_SHELL {
            2
        } else {
            3
        };
        geom.set_density(geom.density() / factor.powi(dimensions));
    }
    body.frame_iter_mut(false)
        .for_each(|frame| scale(frame.pos_mut(), factor));
    body.site_iter_mut(false)
        .for_each(|site| scale(site.pos_mut(), factor));
    body.joint_iter_mut(false)
        .for_each(|joint| scale(joint.pos_mut(), factor));
    for child in body.body_iter_mut() {
        scale(child.pos_mut(), factor);
        resize(child, factor)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    #[test]
    fn what_is_only_seen_is_left_out_unless_the_motion_would_be_another() {
        let part = "<mesh name='part' vertex='0 0 0 .05 0 0 0 .03 0 0 0 .02 .05 .03 .01'/>";
        let unseen = "contype='0' conaffinity='0'";
        let seen = format!("<geom name='seen' type='mesh' mesh='part' mass='.2' {unseen}/>");
        let wrap = "<tendon><spatial><site site='a'/><geom geom='drum'/><site site='b'/></spatial></tendon>";
        for (tendon, geoms) in [("", 1), (wrap, 3)] {
            let text = format!(
                "<mujoco><asset>{part}</asset><worldbody><site name='a' pos='.1 0 0'/><body name='cube'><freejoint/>{seen}
                 <geom name='drum' type='cylinder' size='.01 .01' {unseen}/><geom type='box' size='.02 .03 .04'/>
                 <site name='b' pos='-.1 0 0'/></body></worldbody>{tendon}</mujoco>"
            );
            let mut file = tempfile::NamedTempFile::with_suffix(".xml").unwrap();
            file.write_all(text.as_bytes()).unwrap();
            let [whole, light] = [false, true].map(|physics_only| {
                let plain = Compilation::plain(0.01, Cone::Scene);
                let own = Compilation {
                    physics_only,
                    ..plain
                };
                own.compile(Some(file.path())).unwrap()
            });
            assert_eq!(whole.ngeom(), 3);
            assert_eq!(light.ngeom(), geoms, "{tendon}");
            assert!(
                whole.body_mass() == light.body_mass()
                    && whole.body_inertia() == light.body_inertia()
            );
        }
    }

    #[test]
    fn a_goal_that_is_added_has_the_shapes_of_the_object_in_their_places() {
        let box_in = |more: &str| format!("<geom type='box' size='.02 .03 .04' {more}/>");
        for (size, shapes) in [
            (1.0, box_in("pos='.01 0 0' quat='.6 .8 0 0'")),
            (1.0, box_in("axisangle='0 0 1 30'")),
            (1.2, box_in("pos='.01 0 0' xyaxes='0 1 0 1 0 0'")),
            (
                1.2,
                "<geom type='capsule' size='.02 .04' euler='90 0 0'/>".into(),
            ),
            (
                1.2,
                "<geom type='capsule' size='.02' fromto='0 0 0 .02 .03 .01'/>".into(),
            ),
            (
                1.2,
                format!(
                    "<frame pos='.05 0 0' euler='0 90 0'>{}</frame>",
                    box_in("euler='10 20 30'")
                ),
            ),
            (
                1.2,
                format!(
                    "{}<body pos='0 .03 0' euler='0 0 40'>{}</body>",
                    box_in(""),
                    box_in("pos='.01 0 0'")
                ),
            ),
            (
                1.0,
                "<geom type='mesh' mesh='part' pos='.01 .02 0' axisangle='0 0 1 90'/>".into(),
            ),
            (1.0, "<geom type='box' mesh='part' euler='0 0 45'/>".into()),
        ] {
            let text = format!(
                "<mujoco><asset><mesh name='part' vertex='0 0 0 .05 0 0 0 .03 0 0 0 .02 .05 .03 .01'/></asset>
                 <worldbody><geom type='plane' size='1 1 1'/>
                 <body name='cube' pos='.3 .1 .2'><freejoint/>{shapes}</body></worldbody></mujoco>"
            );
            let mut file = tempfile::NamedTempFile::with_suffix(".xml").unwrap();
            file.write_all(text.as_bytes()).unwrap();
            let plain = Compilation::plain(0.01, Cone::Scene);
            let compilation = Compilation {
                object: "cube".into(),
                size,
                adds_goal: Some("goal"),
                ..plain
            };
            let model = compilation.compile(Some(file.path())).unwrap();
            let shapes_of = |name: &str| -> Vec<_> {
                let body = model.name_to_id(mjOBJ_BODY, name).unwrap();
                let frames = frames_within(&model, body);
                let placed =
                    geoms_within(&model, &frames)
                        .into_iter()
                        .map(|(geom, (pos, quat))| {
                            let turn = quat::rotation_vector(quat::canonical(quat));
                            let kind = (model.geom_type()[geom], model.geom_dataid()[geom]);
                            (kind, [model.geom_size()[geom], pos, turn].concat())
                        });
                placed.collect()
            };
            let (object, goal) = (shapes_of("cube"), shapes_of("goal"));
            assert!(!object.is_empty() && object.len() == goal.len(), "{shapes}");
            for ((kind, place), (same_kind, same_place)) in object.iter().zip(&goal) {
                let near = place
                    .iter()
                    .zip(same_place)
                    .all(|(a, b)| (a - b).abs() < 1e-9);
                assert!(
                    near && kind.0 == same_kind.0,
                    "{shapes}: {place:?} {same_place:?}"
                );
            }
        }
    }
}
