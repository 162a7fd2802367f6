//! Learns from event logs of earlier runs of a task: the durations of its states, and the outcomes of its conditions, loops and actions. A pure fold
//! over lines; work that was squashed, cancelled or crashed does not count.

use crate::messages::Messages;
use ratn_event_log::{self as log, without_visits};
use ratn_executive::protocol::{Command, Event, Learned, LogEntry, LogLine, Note};
use ratn_model::id::InstanceId;
use ratn_model::time::Timestamp;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Maximum number of logs read from a folder before a run; the last ones by name are read.
const MAX_LOGS: usize = 256;

/// Why nothing can be learned from a given event log.
#[derive(Debug, thiserror::Error)]
#[error("cannot learn from {}: {reason}", path.display())]
pub struct LearnError {
    path: PathBuf,
    reason: String,
}

/// Statistics over several logs.
#[derive(Debug, Default)]
pub struct LearnedStatistics {
    /// By state: the number of attempts with an outcome, and their total duration in seconds.
    durations: BTreeMap<String, (u32, f64)>,
    /// By state and outcome: the number of occurrences.
    outcomes: BTreeMap<String, BTreeMap<String, u32>>,
}

impl LearnedStatistics {
    /// Adds one log.
    pub fn add(&mut self, lines: &[LogLine]) {
        let mut fold = Fold::default();
        for line in lines {
            match &line.entry {
                LogEntry::Event(event) => fold.event(self, line.at, event),
                LogEntry::Command(command) => fold.command(self, line.at, command),
            }
        }
        for (instance, outcome) in fold.finished {
            if fold.retired.contains(&instance)
                && let Some(path) = fold.paths.get(&instance)
                && !fold.decided.contains(path)
            {
                self.came(path, &outcome);
            }
        }
    }

    /// Computes means and fractions.
    pub fn learned(&self) -> Learned {
        let mean = |(path, (count, total_s)): (&String, &(u32, f64))| (path.clone(), total_s / f64::from(*count));
        let shares = |(path, counts): (&String, &BTreeMap<String, u32>)| {
            let all: u32 = counts.values().sum();
            let share = |(outcome, count): (&String, &u32)| (outcome.clone(), f64::from(*count) / f64::from(all));
            (path.clone(), counts.iter().map(share).collect())
        };
        Learned {
            durations_s: self.durations.iter().map(mean).collect(),
            outcomes: self.outcomes.iter().map(shares).collect(),
        }
    }

    fn came(&mut self, path: &str, outcome: &str) {
        *self.outcomes.entry(path.to_owned()).or_default().entry(outcome.to_owned()).or_default() += 1;
    }
}

/// The fold over one log.
#[derive(Debug, Default)]
struct Fold {
    /// Paths without visits.
    paths: BTreeMap<InstanceId, String>,
    started: BTreeMap<InstanceId, (u32, Timestamp)>,
    finished: BTreeMap<InstanceId, String>,
    retired: BTreeSet<InstanceId>,
    /// States with logged decisions: their outcomes are not counted again.
    decided: BTreeSet<String>,
}

impl Fold {
    fn event(&mut self, statistics: &mut LearnedStatistics, at: Timestamp, event: &Event) {
        match event {
            // An anytime action counts as done at its first result, which its users wait for.
            Event::Finished { instance, attempt, .. } | Event::Improved { instance, attempt, .. } => {
                let Some((_, began)) = self.started.remove(instance).filter(|started| started.0 == *attempt) else {
                    return;
                };
                if let Some(path) = self.paths.get(instance) {
                    let (count, total_s) = statistics.durations.entry(path.clone()).or_default();
                    *count += 1;
                    *total_s += at.since(began).as_secs_f64();
                }
            }
            // Until now it waited before it was given to its provider.
            Event::Given { instance, attempt } => {
                if let Some(started) = self.started.get_mut(instance).filter(|started| started.0 == *attempt) {
                    started.1 = at;
                }
            }
            Event::Crashed { instance, .. } => drop(self.started.remove(instance)),
            // The duration of what was under way is unknown.
            Event::Resumed { .. } => self.started.clear(),
            _ => {}
        }
    }

    fn command(&mut self, statistics: &mut LearnedStatistics, at: Timestamp, command: &Command) {
        match command {
            Command::Start { instance, attempt, .. } => drop(self.started.insert(*instance, (*attempt, at))),
            Command::Cancel { instance, .. } => drop(self.started.remove(instance)),
            Command::Note(Note::Expanded { instance, path, .. }) => {
                self.paths.insert(*instance, without_visits(path));
            }
            Command::Note(Note::Decided { path, decision, .. }) => {
                let path = without_visits(path);
                // The number of elements of a collection is not an outcome.
                if decision.parse::<u64>().is_err() {
                    statistics.came(&path, decision);
                }
                self.decided.insert(path);
            }
            Command::Note(Note::Finished { instance, outcome }) => {
                self.finished.insert(*instance, outcome.to_string());
            }
            Command::Note(Note::Retired { instance }) => drop(self.retired.insert(*instance)),
            _ => {}
        }
    }
}

