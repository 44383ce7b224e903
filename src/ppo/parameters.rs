//! The location of each weight of a policy in the single array that holds all weights.
//!
//! Code that treats all weights alike (the optimizer, the norm of a gradient, the exchange) uses the array as a whole.
//! Code that needs one of them uses its range.

use std::ops::Range;

use crate::spaces::Spaces;

/// The parameters of a policy, in order: actor and critic, each layer by layer with weights before biases.
pub struct ParameterLayout {
    /// The layers of the actor.
    pub actor: Vec<Layer>,
    /// The layers of the critic.
    pub critic: Vec<Layer>,
}

/// One layer of a net.
pub struct Layer {
    /// The number of inputs.
    pub inputs: usize,
    /// The number of outputs.
    pub outputs: usize,
    /// `[outputs, inputs]`
    pub weight: Range<usize>,
    /// `[outputs]`
    pub bias: Range<usize>,
}

/// One parameter tensor as it is named in a file.
pub struct View {
    /// The name, e.g. `actor.0.weight`.
    pub name: String,
    /// The sizes of its dimensions.
    pub shape: Vec<usize>,
    /// The range of its values, stored by rows.
    pub range: Range<usize>,
}

impl ParameterLayout {
    /// Creates the layout of nets with these hidden layers, for observations and actions of the sizes in `spaces`.
    pub fn new(hidden: &[usize], spaces: &Spaces) -> Self {
        let mut at = 0;
        let mut take = |count: usize| {
            at += count;
            at - count..at
        };
        let mut net = |outputs: usize| -> Vec<Layer> {
            let mut inputs = spaces.observation_size;
            let layer = |&outputs: &usize| {
                let layer = Layer {
                    inputs,
                    outputs,
                    weight: take(outputs * inputs),
                    bias: take(outputs),
                };
                inputs = outputs;
                layer
            };
            hidden.iter().chain([&outputs]).map(layer).collect()
        };
        Self {
            actor: net(spaces.action_size),
            critic: net(1),
        }
    }

    /// The number of weights and biases.
    pub fn count(&self) -> usize {
        self.nets()[1].end
    }

    /// The ranges of actor and critic.
    pub fn nets(&self) -> [Range<usize>; 2] {
        [&self.actor, &self.critic].map(|net| net[0].weight.start..net[net.len() - 1].bias.end)
    }

    /// Each parameter tensor with its name, in order.
    pub fn views(&self) -> Vec<View> {
        let mut views = Vec::new();
        for (net, layers) in [("actor", &self.actor), ("critic", &self.critic)] {
            for (i, layer) in layers.iter().enumerate() {
                for (part, shape, range) in [
                    ("weight", vec![layer.outputs, layer.inputs], &layer.weight),
                    ("bias", vec![layer.outputs], &layer.bias),
                ] {
                    views.push(View {
                        name: format!("{net}.{i}.{part}"),
                        shape,
                        range: range.clone(),
                    });
                }
            }
        }
        views
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_views_cover_all_numbers_once_and_have_the_names_of_the_files() {
        let layout = ParameterLayout::new(
            &[5, 4],
            &Spaces {
                observation_size: 3,
                action_size: 2,
                object_and_goal: None,
                distance: |_, _| 0.0,
            },
        );
        let views = layout.views();
        let names: Vec<&str> = views.iter().map(|view| view.name.as_str()).collect();
        let layers = "0.weight 0.bias 1.weight 1.bias 2.weight 2.bias";
        let of = |net: &str| {
            layers
                .split(' ')
                .map(|layer| format!("{net}.{layer} "))
                .collect::<String>()
        };
        assert_eq!(names.join(" "), of("actor") + of("critic").trim_end());
        let mut end = 0;
        for View { name, shape, range } in &views {
            assert_eq!(
                (range.start, range.len()),
                (end, shape.iter().product()),
                "{name}"
            );
            end = range.end;
        }
        assert_eq!(end, layout.count());
        assert_eq!(views[4].shape, [2, 4], "the actor's last layer");
        let [actor, critic] = layout.nets();
        assert_eq!([actor.start, actor.end, critic.end], [0, critic.start, end]);
    }
}
