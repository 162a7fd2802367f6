//! `ratn completions SHELL` and `ratn man DIR`: shell completions and man pages of the command
//! line.

use crate::arguments::{Arguments, CompletionsArguments, ManArguments};
use crate::failure::Failure;
use crate::output;
use anyhow::Context;
use clap::CommandFactory;

const NAME: &str = "ratn";

/// Prints the completion script of a shell.
pub(crate) fn run(arguments: &CompletionsArguments) -> Result<(), Failure> {
    let mut script = Vec::new();
    clap_complete::generate(arguments.shell, &mut Arguments::command(), NAME, &mut script);
    Ok(output::result(String::from_utf8_lossy(&script).trim_end())?)
}

/// Writes `ratn.1`, and a page for each command, such as `ratn-run.1`.
pub(crate) fn man(arguments: &ManArguments) -> Result<(), Failure> {
    let directory = &arguments.directory;
    let cannot = || format!("cannot write man pages to {}", directory.display());
    std::fs::create_dir_all(directory).with_context(cannot)?;
    clap_mangen::generate_to(Arguments::command(), directory).with_context(cannot)?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn there_is_a_page_for_each_command() -> anyhow::Result<()> {
        let place = tempfile::tempdir()?;
        assert!(man(&ManArguments { directory: place.path().join("man") }).is_ok());
        for page in ["ratn.1", "ratn-run.1", "ratn-export.1", "ratn-resource-list.1"] {
            assert!(std::fs::read_to_string(place.path().join("man").join(page))?.contains(".TH"), "{page}");
        }
        Ok(())
    }
}
