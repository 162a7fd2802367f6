//! One file per command of the user; `roles.rs` holds the daemons and workers.

mod report;

use crate::arguments::Command;
use crate::failure::Failure;

/// Runs one command to its end.
pub(crate) fn run(command: Command) -> Result<(), Failure> {
    match command {
        Command::Report(arguments) => report::run(&arguments),
        _ => Err(Failure::Refused("not there yet".into())),
    }
}
