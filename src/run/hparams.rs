//! A run as a row of TensorBoard's HPARAMS: its settings, and a few figures as metrics. TensorBoard shows first the settings
//! in which runs differ. It draws only runs that have a value for each of them, so all settings are in each row.
//!
//! The row has a folder of its own, `hparams` in the folder of the run, because TensorBoard takes all scalars beside it for its
//! metrics. No experiment is written, which would name the columns of all rows: no run knows the others, and TensorBoard finds them
//! by itself.

use std::fs;
use std::path::Path;

use anyhow::Result;
use protobuf::Message;
use protobuf::well_known_types::Value as Parameter;
use tensorboard_proto::api::Status;
use tensorboard_proto::plugin_hparams::{
    HParamsPluginData, HParamsPluginData_oneof_data as Data, SessionEndInfo, SessionStartInfo,
};
use tensorboard_proto::summary::{Summary_Value, Summary_Value_oneof_value as Content};
use tensorboard_proto::tensor::TensorProto;
use tensorboard_proto::types::DataType;
use toml::{Table, Value};

use super::checkpoints::expect_no_link;
use super::events::{EventFile, event_files, now};
use super::summary::{Descriptions, with_metadata};
use crate::os::Cannot;

/// The name of the folder.
pub const HPARAMS: &str = "hparams";

/// Begins the row of the run in `folder` anew, at this step, with these settings by dotted key.
///
/// # Errors
/// Fails if its file cannot be written.
pub fn begin(folder: &Path, step: u64, settings: &Table) -> Result<EventFile> {
    let folder = folder.join(HPARAMS);
    expect_no_link(&folder)?;
    if !folder.exists() {
        fs::create_dir(&folder).cannot("create", &folder)?;
    }
    // TensorBoard keeps the first row of a folder that it reads.
    for (_, old) in event_files(&folder)? {
        fs::remove_file(&old).cannot("remove", &old)?;
    }
    let events = EventFile::create(&folder, step, &Descriptions::new(), "")?;
    let start = session_value(
        "session_start_info",
        Data::session_start_info(start_info(settings)),
    )?;
    events.values(vec![start], step)?;
    Ok(events)
}

/// The end of the row: whether the training run has made all its steps, or failed.
pub fn end(succeeded: bool) -> Result<Vec<Summary_Value>> {
    let info = SessionEndInfo {
        status: if succeeded {
            Status::STATUS_SUCCESS
        } else {
            Status::STATUS_FAILURE
        },
        end_time_secs: now(),
        ..SessionEndInfo::default()
    };
    Ok(vec![session_value(
        "session_end_info",
        Data::session_end_info(info),
    )?])
}

fn start_info(settings: &Table) -> SessionStartInfo {
    SessionStartInfo {
        hparams: settings
            .iter()
            .map(|(key, value)| (key.clone(), parameter(value)))
            .collect(),
        start_time_secs: now(),
        ..SessionStartInfo::default()
    }
}

fn parameter(value: &Value) -> Parameter {
    let mut parameter = Parameter::new();
    match value {
        Value::Integer(x) => parameter.set_number_value(*x as f64),
        Value::Float(x) => parameter.set_number_value(*x),
        Value::Boolean(x) => parameter.set_bool_value(*x),
        Value::String(text) => parameter.set_string_value(text.clone()),
        other => parameter.set_string_value(other.to_string()),
    }
    parameter
}

/// The value that holds a message of the plugin.
fn session_value(name: &str, data: Data) -> Result<Summary_Value> {
    let plugin = HParamsPluginData {
        data: Some(data),
        ..HParamsPluginData::default()
    };
    // The value itself is empty: a list of no numbers.
    let mut nothing = TensorProto {
        dtype: DataType::DT_FLOAT,
        ..TensorProto::default()
    };
    nothing.mut_tensor_shape().mut_dim().push_default();
    let mut value = with_metadata(
        &format!("_hparams_/{name}"),
        Content::tensor(nothing),
        HPARAMS,
        // A tensor (`DataClass` in TensorBoard's summary.proto).
        2,
    );
    value
        .mut_metadata()
        .mut_plugin_data()
        .set_content(plugin.write_to_bytes()?);
    Ok(value)
}

#[cfg(test)]
mod tests {
    use protobuf::CodedInputStream;
    use protobuf::wire_format::WireType;

    use super::*;

    /// The fields of a message: their numbers, and their bytes, or the bytes of a double.
    fn fields(bytes: &[u8]) -> Vec<(u32, Vec<u8>)> {
        let (mut stream, mut found) = (CodedInputStream::from_bytes(bytes), Vec::new());
        while !stream.eof().unwrap() {
            let (field, kind) = stream.read_tag_unpack().unwrap();
            found.push(match kind {
                WireType::WireTypeFixed64 => {
                    (field, stream.read_double().unwrap().to_le_bytes().to_vec())
                }
                WireType::WireTypeVarint => (field, vec![stream.read_uint64().unwrap() as u8]),
                _ => (field, stream.read_bytes().unwrap()),
            });
        }
        found
    }

    fn content(value: &Summary_Value) -> (u32, Vec<u8>) {
        assert_eq!(
            value.get_metadata().get_plugin_data().get_plugin_name(),
            "hparams"
        );
        let mut fields = fields(value.get_metadata().get_plugin_data().get_content());
        assert_eq!(fields.len(), 1);
        fields.remove(0)
    }

    #[test]
    fn the_start_of_a_row_holds_each_setting_as_a_number_a_truth_or_a_text() {
        let settings: Table = toml::from_str(
            "a = 3\nb = 0.5\nc = true\nd = 'tanh'\ne = [1, 2]\nf = {from = 1, to = 2, steps = 3}",
        )
        .unwrap();
        let start = Data::session_start_info(start_info(&settings));
        let value = session_value("session_start_info", start).unwrap();
        let (field, info) = content(&value);
        assert_eq!(
            (value.get_tag(), field),
            ("_hparams_/session_start_info", 3)
        );
        let entries = fields(&info).into_iter().filter(|(field, _)| *field == 1);
        let mut entries: Vec<_> = entries
            .map(|(_, entry)| {
                let [(1, key), (2, value)] = &fields(&entry)[..] else {
                    panic!("{entry:?}")
                };
                let (kind, value) = fields(value).remove(0);
                let shown = match kind {
                    2 => f64::from_le_bytes(value.try_into().unwrap()).to_string(),
                    3 => String::from_utf8(value).unwrap(),
                    4 => format!("{}", value[0] != 0),
                    other => panic!("kind {other}"),
                };
                format!("{} {shown}", String::from_utf8(key.clone()).unwrap())
            })
            .collect();
        entries.sort();
        let expected = "a 3; b 0.5; c true; d tanh; e [1, 2]; f { from = 1, to = 2, steps = 3 }";
        assert_eq!(entries.join("; "), expected);
    }

    #[test]
    fn the_end_of_a_row_says_whether_the_run_has_made_its_steps() {
        for (succeeded, status) in [(true, 1), (false, 2)] {
            let values = end(succeeded).unwrap();
            let (field, info) = content(&values[0]);
            assert_eq!(
                (values[0].get_tag(), field),
                ("_hparams_/session_end_info", 4)
            );
            assert_eq!(fields(&info)[0], (1, vec![status]));
        }
    }
}
