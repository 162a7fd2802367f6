//! `ratn status`: what runs, what is held by whom, and what waits for what and why.
//!
//! The runs report their own state, over their sockets in the runtime directory; holders, waiting requests and runs of other hosts come from
//! the resource manager. Exit code 0 also where no run is in progress; 2 where no system runs.

use super::{blocking_on, unanswered};
use crate::arguments::StatusArguments;
use crate::colour::Colours;
use crate::columns::aligned;
use crate::failure::Failure;
use crate::repainting::{self, json_text};
use crate::system::drivers::{self, Answers};
use crate::system::public_directory;
use ratn_daemon::resource_manager;
use ratn_model::program::WORLD_MODEL;
use ratn_model::readable::in_line;
use ratn_model::resource::Quantity;
use ratn_proto::types::{Resource, WaitingAcquire};
use ratn_report::statistics::mode_name;
use ratn_task_control::RUN_KIND;
use ratn_task_control::control::{self, Awaiting, RunStatus};
use ratn_worker::client::{Channels, ResourceClient};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::safety::{SafetyClient, SafetyState};
use ratn_worker::tls::ClientTls;
use serde::Serialize;
use std::path::Path;
use std::time::Duration;

/// Timeout of a driver's answer.
const PATIENCE: Duration = Duration::from_secs(1);

/// Further lines of one kind are counted, not shown.
pub(super) const MOST_LINES: usize = 40;

/// The content of the display.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct Status {
    /// The drivers that are held or stopped, or do not answer.
    drivers: Vec<Driver>,
    /// The states of the runs on this host, sorted by id.
    runs: Vec<RunStatus>,
    /// The ids of runs on other hosts, and of runs that do not answer.
    elsewhere: Vec<String>,
    held: Vec<Held>,
    waiting: Vec<Waiting>,
    /// Resources that are not held.
    free: Vec<String>,
}

/// A driver that does not accept goals normally.
#[derive(Debug, Clone, PartialEq, Serialize)]
struct Driver {
    endpoint: String,
    /// `held`, `stopped`, or `unknown`.
    state: &'static str,
    /// Who requested the state and why, or why it is unknown.
    reason: String,
}

/// Units of a resource that are held.
#[derive(Debug, Clone, PartialEq, Serialize)]
struct Held {
    resource: String,
    kind: String,
    holder: String,
    lease: u64,
}

/// A waiting request.
#[derive(Debug, Clone, PartialEq, Serialize)]
struct Waiting {
    holder: String,
    /// Its obstacles.
    obstacles: Vec<String>,
}

/// Shows it once, or until the user ends it.
pub(crate) fn run(arguments: &StatusArguments, tls: &ClientTls) -> Result<(), Failure> {
    blocking_on(tokio::runtime::Builder::new_current_thread(), async {
        let directory = public_directory(arguments.runtime_dir.as_deref())?;
        let manager = RuntimeDirectory::at(&directory).find(resource_manager::ROLE);
        let manager = manager.map_err(|error| Failure::Refused(format!("ratn: {error}")))?;
        let channels = Channels::new(tls);
        let client = ResourceClient::new(&channels, &manager, "")?;
        let colours = Colours::of_output();
        repainting::repeat(arguments.watch, arguments.json, async || {
            let status = Status::of(&directory, &channels, &client).await.map_err(unanswered)?;
            Ok(match arguments.json {
                true => json_text(&status, arguments.watch)?,
                false => status.text(&directory, colours, MOST_LINES),
            })
        })
        .await
    })
}

impl Status {
    pub(super) async fn of(directory: &Path, channels: &Channels, client: &ResourceClient) -> Result<Status, Failure> {
        let runs = control::statuses(directory).await;
        let resources = client.list(&[]).await?;
        let waiting = client.explain("").await?;
        let state = async |driver: SafetyClient| driver.state().await;
        let answers = drivers::ask(channels, &drivers::among(&resources), PATIENCE, state).await;
        Ok(Status::from(runs, &resources, waiting, answers))
    }

