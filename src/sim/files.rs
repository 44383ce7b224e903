//! Which files a scene reads.

use std::collections::BTreeSet;
use std::ffi::OsString;
use std::os::unix::ffi::OsStringExt;
use std::path::{Path, PathBuf};

use anyhow::{Result, ensure};
use mujoco_rs::wrappers::mj_auxiliary::MjVfs;
use quick_xml::Reader;
use quick_xml::escape::unescape;
use quick_xml::events::Event;
use quick_xml::events::attributes::Attribute;

use crate::os::read_bytes;

/// A user's scene in memory, so that it is the same whenever it is compiled: the names and contents of [`scene_files`], the scene
/// itself first. Nothing is held of the built-in scene.
#[derive(Default)]
pub struct SceneFiles(pub Vec<(String, Vec<u8>)>);

impl SceneFiles {
    /// The files of this scene as they are now.
    ///
    /// # Errors
    /// Fails as [`scene_files`] does.
    pub fn read(scene: &Path) -> Result<Self> {
        let read = |path: PathBuf| Some((path.to_str()?.to_owned(), read_bytes(&path).ok()?));
        Ok(Self(
            scene_files(scene)?.into_iter().filter_map(read).collect(),
        ))
    }

    /// Whether they are the files of this scene.
    pub fn hold(&self, scene: &Path) -> bool {
        self.0
            .first()
            .is_some_and(|(name, _)| Path::new(name) == scene)
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

/// The most folders of meshes and pictures in which a file is looked for. MuJoCo uses the last ones that a scene names.
const MOST_FOLDERS: usize = 256;

/// The files and folders that a scene may read: its own file, included ones, models, meshes, textures, height fields. Each is
/// looked for wherever MuJoCo may look for it, so some may not belong to the scene. The bytes of meshes and textures are not read.
///
/// # Errors
/// Fails if one of them is a pipe or a device: MuJoCo could wait for its end for ever.
pub fn scene_files(scene: &Path) -> Result<Vec<PathBuf>> {
    let folder_of = |path: &Path| path.parent().unwrap_or(Path::new("")).to_owned();
    let mut files = vec![scene.to_owned()];
    let mut scenes = files.clone();
    let mut known = BTreeSet::new();
    let mut folders = Vec::new();
    let mut named = Vec::new();
    while let Some(own) = scenes.pop() {
        let near = [folder_of(&own), folder_of(scene)];
        // What is no XML names no files.
        let bytes = read_bytes(&own).unwrap_or_default();
        for (element, name, value) in attributes(&bytes) {
            let places = near.clone().map(|folder| folder.join(&value));
            if element == b"compiler" && name.ends_with(b"dir") {
                folders.extend(places);
            } else if name.starts_with(b"file") {
                named.push((near.clone(), value));
                if [&b"include"[..], b"model"].contains(&&*element) {
                    scenes.extend(
                        places
                            .into_iter()
                            .filter(|path| path.canonicalize().is_ok_and(|end| known.insert(end))),
                    );
                }
            }
        }
    }
    for (near, name) in &named {
        // With `strippath`, only the last part of a name counts.
        let last = Path::new(name).file_name().unwrap_or(name);
        let folders = near.iter().chain(folders.iter().rev().take(MOST_FOLDERS));
        for path in folders.flat_map(|folder| [name, last].map(|name| folder.join(name))) {
            let Ok(facts) = path.metadata() else { continue };
            ensure!(
                facts.is_file() || facts.is_dir(),
                "{} is a pipe or a device, not a file",
                path.display()
            );
            files.push(path);
        }
    }
    Ok(files)
}

/// The attributes in a scene, up to where it is no XML: the names of their elements, their own names, and their values.
fn attributes(scene: &[u8]) -> Vec<(Vec<u8>, Vec<u8>, OsString)> {
    let mut reader = Reader::from_reader(scene);
    reader.config_mut().check_end_names = false;
    reader.config_mut().allow_dangling_amp = true;
    let mut found = Vec::new();
    while let Ok(event) = reader.read_event() {
        let element = match event {
            Event::Start(element) | Event::Empty(element) => element,
            Event::Eof => break,
            _ => continue,
        };
        for Attribute { key, value } in element.attributes().with_checks(false).flatten() {
            let name = key.as_ref().to_vec();
            found.push((element.name().as_ref().to_vec(), name, path_of(&value)));
        }
    }
    found
}

/// The path that a value of an attribute stands for. MuJoCo takes a backslash for a slash.
fn path_of(value: &[u8]) -> OsString {
    let meant = str::from_utf8(value)
        .ok()
        .and_then(|text| unescape(text).ok());
    let bytes = meant.map_or(value.to_vec(), |text| text.into_owned().into_bytes());
    OsString::from_vec(
        bytes
            .iter()
            .map(|&byte| if byte == b'\\' { b'/' } else { byte })
            .collect(),
    )
}
