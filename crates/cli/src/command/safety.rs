//! `ratn stop`, `ratn hold`, `ratn go-on`: emergency stop and hold of every driver of a system.
//!
//! The cell of this machine is asked at once, and then the other drivers that the resource manager lists: so the cell is stopped even
//! without the resource manager. Exit code 0 only where every driver has confirmed.

use super::blocking_on;
use crate::arguments::{GoOnArguments, HoldArguments, SafetyArguments, StopArguments};
use crate::columns::columns;
use crate::failure::Failure;
use crate::output;
use crate::system::drivers::{self, Answers};
use crate::system::public_directory;
use anyhow::anyhow;
use ratn_worker::client::Channels;
use ratn_worker::endpoint::Endpoint;
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::safety::{SafetyClient, SafetyState};
use ratn_worker::tls::ClientTls;
use std::collections::BTreeSet;
use std::time::Duration;

/// Timeout of a confirmation.
const ANSWER_DEADLINE: Duration = Duration::from_secs(3);

/// The request to every driver.
#[derive(Debug, Clone)]
enum Question {
    Stop(String),
    Clear,
    Hold(String),
    GoOn,
    Show,
}

/// `ratn stop`.
pub(crate) fn stop(arguments: &StopArguments, tls: &ClientTls) -> Result<(), Failure> {
    let question = match (arguments.clear, arguments.show) {
        (true, _) => Question::Clear,
        (_, true) => Question::Show,
        _ => Question::Stop(reason(&arguments.reason)),
    };
    ask_all(&arguments.drivers, tls, &question)
}

/// `ratn hold`.
pub(crate) fn hold(arguments: &HoldArguments, tls: &ClientTls) -> Result<(), Failure> {
    ask_all(&arguments.drivers, tls, &Question::Hold(reason(&arguments.reason)))
}

/// `ratn go-on`.
pub(crate) fn go_on(arguments: &GoOnArguments, tls: &ClientTls) -> Result<(), Failure> {
    ask_all(&arguments.drivers, tls, &Question::GoOn)
}

fn reason(said: &Option<String>) -> String {
    said.clone().unwrap_or_else(|| format!("by the user with uid {}", nix::unistd::getuid()))
}

fn ask_all(arguments: &SafetyArguments, tls: &ClientTls, question: &Question) -> Result<(), Failure> {
    blocking_on(tokio::runtime::Builder::new_current_thread(), async {
        let directory = RuntimeDirectory::at(public_directory(arguments.runtime_dir.as_deref())?);
        let channels = Channels::new(tls);
        let known: BTreeSet<Endpoint> =
            arguments.endpoint.iter().cloned().chain(directory.find(ratn_cell::ROLE)).collect();
        // Known drivers are asked while the others are looked up.
        let (mut answers, offered) =
            tokio::join!(ask(&channels, question, &known), drivers::offered(&channels, &directory, ANSWER_DEADLINE));
        let others = match offered {
            Ok(offered) => offered.difference(&known).cloned().collect(),
            Err(reason) if known.is_empty() => {
                return Err(Failure::Refused(format!("ratn: no driver is known: {reason}")));
            }
            Err(reason) => {
                output::progress(format_args!("only the drivers of this machine are asked: {reason}"));
                BTreeSet::new()
            }
        };
        answers.extend(ask(&channels, question, &others).await);
        if answers.is_empty() {
            return Err(Failure::Refused("ratn: no driver of this system offers anything that moves".to_owned()));
        }
        output::result(table(&answers))?;
        let silent = answers.values().filter(|answer| answer.is_err()).count();
        match silent {
            0 => Ok(()),
            _ => Err(anyhow!("{silent} of {} drivers did not confirm: go and look", answers.len()).into()),
        }
    })
}

async fn ask(channels: &Channels, question: &Question, drivers: &BTreeSet<Endpoint>) -> Answers {
    let put = async |driver: SafetyClient| match question {
        Question::Stop(reason) => driver.stop(reason).await,
        Question::Clear => driver.clear().await,
        Question::Hold(reason) => driver.hold(reason).await,
        Question::GoOn => driver.go_on().await,
        Question::Show => driver.state().await,
    };
    drivers::ask(channels, drivers, ANSWER_DEADLINE, put).await
}

fn table(answers: &Answers) -> String {
    let row = |(endpoint, answer): (&Endpoint, &Result<SafetyState, String>)| {
        let (state, reason) = match answer {
            Ok(SafetyState::Ready) => ("ready", ""),
            Ok(SafetyState::Held { reason }) => ("held", reason.as_str()),
            Ok(SafetyState::Stopped { reason }) => ("stopped", reason.as_str()),
            Err(reason) => ("NOT CONFIRMED", reason.as_str()),
        };
        [endpoint.to_string(), state.to_owned(), reason.to_owned()]
    };
    columns(&["DRIVER", "STATE", "REASON"], answers.iter().map(row).collect())
}