    fn from(runs: Vec<RunStatus>, resources: &[Resource], waiting: Vec<WaitingAcquire>, answers: Answers) -> Status {
        let held = |resource: &Resource| {
            let held = |holding: &ratn_proto::types::Holding| Held {
                resource: resource.id.clone(),
                kind: resource.kind.clone(),
                holder: if holding.holder.is_empty() { holding.session.clone() } else { holding.holder.clone() },
                lease: holding.lease.0,
            };
            resource.holdings.iter().map(held).collect::<Vec<_>>()
        };
        // Room for projections is not of interest here, and runs are listed above.
        let is_thing = |kind: &str| kind != WORLD_MODEL && kind != RUN_KIND;
        let things = || resources.iter().filter(|resource| is_thing(&resource.kind));
        let is_free = |resource: &&Resource| resource.holdings.is_empty() && resource.free > Quantity::ZERO;
        let is_said = |id: &str| runs.iter().any(|run| run.run == id);
        let elsewhere = resources.iter().filter(|resource| resource.kind == RUN_KIND && !is_said(&resource.id));
        let driver = |(endpoint, answer): (Endpoint, Result<SafetyState, String>)| {
            let (state, reason) = match answer {
                Ok(SafetyState::Ready) => return None,
                Ok(SafetyState::Held { reason }) => ("held", reason),
                Ok(SafetyState::Stopped { reason }) => ("stopped", reason),
                Err(reason) => ("unknown", reason),
            };
            Some(Driver { endpoint: endpoint.to_string(), state, reason })
        };
        Status {
            drivers: answers.into_iter().filter_map(driver).collect(),
            elsewhere: elsewhere.map(|resource| resource.id.clone()).collect(),
            runs,
            held: things().flat_map(held).collect(),
            waiting: waiting
                .into_iter()
                .map(|one| Waiting {
                    holder: if one.holder.is_empty() { one.session } else { one.holder },
                    obstacles: one.obstacles,
                })
                .collect(),
            free: things().filter(is_free).map(|resource| resource.id.clone()).collect(),
        }
    }

    /// Text for people, with at most `most` lines of one kind.
    pub(super) fn text(&self, directory: &Path, colours: Colours, most: usize) -> String {
        let mut lines = Vec::new();
        let section = |lines: &mut Vec<String>, head: &str, rows| section(lines, head, rows, most);
        let rows = self.drivers.iter().map(|one| [one.endpoint.clone(), format!("{}: {}", one.state, one.reason)]);
        section(&mut lines, &colours.yellow("drivers that are held, stopped or silent"), rows.collect());
        if self.runs.is_empty() && self.elsewhere.is_empty() {
            lines.push(format!("no run is under way in {}", directory.display()));
        }
        for run in &self.runs {
            let RunStatus { task, mode, at_s, ended, log, .. } = run;
            let paused = if run.paused { format!(", {}", colours.yellow("paused")) } else { String::new() };
            let states = if *ended == 1 { "state has" } else { "states have" };
            let head = colours.bold(&in_line(task));
            lines.push(format!("{head} in {} mode: {at_s:.1} s{paused}; {ended} {states} ended", mode_name(*mode)));
            if self.runs.len() > 1 {
                lines.push(format!("run: {}", run.run));
            }
            lines.extend(beside(run, self.runs.len() + self.elsewhere.len()));
            lines.push(format!("event log: {}", in_line(&log.display().to_string())));
            let rows = run.under_way.iter().map(|one| [one.path.clone(), one.text()]);
            section(&mut lines, &colours.green("under way"), rows.collect());
            let until = |one: &Awaiting| one.until_s.map_or_else(String::new, |until| format!(", until {until:.1} s"));
            let rows = run.awaits.iter().map(|one| [one.path.clone(), format!("for {}{}", one.awaited, until(one))]);
            section(&mut lines, &colours.yellow("waiting by themselves"), rows.collect());
            let rows = run.waits.iter().map(|sentence| [sentence.clone(), String::new()]);
            section(&mut lines, &colours.yellow("states that wait"), rows.collect());
            let rows = run.breakpoints.iter().map(|state| [state.clone(), String::new()]);
            section(&mut lines, &colours.bold("breakpoints"), rows.collect());
        }
        if !self.elsewhere.is_empty() {
            lines.push(format!("{}: {}", colours.bold("runs elsewhere"), self.elsewhere.join(", ")));
        }
        let rows = self.held.iter().map(|held| [held.resource.clone(), held.holder.clone()]);
        section(&mut lines, &colours.bold("held"), rows.collect());
        let why =
            |one: &Waiting| if one.obstacles.is_empty() { "its turn".to_owned() } else { one.obstacles.join("; ") };
        let rows = self.waiting.iter().map(|one| [one.holder.clone(), why(one)]);
        section(&mut lines, &colours.yellow("waiting"), rows.collect());
        if !self.free.is_empty() {
            lines.push(format!("{}: {}", colours.bold("free"), self.free.join(", ")));
        }
        lines.join("\n")
    }
}

