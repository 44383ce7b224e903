//! The check for infinite or NaN values in a scene: MuJoCo accepts them, and the physics then diverges immediately.

use anyhow::{Context, Result, anyhow};
use mujoco_rs::prelude::MjModel;
use tempfile::NamedTempFile;

use super::constants::*;
use crate::os::{self, shortened};

/// A description of the first such value: the quantity, by MuJoCo's name, and the object it belongs to. MuJoCo itself
/// prints every array of a model, so that none is forgotten here.
///
/// # Errors
/// Fails if there is no room for a temporary file.
pub fn not_finite(model: &MjModel) -> Result<Option<String>> {
    let printed = || {
        let file = NamedTempFile::new()?;
        model
            .print(file.path())
            .map_err(|error| anyhow!("{error}"))?;
        os::read_bytes(file.path())
    };
    let text: Result<Vec<u8>> = printed();
    let text = text.context(
        "cannot check that the numbers of the scene are finite; set TMPDIR=PATH to a folder for a temporary file",
    )?;
    let found = first_in(&String::from_utf8_lossy(&text));
    let found = found.map(|(quantity, object)| {
        // A degree of freedom has no name, but it belongs to a joint that may have one.
        let of_joint = object
            .strip_prefix("DOF ")
            .and_then(|dof| model.dof_jntid().get(dof.parse::<usize>().ok()?));
        let joint = of_joint.and_then(|&joint| model.id_to_name(mjOBJ_JOINT, joint as usize));
        let object = joint.map_or(object, |name| format!("joint `{}`", shortened(name)));
        if object.is_empty() {
            quantity
        } else {
            format!("{quantity} of {object}")
        }
    });
    Ok(found.or_else(|| first_in_assets(model)))
}

/// The same for the arrays that MuJoCo does not print.
fn first_in_assets(model: &MjModel) -> Option<String> {
    let height = model.hfield_data().iter().position(|x| !x.is_finite());
    let height = height.map(|at| {
        (
            "hfield_data of hfield",
            mjOBJ_HFIELD,
            model.hfield_adr(),
            at,
        )
    });
    let vertex = model
        .mesh_vert()
        .iter()
        .position(|vertex| !vertex.iter().all(|x| x.is_finite()));
    let vertex = vertex.map(|at| ("mesh_vert of mesh", mjOBJ_MESH, model.mesh_vertadr(), at));
    let (what, kind, starts, at) = height.or(vertex)?;
    let id = starts.iter().rposition(|&start| start as usize <= at);
    let name = model
        .id_to_name(kind, id.unwrap_or_default())
        .unwrap_or_default();
    Some(format!("{what} `{}`", shortened(name)))
}

/// Quantities that MuJoCo computes when it compiles a model, in addition to the names that end with 0.
const DERIVED: [&str; 5] = [
    "body_subtreemass",
    "dof_length",
    "geom_aabb",
    "geom_rbound",
    "bvh_aabb",
];

/// The first quantity with a value that is not finite in the text of a model, and the object under whose heading it stands.
fn first_in(text: &str) -> Option<(String, String)> {
    let mut heading = "";
    let mut name = None;
    let mut derived = None;
    for line in text.lines() {
        let mut words = line.split_whitespace();
        let first = words.next().unwrap_or_default();
        let indented = line.starts_with(' ');
        let mut odd = || words.any(|word| ["nan", "inf"].contains(&word.trim_start_matches('-')));
        if !indented && (line.ends_with(':') || line == first) {
            heading = line.trim_end_matches(':');
            name = None;
        } else if let Some(named) = line.strip_prefix("  name ") {
            name = Some(named.trim());
        } else if heading != "STATISTIC" && odd() {
            let kind = heading.split(' ').next().unwrap_or_default().to_lowercase();
            let object = name.map_or(heading.to_owned(), |name| {
                format!("{kind} `{}`", shortened(name))
            });
            if indented && !first.ends_with('0') && !DERIVED.contains(&first) {
                return Some((first.to_owned(), object));
            }
            // A value that MuJoCo has computed follows from another one. So may a value of the whole model.
            let object = if indented { object } else { String::new() };
            derived = derived.or(Some((first.to_owned(), object)));
        }
    }
    derived
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_value_that_is_not_finite_is_found_with_its_heading_and_name() {
        let text = "MuJoCo version 3\n\nOPTION\n  gravity  0 0 -9.8\n\nqpos0  0 1\n\nBODY 0:\n  name  nan\n  body_pos  0 0 0\n";
        assert_eq!(first_in(text), None);
        let found = |more: &str| {
            first_in(&format!("{text}{more}"))
                .map(|(quantity, object)| format!("{quantity}|{object}"))
        };
        assert_eq!(
            found("  body_mass  nan\n").as_deref(),
            Some("body_mass|body `nan`")
        );
        assert_eq!(
            found("DOF 3:\n  dof_damping  1 -inf\n").as_deref(),
            Some("dof_damping|DOF 3")
        );
        assert_eq!(
            found("qpos_spring  0 -nan 1\n").as_deref(),
            Some("qpos_spring|")
        );
    }
}
