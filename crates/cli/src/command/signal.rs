//! `ratn signal RUN NAME [VALUE]` and `ratn answer RUN CHOICE`: signals and answers that states of
//! a run wait for.
//!
//! Exit code 0 when the message is in the run's log, on the disk.

use super::blocking_on;
use crate::arguments::{AnswerArguments, SignalArguments};
use crate::failure::Failure;
use crate::output;
use crate::system::public_directory;
use anyhow::Context;
use ratn_model::parameters;
use ratn_model::value::Value;
use ratn_task_control::control::{self, Message};
use std::path::Path;

/// Sends a signal.
pub(crate) fn signal(arguments: &SignalArguments) -> Result<(), Failure> {
    let value = match &arguments.value {
        None => Value::Null,
        Some(text) => parameters::constant(text).map_err(|why| {
            Failure::Refused(format!("ratn: `{text}` is no value: {why}; quote a text twice: \"'two words'\""))
        })?,
    };
    let (run, signal) = (arguments.run.clone(), arguments.signal.clone());
    send(arguments.runtime_dir.as_deref(), &Message::Signal { run, signal, value })
}

/// Answers a question.
pub(crate) fn answer(arguments: &AnswerArguments) -> Result<(), Failure> {
    let (run, state, choice) = (arguments.run.clone(), arguments.state.clone(), arguments.choice.clone());
    send(arguments.runtime_dir.as_deref(), &Message::Answer { run, state, choice })
}

/// Sends a message to the run of a system, and prints the result.
pub(crate) fn send(directory: Option<&Path>, message: &Message) -> Result<(), Failure> {
    blocking_on(tokio::runtime::Builder::new_current_thread(), async {
        let directory = public_directory(directory)?;
        let place = directory.display();
        match control::send(&directory, message).await {
            Err(error) if control::is_nobody(&error) => {
                Err(anyhow::anyhow!("no run is under way in {place}: say the `--runtime-dir` of its system").into())
            }
            Err(error) if control::is_uncertain(&error) => Err(anyhow::anyhow!("{error} (system in {place})").into()),
            sent => {
                let said = sent.with_context(|| format!("the run in {place} does not take that"))?;
                Ok(output::result(said)?)
            }
        }
    })
}
