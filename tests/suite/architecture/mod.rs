//! The rules for the structure of the code: imports, lengths of files and functions, unsafe code.

mod imports;

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use shadow_repose::config::{Config, Source};
use syn::spanned::Spanned;
use syn::visit::{self, Visit};

/// The largest allowed number of lines of a file and of a function.
const LONGEST_FILE: usize = 450;
const LONGEST_FUNCTION: usize = 60;

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
const UNSAFE: [&str; 7] = [
    "ppo/kernels/amx.rs",
    "ppo/kernels/avx512.rs",
    "ppo/kernels/product.rs",
    "processor.rs",
    "sim/compilation.rs",
    "sim/fatal.rs",
    "sim/variation.rs",
];

fn src() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("src")
}

/// Returns all files in a folder and below.
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
            let allowed = folders.iter().any(|folder| inside.starts_with(folder)) || !text.contains(word);
            assert!(allowed, "{} names {word}, which belongs in {folders:?}", inside.display());
        }
        let allowed = UNSAFE.iter().any(|name| inside == Path::new(name)) || !text.contains("unsafe_code");
        assert!(allowed, "{} must not allow unsafe code", inside.display());
        assert!(text.starts_with("//!"), "{} must begin with a `//!` comment that says what it is", inside.display());
        assert!(text.lines().count() <= LONGEST_FILE, "{} is too long", inside.display());
    }
}

/// Returns what each module imports by the last column of the table in lib.rs.
fn allowed() -> BTreeMap<String, BTreeSet<String>> {
    let text = fs::read_to_string(src().join("lib.rs")).unwrap();
    let rows = text.lines().filter_map(|line| line.strip_prefix("//! | ")?.strip_suffix(" |"));
    let rows = rows.map(|row| row.split(" | ").collect::<Vec<_>>()).filter(|cells| cells.len() == 3);
    let word = |text: &str| text.replace(['`', '[', ']'], "").replace("mod@", "");
    let words = |cell: &str| cell.split(", ").map(word).filter(|name| name != "-").collect();
    rows.filter(|cells| cells[0].contains('`')).map(|cells| (word(cells[0]), words(cells[2]))).collect()
}

#[test]
fn modules_import_what_the_table_in_lib_rs_says_and_nothing_else() {
    let top = |path: &Path| path.with_extension("").iter().next().unwrap().to_str().unwrap().to_owned();
    let mut found: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    for (file, others) in imports::imports(&src()) {
        let own = top(&file);
        let used = found.entry(own.clone()).or_default();
        used.extend(others.iter().map(|other| top(other)).filter(|other| *other != own));
    }
    found.remove("lib");
    let allowed = allowed();
    for (module, used) in &found {
        let said = allowed.get(module).unwrap_or_else(|| panic!("{module} is not in the table of lib.rs"));
        assert!(used == said, "{module} imports {used:?}; the table in lib.rs says {said:?}");
    }
    assert!(found.keys().eq(allowed.keys()), "the table in lib.rs has modules that do not exist");
}

#[test]
fn no_file_imports_itself_by_way_of_others() {
    let imports = imports::imports(&src());
    assert!(imports.values().map(BTreeSet::len).sum::<usize>() > 200, "most imports were not found");
    // Files that import none of the remaining ones, or that none of the remaining ones imports, are removed one by one. Only
    // cycles and what lies between them are left.
    let mut left = imports.clone();
    let ends = |left: &BTreeMap<PathBuf, BTreeSet<PathBuf>>| {
        let imports = |file: &PathBuf| left[file].iter().any(|other| left.contains_key(other));
        let is_imported = |file: &PathBuf| left.values().any(|used| used.contains(file));
        left.keys().find(|file| !imports(file) || !is_imported(file)).cloned()
    };
    while let Some(end) = ends(&left) {
        left.remove(&end);
    }
    let circle: BTreeMap<_, Vec<_>> = left
        .iter()
        .map(|(file, used)| (file, used.iter().filter(|other| left.contains_key(*other)).collect()))
        .collect();
    assert!(circle.is_empty(), "these import each other: {circle:#?}");
}

#[test]
fn functions_are_short() {
    struct Functions(Vec<(String, usize)>);
    impl Functions {
        fn add(&mut self, name: &syn::Ident, block: &syn::Block) {
            self.0.push((name.to_string(), block.span().end().line - name.span().start().line + 1));
        }
    }
    impl<'ast> Visit<'ast> for Functions {
        fn visit_item_fn(&mut self, item: &'ast syn::ItemFn) {
            self.add(&item.sig.ident, &item.block);
            visit::visit_item_fn(self, item);
        }
        fn visit_trait_item_fn(&mut self, item: &'ast syn::TraitItemFn) {
            if let Some(block) = &item.default {
                self.add(&item.sig.ident, block);
            }
            visit::visit_trait_item_fn(self, item);
        }
        fn visit_impl_item_fn(&mut self, item: &'ast syn::ImplItemFn) {
            self.add(&item.sig.ident, &item.block);
            visit::visit_impl_item_fn(self, item);
        }
    }
    let mut counted = 0;
    for file in sources(&src()) {
        let mut functions = Functions(Vec::new());
        functions.visit_file(&syn::parse_file(&fs::read_to_string(&file).unwrap()).unwrap());
        counted += functions.0.len();
        for (name, lines) in functions.0 {
            assert!(lines <= LONGEST_FUNCTION, "{}: {name} has {lines} lines", file.display());
        }
    }
    assert!(counted > 500, "most functions were not found");
}

#[test]
fn every_configuration_that_comes_with_the_program_is_valid() {
    let files = sources(&Path::new(env!("CARGO_MANIFEST_DIR")).join("configs"));
    assert!(files.len() > 1);
    for path in files {
        let text = fs::read_to_string(&path).unwrap();
        Config::resolve(Some(&Source { path, text }), &[]).unwrap();
    }
}

#[test]
fn every_setting_is_explained_in_the_default_configuration() {
    let text = include_str!("../../../configs/repose.toml");
    for line in text.lines().filter(|line| line.contains('=') && !line.starts_with('#')) {
        assert!(line.contains(" # "), "no comment: {line}");
    }
}
