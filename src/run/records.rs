//! Reads event files back: finds the bytes of a file that are whole events up to a step.
//!
//! A file is a sequence of records: length (8 bytes, little endian), its checksum, an event, its checksum (TFRecord, from
//! TensorFlow's record_writer.h). An event is a protobuf message, of which only the step, field 2, is read. Files are untrusted:
//! sizes are bounded.

use std::io::{BufRead, Read, Result};

use protobuf::CodedInputStream;
use protobuf::wire_format::WireType;
use tensorboard_rs::masked_crc32c::masked_crc32c;

/// The most bytes of an event. This program writes none that is larger. A record that claims to be is damaged.
const LARGEST: u64 = 64 << 20;

/// The number of bytes at the start of a file that are whole events up to `last_step`. Steps do not decrease within a
/// file.
///
/// # Errors
/// Fails if the file cannot be read.
pub fn length_up_to(mut reader: impl BufRead, last_step: u64) -> Result<u64> {
    let mut length = 0;
    while let Some(event) = next_event(&mut reader)? {
        if step_of(&event).is_none_or(|step| step > last_step as i64) {
            break;
        }
        length += 16 + event.len() as u64;
    }
    Ok(length)
}

/// Reads the next event. Returns `None` at the end of the file, or if no whole record follows.
fn next_event(reader: &mut impl BufRead) -> Result<Option<Vec<u8>>> {
    let length = checked(reader, 8)?.and_then(|bytes| bytes.try_into().ok());
    match length.map(u64::from_le_bytes) {
        Some(length) if length <= LARGEST => checked(reader, length as usize),
        _ => Ok(None),
    }
}

/// Reads `count` bytes and their checksum. Returns `None` if they are incomplete or do not match.
fn checked(reader: &mut impl BufRead, count: usize) -> Result<Option<Vec<u8>>> {
    let mut bytes = Vec::new();
    let mut checksum = Vec::new();
    reader.by_ref().take(count as u64).read_to_end(&mut bytes)?;
    reader.take(4).read_to_end(&mut checksum)?;
    let is_whole = bytes.len() == count && checksum == masked_crc32c(&bytes).to_le_bytes();
    Ok(is_whole.then_some(bytes))
}

/// The step of an event, or 0 if it has none, or `None` if it is not a protobuf message.
fn step_of(event: &[u8]) -> Option<i64> {
    let mut stream = CodedInputStream::from_bytes(event);
    let mut step = 0;
    while !stream.eof().ok()? {
        match stream.read_tag_unpack().ok()? {
            (2, WireType::WireTypeVarint) => step = stream.read_int64().ok()?,
            // Refuses groups, which could be nested without end.
            (_, kind) => stream.skip_field(kind).ok()?,
        }
    }
    Some(step)
}

#[cfg(test)]
mod tests {
    use protobuf::Message;
    use tensorboard_proto::event::Event;
    use tensorboard_proto::summary::{Summary, Summary_Value};
    use tensorboard_rs::record_writer::RecordWriter;

    use super::*;

    /// An event as another library writes it.
    fn event(step: i64, values: usize) -> Vec<u8> {
        let (mut event, mut summary) = (Event::new(), Summary::new());
        for _ in 0..values {
            let mut value = Summary_Value::new();
            value.set_tag("reward/rotation".into());
            value.set_simple_value(0.5);
            summary.mut_value().push(value);
        }
        event.set_wall_time(1.7e9);
        event.set_step(step);
        event.set_summary(summary);
        event.write_to_bytes().unwrap()
    }

    fn record(event: &[u8]) -> Vec<u8> {
        let mut bytes = Vec::new();
        RecordWriter::new(&mut bytes).write(event).unwrap();
        bytes
    }

    #[test]
    fn the_step_is_the_one_that_protobuf_reads() {
        for step in [0, 1, 127, 128, 16_384, 100_000_000, i64::MAX, -1, i64::MIN] {
            for values in [0, 1, 40] {
                assert_eq!(step_of(&event(step, values)), Some(step));
            }
        }
        assert_eq!(step_of(&[]), Some(0));
        // A file version, a group, a string longer than the event, a varint that does not end.
        assert_eq!(step_of(b"\x1a\x01x"), Some(0));
        for bad in [
            &b"\x0b\x0c"[..],
            b"\x1a\x09x",
            b"\x10\xff",
            &[0xff; 12],
            b"\x1a\xff\xff\xff\xff\xff\xff\xff\xff\xff\x01",
        ] {
            assert_eq!(step_of(bad), None, "{bad:?}");
        }
    }

    #[test]
    fn what_is_no_whole_record_ends_a_file() {
        let whole = [record(&event(1, 2)), record(&event(2, 2))].concat();
        let first = whole.len() as u64 / 2;
        let length = |bytes: &[u8]| length_up_to(bytes, 5).unwrap();
        assert_eq!(
            (
                length(&whole),
                length(&[]),
                length_up_to(&whole[..], 1).unwrap()
            ),
            (2 * first, 0, first)
        );
        for end in 0..whole.len() {
            assert_eq!(
                length(&whole[..end]),
                if end as u64 >= first { first } else { 0 }
            );
        }
        // A flipped bit, or a block that a crash left empty.
        for place in 0..whole.len() {
            let mut damaged = whole.clone();
            damaged[place] ^= 8;
            assert_eq!(
                length(&damaged),
                if place as u64 >= first { first } else { 0 },
                "byte {place}"
            );
        }
        assert_eq!(length(&[&whole[..], &[0; 4096]].concat()), 2 * first);
        assert_eq!(
            length(&[&whole[..], &record(&vec![0x40; LARGEST as usize + 1])].concat()),
            2 * first,
            "larger than any event"
        );
    }
}
