//! The part of the ONNX format that a policy needs. The field numbers come from
//! <https://github.com/onnx/onnx/blob/main/onnx/onnx.proto>. Runtimes read opset 13 and IR 8 since 2021.

use protobuf::{CodedOutputStream, ProtobufResult};

const IR_VERSION: i64 = 8;
const OPSET: i64 = 13;

/// The number of a type of elements, `TensorProto.DataType`.
const FLOAT: i64 = 1;
const INT64: i64 = 7;

/// The number of the type of an integer that belongs to an operation, `AttributeProto.AttributeType`.
const INT: i64 = 2;

/// Operations on named values, in the order in which they are computed.
pub struct Graph(Message);

impl Graph {
    /// Begins a graph that computes `output` `[batch, out]` from `input` `[batch, in]`.
    pub fn new(name: &str, input: (&str, usize), output: (&str, usize)) -> Self {
        Self(
            Message::default()
                .text(2, name)
                .message(11, &rows_of(input))
                .message(12, &rows_of(output)),
        )
    }

    /// Adds an operation with these integers as attributes, and returns the name of its result.
    pub fn node(
        &mut self,
        operation: &str,
        inputs: &[&str],
        output: &str,
        attributes: &[(&str, i64)],
    ) -> String {
        let node = inputs
            .iter()
            .fold(Message::default(), |node, input| node.text(1, input));
        let node = node.text(2, output).text(3, output).text(4, operation);
        let node = attributes.iter().fold(node, |node, (name, value)| {
            let attribute = Message::default().text(1, name).int(3, *value);
            node.message(5, &attribute.int(20, INT))
        });
        self.add(1, &node);
        output.to_owned()
    }

    /// Adds a constant of floats with these dimensions. There are none for a single number.
    pub fn floats(&mut self, name: &str, dimensions: &[usize], values: &[f32]) {
        assert_eq!(dimensions.iter().product::<usize>(), values.len(), "{name}");
        self.constant(
            name,
            dimensions,
            FLOAT,
            values
                .iter()
                .flat_map(|value| value.to_le_bytes())
                .collect(),
        );
    }

    /// Adds a constant list of one integer.
    pub fn index(&mut self, name: &str, value: usize) {
        self.constant(name, &[1], INT64, (value as i64).to_le_bytes().to_vec());
    }

    fn constant(&mut self, name: &str, dimensions: &[usize], kind: i64, bytes: Vec<u8>) {
        let tensor = dimensions.iter().fold(Message::default(), |tensor, &size| {
            tensor.int(1, size as i64)
        });
        self.add(5, &tensor.int(2, kind).text(8, name).bytes(9, &bytes));
    }

    fn add(&mut self, field: u32, part: &Message) {
        self.0 = std::mem::take(&mut self.0).message(field, part);
    }

    /// The bytes of a file with this graph and texts about it, which are sorted by key.
    pub fn file(&self, mut metadata: Vec<(&str, String)>) -> Vec<u8> {
        metadata.sort();
        let model = Message::default()
            .int(1, IR_VERSION)
            .text(2, "shadow-repose")
            .text(3, env!("CARGO_PKG_VERSION"))
            .message(7, &self.0)
            .message(8, &Message::default().text(1, "").int(2, OPSET));
        metadata
            .iter()
            .fold(model, |model, (key, value)| {
                model.message(14, &Message::default().text(1, key).text(2, value))
            })
            .0
    }
}

/// Describes a value `[batch, size]` of floats.
fn rows_of((name, size): (&str, usize)) -> Message {
    let shape = Message::default()
        .message(1, &Message::default().text(2, "batch"))
        .message(1, &Message::default().int(1, size as i64));
    let kind = Message::default().message(1, &Message::default().int(1, FLOAT).message(2, &shape));
    Message::default().text(1, name).message(2, &kind)
}

/// The bytes of a message, to which fields are added.
#[derive(Default)]
struct Message(Vec<u8>);

impl Message {
    fn int(self, field: u32, value: i64) -> Self {
        self.put(|out| out.write_int64(field, value))
    }

    fn text(self, field: u32, value: &str) -> Self {
        self.put(|out| out.write_string(field, value))
    }

    fn bytes(self, field: u32, value: &[u8]) -> Self {
        self.put(|out| out.write_bytes(field, value))
    }

    fn message(self, field: u32, value: &Self) -> Self {
        self.bytes(field, &value.0)
    }

    fn put(mut self, write: impl FnOnce(&mut CodedOutputStream) -> ProtobufResult<()>) -> Self {
        let mut out = CodedOutputStream::vec(&mut self.0);
        write(&mut out)
            .and_then(|()| out.flush())
            .expect("a vector takes everything");
        drop(out);
        self
    }
}
