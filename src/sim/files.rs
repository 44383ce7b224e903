//! Which files a scene reads.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use crate::os::read_bytes;

/// The files that a scene may read: its own, included files, meshes, textures, height fields. Each is looked for in every
/// folder that the scene names, so some may not belong to it.
pub fn scene_files(scene: &Path) -> Vec<PathBuf> {
    let folder_of = |path: &Path| path.parent().unwrap_or(Path::new("")).to_owned();
    let top = folder_of(scene);
    let mut files = vec![scene.to_owned()];
    let mut folders = BTreeSet::new();
    let mut names = BTreeSet::new();
    let mut known = BTreeSet::from([scene.to_owned()]);
    let mut done = 0;
    while done < files.len() {
        // What is no XML names no files.
        let bytes = read_bytes(&files[done]).unwrap_or_default();
        let text = String::from_utf8_lossy(&bytes);
        let folder = folder_of(&files[done]);
        done += 1;
        for (name, value) in attributes(&text) {
            folders.insert(folder.clone());
            if name.ends_with("dir") {
                folders.insert(top.join(value));
            } else if name.starts_with("file") {
                names.insert(PathBuf::from(value));
                // With `strippath`, only the last part counts.
                names.extend(Path::new(value).file_name().map(PathBuf::from));
            }
        }
        let found = folders
            .iter()
            .flat_map(|folder| names.iter().map(|name| folder.join(name)));
        let found: Vec<PathBuf> = found
            .filter(|path| !known.contains(path) && path.is_file())
            .collect();
        known.extend(found.iter().cloned());
        files.extend(found);
    }
    files
}

/// The names and values of all attributes.
fn attributes(text: &str) -> impl Iterator<Item = (&str, &str)> {
    text.match_indices('=').filter_map(|(at, _)| {
        let name = text[..at]
            .trim_end()
            .rsplit(|c: char| !c.is_alphanumeric())
            .next()?;
        let value = text[at + 1..].trim_start();
        let quote = value.chars().next().filter(|c| "\"'".contains(*c))?;
        Some((name, value[1..].split(quote).next()?))
    })
}
