//! `ratn run TASK`: on the system that runs here, or on one started for it; `ratn run --resume LOG`.

mod described;
mod resume;

use super::{blocking_here, check};
use crate::arguments::{JsonArgument, ModeArgument, RunArguments, SystemArguments, UrgencyArgument};
use crate::colour::can_paint;
use crate::failure::Failure;
use crate::fitted::shortened;
use crate::interrupt::Interrupt;
use crate::live::{Live, Way};
use crate::output;
use crate::repainting::json_text;
use crate::system::config::SystemConfig;
use crate::system::{System, public_directory};
use anyhow::{Context, anyhow, bail};
use ratn_event_log as log;
use ratn_executive::protocol::Mode;
use ratn_model::program::{ABORTED, PREEMPTED, SUCCESS};
use ratn_model::value::Value;
use ratn_report::gantt;
use ratn_report::statistics::Statistics;
use ratn_report::timeline::Timeline;
use ratn_task_control::learn;
use ratn_task_control::shell::{self, Ended, Place, Run, Urgency};
use ratn_worker::session::Standing;
use ratn_worker::tls::ClientTls;
use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::SystemTime;

/// Maximum number of characters of an output on a terminal.
const MOST_OF_AN_OUTPUT: usize = 300;

impl From<ModeArgument> for Mode {
    fn from(mode: ModeArgument) -> Mode {
        match mode {
            ModeArgument::Hsm => Mode::Hsm,
            ModeArgument::Cdtn => Mode::Cdtn,
        }
    }
}

/// Runs a task once, or resumes a run.
pub(crate) fn run(arguments: &RunArguments, tls: &ClientTls) -> Result<(), Failure> {
    if arguments.quiet {
        output::be_quiet();
    }
    blocking_here(async {
        let interrupt = Interrupt::listen()?;
        let directory = public_directory(arguments.runtime_dir.as_deref())?;
        match (&arguments.resume, &arguments.task) {
            (Some(log), task) => {
                Box::pin(resume::run(arguments, log, task.as_deref(), &directory, tls, &interrupt)).await
            }
            (None, Some(task)) => begin(arguments, task, &directory, tls, &interrupt).await,
            (None, None) => Err(Failure::Refused("ratn: no task file is named".to_owned())),
        }
    })
}

/// Starts a system for one run.
async fn start(
    config: &SystemConfig,
    tls: &ClientTls,
    directory: &Path,
    interrupt: &Interrupt,
) -> Result<System, Failure> {
    output::progress(format_args!("no system runs in {}: starting one for this run", directory.display()));
    let system = starting(Box::pin(System::start_private(config.clone(), tls)), interrupt).await?;
    output::progress(format_args!("its runtime directory: {}", system.directory().path().display()));
    Ok(system)
}

async fn begin(
    arguments: &RunArguments,
    task: &Path,
    directory: &Path,
    tls: &ClientTls,
    interrupt: &Interrupt,
) -> Result<(), Failure> {
    let mut started = None;
    let ended = Box::pin(begin_on(&mut started, arguments, task, directory, tls, interrupt)).await;
    // The run was refused behind the start of its system.
    if let Some(system) = started {
        system.stop().await;
    }
    ended
}

