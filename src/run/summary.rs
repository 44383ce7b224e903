//! The values of an event for TensorBoard: numbers, histograms, an animated picture, text.
//!
//! Numbers, histograms and pictures have the older form, which is smaller and which all readers convert. The first value of a
//! tag in a file also holds its plugin, data class and description; without a data class, TensorBoard shows no description.

use std::collections::{HashMap, HashSet};

use protobuf::Message;
use tensorboard_proto::summary::{HistogramProto, Summary, Summary_Image, Summary_Value};
use tensorboard_proto::types::DataType;

use super::Histogram;

/// A quantity that is logged.
pub struct Tag {
    /// Its name, which is the column in the table too if it is a number.
    pub name: String,
    /// What it is.
    pub description: String,
}

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

/// A plugin of TensorBoard: its name and the class of its data (`DataClass` in TensorBoard's summary.proto).
struct Plugin(&'static str, u64);

const SCALARS: Plugin = Plugin("scalars", 1);
const HISTOGRAMS: Plugin = Plugin("histograms", 2);
const IMAGES: Plugin = Plugin("images", 3);
const TEXT: Plugin = Plugin("text", 2);

/// The number of the field `data_class` of the metadata, which tensorboard-proto does not know.
const DATA_CLASS: u32 = 4;

/// Builds the values of the events of one file.
pub(super) struct Summaries {
    /// Descriptions by tag.
    descriptions: HashMap<String, String>,
    /// The tags of this file so far.
    known: HashSet<String>,
}

impl Summaries {
    /// Creates the summaries of a new file.
    pub(super) fn new(tags: &[Tag]) -> Self {
        let descriptions = tags.iter().map(|tag| (tag.name.clone(), tag.description.clone())).collect();
        Self { descriptions, known: HashSet::new() }
    }

    /// Returns the values of an iteration. `NaN` values are left out.
    pub(super) fn of_iteration(&mut self, values: &[(impl AsRef<str>, f64)], figures: &Media) -> Summary {
        let mut summary = Summary::new();
        for (tag, number) in values.iter().filter(|(_, number)| !number.is_nan()) {
            let mut value = self.value(tag.as_ref(), SCALARS);
            value.set_simple_value(*number as f32);
            summary.mut_value().push(value);
        }
        for (tag, histogram) in &figures.histograms {
            let mut value = self.value(tag, HISTOGRAMS);
            value.set_histo(histogram_proto(histogram));
            summary.mut_value().push(value);
        }
        if let Some((tag, film)) = &figures.film {
            let mut value = self.value(tag, IMAGES);
            let mut image = Summary_Image::new();
            image.set_width(film.size[0] as i32);
            image.set_height(film.size[1] as i32);
            image.set_colorspace(3);
            image.set_encoded_image_string(film.gif.clone());
            value.set_image(image);
            summary.mut_value().push(value);
        }
        summary
    }

    /// Returns a value that is a text in Markdown.
    pub(super) fn of_text(&mut self, tag: &str, text: &str) -> Summary {
        let (mut summary, mut value) = (Summary::new(), self.value(tag, TEXT));
        let tensor = value.mut_tensor();
        tensor.set_dtype(DataType::DT_STRING);
        // A shape without dimensions: a single string.
        tensor.mut_tensor_shape();
        tensor.mut_string_val().push(text.as_bytes().to_vec());
        summary.mut_value().push(value);
        summary
    }

    fn value(&mut self, tag: &str, Plugin(plugin, data_class): Plugin) -> Summary_Value {
        let mut value = Summary_Value::new();
        value.set_tag(tag.to_owned());
        if !self.known.contains(tag) {
            self.known.insert(tag.to_owned());
            let metadata = value.mut_metadata();
            metadata.mut_plugin_data().set_plugin_name(plugin.to_owned());
            metadata.mut_unknown_fields().add_varint(DATA_CLASS, data_class);
            metadata.set_summary_description(self.descriptions.get(tag).cloned().unwrap_or_default());
        }
        value
    }
}

fn histogram_proto(histogram: &Histogram) -> HistogramProto {
    let mut proto = HistogramProto::new();
    proto.set_min(histogram.min);
    proto.set_max(histogram.max);
    proto.set_num(histogram.counts.iter().sum());
    proto.set_sum(histogram.sum);
    proto.set_sum_squares(histogram.sum_squares);
    proto.set_bucket_limit(histogram.limits.clone());
    proto.set_bucket(histogram.counts.clone());
    proto
}
