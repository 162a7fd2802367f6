//! How a command ends when it does not succeed.

use ratn_task_control::NotStarted;
use ratn_task_control::learn::LearnError;
use std::fmt;
use std::process::ExitCode;

/// Why a command did not do what was asked.
#[derive(Debug)]
pub(crate) enum Failure {
    /// Refused before anything was started; the message is complete.
    Refused(String),
    /// Something went wrong on the way.
    Failed(anyhow::Error),
    /// What was held was lost before the end.
    Lost(String),
    /// A task ended with an outcome of its own, which its user may have wanted to know.
    Outcome(String),
    /// A program that was run for the user ended with this code, which is then the command's.
    Program(u8),
}

/// The task ended neither with success nor badly.
const EXIT_CODE_OUTCOME: u8 = 4;
/// What was held for the user was lost: "try again later", as `sysexits.h` has it.
const EXIT_CODE_LOST: u8 = 75;

impl Failure {
    /// 2 for what was refused, 1 for what failed, 4 for an outcome of a task's own, 75 for what was lost, the program's where one was run.
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
