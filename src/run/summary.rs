//! The values of an event for TensorBoard: numbers, histograms, an animated picture, text.
//!
//! Numbers, histograms and pictures have the older form, which is smaller and which all readers convert. The first value of a
//! tag in a file also holds its plugin, data class and description. Without a data class, TensorBoard shows no description.

use std::collections::HashMap;

use protobuf::Message;
use tensorboard_proto::summary::{Summary_Image, Summary_Value, Summary_Value_oneof_value as Content};
use tensorboard_proto::tensor::TensorProto;
use tensorboard_proto::types::DataType;

use super::Histogram;

/// The descriptions of the logged quantities, by their tags.
pub type Descriptions = HashMap<String, String>;

/// What some iterations have in the event file besides numbers, each with its tag.
#[derive(Debug, Default)]
pub struct Media {
    /// Histograms.
    pub histograms: Vec<(&'static str, Histogram)>,
    /// An animated picture.
    pub film: Option<(&'static str, Animation)>,
}

/// An animated picture.
#[derive(Debug)]
pub struct Animation {
    /// Width and height in pixels.
    pub size: [u32; 2],
    /// The bytes of a GIF file.
    pub gif: Vec<u8>,
}

/// The number of the field `data_class` of the metadata, which tensorboard-proto does not know.
const DATA_CLASS: u32 = 4;

/// Returns a value of a tag. The first one in a file has the tag's description.
pub(super) fn value(tag: &str, content: Content, description: Option<String>) -> Summary_Value {
    // The plugin that shows the value, and the class of its data (`DataClass` in TensorBoard's summary.proto).
    let (plugin, data_class) = match content {
        Content::simple_value(_) => ("scalars", 1),
        Content::histo(_) => ("histograms", 2),
        Content::image(_) => ("images", 3),
        _ => ("text", 2),
    };
    let Some(description) = description else {
        return Summary_Value { tag: tag.to_owned(), value: Some(content), ..Summary_Value::default() };
    };
    let mut value = with_metadata(tag, content, plugin, data_class);
    value.mut_metadata().set_summary_description(description);
    value
}

/// Returns a value of a tag that says which plugin shows it, and of which class its data are.
pub(super) fn with_metadata(tag: &str, content: Content, plugin: &str, data_class: u32) -> Summary_Value {
    let mut value = Summary_Value { tag: tag.to_owned(), value: Some(content), ..Summary_Value::default() };
    let metadata = value.mut_metadata();
    metadata.mut_plugin_data().set_plugin_name(plugin.to_owned());
    metadata.mut_unknown_fields().add_varint(DATA_CLASS, data_class.into());
    value
}

/// Returns a text in Markdown.
pub(super) fn markdown(text: &str) -> TensorProto {
    let mut tensor = TensorProto { dtype: DataType::DT_STRING, ..TensorProto::default() };
    // A shape without dimensions: a single string.
    tensor.mut_tensor_shape();
    tensor.mut_string_val().push(text.as_bytes().to_vec());
    tensor
}

/// Returns a picture in colour.
pub(super) fn image(film: &Animation) -> Summary_Image {
    let [width, height] = film.size.map(|pixels| pixels as i32);
    Summary_Image { width, height, colorspace: 3, encoded_image_string: film.gif.clone(), ..Summary_Image::default() }
}
