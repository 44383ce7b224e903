//! The rules for the structure of the code: imports, sizes of files and functions, unsafe code.

mod imports;
mod tokens;

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use shadow_repose::config::{Settings, Source};

use imports::Imports;

/// Words that may appear in these folders of src/ only.
const FENCES: [(&str, &[&str]); 15] = [
    ("mpi::", &["ranks"]),
    ("mujoco_rs", &["sim"]),
    ("candle_", &["ppo/candle"]),
    ("safetensors::", &["ppo"]),
    ("std::fs", &["os", "run"]),
    ("std::net", &["os"]),
    ("println!", &["os"]),
    ("indicatif", &["os"]),
    ("tensorboard_", &["run"]),
    ("signal_hook", &["os", "processor.rs"]),
    ("egui::", &["sim"]),
    ("openh264", &["draw"]),
    ("shiguredo_mp4", &["draw"]),
    ("png::", &["draw"]),
    ("plotters", &["draw"]),
];

/// The files that may contain unsafe code. Each allows it with a reason.
const UNSAFE: [&str; 9] = [
    "os/interrupt.rs",
    "ppo/kernels/amx.rs",
    "ppo/kernels/avx512.rs",
    "ppo/kernels/product.rs",
    "processor.rs",
    "sim/compilation.rs",
    "sim/fatal.rs",
    "sim/sharing.rs",
    "sim/variation.rs",
];

fn src() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("src")
}

/// All files in a folder and below.
pub(crate) fn sources(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            found.extend(sources(&path));
        } else {
            found.push(path);
        }
    }
    found.sort();
    found
}

#[test]
fn outside_worlds_are_fenced() {
    let files = sources(&src());
    assert!(files.len() > 20);
    for file in files {
        let text = fs::read_to_string(&file).unwrap();
        let inside = file.strip_prefix(src()).unwrap();
        for (word, folders) in FENCES {
            let allowed =
                folders.iter().any(|folder| inside.starts_with(folder)) || !text.contains(word);
            assert!(
                allowed,
                "{} names {word}, which belongs in {folders:?}",
                inside.display()
            );
        }
        let allowed =
            UNSAFE.iter().any(|name| inside == Path::new(name)) || !text.contains("unsafe_code");
        assert!(allowed, "{} must not allow unsafe code", inside.display());
        assert!(
            text.starts_with("//!"),
            "{} must begin with a `//!` comment that says what it is",
            inside.display()
        );
    }
}

/// What each module imports by the last column of the table in lib.rs.
fn allowed() -> BTreeMap<String, BTreeSet<String>> {
    let text = fs::read_to_string(src().join("lib.rs")).unwrap();
    let rows = text
        .lines()
        .filter_map(|line| line.strip_prefix("//! | ")?.strip_suffix(" |"));
    let rows = rows
        .map(|row| row.split(" | ").collect::<Vec<_>>())
        .filter(|cells| cells.len() == 3);
    let word = |text: &str| text.replace(['`', '[', ']'], "").replace("mod@", "");
    let words = |cell: &str| {
        cell.split(", ")
            .map(word)
            .filter(|name| name != "-")
            .collect()
    };
    rows.filter(|cells| cells[0].contains('`'))
        .map(|cells| (word(cells[0]), words(cells[2])))
        .collect()
}

#[test]
fn modules_import_what_the_table_in_lib_rs_says_and_nothing_else() {
    let top = |path: &Path| {
        path.with_extension("")
            .iter()
            .next()
            .unwrap()
            .to_str()
            .unwrap()
            .to_owned()
    };
    let mut found: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    for (file, others) in imports::imports(&src(), "shadow_repose") {
        let own = top(&file);
        let used = found.entry(own.clone()).or_default();
        used.extend(
            others
                .iter()
                .map(|other| top(other))
                .filter(|other| *other != own),
        );
    }
    found.remove("lib");
    let allowed = allowed();
    for (module, used) in &found {
        let said = allowed
            .get(module)
            .unwrap_or_else(|| panic!("{module} is not in the table of lib.rs"));
        assert!(
            used == said,
            "{module} imports {used:?}; the table in lib.rs says {said:?}"
        );
    }
    assert!(
        found.keys().eq(allowed.keys()),
        "the table in lib.rs has modules that do not exist"
    );
}

