//! One HTML file that shows recorded motion. It contains data, style and code, and loads nothing from elsewhere.
//!
//! The page's own files are in `assets/page`. `FORMAT.md` there says what the blocks of data hold. A table of numbers is stored as
//! 16-bit integers, column by column, as differences from row to row. All low bytes come before all high bytes, so it compresses
//! well.

use base64::prelude::{BASE64_STANDARD, Engine};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};

use crate::os::gzip;

const PAGE: &str = include_str!("../../assets/page/page.html");
const STYLE: &str = include_str!("../../assets/page/style.css");

/// The code, in the order in which it is put together.
const CODE: [&str; 9] = [
    include_str!("../../assets/page/format.js"),
    include_str!("../../assets/page/shapes.js"),
    include_str!("../../assets/page/draw.js"),
    include_str!("../../assets/page/flat.js"),
    include_str!("../../assets/page/camera.js"),
    include_str!("../../assets/page/line.js"),
    include_str!("../../assets/page/panel.js"),
    include_str!("../../assets/page/live.js"),
    include_str!("../../assets/page/main.js"),
];

/// The largest 16-bit integer.
const LARGEST: f64 = 32767.0;

/// A mesh: corners with their normals, and triangles of corners.
pub type Mesh = (Vec<([f32; 3], [f32; 3])>, Vec<[usize; 3]>);

/// What a page shows.
pub struct Page {
    /// The metadata of the page (see `FORMAT.md`). The number of rows and their scale are added to it.
    pub meta: Value,
    /// The bodies and shapes. The list of meshes is added to it.
    pub scene: Value,
    /// The meshes of its shapes.
    pub meshes: Vec<Mesh>,
    /// The recorded rows, all of one length.
    pub rows: Vec<Vec<f64>>,
    /// The columns of counts, which are stored without a scale.
    pub counts: Vec<usize>,
}

impl Page {
    /// The key of a page, which is different for another scene or other columns.
    pub fn key(&self) -> String {
        BASE64_STANDARD.encode(&Sha256::digest(format!("{}{}", self.meta, self.scene))[..12])
    }

    /// The page as text. A live page has no rows, and reads them from its server.
    pub fn html(mut self) -> String {
        let is_live = self.meta["live"] == true;
        if is_live {
            self.meta["key"] = self.key().into();
        }
        let (lists, meshes): (Vec<Value>, Vec<Vec<u8>>) =
            self.meshes.iter().map(packed_mesh).unzip();
        self.scene["meshes"] = lists.into();
        let (scale, rows) = packed_rows(&self.rows, &self.counts);
        self.meta["rows"] = self.rows.len().into();
        self.meta["scale"] = scale.into();
        let code = format!("\"use strict\";\n{}", CODE.map(lean).concat());
        let style = lean(STYLE);
        let policy = format!(
            "default-src 'none'; script-src {}; style-src {}; img-src data:; connect-src '{}'; base-uri 'none'; form-action 'none'",
            hash(&code),
            hash(&style),
            if is_live { "self" } else { "none" }
        );
        // The last one may quote any text: what asks for another one, or ends a script.
        let values = [
            ("POLICY", policy),
            ("STYLE", style),
            ("CODE", code),
            ("SCENE", packed(self.scene.to_string().as_bytes())),
            ("ROWS", packed(&rows)),
            ("MESHES", packed(&meshes.concat())),
            ("META", self.meta.to_string().replace('<', "\\u003c")),
        ];
        values.iter().fold(PAGE.to_owned(), |page, (name, value)| {
            page.replace(&format!("{{{{{name}}}}}"), value)
        })
    }
}

/// A text without indents, empty lines and lines of comment.
fn lean(text: &str) -> String {
    let is_code =
        |line: &&str| !line.is_empty() && !line.starts_with("//") && !line.starts_with("/*");
    text.lines()
        .map(str::trim)
        .filter(is_code)
        .map(|line| format!("{line}\n"))
        .collect()
}

/// The hash by which a content security policy names a text.
fn hash(text: &str) -> String {
    format!("'sha256-{}'", BASE64_STANDARD.encode(Sha256::digest(text)))
}

/// Bytes as compressed text, or nothing.
fn packed(bytes: &[u8]) -> String {
    if bytes.is_empty() {
        return String::new();
    }
    BASE64_STANDARD.encode(gzip(bytes))
}

