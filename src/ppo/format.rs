//! Named arrays and a few texts as the bytes of a safetensors file, with a checksum over everything.
//!
//! The bytes may come from anywhere. Sizes are checked before they determine an allocation, values must be finite, and
//! content that does not match the checksum is refused.

use std::collections::BTreeMap;
use std::fmt;

use anyhow::{Context, Result, bail, ensure};
use safetensors::tensor::{Dtype, SafeTensorError, SafeTensors, TensorView};

use crate::os::shortened;

/// The metadata key of the checksum.
const CHECKSUM: &str = "checksum";

/// The largest header that is read. Ours take a few KiB. The limit keeps a foreign one from filling the memory.
const LARGEST_HEADER: u64 = 1 << 20;

/// An array of any shape, stored by rows.
#[derive(Clone, Debug, PartialEq)]
pub enum Array {
    /// f32 values.
    F32(Vec<usize>, Vec<f32>),
    /// f64 values.
    F64(Vec<usize>, Vec<f64>),
    /// u64 values.
    U64(Vec<usize>, Vec<u64>),
}

/// The error for bytes that are not as they were written: cut off or changed.
#[derive(Debug)]
pub struct Damaged(String);

impl fmt::Display for Damaged {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for Damaged {}

/// Texts by name.
pub type Texts = BTreeMap<String, String>;

/// Arrays by name.
pub type Arrays = BTreeMap<String, Array>;

/// The bytes of a file with this content.
///
/// # Errors
/// Fails if an array has a value that is not finite, or a shape that does not match its length.
pub fn to_bytes(texts: Texts, arrays: &Arrays) -> Result<Vec<u8>> {
    let mut parts = Vec::new();
    for (name, array) in arrays {
        ensure!(
            array.is_finite(),
            "`{name}` is not finite and cannot be saved"
        );
        parts.push((name, array.bytes(), array.shape()));
    }
    let mut views = Vec::new();
    for (name, (kind, bytes), shape) in &parts {
        views.push((
            name.to_string(),
            TensorView::new(*kind, shape.to_vec(), bytes)?,
        ));
    }
    seal(texts, views)
}

/// Parses the bytes of a file.
///
/// # Errors
/// Fails if the bytes were not written by [`to_bytes`], or with [`Damaged`] if they were changed since.
pub fn parse(bytes: &[u8]) -> Result<(Texts, Arrays)> {
    let (mut texts, views) = read(bytes)?;
    let stored = texts
        .remove(CHECKSUM)
        .context("no checksum: not a file of this program")?;
    let found = checksum(&texts, &views);
    ensure!(
        stored == found,
        Damaged(format!(
            "damaged: its checksum is {found} instead of {}",
            shortened(&stored)
        ))
    );
    let mut arrays = Arrays::new();
    for (name, view) in views {
        let array = Array::read(&view).with_context(|| format!("tensor `{}`", shortened(&name)))?;
        arrays.insert(name, array);
    }
    Ok((texts, arrays))
}

/// The file with these texts and arrays and their checksum. The texts are sorted by name, so that files with
/// equal content are equal. safetensors writes texts in the order of a hash map, which differs from run to run.
fn seal(mut texts: Texts, views: Vec<(String, TensorView)>) -> Result<Vec<u8>> {
    texts.insert(CHECKSUM.into(), checksum(&texts, &views));
    let mut bytes = safetensors::serialize(views, Some(texts.into_iter().collect()))?;
    let (length, rest) = bytes
        .split_first_chunk_mut()
        .context("a file begins with the length of its header")?;
    let header = &mut rest[..u64::from_le_bytes(*length) as usize];
    let mut parsed: serde_json::Map<String, serde_json::Value> = serde_json::from_slice(header)?;
    parsed
        .values_mut()
        .for_each(serde_json::Value::sort_all_objects);
    let sorted = serde_json::to_vec(&parsed)?;
    header.fill(b' ');
    header[..sorted.len()].copy_from_slice(&sorted);
    Ok(bytes)
}

/// Checks the beginning of a file, at least 8 bytes of it if it has as many. A file of another kind is reported as such.
///
/// # Errors
/// Fails if the bytes do not begin like a safetensors file.
fn expect_safetensors(bytes: &[u8]) -> Result<()> {
    ensure!(
        !bytes.starts_with(b"version "),
        "a Git LFS pointer: `git lfs pull` fetches the file itself"
    );
    ensure!(
        !(bytes.starts_with(&[8]) && bytes.get(2) == Some(&0x12)),
        "an ONNX file, not a safetensors file"
    );
    let length = bytes
        .first_chunk()
        .map_or(1, |length| u64::from_le_bytes(*length));
    ensure!(
        (1..=LARGEST_HEADER).contains(&length),
        Damaged("not a safetensors file".into())
    );
    Ok(())
}

/// The texts of a file, and its arrays sorted by name.
fn read(bytes: &[u8]) -> Result<(Texts, Vec<(String, TensorView<'_>)>)> {
    expect_safetensors(bytes)?;
    let whole = |error: SafeTensorError| {
        let reason = shortened(&error.to_string());
        Damaged(format!(
            "not a complete safetensors file ({reason}); it may be cut off"
        ))
    };
    let (_, header) = SafeTensors::read_metadata(bytes).map_err(whole)?;
    let texts = header
        .metadata()
        .clone()
        .context("no metadata: not a file of this program")?;
    let mut views = SafeTensors::deserialize(bytes).map_err(whole)?.tensors();
    views.sort_by(|(a, _), (b, _)| a.cmp(b));
    Ok((texts.into_iter().collect(), views))
}

/// The file with these bytes and a checksum that matches its content, for tests of what follows the checksum.
///
/// # Errors
/// Fails if the bytes are not a complete safetensors file.
pub fn sealed(bytes: &[u8]) -> Result<Vec<u8>> {
    let (mut texts, views) = read(bytes)?;
    texts.remove(CHECKSUM);
    seal(texts, views)
}

/// The CRC-32 of all names, texts, types, shapes and values. It does not depend on the layout of the header.
fn checksum(texts: &Texts, views: &[(String, TensorView)]) -> String {
    let mut hasher = crc32fast::Hasher::new();
    let mut take = |part: &[u8]| {
        hasher.update(&(part.len() as u64).to_le_bytes());
        hasher.update(part);
    };
    for (key, text) in texts {
        take(key.as_bytes());
        take(text.as_bytes());
    }
    for (name, view) in views {
        take(name.as_bytes());
        take(view.dtype().to_string().as_bytes());
        view.shape()
            .iter()
            .for_each(|size| take(&(*size as u64).to_le_bytes()));
        take(view.data());
    }
    format!("{:08x}", hasher.finalize())
}

impl Array {
    fn read(view: &TensorView) -> Result<Self> {
        let shape = view.shape().to_vec();
        let (words, _) = view.data().as_chunks::<4>();
        let (longs, _) = view.data().as_chunks::<8>();
        let array = match view.dtype() {
            Dtype::F32 => Self::F32(
                shape,
                words.iter().copied().map(f32::from_le_bytes).collect(),
            ),
            Dtype::F64 => Self::F64(
                shape,
                longs.iter().copied().map(f64::from_le_bytes).collect(),
            ),
            Dtype::U64 => Self::U64(
                shape,
                longs.iter().copied().map(u64::from_le_bytes).collect(),
            ),
            other => bail!("has the type {other:?}, expected F32, F64 or U64"),
        };
        ensure!(array.is_finite(), "has a value that is infinite or NaN");
        Ok(array)
    }

    /// The type of the values, and their bytes.
    fn bytes(&self) -> (Dtype, Vec<u8>) {
        match self {
            Self::F32(_, values) => (
                Dtype::F32,
                values.iter().flat_map(|x| x.to_le_bytes()).collect(),
            ),
            Self::F64(_, values) => (
                Dtype::F64,
                values.iter().flat_map(|x| x.to_le_bytes()).collect(),
            ),
            Self::U64(_, values) => (
                Dtype::U64,
                values.iter().flat_map(|x| x.to_le_bytes()).collect(),
            ),
        }
    }

    /// The sizes of its dimensions.
    pub fn shape(&self) -> &[usize] {
        match self {
            Self::F32(shape, _) | Self::F64(shape, _) | Self::U64(shape, _) => shape,
        }
    }

    fn is_finite(&self) -> bool {
        match self {
            Self::F32(_, values) => values.iter().all(|x| x.is_finite()),
            Self::F64(_, values) => values.iter().all(|x| x.is_finite()),
            Self::U64(..) => true,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn content() -> (Texts, Arrays) {
        let arrays = [
            ("weight", Array::F32(vec![2, 2], vec![1.5, -2.0, 0.0, 4.0])),
            ("count", Array::U64(vec![1], vec![u64::MAX])),
            ("mean", Array::F64(vec![2], vec![0.1, 0.2])),
        ];
        let texts = Texts::from([("config".into(), "a = 1".into())]);
        (
            texts,
            arrays.map(|(name, array)| (name.to_owned(), array)).into(),
        )
    }

    fn written((texts, arrays): (Texts, Arrays)) -> Vec<u8> {
        to_bytes(texts, &arrays).unwrap()
    }

    fn refusal(bytes: &[u8]) -> String {
        format!("{:#}", parse(bytes).unwrap_err())
    }

    /// The position of these bytes in the file.
    fn find(bytes: &[u8], part: &[u8]) -> usize {
        bytes
            .windows(part.len())
            .position(|window| window == part)
            .expect("it is in the file")
    }

    #[test]
    fn what_is_written_is_what_is_read() {
        assert_eq!(parse(&written(content())).unwrap(), content());
    }

    #[test]
    fn files_of_equal_content_are_equal() {
        let mut many = content();
        (0..20).for_each(|i| drop(many.0.insert(format!("text {i}"), "x".into())));
        // Each call fills a new hash map, with its own order.
        let bytes = written(many.clone());
        assert!((0..20).all(|_| written(many.clone()) == bytes));
        assert_eq!(parse(&bytes).unwrap(), many);
    }

    #[test]
    fn every_changed_bit_of_texts_and_numbers_is_found() {
        let bytes = written(content());
        let header = 8 + u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
        for bit in 0..8 * (bytes.len() - header) {
            let mut changed = bytes.clone();
            changed[header + bit / 8] ^= 1 << (bit % 8);
            assert!(refusal(&changed).contains("checksum"));
        }
        let mut changed = bytes.clone();
        changed[find(&bytes, b"a = 1") + 4] = b'2';
        assert!(refusal(&changed).contains("checksum"));
    }

    #[test]
    fn cut_off_and_foreign_files_are_refused() {
        let bytes = written(content());
        for length in [0, 7, 8, 100, bytes.len() / 2, bytes.len() - 1] {
            assert!(refusal(&bytes[..length]).contains("cut off"));
        }
        let foreign = safetensors::serialize(Vec::<(String, TensorView)>::new(), None).unwrap();
        assert!(refusal(&foreign).contains("not a file of this program"));
    }

    #[test]
    fn a_header_that_claims_to_be_huge_is_refused_unread() {
        let mut bytes = written(content());
        for length in [LARGEST_HEADER + 1, 1 << 40, u64::MAX] {
            bytes[..8].copy_from_slice(&length.to_le_bytes());
            assert!(refusal(&bytes).contains("not a safetensors file"));
        }
    }

    #[test]
    fn what_is_no_safetensors_file_is_called_what_it_is() {
        for (text, what) in [
            (
                &b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n"[..],
                "a Git LFS pointer",
            ),
            (b"\x08\x08\x12\x0dshadow-repose", "an ONNX file"),
            (b"<!DOCTYPE html><html></html>", "not a safetensors file"),
            (b"PK\x03\x04\x14\x00\x00\x00\x08", "not a safetensors file"),
            (b"iteration,env_steps\n", "not a safetensors file"),
            (&[0; 100], "not a safetensors file"),
            (b"", "not a complete safetensors file"),
        ] {
            assert!(refusal(text).contains(what), "{}", refusal(text));
        }
    }

    #[test]
    fn numbers_that_are_not_finite_are_neither_written_nor_read() {
        let mut bad = content();
        bad.1
            .insert("weight".into(), Array::F32(vec![1], vec![f32::NAN]));
        assert!(
            to_bytes(bad.0, &bad.1)
                .unwrap_err()
                .to_string()
                .contains("`weight` is not finite")
        );
        let mut bytes = written(content());
        let at = find(&bytes, &0.2_f64.to_le_bytes());
        bytes[at..at + 8].copy_from_slice(&f64::INFINITY.to_le_bytes());
        assert!(refusal(&bytes).contains("checksum"));
        assert!(
            refusal(&sealed(&bytes).unwrap())
                .contains("tensor `mean`: has a value that is infinite or NaN")
        );
    }
}