/// Where two paths part: the file or folder of each, beside each other in one folder.
fn siblings(one: &Path, other: &Path) -> (PathBuf, PathBuf) {
    let shared = one.iter().zip(other).take_while(|(a, b)| a == b).count();
    (
        one.iter().take(shared + 1).collect(),
        other.iter().take(shared + 1).collect(),
    )
}

/// Those that import each other, and what lies between them. An inner folder counts as one, beside the files of its folder.
fn circles(imports: &Imports) -> Imports {
    let mut left = Imports::new();
    for (file, others) in imports {
        for (importer, imported) in others.iter().map(|other| siblings(file, other)) {
            left.entry(imported.clone()).or_default();
            left.entry(importer).or_default().insert(imported);
        }
    }
    // Those that import none of the remaining ones, or that none of the remaining ones imports, are removed one by one.
    let end = |left: &Imports| {
        let imports = |file: &PathBuf| left[file].iter().any(|other| left.contains_key(other));
        let is_imported = |file: &PathBuf| left.values().any(|used| used.contains(file));
        left.keys()
            .find(|file| !imports(file) || !is_imported(file))
            .cloned()
    };
    while let Some(end) = end(&left) {
        left.remove(&end);
    }
    let remaining: BTreeSet<PathBuf> = left.keys().cloned().collect();
    left.values_mut()
        .for_each(|used| used.retain(|other| remaining.contains(other)));
    left
}

#[test]
fn files_and_folders_do_not_import_each_other_in_a_circle() {
    let imports = imports::imports(&src(), "shadow_repose");
    assert!(
        imports.values().map(BTreeSet::len).sum::<usize>() > 200,
        "most imports were not found"
    );
    let circles = circles(&imports);
    assert!(circles.is_empty(), "these import each other: {circles:#?}");
}

#[test]
fn a_folder_and_the_files_beside_it_make_a_circle() {
    let path = |path: &&str| PathBuf::from(path);
    let used =
        |file: &str, others: &[&str]| (PathBuf::from(file), others.iter().map(path).collect());
    let face = used("a/mod.rs", &["a/inner/x.rs", "a/y.rs"]);
    let inner = used("a/inner/x.rs", &["a/y.rs", "b.rs"]);
    let calm = Imports::from([face.clone(), inner.clone(), used("b.rs", &["c.rs"])]);
    assert!(circles(&calm).is_empty());
    let circle = Imports::from([face, inner, used("a/y.rs", &["a/inner/z.rs"])]);
    assert!(
        circles(&circle)
            .keys()
            .eq(&[PathBuf::from("a/inner"), "a/y.rs".into()])
    );
}

#[test]
fn the_package_for_python_has_no_circle() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("python");
    let rust = imports::imports(&folder.join("src"), "_native");
    let python = imports::of_python(&folder.join("shadow_repose"));
    for imports in [rust, python] {
        assert!(
            imports.values().map(BTreeSet::len).sum::<usize>() > 5,
            "most imports were not found"
        );
        let circles = circles(&imports);
        assert!(circles.is_empty(), "these import each other: {circles:#?}");
    }
}

#[test]
fn every_configuration_that_comes_with_the_program_is_valid() {
    let files = sources(&Path::new(env!("CARGO_MANIFEST_DIR")).join("configs"));
    assert!(files.len() > 1);
    for path in files {
        let text = fs::read_to_string(&path).unwrap();
        Settings::new()
            .file(Source::new(path, text))
            .resolve()
            .unwrap();
    }
}

#[test]
fn every_setting_is_explained_in_the_default_configuration() {
    let text = include_str!("../../../configs/repose.toml");
    for line in text
        .lines()
        .filter(|line| line.contains('=') && !line.starts_with('#'))
    {
        assert!(line.contains(" # "), "no comment: {line}");
    }
}
