//! How a command ends without success.

use ratn_task_control::NotStarted;
use ratn_task_control::learn::LearnError;
use std::fmt;
use std::process::ExitCode;

/// Why a command did not do what was requested.
#[derive(Debug)]
pub(crate) enum Failure {
    /// Refused before anything was started; the message is complete.
    Refused(String),
    /// An error occurred during the command.
    Failed(anyhow::Error),
    /// A resource that was held for the user was lost before the end.
    Lost(String),
    /// A task ended with an outcome other than success or failure.
    Outcome(String),
    /// A program that was run for the user ended with this exit code, which becomes the command's.
    Program(u8),
}

/// The task ended with an outcome of its own.
const EXIT_CODE_OUTCOME: u8 = 4;
/// A held resource was lost: "try again later", as in `sysexits.h`.
const EXIT_CODE_LOST: u8 = 75;

impl Failure {
    /// 2 for a refusal, 1 for a failure, 4 for a task's own outcome, 75 for a loss, and the program's own code where one was run.
    pub(crate) fn exit_code(&self) -> ExitCode {
        match self {
            Failure::Refused(_) => ExitCode::from(2),
            Failure::Failed(_) => ExitCode::FAILURE,
            Failure::Outcome(_) => ExitCode::from(EXIT_CODE_OUTCOME),
            Failure::Lost(_) => ExitCode::from(EXIT_CODE_LOST),
            Failure::Program(code) => ExitCode::from(*code),
        }
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Failure::Refused(message) => f.write_str(message),
            Failure::Failed(error) => write!(f, "ratn: {error:#}"),
            Failure::Outcome(outcome) => write!(f, "ratn: the task ended with {outcome}, an outcome of its own"),
            Failure::Lost(what) => write!(f, "ratn: lost: {what}"),
            Failure::Program(code) => write!(f, "ratn: the program ended with exit code {code}"),
        }
    }
}

impl<E: Into<anyhow::Error>> From<E> for Failure {
    fn from(error: E) -> Self {
        let error = error.into();
        if error.is::<NotStarted>() || error.is::<LearnError>() {
            Failure::Refused(format!("ratn: {error:#}"))
        } else {
            Failure::Failed(error)
        }
    }
}
