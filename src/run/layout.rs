//! The layout of TensorBoard's page CUSTOM SCALARS: what to look at first, then the rest.

use protobuf::Message;
use tensorboard_proto::layout::{Category, Chart, Layout};
use tensorboard_proto::summary::{Summary_Value, Summary_Value_oneof_value as Content};

use super::summary::{text, with_metadata};

/// The title of a chart, and a regular expression for its tags.
type Lines = (&'static str, &'static str);

/// The categories of charts in their order.
const CATEGORIES: [(&str, &[Lines]); 4] = [
    (
        "Look at these first",
        &[
            (
                "turned towards the goal, rad in 100 steps",
                "training/turned",
            ),
            ("goals per episode, evaluations of the task", "eval/goals"),
            ("share of drops", "(eval|episode)/drop_rate"),
        ],
    ),
    (
        "Training episodes, by the rules of the curriculum",
        &[
            ("goals per episode", "(episode|randomized)/goals"),
            ("rotation error, rad", "(episode|randomized)/rot_dist"),
            ("ramps", "training/(?!turned).*"),
        ],
    ),
    ("Reward", &[("each term", "reward/.*")]),
    (
        "Learning",
        &[
            ("explained variance", "value/explained_variance"),
            ("KL divergence", "policy/(first_)?kl"),
            ("standard deviation of actions", "policy/std"),
            ("learning rate", "optim/learning_rate"),
        ],
    ),
];

/// The value of an event that lays out the page.
pub fn layout() -> Summary_Value {
    let mut layout = Layout::default();
    for (title, charts) in CATEGORIES {
        let mut category = Category::default();
        category.set_title(title.into());
        for (title, tags) in charts {
            let mut chart = Chart::default();
            chart.set_title((*title).into());
            chart.mut_multiline().mut_tag().push((*tags).into());
            category.mut_chart().push(chart);
        }
        layout.mut_category().push(category);
    }
    let layout = layout.write_to_bytes().expect("no field is required");
    with_metadata(
        "custom_scalars__config__",
        Content::tensor(text(layout)),
        "custom_scalars",
        2,
    )
}