/// A run's share and due time, where they are unusual or there are several runs.
fn beside(run: &RunStatus, runs: usize) -> Option<String> {
    let due = run.due_in_s.map(|due| match due {
        due if due >= 0.0 => format!(", due in {due:.0} s"),
        due => format!(", was due {:.0} s ago", -due),
    });
    (runs > 1 || run.share != 1.0 || due.is_some()).then(|| format!("share {}{}", run.share, due.unwrap_or_default()))
}

/// A heading and a line for each row; nothing without rows.
fn section(lines: &mut Vec<String>, head: &str, mut rows: Vec<[String; 2]>, most: usize) {
    if rows.is_empty() {
        return;
    }
    let hidden = rows.len().saturating_sub(most);
    rows.truncate(most);
    lines.push(format!("{head}:"));
    lines.extend(aligned(&rows).into_iter().map(|line| format!("  {line}")));
    if hidden > 0 {
        lines.push(format!("  and {hidden} more"));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use insta::assert_snapshot;
    use ratn_executive::protocol::{Awaited, Mode};
    use ratn_model::resource::ResourceClass;
    use ratn_task_control::progress::UnderWay;

    #[test]
    fn what_runs_is_told_by_the_names_of_states_and_who_holds_what() {
        let status = Status {
            drivers: vec![Driver { endpoint: "unix:cell.sock".to_owned(), state: "held", reason: "a look".to_owned() }],
            elsewhere: Vec::new(),
            runs: vec![RunStatus {
                run: "run-1".to_owned(),
                task: "sort_boxes".to_owned(),
                mode: Mode::Cdtn,
                log: "log.jsonl".into(),
                at_s: 12.34,
                share: 2.5,
                due_in_s: Some(90.2),
                paused: true,
                ended: 3,
                under_way: vec![UnderWay {
                    path: "place[2]/plan".to_owned(),
                    for_s: 1.5,
                    usually_s: Some(4.0),
                    message: "2 of 5 ways".to_owned(),
                }],
                waits: vec!["place[2]/move waits for an output of place[2]/plan".to_owned()],
                awaits: vec![Awaiting {
                    path: "check".to_owned(),
                    awaited: Awaited::Signal { signal: "lid_closed".to_owned() },
                    until_s: Some(20.0),
                }],
                breakpoints: vec!["place/move".to_owned()],
            }],
            held: vec![Held {
                resource: "path-planner-1@compute".to_owned(),
                kind: "PathPlanner".to_owned(),
                holder: "sort_boxes: place[2]/plan".to_owned(),
                lease: 7,
            }],
            waiting: vec![Waiting { holder: "sort_boxes: look".to_owned(), obstacles: Vec::new() }],
            free: vec!["arm@sim".to_owned(), "base@sim".to_owned()],
        };
        assert_snapshot!(status.text(Path::new("/run/ratn"), Colours::default(), MOST_LINES), @r"
        drivers that are held, stopped or silent:
          unix:cell.sock  held: a look
        sort_boxes in CDTN mode: 12.3 s, paused; 3 states have ended
        share 2.5, due in 90 s
        event log: log.jsonl
        under way:
          place[2]/plan  for 1.5 s of about 4.0 s: 2 of 5 ways
        waiting by themselves:
          check  for the signal `lid_closed`, until 20.0 s
        states that wait:
          place[2]/move waits for an output of place[2]/plan
        breakpoints:
          place/move
        held:
          path-planner-1@compute  sort_boxes: place[2]/plan
        waiting:
          sort_boxes: look  its turn
        free: arm@sim, base@sim
        ");
        let short = status.text(Path::new("/run/ratn"), Colours::default(), 0);
        assert!(short.contains("held:\n  and 1 more\n"), "{short}");
        let kinds = [("run-7", RUN_KIND), ("world-model@compute", WORLD_MODEL), ("arm@sim", "Arm")];
        let resources: Vec<Resource> =
            kinds.into_iter().map(|(id, kind)| Resource::new(id, ResourceClass::Task, kind)).collect();
        let status = Status::from(Vec::new(), &resources, Vec::new(), Answers::new());
        assert_eq!((status.free, status.elsewhere), (vec!["arm@sim".to_owned()], vec!["run-7".to_owned()]));
        let nothing = Status::from(Vec::new(), &[], Vec::new(), Answers::new());
        assert_snapshot!(nothing.text(Path::new("/run/ratn"), Colours::default(), MOST_LINES), @"no run is under way in /run/ratn");
    }
}
