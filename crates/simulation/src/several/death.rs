//! A task control that dies without notice while others run, and is resumed from its event log.
//!
//! ```text
//! dies ─► its goals go on for 3 s, then they stop ─► its session ends after 3 s, and with it its leases ─► it is resumed
//!   └─ of the commands of its last event some are logged, and some of these performed
//! ```
//!
//! It comes back as `ratn run --resume` does (`ratn-task-control`): its log is replayed; its decided commits are made or refused; its
//! requests are made again; it learns how each goal ended; then it gets the changes by others.

use super::{Due, System, What};
use crate::run::RunError;
use ratn_executive::executive::Executive;
use ratn_executive::protocol::{Command, Event, LogEntry, LogLine};
use ratn_executive::was_overtaken;
use ratn_model::fact::FactKey;
use ratn_model::program::Program;
use ratn_model::time::Timestamp;
use ratn_model::tolerance::Tolerance;
use ratn_model::value::Value;
use std::cmp::Reverse;
use std::sync::Arc;
use std::time::Duration;

/// Lifetime of a session without its client, and of a goal without a listener, in seconds.
pub const SESSION_S: f64 = 3.0;

/// The outcome of a run that is refused when it is resumed.
pub const REFUSED: &str = "refused";

/// When a task control dies and is resumed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Death {
    /// It dies at the first event from this virtual second on.
    pub at_s: f64,
    /// Number of commands of that event that are logged, if there are so many …
    pub written: usize,
    /// … and number of commands performed, if all are logged; else none.
    pub performed: usize,
    /// It is resumed after this number of virtual seconds.
    pub away_s: f64,
}

/// The state of a run without task control.
pub(super) struct Gone {
    since: Timestamp,
    /// Commands that were logged but not performed.
    unperformed: Vec<Command>,
    /// Events that it has missed.
    kept: Vec<Event>,
    has_lost: bool,
    /// Number of commits by all runs at its death.
    commits: usize,
}

impl Gone {
    /// Keeps an event for the resumed task control.
    pub(super) fn keep(&mut self, now: Timestamp, event: Event) {
        match event {
            // Resuming gives back unknown grants, and compares the worlds.
            Event::Granted { .. } | Event::WantedByOthers { .. } | Event::WorldChanged { .. } => {}
            event => self.kept.push(self.as_it_ended(now, event)),
        }
    }

    /// A goal that would have run longer than without a listener allowed was stopped.
    fn as_it_ended(&self, at: Timestamp, event: Event) -> Event {
        match event {
            Event::Finished { instance, attempt, .. } | Event::Crashed { instance, attempt, .. }
                if at.since(self.since) >= Duration::from_secs_f64(SESSION_S) =>
            {
                Event::Crashed {
                    instance,
                    attempt,
                    reason: "it was stopped while task control was gone".to_owned(),
                    unknown: true,
                    refused: false,
                }
            }
            event => event,
        }
    }
}

/// The numbers of commands that a task control logs and performs before it dies.
pub(super) fn reached(death: Option<&Death>, commands: usize) -> (usize, usize) {
    let Some(death) = death else { return (commands, commands) };
    let written = death.written.min(commands);
    (written, if written < commands { 0 } else { death.performed.min(commands) })
}

