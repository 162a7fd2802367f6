//! `ratn run --resume LOG`: checks whether the run can be resumed before anything is changed, then resumes
//! it.

use super::{Beside, conclude, described};
use crate::arguments::RunArguments;
use crate::failure::Failure;
use crate::interrupt::Interrupt;
use crate::output;
use crate::system::System;
use crate::system::config::SystemConfig;
use ratn_event_log::LogWriter;
use ratn_task_control::history::{History, ReplayError};
use ratn_task_control::shell::{self, Resumption};
use ratn_worker::tls::ClientTls;
use std::path::Path;

/// Resumes the run whose log is `file`.
pub(super) async fn run(
    arguments: &RunArguments,
    file: &Path,
    task: Option<&Path>,
    directory: &Path,
    tls: &ClientTls,
    interrupt: &Interrupt,
) -> Result<(), Failure> {
    let refused = |reason: &dyn std::fmt::Display| {
        Failure::Refused(format!("ratn: cannot resume the run of {}: {reason}", file.display()))
    };
    if let Some(chart) = &arguments.gantt {
        output::check_writable(chart)?;
    }
    // Wrong arguments are refused first.
    Beside::of(arguments)?;
    // From here on no other process can resume it.
    let log = |error| refused(&format_args!("{:#}", anyhow::Error::from(error)));
    let writer = LogWriter::go_on(file).map_err(log)?;
    let history = History::of(&writer, output::messages()).map_err(log)?;
    let task = task.map(Path::to_owned).or_else(|| history.task());
    let task = task.ok_or_else(|| refused(&"it does not name its task file: say `ratn run --resume LOG TASK`"))?;
    let given = arguments.config.as_deref().map(|file| SystemConfig::load(Some(file))).transpose()?;
    let tls = &given.as_ref().map_or_else(|| Ok(tls.clone()), |config| config.client_tls(tls))?;
    let Some(mut system) = System::find(directory, given, tls).await? else {
        let place = directory.display();
        return Err(refused(&format_args!(
            "no system runs in {place}: a run goes on where it was, on a system that outlives it (`ratn up`)"
        )));
    };
    let program = Box::pin(described::program(&task, history.from().as_deref(), &mut system, interrupt)).await?;
    let resumption = Resumption::new(program, history, writer, arguments.checkpoint_every)
        .map_err(|error| refused(&format_args!("{:#}", anyhow::Error::from(error))))?;
    let beside = Beside::going_on(arguments, resumption.share())?;
    output::progress(format_args!("on the system in {}", directory.display()));
    let place = beside.on(system.place());
    let ended = tokio::select! {
        ended = shell::resume(resumption, &place, interrupt) => ended,
        error = system.one_ended() => Err(error.context("a part of the system ended during the run")),
    };
    let ended = match ended {
        // The run has ended, so there is nothing to do.
        Err(error) if error.is::<ReplayError>() => return Err(refused(&error)),
        ended => ended?,
    };
    conclude(&ended, file, arguments)
}
