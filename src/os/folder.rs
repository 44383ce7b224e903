//! A folder that is held open, so that its files are found wherever it is moved.

use std::fs::{self, File};
use std::path::PathBuf;
use std::sync::Arc;

use anyhow::Result;

use super::file::{Cannot, HANDLES, expect_named, place_of, through};

/// A folder that is known by its name or, once it is held, by a handle. Then its files are reached even after it was renamed, and
/// what has taken its name is not.
#[derive(Clone, Debug)]
pub struct Folder {
    /// The path by which its files are reached.
    pub path: PathBuf,
    /// The path at which it is opened or created.
    pub name: PathBuf,
    handle: Option<Arc<File>>,
}

impl Folder {
    /// The folder with this name, which need not exist.
    pub fn at(name: PathBuf) -> Self {
        Self {
            path: name.clone(),
            name,
            handle: None,
        }
    }

    /// Creates the folder unless it exists, and opens it. A held folder that was deleted is created again.
    ///
    /// # Errors
    /// Fails if it cannot be created or opened, or if something else has the name of a deleted one.
    pub fn hold(&mut self) -> Result<()> {
        let created = match &self.handle {
            Some(handle) if self.is_alive(handle) => return Ok(()),
            Some(_) => fs::create_dir(&self.name),
            None => fs::create_dir_all(&self.name),
        };
        created.cannot("create the folder", &self.name)?;
        let handle = File::open(&self.name).cannot("open", &self.name)?;
        self.path = through(&handle).cannot("open", &self.name)?;
        // Where the system lists no handles, the name must do.
        if !self.path.is_dir() {
            self.path.clone_from(&self.name);
        }
        self.handle = Some(Arc::new(handle));
        Ok(())
    }

    /// Whether the path leads to this open folder, and the folder was not deleted. Not all file systems count the names of a folder, or
    /// number it the same each time.
    fn is_alive(&self, handle: &File) -> bool {
        match self.link() {
            Some(place) => !place.to_string_lossy().ends_with(" (deleted)") || place.exists(),
            None => expect_named(&self.path, handle).is_ok(),
        }
    }

    /// Where the system says that the held folder lies.
    fn link(&self) -> Option<PathBuf> {
        let is_through = self.path.starts_with(HANDLES);
        is_through.then(|| place_of(&self.path)).flatten()
    }

    /// The path where the folder lies now: its name, unless it was moved.
    pub fn place(&self) -> PathBuf {
        let moved = self
            .link()
            .filter(|place| self.name.canonicalize().ok().as_ref() != Some(place));
        moved.unwrap_or_else(|| self.name.clone())
    }
}

#[cfg(test)]
mod tests {
    use super::super::file::shown;
    use super::*;

    fn held(name: PathBuf) -> Folder {
        let mut folder = Folder::at(name);
        folder.hold().unwrap();
        folder
    }

    #[test]
    fn a_folder_that_was_moved_is_written_where_it_lies_and_what_has_its_name_is_not() {
        let place = tempfile::tempdir().unwrap();
        let [name, moved] = ["run", "moved"].map(|name| place.path().join(name));
        let mut folder = held(name.clone());
        assert_eq!(folder.place(), name);
        fs::rename(&name, &moved).unwrap();
        fs::create_dir(&name).unwrap();
        fs::write(folder.path.join("file"), "").unwrap();
        assert!(moved.join("file").exists() && !name.join("file").exists());
        assert_eq!(folder.place(), moved);
        assert_eq!(shown(&folder.path.join("file")), moved.join("file"));
        folder.hold().unwrap();
        assert_eq!(folder.place(), moved, "it is held as before");
    }

    #[test]
    fn a_folder_that_was_deleted_is_created_again_only_where_nothing_has_its_name() {
        let place = tempfile::tempdir().unwrap();
        let name = place.path().join("run");
        let mut folder = held(name.clone());
        fs::remove_dir(&name).unwrap();
        fs::write(&name, "of another").unwrap();
        let refusal = format!("{:#}", folder.hold().unwrap_err());
        assert!(refusal.contains("exists"), "{refusal}");
        fs::remove_file(&name).unwrap();
        folder.hold().unwrap();
        fs::write(folder.path.join("file"), "").unwrap();
        assert!(name.join("file").exists());
    }
}
