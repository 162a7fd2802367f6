//! Points in the code at which a test can make a running process panic, to check that the process then ends and another one takes over; or
//! hang, if the file contains [`HANG`].
//!
//! Each point has a name and calls [`panic_point`]. A process that was started with [`VARIABLE`] panics at a point when the folder in that
//! variable contains a file with the point's name. The point removes the file first, so that the next process goes on.
//!
//! In a build without debug assertions (every release) the function is empty, and the variable is not read.

/// The environment variable with the folder.
pub const VARIABLE: &str = "RATN_PANIC_POINTS";

/// The content of a file that makes a thread hang at its point instead of panicking.
pub const HANG: &str = "hang";

/// Panics, or never returns, if a test asks for it; see the module.
///
/// # Panics
/// In a build with debug assertions, if the folder in [`VARIABLE`] contains a file of this name.
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
        let asked = folder.as_deref().and_then(|folder| asked_for(folder, name));
        if asked.as_deref() == Some(super::HANG) {
            loop {
                std::thread::park();
            }
        }
        if asked.is_some() {
            panic!("a test asked for a panic at `{name}`");
        }
    }

    /// The content of the file, which is removed.
    pub(super) fn asked_for(folder: &Path, name: &str) -> Option<String> {
        let file = folder.join(name);
        let says = std::fs::read_to_string(&file).ok()?;
        std::fs::remove_file(file).is_ok().then_some(says)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]

    #[test]
    #[cfg(debug_assertions)]
    fn a_file_asks_for_one_panic_at_the_place_of_its_name() {
        let folder = tempfile::tempdir().unwrap();
        let asked_for = |name| super::in_debug_builds::asked_for(folder.path(), name);
        assert_eq!(asked_for("spawner"), None);
        std::fs::write(folder.path().join("spawner"), super::HANG).unwrap();
        assert_eq!(asked_for("session"), None, "another place");
        assert_eq!(asked_for("spawner").as_deref(), Some(super::HANG));
        assert_eq!(asked_for("spawner"), None, "once");
        super::panic_point("spawner");
    }
}
