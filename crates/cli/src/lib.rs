//! The `ratn` command as a library, so that tests run the same code.
//!
//! [`main`] parses the command line and runs one of the commands in `command/`; `system/` starts and finds the other processes.
//! `ratn-task-control` runs tasks, `ratn-report` evaluates event logs: both are libraries that print nothing. Results go to stdout,
//! everything else to stderr. Exit code 0 is success, 1 a failure, 2 a refusal before anything was started (of a task file, a config or
//! a command line), 4 a task's own outcome.

mod arguments;
mod colour;
mod columns;
mod command;
mod failure;
mod fitted;
mod input;
mod interrupt;
mod live;
mod output;
mod repainting;
mod system;

use clap::Parser;
use std::process::ExitCode;

/// Whether `ratn` accepts these words (the name of the program first) as a command line; otherwise its message. Nothing is executed:
/// the test of the documentation asks this for every command that is printed there.
///
/// # Errors
/// The message that a user would see, also for `--help` and `--version`.
pub fn would_take(words: &[String]) -> Result<(), String> {
    arguments::Arguments::try_parse_from(words).map(drop).map_err(|refusal| refusal.to_string())
}

/// Runs the command line of this process.
pub fn main() -> ExitCode {
    let arguments = match arguments::Arguments::try_parse() {
        Ok(arguments) => arguments,
        Err(error) => {
            output::usage(&error);
            // clap returns 0 for --help and --version and 2 for a usage error, as intended.
            return ExitCode::from(u8::try_from(error.exit_code()).unwrap_or(1));
        }
    };
    match command::run(arguments.command) {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            output::failure(&failure);
            failure.exit_code()
        }
    }
}

/// A quarter of the resource manager's time per call is allocation; with this allocator it grants half as many again per second.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;