impl System<'_> {
    pub(super) fn dies(&mut self, run: usize, death: Death, unperformed: Vec<Command>) -> Result<(), RunError> {
        self.happened(run, What::Died);
        let session = self.runs[run].session.clone();
        let lives = Duration::from_secs_f64(SESSION_S);
        self.pool.keep_alive(self.now, &session, "simulation", lives).map_err(|error| self.broken(error))?;
        self.at(run, lives, Due::SessionEnds);
        self.at(run, Duration::from_secs_f64(death.away_s.max(0.0)), Due::TakenUp);
        let commits = self.commits.len();
        self.runs[run].gone = Some(Gone { since: self.now, unperformed, kept: Vec::new(), has_lost: false, commits });
        Ok(())
    }

    /// Its session expires: its leases and requests are gone.
    pub(super) fn session_ends(&mut self, run: usize) {
        let one = &mut self.runs[run];
        let Some(gone) = &mut one.gone else { return };
        gone.has_lost = true;
        one.waiters.clear();
        let leases = std::mem::take(&mut one.leases);
        one.lost.extend(leases.keys());
        leases.into_keys().for_each(|lease| self.happened(run, What::GaveBack(lease)));
        self.pool.advance(self.now);
        self.answers();
    }

    pub(super) fn is_taken_up(&mut self, run: usize) -> Result<(), RunError> {
        let Some(gone) = self.runs[run].gone.take() else { return Ok(()) };
        self.happened(run, What::TakenUp { has_lost: gone.has_lost });
        let (executive, missing) =
            replayed(&self.runs[run].program, &self.runs[run].log).map_err(|e| self.broken(e))?;
        self.runs[run].executive = executive;
        let decided = gone.unperformed.iter().chain(&missing);
        let (commits, others): (Vec<Command>, Vec<Command>) =
            decided.cloned().partition(|command| matches!(command, Command::Commit { .. }));
        if gone.has_lost
            && let Some(key) = self.overtaken(run, &commits, gone.commits)
        {
            self.agenda.retain(|_, (of, _)| *of != run);
            let reason = format!("others have changed {key} since the run lost its resources");
            self.runs[run].end = Some((REFUSED.to_owned(), reason));
            return Ok(());
        }
        let session = self.runs[run].session.clone();
        self.pool.keep_alive(self.now, &session, "simulation", super::FOREVER).map_err(|error| self.broken(error))?;
        self.perform_all(run, commits)?;
        self.hears_again(run, gone)?;
        self.asks_again(run)?;
        let log = &mut self.runs[run].log;
        log.extend(missing.into_iter().map(|command| LogLine { at: self.now, entry: LogEntry::Command(command) }));
        let commands = self.decide(run, Event::Resumed { share: None });
        self.perform_all(run, others)?;
        self.perform_all(run, commands)?;
        let facts = self.differences(run);
        if self.runs[run].end.is_none() && !facts.is_empty() {
            self.tell(run, Event::WorldChanged { revision: self.root.revision(), facts })?;
        }
        Ok(())
    }

    /// The first fact changed by another run meanwhile that a pending commit changes or depends on; task control (`performer/resume.rs`)
    /// refuses the run for the same reason.
    fn overtaken(&self, run: usize, commits: &[Command], since: usize) -> Option<FactKey> {
        let by_others = self.commits[since..].iter().filter(|(by, _)| *by != run).flat_map(|(_, keys)| keys);
        let is_meant = |key: &&FactKey| {
            commits.iter().any(|command| match command {
                Command::Commit { writer, changes, .. } => was_overtaken(&self.runs[run].program, writer, changes, key),
                _ => false,
            })
        };
        by_others.clone().find(is_meant).cloned()
    }

    /// Sends the missed events, and how its goals ended meanwhile.
    fn hears_again(&mut self, run: usize, gone: Gone) -> Result<(), RunError> {
        let mut kept = Vec::new();
        let is_over = self.now.since(gone.since) >= Duration::from_secs_f64(SESSION_S);
        self.agenda.retain(|_, (of, due)| match due {
            Due::Event(event)
                if *of == run && is_over && matches!(**event, Event::Finished { .. } | Event::Crashed { .. }) =>
            {
                kept.push((**event).clone());
                false
            }
            _ => true,
        });
        let kept: Vec<Event> = kept.into_iter().map(|event| gone.as_it_ended(self.now, event)).collect();
        for event in gone.kept.into_iter().chain(kept) {
            self.at(run, Duration::ZERO, Due::Event(Box::new(event)));
        }
        Ok(())
    }

    /// Gives back leases that it does not know, and makes its pending requests again.
    fn asks_again(&mut self, run: usize) -> Result<(), RunError> {
        let one = &mut self.runs[run];
        let waiters = std::mem::take(&mut one.waiters);
        let unheard: Vec<_> = one.leases.keys().filter(|lease| !one.heard.contains(lease)).copied().collect();
        for waiter in waiters.into_values() {
            self.pool.cancel(self.now, waiter).map_err(|error| self.broken(error))?;
        }
        for lease in unheard {
            self.give_back(run, lease)?;
        }
        self.answers();
        let mut asked: Vec<_> = std::mem::take(&mut self.runs[run].asked).into_iter().collect();
        asked.sort_by_key(|(instance, (_, priority))| (Reverse(*priority), *instance));
        for (instance, (requirements, priority)) in asked {
            self.perform(run, Command::Acquire { instance, requirements, priority })?;
        }
        Ok(())
    }

    /// The differences of the root from the run's mirror.
    fn differences(&self, run: usize) -> Vec<(FactKey, Option<Value>)> {
        let mirror = self.runs[run].executive.root();
        let written = self.root.iter().filter(|(key, fact)| mirror.get(key) != Some(&fact.value));
        let gone = mirror.iter().filter(|(key, _)| self.root.get(key).is_none());
        let written = written.map(|(key, fact)| (key.clone(), Some(fact.value.clone())));
        written.chain(gone.map(|(key, _)| (key.clone(), None))).collect()
    }
}

/// The executive in the state at the end of the log, and its last commands that are missing in the log.
fn replayed(program: &Arc<Program>, log: &[LogLine]) -> Result<(Executive, Vec<Command>), String> {
    let mut executive = Executive::new(program.clone(), Tolerance::ROBOT);
    let mut said: std::collections::VecDeque<Command> = Default::default();
    for line in log {
        match &line.entry {
            LogEntry::Event(event) => {
                if let Some(more) = said.front() {
                    return Err(format!("taken up again, it says {more:?}, which it had not said"));
                }
                said = executive.handle(line.at, event.clone()).into();
            }
            LogEntry::Command(command) => {
                let again = said.pop_front();
                if again.as_ref() != Some(command) {
                    return Err(format!("taken up again, it says {again:?} instead of {command:?}"));
                }
            }
        }
    }
    Ok((executive, said.into()))
}
