//! `ratn check TASK`, and what `ratn run` does first.

use crate::arguments::CheckArguments;
use crate::failure::Failure;
use crate::system::config::SystemConfig;
use crate::{input, output};
use ratn_model::catalogue::Catalogue;
use ratn_model::diagnostic::Diagnostic;
use ratn_model::program::Program;
use std::path::Path;

/// Says what is wrong with a task file.
pub(crate) fn run(arguments: &CheckArguments) -> Result<(), Failure> {
    let config = SystemConfig::load(arguments.config.as_deref())?;
    let program = load(&arguments.task, &config.catalogue)?;
    // State 0 is the task itself.
    let states = program.states.len().saturating_sub(1);
    let plural = if states == 1 { "state" } else { "states" };
    output::progress(format_args!("{}: task `{}` is good: {states} {plural}", arguments.task.display(), program.name));
    Ok(())
}

/// Loads a task file; errors refuse it, warnings go to standard error.
pub(crate) fn load(path: &Path, catalogue: &Catalogue) -> Result<Program, Failure> {
    let text =
        input::read(path).map_err(|error| Failure::Refused(format!("{}: cannot be read: {error}", path.display())))?;
    load_text(&text, &path.display().to_string(), catalogue)
}

/// Loads a task file's text; `file` is its name in messages.
pub(crate) fn load_text(text: &str, file: &str, catalogue: &Catalogue) -> Result<Program, Failure> {
    match ratn_model::load::load(text, file, catalogue) {
        Ok(loaded) => {
            loaded.warnings.iter().for_each(output::progress);
            Ok(loaded.program)
        }
        Err(findings) => {
            let lines: Vec<String> = findings.iter().map(Diagnostic::to_string).collect();
            Err(Failure::Refused(lines.join("\n")))
        }
    }
}