/// Reads the given logs, and those in the given folders that are of the task.
///
/// # Errors
/// A given log cannot be read. In a folder, files that are not logs of the task are skipped.
pub fn from_files(named: &[PathBuf], task: &str, messages: &Messages) -> Result<Learned, LearnError> {
    let mut statistics = LearnedStatistics::default();
    let mut used = 0_usize;
    for path in named {
        if path.is_dir() {
            let logs = logs_in(path).map_err(|error| refused(path, &error))?;
            for lines in logs.iter().filter_map(|log| log::read(log).ok()).map(|log| log.lines) {
                if of_task(&lines, task) {
                    statistics.add(&lines);
                    used += 1;
                }
            }
        } else {
            let lines = log::read(path).map_err(|error| refused(path, &error))?.lines;
            if !of_task(&lines, task) {
                return Err(refused(path, &format!("is not of the task `{task}`")));
            }
            statistics.add(&lines);
            used += 1;
        }
    }
    if !named.is_empty() {
        let states = statistics.durations.len();
        messages.say(format_args!("learned from {used} event logs how long {states} states take"));
    }
    Ok(statistics.learned())
}

fn refused(path: &Path, reason: &dyn std::fmt::Display) -> LearnError {
    LearnError { path: path.to_owned(), reason: reason.to_string() }
}

fn of_task(lines: &[LogLine], name: &str) -> bool {
    let first = lines.first().map(|line| &line.entry);
    matches!(first, Some(LogEntry::Event(Event::Started { task, .. })) if task == name)
}

/// The files that are named like event logs, the last ones by name.
fn logs_in(folder: &Path) -> std::io::Result<Vec<PathBuf>> {
    let mut logs = Vec::new();
    for entry in std::fs::read_dir(folder)? {
        let path = entry?.path();
        if path.extension().is_some_and(|end| end == "jsonl") && path.is_file() {
            logs.push(path);
        }
    }
    logs.sort();
    Ok(logs.split_off(logs.len().saturating_sub(MAX_LOGS)))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    fn lines(text: &str) -> Vec<LogLine> {
        text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
    }

    const LOOK: &str = r#"{"at":0,"command":"note","note":"expanded","instance":1,"state":1,"path":"all[0]/look","speculative":false}
{"at":0,"command":"note","note":"expanded","instance":2,"state":1,"path":"all[1]/look#2","speculative":true}
{"at":0,"command":"start","instance":1,"attempt":1,"goal":{"provider":"eye","action":"look","inputs":{},"seed":1,"lease":null,"projection":null,"expected_s":null}}
{"at":1000000000,"command":"start","instance":2,"attempt":1,"goal":{"provider":"eye","action":"look","inputs":{},"seed":1,"lease":null,"projection":null,"expected_s":null}}
{"at":2000000000,"event":"finished","instance":1,"attempt":1,"outcome":"success","outputs":{},"measured":[],"reason":""}
{"at":2000000000,"command":"note","note":"finished","instance":1,"outcome":"success"}
{"at":2000000000,"command":"note","note":"retired","instance":1}
{"at":2000000000,"command":"note","note":"decided","instance":3,"path":"all[0]/found","decision":"then"}
{"at":2500000000,"command":"note","note":"decided","instance":4,"path":"all[1]/found","decision":"else"}
{"at":2500000000,"command":"note","note":"decided","instance":5,"path":"all","decision":"2"}"#;

    #[test]
    fn durations_are_means_and_outcomes_are_shares_of_what_was_real() {
        let mut statistics = LearnedStatistics::default();
        statistics.add(&lines(LOOK));
        // The second visit was squashed: neither its duration nor its outcome counts.
        let learned = statistics.learned();
        assert_eq!(learned.durations_s, [("all/look".to_owned(), 2.0)].into());
        let shares: Vec<String> = learned.outcomes.iter().map(|(path, shares)| format!("{path} {shares:?}")).collect();
        assert_eq!(shares, [r#"all/found {"else": 0.5, "then": 0.5}"#, r#"all/look {"success": 1.0}"#]);
    }

    #[test]
    fn logs_add_up() {
        let mut statistics = LearnedStatistics::default();
        statistics.add(&lines(LOOK));
        statistics.add(&lines(&LOOK.replace("\"at\":2000000000", "\"at\":6000000000").replace("then", "else")));
        let learned = statistics.learned();
        assert_eq!(learned.durations_s["all/look"], 4.0);
        assert_eq!(learned.outcomes["all/found"], [("else".to_owned(), 0.75), ("then".to_owned(), 0.25)].into());
    }

    #[test]
    fn a_log_of_another_task_is_refused_and_in_a_folder_left_out() {
        let folder = tempfile::tempdir().unwrap();
        let log = folder.path().join("a.jsonl");
        std::fs::write(&log, "rubbish\n").unwrap();
        assert!(matches!(from_files(std::slice::from_ref(&log), "t", &Messages::nowhere()), Err(LearnError { .. })));
        let learned = from_files(&[folder.path().to_owned()], "t", &Messages::nowhere());
        assert_eq!(learned.unwrap(), Learned::default());
    }
}
