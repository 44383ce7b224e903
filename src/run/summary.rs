//! The values of an event for TensorBoard: numbers, histograms, text.
//!
//! Numbers and histograms have the older form, which is smaller and which all readers convert. The first value of a
//! tag in a file also holds its plugin, data class and description. Without a data class, TensorBoard shows no description.

use std::collections::HashMap;

use protobuf::Message;
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
