//! The one loop of task control: receive an event, log it, hand it to the executive, log its commands, perform them.
//!
//! Nothing is decided here. Whatever a command leads to comes back as an event through one bounded queue, so the event log is
//! the whole story of the run.

use super::log::LogWriter;
use super::performer::Performer;
use super::progress::Progress;
use crate::interrupt::Interrupt;
use anyhow::{Context, bail};
use ratn_executive::executive::Executive;
use ratn_executive::protocol::{Command, Event, Mode};
use ratn_model::catalogue::Catalogue;
use ratn_model::program::{Program, SUCCESS};
use ratn_model::value::Value;
use ratn_worker::robot_clock::RobotClock;
use ratn_world::tolerance::Tolerance;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;
use tokio::sync::mpsc;

/// Answers that the executive has not been given yet.
pub(super) const MAX_PENDING_EVENTS: usize = 1024;

/// A task to be run once.
#[derive(Debug, Clone)]
pub(crate) struct Run {
    pub(crate) program: Arc<Program>,
    pub(crate) catalogue: Arc<Catalogue>,
    pub(crate) parameters: BTreeMap<String, Value>,
    pub(crate) mode: Mode,
    pub(crate) seed: u64,
    /// The robot's seconds per second of wall time.
    pub(crate) speed: f64,
    /// Where the event log goes.
    pub(crate) log: PathBuf,
    /// Whether every node that starts and ends is printed.
    pub(crate) quiet: bool,
}

/// How a run ended.
#[derive(Debug, Clone)]
pub(crate) struct Ended {
    pub(crate) outcome: String,
    pub(crate) outputs: BTreeMap<String, Value>,
    pub(crate) reason: String,
    /// The robot's seconds from the first event to the last.
    pub(crate) makespan_s: f64,
}

/// Runs a task on a running system.
///
/// # Errors
/// When the system cannot be reached, the log cannot be written, or the user insists. A task that ends badly is no error: its
/// outcome says so.
pub(crate) async fn run(run: Run, endpoints: &super::Endpoints, interrupt: &Interrupt) -> anyhow::Result<Ended> {
    let mut log = LogWriter::create(&run.log)?;
    let (events, mut answers) = mpsc::channel(MAX_PENDING_EVENTS);
    let mut performer = Performer::connect(endpoints, run.catalogue.clone(), &run.program.name, events)
        .await
        .context("cannot begin the run")?;
    let (revision, world) = performer.root().await.context("cannot read the root world")?;

    let clock = RobotClock::start(run.speed);
    let mut executive = Executive::new(run.program.clone(), Tolerance::ROBOT);
    let mut progress = Progress::new(run.quiet);
    let mut event = Event::Started {
        task: run.program.name.clone(),
        digest: run.program.digest.clone(),
        mode: run.mode,
        parameters: run.parameters,
        seed: run.seed,
        world,
        revision,
        capacity: run.catalogue.resources.iter().map(|(kind, offer)| (kind.clone(), offer.count)).collect(),
        learned: Default::default(),
        origin: Default::default(),
    };
    let mut asked_to_abort = false;
    let ended = 'run: loop {
        let now = clock.now();
        let commands = executive.handle(now, event.clone());
        log.append(now, &event, &commands)?;
        progress.follow(now, &event, &commands);
        for command in commands {
            if let Command::End { outcome, outputs, reason } = command {
                break 'run Ended { outcome, outputs, reason, makespan_s: now.seconds() };
            }
            performer.perform(command)?;
        }
        event = loop {
            let answer = tokio::select! {
                answer = answers.recv() => answer.context("nothing can answer any more")?,
                () = interrupt.asked_times(1), if !asked_to_abort => {
                    asked_to_abort = true;
                    Event::AbortRequested { reason: "the user asked for it".into() }.into()
                }
                () = performer.lost(), if !asked_to_abort => {
                    asked_to_abort = true;
                    let reason = "the session with the resource manager, and every lease, is lost".into();
                    Event::AbortRequested { reason }.into()
                }
                () = interrupt.asked_times(2) => {
                    let _ = performer.close().await;
                    bail!("interrupted twice: the run was left where it was");
                }
            };
            if let Some(event) = performer.accept(answer) {
                break event;
            }
        };
    };
    match performer.close().await {
        // A success of which not everything is known afterwards is none.
        Err(error) if ended.outcome == SUCCESS => Err(error),
        // The reason is in the outcome already, or matters less.
        _ => Ok(ended),
    }
}
