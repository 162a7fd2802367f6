//! The program of a task on a running system. The workers' descriptions extend the catalogue; workers that are just restarting have not described
//! themselves yet, and are waited for.

use crate::command::check;
use crate::failure::Failure;
use crate::interrupt::Interrupt;
use crate::output;
use crate::system::System;
use anyhow::anyhow;
use ratn_model::diagnostic::Diagnostic;
use ratn_model::program::Program;
use std::collections::BTreeMap;
use std::path::Path;
use std::time::{Duration, Instant};

/// How long workers that are away, and process managers that do not answer, are waited for.
const PATIENCE: Duration = Duration::from_secs(10);
/// Interval at which they are asked.
const POLL: Duration = Duration::from_millis(250);

/// Loads the task. Where it uses an action that the catalogue does not have, and workers of the system are away, waits for their descriptions.
pub(super) async fn program(
    task: &Path,
    from: Option<&str>,
    system: &mut System,
    interrupt: &Interrupt,
) -> Result<Program, Failure> {
    let deadline = Instant::now() + PATIENCE;
    let mut is_said = false;
    loop {
        let findings = match check::found(task, from, &system.config.catalogue)? {
            Ok(program) => return Ok(program),
            Err(findings) => findings,
        };
        let lacks = check::is_lacking(&findings);
        let awaited = system.offered.awaited();
        if !lacks {
            return Err(check::refused(&findings));
        }
        if awaited.is_empty() {
            return Err(given_up(&findings, &system.offered.given_up));
        }
        if Instant::now() >= deadline {
            return Err(in_vain(&findings, &awaited));
        }
        if !is_said {
            output::progress(format_args!("waits for {} to say what they can do", awaited.join(", ")));
            is_said = true;
        }
        tokio::select! {
            () = tokio::time::sleep(POLL) => {}
            () = interrupt.asked_times(1) => return Err(anyhow!("interrupted before the run began").into()),
        }
        system.ask_again().await;
    }
}

/// The failure when the workers that could describe the action are not started any more.
fn given_up(findings: &[Diagnostic], given_up: &BTreeMap<String, String>) -> Failure {
    if given_up.is_empty() {
        return check::refused(findings);
    }
    let pools: Vec<String> = given_up.iter().map(|(kind, why)| format!("{kind} ({why})")).collect();
    let help = format!(
        "ratn: what workers of {} can do is not known, as none is started any more: `ratn ps` and `ratn logs` say why",
        pools.join(", ")
    );
    Failure::Refused(format!("{}\n{help}", check::refused(findings)))
}

fn in_vain(findings: &[Diagnostic], awaited: &[String]) -> Failure {
    let seconds = PATIENCE.as_secs();
    let help = format!(
        "ratn: {} have not been there for {seconds} s to say what they can do: `ratn ps` and `ratn logs` say what keeps them; start them, or name a \
         file that says it in the system's config (`catalogues`)",
        awaited.join(", ")
    );
    Failure::Refused(format!("{}\n{help}", check::refused(findings)))
}
