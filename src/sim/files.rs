//! Which files a scene reads.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use mujoco_rs::wrappers::mj_auxiliary::MjVfs;

use crate::os::read_bytes;

/// A user's scene in memory, so that it is the same whenever it is compiled: the names and contents of [`scene_files`], the scene
/// itself first. Nothing is held of the built-in scene.
#[derive(Default)]
pub struct SceneFiles(pub Vec<(String, Vec<u8>)>);

impl SceneFiles {
    /// These files if they are those of `scene`, and otherwise its files as they are now.
    pub fn or_read(self: &Arc<Self>, scene: Option<&Path>) -> Arc<Self> {
        let Some(scene) = scene else {
            return Arc::default();
        };
        if self.hold(scene) {
            return self.clone();
        }
        let read = |path: PathBuf| Some((path.to_str()?.to_owned(), read_bytes(&path).ok()?));
        let files = scene_files(scene).into_iter().filter_map(read);
        Arc::new(Self(files.collect()))
    }

    /// Whether they are the files of this scene.
    pub fn hold(&self, scene: &Path) -> bool {
        let first = self.0.first();
        first.is_some_and(|(name, _)| Path::new(name) == scene)
    }

    /// The files for MuJoCo, which reads from the disk what is not among them.
    pub fn for_mujoco(&self) -> MjVfs {
        let mut files = MjVfs::new();
        for (name, content) in &self.0 {
            // MuJoCo takes two spellings of a path for the same file.
            let _ = files.add_from_buffer(name, content);
        }
        files
    }
}

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
                folders.extend([top.join(value), folder.join(value)]);
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
