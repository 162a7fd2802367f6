//! The program of a task on a system that runs. What workers say of themselves extends the catalogue; those that have just been started again have
//! not said it yet: they are waited for.

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

/// Workers that are away, and process managers that do not answer, are waited for so long.
const PATIENCE: Duration = Duration::from_secs(10);
/// And are asked for so often.
const POLL: Duration = Duration::from_millis(250);
/// What the findings are called of an action that nobody has described.
const NOT_DESCRIBED: [&str; 2] = ["unknown-provider", "unknown-action"];

/// Loads the task; where it performs what the catalogue does not have, and workers of the system are away, when they have described themselves.
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
        let lacks = findings.iter().any(|finding| NOT_DESCRIBED.contains(&finding.rule.as_str()));
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

/// Whoever could say it is not being started any more.
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
