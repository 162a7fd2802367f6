//! The command of the user, as a library so that tests run the same code.
//!
//! [`main`] reads the command line and runs one of the commands in `command/`; `system/` starts and finds the other processes. What
//! runs a task is in `ratn-task-control`, what is made of event logs in `ratn-report`: both are libraries that print nothing.
//! Results go to stdout, everything else to stderr. Exit code 0 is success, 1 a failure, 2 something refused before anything
//! was started: a task file, a config or a command line; 4 a task's own outcome.

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

/// Whether these words, the name of the program first, are a command line that `ratn` takes; otherwise what it says to them. Nothing is
/// done: the test of the documentation asks about every command that is printed there.
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
            // clap gives 0 to --help and --version and 2 to a usage error, as we want it.
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

/// A quarter of what a call costs the resource manager is allocation; with this one it grants half as many again a second.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;
