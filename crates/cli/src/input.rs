//! Reads files that a user names: task files and configs, which are small regular files.

use ratn_model::load::MAX_SOURCE;
use std::path::Path;

/// The text of a file. A device or a pipe, which might never end, is refused, and so is a file that is too long for
/// a task file.
pub(crate) fn read(path: &Path) -> std::io::Result<String> {
    ratn_regular_file::read_text(path, MAX_SOURCE)
}

/// Libraries are found relative to the files that use them.
pub(crate) struct Libraries;

impl ratn_model::load::Files for Libraries {
    fn read(&self, using: &str, path: &str) -> Result<(String, String), String> {
        let file = Path::new(using).parent().unwrap_or(Path::new("")).join(path);
        let text = read(&file).map_err(|error| error.to_string())?;
        // Two paths to one file give one name, which is as short as possible.
        let name = file.canonicalize().unwrap_or(file);
        let here = std::env::current_dir().and_then(|here| here.canonicalize()).unwrap_or_default();
        Ok((name.strip_prefix(here).unwrap_or(&name).display().to_string(), text))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    #[test]
    fn a_library_is_found_from_the_file_that_uses_it_and_has_one_name() {
        use ratn_model::load::Files;
        let directory = tempfile::tempdir().unwrap();
        std::fs::create_dir(directory.path().join("parts")).unwrap();
        std::fs::write(directory.path().join("parts/a.yaml"), "task: a\n").unwrap();
        let using = directory.path().join("main.yaml").display().to_string();
        let (name, text) = Libraries.read(&using, "parts/a.yaml").unwrap();
        assert_eq!(text, "task: a\n");
        assert_eq!(Libraries.read(&using, "./parts/../parts/a.yaml").unwrap().0, name);
        // A library is also found from another library.
        assert_eq!(Libraries.read(&name, "a.yaml").unwrap().0, name);
        assert!(Libraries.read(&using, "parts").unwrap_err().contains("not a regular file"));
    }
}
