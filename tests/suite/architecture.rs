//! The fences of the house: who may know what.

use std::fs;
use std::path::{Path, PathBuf};

use shadow_repose::config::{Config, Source};

fn sources(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            sources(&path, found);
        } else {
            found.push(path);
        }
    }
}

#[test]
fn outside_worlds_are_fenced() {
    let src = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut files = Vec::new();
    sources(&src, &mut files);
    assert!(files.len() > 20);
    // What is known only within one folder.
    let fences = [
        ("mujoco_rs", "sim"),
        ("candle_", "ppo/candle"),
        ("safetensors::", "ppo"),
        ("std::fs", "run"),
        ("println!", "run"),
        ("indicatif", "run"),
        ("tensorboard_", "run"),
        ("signal_hook", "run"),
        ("egui::", "sim"),
        ("openh264", "run"),
        ("shiguredo_mp4", "run"),
        ("png::", "run"),
        ("plotters", "run"),
    ];
    // What a folder must not know.
    let blind = [
        ("env", "crate::ppo"),
        ("ppo", "crate::env"),
        ("run", "crate::env"),
        ("run", "crate::ppo"),
        ("sim", "crate::env"),
        ("sim", "crate::run"),
    ];
    for file in files {
        let text = fs::read_to_string(&file).unwrap();
        let inside = file.strip_prefix(&src).unwrap();
        for (word, folder) in fences {
            let allowed = inside.starts_with(folder) || !text.contains(word);
            assert!(allowed, "{} names {word}, which belongs in src/{folder}", inside.display());
        }
        for (folder, word) in blind {
            let allowed = !inside.starts_with(folder) || !text.contains(word);
            assert!(allowed, "{} must not know {word}", inside.display());
        }
        let comment = if inside.extension().is_some_and(|kind| kind == "rs") { "//!" } else { "# " };
        assert!(text.starts_with(comment), "{} must open with what it is", inside.display());
        assert!(text.lines().count() <= 450, "{} has grown too long", inside.display());
    }
}

#[test]
fn every_configuration_that_comes_with_the_program_is_valid() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs");
    let mut files = Vec::new();
    sources(&folder, &mut files);
    assert!(files.len() > 1);
    for path in files {
        let text = fs::read_to_string(&path).unwrap();
        Config::resolve(Some(&Source { path, text }), &[]).unwrap();
    }
}

#[test]
fn every_setting_is_explained_in_the_default_configuration() {
    let text = include_str!("../../configs/repose.toml");
    for line in text.lines().filter(|line| line.contains('=') && !line.starts_with('#')) {
        assert!(line.contains(" # "), "no comment: {line}");
    }
}