/// Packs integers, which are taken modulo 2^16.
fn table(rows: usize, columns: usize, value: impl Fn(usize, usize) -> i64) -> Vec<u8> {
    let places = (0..columns).flat_map(|column| (0..rows).map(move |row| (row, column)));
    let differences = places.map(|(row, column)| {
        let before = if row == 0 { 0 } else { value(row - 1, column) };
        (value(row, column) - before) as u16
    });
    let (low, high): (Vec<u8>, Vec<u8>) = differences.map(u16::to_le_bytes).map(Into::into).unzip();
    [low, high].concat()
}

/// The factor of each column, and the rows as a table of integers.
fn packed_rows(rows: &[Vec<f64>], counts: &[usize]) -> (Vec<f64>, Vec<u8>) {
    let columns = rows.first().map_or(0, Vec::len);
    let scale = |column| {
        if counts.contains(&column) {
            return 1.0;
        }
        let sizes = rows.iter().map(|row| row[column].abs());
        sizes.fold(1e-9, f64::max) / LARGEST
    };
    let scale: Vec<f64> = (0..columns).map(scale).collect();
    let packed = table(rows.len(), columns, |row, column| {
        (rows[row][column] / scale[column]).round() as i64
    });
    (scale, packed)
}

/// The entry of a mesh in the scene, and its bytes: points as a table in its bounding box, normals by axis, corners of
/// triangles.
fn packed_mesh((corners, triangles): &Mesh) -> (Value, Vec<u8>) {
    let bounds = |pick: fn(f32, f32) -> f32, start| {
        [0, 1, 2].map(|axis| {
            let along = corners.iter().map(|(point, _)| point[axis]);
            along.fold(start, pick)
        })
    };
    let low = bounds(f32::min, f32::INFINITY);
    let high = bounds(f32::max, f32::NEG_INFINITY);
    let step = [0, 1, 2].map(|axis| f64::from(high[axis] - low[axis]).max(1e-9) / 65535.0);
    let point = |corner: usize, axis: usize| {
        (f64::from(corners[corner].0[axis] - low[axis]) / step[axis]).round() as i64 - 32768
    };
    let mut bytes = table(corners.len(), 3, point);
    for axis in 0..3 {
        let normals = corners.iter().map(|(_, normal)| normal[axis]);
        bytes.extend(normals.map(|x| (x * 127.0).round() as i8 as u8));
    }
    bytes.extend(table(3 * triangles.len(), 1, |place, _| {
        triangles[place / 3][place % 3] as i64
    }));
    (
        json!({ "points": corners.len(), "triangles": triangles.len(), "low": low, "step": step }),
        bytes,
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_is_ascii_but_for_its_data_and_names_no_other_place() {
        for text in CODE.into_iter().chain([STYLE, PAGE]) {
            assert!(
                text.is_ascii(),
                "{:?}",
                text.chars().find(|c| !c.is_ascii())
            );
            assert!(
                !text.contains("://") && !text.contains("src="),
                "it loads something"
            );
        }
        for text in CODE.into_iter().chain([STYLE]) {
            assert!(
                !["</script", "</style", "<!--"]
                    .iter()
                    .any(|end| text.contains(end)),
                "it would end early"
            );
        }
    }

    #[test]
    fn the_example_in_the_documents_has_the_code_and_the_style_of_today() {
        let example = include_str!("../../docs/hand.html");
        for text in CODE.into_iter().chain([STYLE]) {
            assert!(
                example.contains(&lean(text)),
                "write it anew, as CONTRIBUTING.md says"
            );
        }
    }

    #[test]
    fn a_table_is_undone_by_sums_that_wrap() {
        let rows = [[5, -32768], [-7, 32767], [32767, 0]];
        let bytes = table(3, 2, |row, column| rows[row][column]);
        assert_eq!(bytes.len(), 12);
        for column in 0..2 {
            let mut sum = 0_i16;
            for (row, values) in rows.iter().enumerate() {
                let place = column * 3 + row;
                sum = sum.wrapping_add(i16::from_le_bytes([bytes[place], bytes[6 + place]]));
                assert_eq!(i64::from(sum), values[column]);
            }
        }
    }

    #[test]
    fn what_ends_a_script_does_not_end_the_data() {
        let meta = json!({ "policy": "</script><script>alert(1)</script>" });
        let page = Page {
            meta,
            scene: json!({}),
            meshes: Vec::new(),
            rows: vec![vec![1.0]],
            counts: Vec::new(),
        }
        .html();
        assert_eq!(
            page.matches("</script>").count(),
            PAGE.matches("</script>").count()
        );
        assert!(!page.contains("alert(1)</script>") && page.contains("\\u003c/script>"));
    }
}