/// Runs the task on the system that is there, or on one of its own: in `started` if that was started before the run was known to be accepted.
async fn begin_on(
    started: &mut Option<System>,
    arguments: &RunArguments,
    task: &Path,
    directory: &Path,
    tls: &ClientTls,
    interrupt: &Interrupt,
) -> Result<(), Failure> {
    let robot = arguments.robot.as_deref();
    let given = arguments.config.as_deref().map(|file| SystemConfig::load_for(Some(file), robot)).transpose()?;
    let tls = &given.as_ref().map_or_else(|| Ok(tls.clone()), |config| config.client_tls(tls))?;
    let mut found = System::find(directory, given.clone(), tls).await?;
    if found.is_none() && arguments.runtime_dir.is_some() {
        let place = directory.display();
        return Err(Failure::Refused(format!(
            "ratn: no system runs in {place}: start one with `ratn up --runtime-dir {place}`, or leave --runtime-dir out"
        )));
    }
    let mut config = match &found {
        Some(system) => system.config.clone(),
        None => given.map_or_else(|| SystemConfig::load_for(None, robot), Ok)?,
    };
    config.apply(&SystemArguments { speed: arguments.speed, ..SystemArguments::default() });

    // What can be refused without a system is refused before one is started.
    if let Some(system) = &found {
        system.mismatches.iter().for_each(|what| output::progress(format_args!("warning: {what}")));
    }
    let from = arguments.from.as_deref();
    let program = match &mut found {
        Some(system) => Box::pin(described::program(task, from, system, interrupt)).await?,
        None => match check::found(task, from, &config.catalogue)? {
            Ok(program) => program,
            // A worker of this config may say it of itself once it runs.
            Err(findings) if check::is_lacking(&findings) && !config.may_describe().is_empty() => {
                let system = started.insert(start(&config, tls, directory, interrupt).await?);
                Box::pin(described::program(task, from, system, interrupt)).await?
            }
            Err(findings) => return Err(check::refused(&findings)),
        },
    };
    let parameters = program
        .bind_parameters(&arguments.set)
        .map_err(|error| Failure::Refused(format!("{}: error[invalid-parameter]: {error}", task.display())))?;
    if found.is_some() && robot.is_some() {
        let message = format!(
            "ratn: a system runs in {}: its robot was chosen when it was started; leave --robot out",
            directory.display()
        );
        return Err(Failure::Refused(message));
    }
    if found.is_some() && arguments.speed.is_some() {
        let message = format!(
            "ratn: a system runs in {}: its speed was chosen when it was started; leave --speed out",
            directory.display()
        );
        return Err(Failure::Refused(message));
    }
    if let Some(log) = &arguments.log {
        output::check_new(log, "name another file; `ratn run --resume LOG` goes on with the run of an event log")?;
    }
    if let Some(chart) = &arguments.gantt {
        output::check_writable(chart)?;
    }
    Beside::of(arguments)?;
    let learned = learn::from_files(&arguments.learn, &program.name, &output::messages())?;
    let log = arguments.log.clone().map_or_else(|| log_file(&program.name), Ok)?;

    let breakpoints = shell::breakpoints(&program, &arguments.breakpoints)
        .map_err(|why| Failure::Refused(format!("ratn: --break: {why}")))?;
    let system = match found {
        Some(system) => {
            output::progress(format_args!("on the system in {}", directory.display()));
            if let Some(before) = system.left_behind().await {
                output::progress(before);
            }
            system
        }
        None => match started.take() {
            Some(system) => system,
            None => start(&config, tls, directory, interrupt).await?,
        },
    };
    system.offered.lacking(&program).iter().for_each(|what| output::progress(format_args!("warning: {what}")));
    let way = way(arguments);
    let run = Run {
        program: Arc::new(program),
        file: std::path::absolute(task)?.display().to_string(),
        from: arguments.from.clone(),
        parameters,
        mode: arguments.mode.into(),
        seed: arguments.seed,
        learned,
        log: log.clone(),
        breakpoints,
        quiet: arguments.quiet || way == Some(Way::Painted),
        checkpoint_every: arguments.checkpoint_every,
    };
    let live = way.map(|way| Live::follow(&log, way, system.place().speed, system.directory().path()));
    let ended = on_system(run, system, Beside::of(arguments)?, interrupt, async |_| Ok(())).await;
    drop(live);
    output::progress(format_args!("event log: {}", log.display()));
    let (ended, ()) = ended?;
    conclude(&ended, &log, arguments)
}

impl From<UrgencyArgument> for Urgency {
    fn from(argument: UrgencyArgument) -> Urgency {
        match argument {
            UrgencyArgument::Low => Urgency::Low,
            UrgencyArgument::Normal => Urgency::Normal,
            UrgencyArgument::High => Urgency::High,
        }
    }
}

/// How the run's progress is shown, in addition to the lines of its nodes, or on a terminal in place of them.
fn way(arguments: &RunArguments) -> Option<Way> {
    let is_seen = std::io::stderr().is_terminal() && can_paint();
    match arguments.json {
        Some(JsonArgument::Lines) => Some(Way::Lines),
        _ => (is_seen && !arguments.quiet).then_some(Way::Painted),
    }
}

fn conclude(ended: &Ended, log: &Path, arguments: &RunArguments) -> Result<(), Failure> {
    say(ended, log, arguments)?;
    match ended.outcome.as_str() {
        SUCCESS => Ok(()),
        outcome @ (ABORTED | PREEMPTED) => Err(anyhow!("the task ended with {outcome}").into()),
        outcome => Err(Failure::Outcome(outcome.to_owned())),
    }
}

/// Starts something, unless the user interrupts it.
pub(super) async fn starting<T>(
    start: impl Future<Output = anyhow::Result<T>>,
    interrupt: &Interrupt,
) -> anyhow::Result<T> {
    tokio::select! {
        started = start => started,
        () = interrupt.asked_times(1) => bail!("interrupted before the run began"),
    }
}

/// How a run competes with others on its system.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Beside {
    alone: bool,
    urgency: Urgency,
    standing: Standing,
}

impl Beside {
    /// For a new run.
    fn of(arguments: &RunArguments) -> Result<Beside, Failure> {
        let due = arguments.due.map(|due| due.from(SystemTime::now())).transpose();
        let due = due.map_err(|why| Failure::Refused(format!("ratn: {why}")))?;
        let usual = Standing::default();
        let standing = Standing { share: arguments.share.unwrap_or(usual.share), due };
        Ok(Beside { alone: arguments.alone, urgency: arguments.urgency.into(), standing })
    }

