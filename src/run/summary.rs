//! The values of an event for TensorBoard: numbers, histograms, text, and the layout of a page.
//!
//! Numbers and histograms have the older form, which is smaller and which all readers convert. The first value of a
//! tag in a file also holds its plugin, data class and description. Without a data class, TensorBoard shows no description.

use std::collections::HashMap;

use protobuf::Message;
use tensorboard_proto::layout::{Category, Chart, Layout};
use tensorboard_proto::summary::{Summary_Value, Summary_Value_oneof_value as Content};
use tensorboard_proto::tensor::TensorProto;
use tensorboard_proto::types::DataType;

/// The descriptions of the logged quantities, by their tags.
pub type Descriptions = HashMap<String, String>;

/// The number of the field `data_class` of the metadata, which tensorboard-proto does not know.
const DATA_CLASS: u32 = 4;

/// A value of a tag. The first one in a file has the tag's description.
pub fn value(tag: &str, content: Content, description: Option<String>) -> Summary_Value {
    // The plugin that shows the value, and the class of its data (`DataClass` in TensorBoard's summary.proto).
    let (plugin, data_class) = match content {
        Content::simple_value(_) => ("scalars", 1),
        Content::histo(_) => ("histograms", 2),
        _ => ("text", 2),
    };
    let mut value = with_metadata(tag, content, plugin, data_class);
    match description {
        Some(description) => value.mut_metadata().set_summary_description(description),
        None => value.clear_metadata(),
    }
    value
}

/// A value of a tag that says which plugin shows it, and of which class its data are.
pub fn with_metadata(tag: &str, content: Content, plugin: &str, data_class: u32) -> Summary_Value {
    let mut value = Summary_Value {
        tag: tag.to_owned(),
        value: Some(content),
        ..Summary_Value::default()
    };
    let metadata = value.mut_metadata();
    metadata
        .mut_plugin_data()
        .set_plugin_name(plugin.to_owned());
    metadata
        .mut_unknown_fields()
        .add_varint(DATA_CLASS, data_class.into());
    value
}

/// A text: Markdown, or the bytes of a message.
pub fn text(text: impl Into<Vec<u8>>) -> TensorProto {
    let mut tensor = TensorProto {
        dtype: DataType::DT_STRING,
        ..TensorProto::default()
    };
    // A shape without dimensions: a single string.
    tensor.mut_tensor_shape();
    tensor.mut_string_val().push(text.into());
    tensor
}

// The layout of TensorBoard's page CUSTOM SCALARS: what to look at first, then the rest.

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
