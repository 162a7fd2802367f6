//! Places in the code where a test can make a running process panic, to see that the process then ends and that another one takes its place.
//!
//! Each place has a name and calls [`panic_point`]. A process that was started with [`VARIABLE`] panics at a place once the folder that the
//! variable names has a file of the place's name. The place removes the file first, so the process that is started next goes on.
//!
//! In a build without debug assertions (every release) there are no such places: the function is empty, and the variable is not read.

/// The environment variable with the folder.
pub const VARIABLE: &str = "RATN_PANIC_POINTS";

/// Panics if a test asks for it; see the module.
///
/// # Panics
/// In a build with debug assertions, where the folder of [`VARIABLE`] has a file of this name.
#[inline]
pub fn panic_point(name: &str) {
    #[cfg(debug_assertions)]
    in_debug_builds::panic_point(name);
    #[cfg(not(debug_assertions))]
    let _ = name;
}

#[cfg(debug_assertions)]
mod in_debug_builds {
    use std::path::{Path, PathBuf};
    use std::sync::OnceLock;

    static FOLDER: OnceLock<Option<PathBuf>> = OnceLock::new();

    pub(super) fn panic_point(name: &str) {
        let folder = FOLDER.get_or_init(|| std::env::var_os(super::VARIABLE).map(PathBuf::from));
        if folder.as_deref().is_some_and(|folder| is_asked_for(folder, name)) {
            panic!("a test asked for a panic at `{name}`");
        }
    }

    /// Once for each file.
    pub(super) fn is_asked_for(folder: &Path, name: &str) -> bool {
        std::fs::remove_file(folder.join(name)).is_ok()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]

    #[test]
    #[cfg(debug_assertions)]
    fn a_file_asks_for_one_panic_at_the_place_of_its_name() {
        let folder = tempfile::tempdir().unwrap();
        let is_asked_for = |name| super::in_debug_builds::is_asked_for(folder.path(), name);
        assert!(!is_asked_for("spawner"));
        std::fs::write(folder.path().join("spawner"), "").unwrap();
        assert!(!is_asked_for("session"), "another place");
        assert!(is_asked_for("spawner"));
        assert!(!is_asked_for("spawner"), "once");
        super::panic_point("spawner");
    }
}