    /// For a resumed run that had this share: it keeps the share unless another one is requested.
    fn going_on(arguments: &RunArguments, share: Option<f64>) -> Result<Beside, Failure> {
        let mut beside = Beside::of(arguments)?;
        let kept = share.filter(|share| arguments.share.is_none() && Standing::SHARES.contains(share));
        beside.standing.share = kept.unwrap_or(beside.standing.share);
        Ok(beside)
    }

    fn on(self, place: Place) -> Place {
        let Beside { alone, urgency, standing } = self;
        Place { alone, urgency, standing, ..place }
    }
}

/// Runs a task, alone on its system or among others with the given urgency. Calls `afterwards` to examine the system, and ends the system if
/// it was started for this run.
pub(super) async fn on_system<T>(
    run: Run,
    mut system: System,
    beside: Beside,
    interrupt: &Interrupt,
    afterwards: impl AsyncFnOnce(&System) -> anyhow::Result<T>,
) -> anyhow::Result<(Ended, T)> {
    let place = beside.on(system.place());
    let ended = tokio::select! {
        ended = Box::pin(shell::run(run, &place, interrupt)) => ended,
        error = system.one_ended() => Err(error.context("a part of the system ended during the run")),
    };
    let answer = match ended {
        Ok(ended) => afterwards(&system).await.map(|answer| (ended, answer)),
        Err(error) => Err(error),
    };
    system.stop().await;
    answer
}

fn say(ended: &Ended, log: &Path, arguments: &RunArguments) -> anyhow::Result<()> {
    let timeline = Timeline::of(&log::read(log)?.lines);
    if let Some(path) = &arguments.gantt {
        gantt::write(path, &timeline, None).with_context(|| format!("cannot write {}", path.display()))?;
        output::progress(format_args!("chart: {}", path.display()));
    }
    let statistics = Statistics::of(&timeline);
    if let Some(how) = arguments.json {
        let outputs: serde_json::Map<_, _> = ended.outputs.iter().map(|(k, v)| (k.clone(), plain(v))).collect();
        let document = serde_json::json!({
            "outcome": ended.outcome, "reason": ended.reason, "outputs": outputs,
            "makespan_s": ended.makespan_s, "log": log, "statistics": statistics,
        });
        return output::result(json_text(&document, how == JsonArgument::Lines)?);
    }
    // A long covariance is of no use at a terminal, and would scroll the rest out of sight.
    let most = if std::io::stdout().is_terminal() { MOST_OF_AN_OUTPUT } else { usize::MAX };
    let outputs = ended.outputs.iter().map(|(name, value)| {
        format!("\n{name} = {}", shortened(&value.to_string(), most, "--json prints all, and so does a pipe"))
    });
    output::result(format_args!("{statistics}{}", outputs.collect::<String>()))
}

/// A value as other programs expect it; values without a plain form are written as in an event log.
fn plain(value: &Value) -> serde_json::Value {
    match value {
        Value::Null => serde_json::Value::Null,
        Value::Bool(b) => (*b).into(),
        Value::Int(i) => (*i).into(),
        Value::Float(x) => (*x).into(),
        Value::String(s) => s.as_str().into(),
        Value::Joints(positions) => positions.clone().into(),
        Value::List(items) => items.iter().map(plain).collect(),
        Value::Map(fields) => fields.iter().map(|(name, value)| (name.clone(), plain(value))).collect(),
        Value::Pose(_) | Value::Trajectory(_) | Value::Bytes(_) => serde_json::to_value(value).unwrap_or_default(),
    }
}

fn log_file(task: &str) -> anyhow::Result<PathBuf> {
    let name = format!("ratn-{task}-");
    let file =
        tempfile::Builder::new().prefix(&name).suffix(".jsonl").tempfile().context("cannot make an event log")?;
    Ok(file.into_temp_path().keep()?)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::panic, reason = "a test may panic")]

    use super::*;
    use crate::arguments::{Arguments, Command};
    use clap::Parser;

    fn arguments(words: &[&str]) -> RunArguments {
        match Arguments::try_parse_from(["ratn", "run"].iter().chain(words)).map(|arguments| arguments.command) {
            Ok(Command::Run(arguments)) => arguments,
            _ => panic!("{words:?}"),
        }
    }

    #[test]
    fn a_run_that_is_resumed_keeps_its_share_unless_another_one_is_asked_for() {
        let share = |words: &[&str], before| {
            let beside = Beside::going_on(&arguments(words), before);
            beside.map(|beside| beside.standing.share).ok()
        };
        assert_eq!(share(&["--resume", "log.jsonl"], Some(2.5)), Some(2.5));
        assert_eq!(share(&["--resume", "log.jsonl", "--share", "1"], Some(2.5)), Some(1.0));
        assert_eq!(share(&["--resume", "log.jsonl"], None), Some(1.0));
        // The log may have been edited.
        assert_eq!(share(&["--resume", "log.jsonl"], Some(-3.0)), Some(1.0));
    }
}
