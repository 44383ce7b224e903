//! The graph of a policy: what `ppo::perception`, the normaliser and the actor compute, in operations of ONNX.

use super::onnx::Graph;
use crate::config::Activation;
use crate::ppo::{Perception, Policy};
use crate::spaces::{ObjectAndGoal, Spaces};

/// The graph from `obs` `[batch, O]` to `actions` `[batch, A]`, clipped to ± 1.
///
/// Before anything else, observations are multiplied from the right by a `mirror` `[O, O]`, if there is one.
pub fn policy_graph(policy: &Policy, mirror: Option<&[f32]>) -> Graph {
    let Spaces {
        observation_size: size,
        action_size,
        ..
    } = policy.spaces;
    let Perception {
        object_and_goal,
        rotations,
        mean,
        factor,
        clip: limit,
    } = policy.perception();
    let mut graph = Graph::new("policy", ("obs", size), ("actions", action_size));
    let seen = match mirror {
        Some(matrix) => {
            graph.floats("mirror", &[size, size], matrix);
            graph.node("MatMul", &["obs", "mirror"], "mirrored", &[])
        }
        None => "obs".into(),
    };
    let seen = match object_and_goal {
        Some(places) => canonicalize(&mut graph, size, &seen, (places, &rotations)),
        None => seen,
    };
    graph.floats("mean", &[size], &mean);
    graph.floats("factor", &[size], &factor);
    graph.node("Sub", &[&seen, "mean"], "centred", &[]);
    graph.node("Mul", &["centred", "factor"], "scaled", &[]);
    let normalised = clip(&mut graph, "scaled", limit, "normalised");
    let means = actor(&mut graph, policy, normalised);
    clip(&mut graph, &means, 1.0, "actions");
    graph
}

/// Computes the mean actions, before they are clipped.
fn actor(graph: &mut Graph, policy: &Policy, mut row: String) -> String {
    for (i, layer) in policy.layout.actor.iter().enumerate() {
        let weight = format!("actor.{i}.weight");
        let bias = format!("actor.{i}.bias");
        graph.floats(
            &weight,
            &[layer.outputs, layer.inputs],
            &policy.parameters[layer.weight.clone()],
        );
        graph.floats(
            &bias,
            &[layer.outputs],
            &policy.parameters[layer.bias.clone()],
        );
        row = graph.node(
            "Gemm",
            &[&row, &weight, &bias],
            &format!("layer{i}"),
            &[("transB", 1)],
        );
        if i + 1 < policy.layout.actor.len() {
            let operation = match policy.activation {
                // Its slope at zero, `alpha`, is 1 unless a node says otherwise.
                Activation::Elu => "Elu",
                Activation::Relu => "Relu",
                Activation::Tanh => "Tanh",
            };
            row = graph.node(operation, &[&row], &format!("hidden{i}"), &[]);
        }
    }
    row
}

fn clip(graph: &mut Graph, row: &str, limit: f32, output: &str) -> String {
    let [low, high] = ["low", "high"].map(|side| format!("{output}_{side}"));
    graph.floats(&low, &[], &[-limit]);
    graph.floats(&high, &[], &[limit]);
    graph.node("Clip", &[row, &low, &high], output, &[])
}

/// Turns cube and goal by the rotation, of those that the policy treats as the same, that brings the cube closest to its unrotated orientation.
fn canonicalize(
    graph: &mut Graph,
    size: usize,
    obs: &str,
    (ObjectAndGoal { object, goal, .. }, rotations): (ObjectAndGoal, &[[f32; 4]]),
) -> String {
    assert!(object + 4 <= goal, "the goal follows the cube");
    add_rotations(graph, rotations);
    for (name, sign) in [("zero", 0.0), ("plus", 1.0), ("minus", -1.0)] {
        graph.floats(name, &[1], &[sign]);
    }
    graph.index("axis", 1);
    for (name, ends) in [
        ("before", [0, object]),
        ("cube", [object, object + 4]),
        ("between", [object + 4, goal]),
        ("goal", [goal, goal + 4]),
        ("after", [goal + 4, size]),
    ] {
        slice(graph, obs, ends, name);
    }
    graph.node("MatMul", &["cube", "cosines"], "near", &[]);
    graph.node("Abs", &["near"], "nearness", &[]);
    // The first of equals, as in `ppo::perception`.
    graph.node(
        "ArgMax",
        &["nearness"],
        "nearest",
        &[("axis", 1), ("keepdims", 0)],
    );
    graph.node(
        "Gather",
        &["products", "nearest"],
        "product",
        &[("axis", 0)],
    );
    let [object, goal] = ["cube", "goal"].map(|quaternion| rotated(graph, quaternion));
    graph.node(
        "Concat",
        &["before", &object, "between", &goal, "after"],
        "seen",
        &[("axis", 1)],
    )
}

/// Adds what finds the nearest of these rotations, and what multiplies by it.
fn add_rotations(graph: &mut Graph, rotations: &[[f32; 4]]) {
    // [4, 24]: the cosine of half the angle between a cube's orientation and each rotation's inverse.
    let mut cosines = [0.0; 4 * 24];
    // [24, 4, 4]: a quaternion as a row times this matrix is its product with the rotation.
    let mut products = Vec::new();
    for (j, &[w, x, y, z]) in rotations.iter().enumerate() {
        for (k, value) in [w, -x, -y, -z].into_iter().enumerate() {
            cosines[k * 24 + j] = value;
        }
        products.extend([w, x, y, z, -x, w, -z, y, -y, z, w, -x, -z, -y, x, w]);
    }
    graph.floats("cosines", &[4, 24], &cosines);
    graph.floats("products", &[24, 4, 4], &products);
}

/// Multiplies a quaternion by the rotation `product`, and negates it if w is negative then.
fn rotated(graph: &mut Graph, quaternion: &str) -> String {
    let name = |what: &str| format!("{quaternion}_{what}");
    let row = graph.node("Unsqueeze", &[quaternion, "axis"], &name("row"), &[]);
    let rotated = graph.node("MatMul", &[&row, "product"], &name("turned_row"), &[]);
    let rotated = graph.node("Squeeze", &[&rotated, "axis"], &name("turned"), &[]);
    let w = slice(graph, &rotated, [0, 1], &name("w"));
    let negative = graph.node("Less", &[&w, "zero"], &name("negative"), &[]);
    let sign = graph.node("Where", &[&negative, "minus", "plus"], &name("sign"), &[]);
    graph.node("Mul", &[&rotated, &sign], &name("seen"), &[])
}

fn slice(graph: &mut Graph, row: &str, ends: [usize; 2], output: &str) -> String {
    let [from, to] = ["from", "to"].map(|end| format!("{output}_{end}"));
    graph.index(&from, ends[0]);
    graph.index(&to, ends[1]);
    graph.node("Slice", &[row, &from, &to, "axis"], output, &[])
}
