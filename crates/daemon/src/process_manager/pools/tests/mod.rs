//! The pools in virtual time.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod another_session;
mod crashes;
mod demand;
mod replacing;

use super::*;
use crate::process_manager::machine::Sample;
use crate::process_manager::readiness::Readiness;
use crate::process_manager::template::{Liveness, Needs};
use ratn_model::resource::{Quantity, Requirement, ResourceOperation};
use ratn_model::value::Value;
use ratn_proto::types::WorkerState;
use std::ops::Deref;

/// The pools of one template, with their commands since the last look.
struct Rig {
    pools: Pools,
    commands: Vec<Command>,
}

impl Deref for Rig {
    type Target = Pools;

    fn deref(&self) -> &Pools {
        &self.pools
    }
}

fn shortage(most: u32, reason: &str) -> Shortage {
    Shortage { most, reason: reason.to_owned() }
}

impl Rig {
    fn take_commands(&mut self) -> Vec<Command> {
        std::mem::take(&mut self.commands)
    }

    fn handle(&mut self, now: Timestamp, event: Event) {
        self.commands.extend(self.pools.handle(now, event));
    }

    fn advance(&mut self, now: Timestamp) {
        self.handle(now, Event::Time);
    }

    fn spawned(&mut self, id: &str) {
        self.handle(Timestamp(0), Event::Spawned { id: id.to_owned(), pid: 4711, limits: String::new() });
    }

    fn serving(&mut self, now: Timestamp, id: &str) {
        self.handle(now, Event::Serving { id: id.to_owned(), endpoint: "unix:/w".to_owned() });
    }

    fn bring_up(&mut self, now: Timestamp, id: &str) {
        self.spawned(id);
        self.serving(now, id);
        self.handle(now, Event::Offered { id: id.to_owned() });
    }

    fn exited(&mut self, now: Timestamp, id: &str, reason: &str, last_words: &str) {
        let (id, reason, last_words) = (id.to_owned(), reason.to_owned(), last_words.to_owned());
        self.handle(now, Event::Exited { id, reason, last_words });
    }

    fn spawn(&mut self, now: Timestamp, template: &str, count: u32) -> Result<Vec<String>, PoolError> {
        let (started, commands) = self.pools.spawn(now, template, count)?;
        self.commands.extend(commands);
        Ok(started)
    }

    fn stop(&mut self, now: Timestamp, id: &str) {
        self.commands.extend(self.pools.stop(now, id).unwrap());
    }

    fn renew(&mut self, now: Timestamp) {
        self.commands.extend(self.pools.renew(now));
    }

    fn used(&mut self, now: Timestamp, id: &str, held: bool) {
        self.handle(now, Event::Used { id: id.to_owned(), held });
    }

    /// Advances the clock, deadline by deadline; the resource manager withdraws retired resources, and processes end as asked.
    fn run_until(&mut self, until: Timestamp) {
        while let Some(now) = self.next_deadline().filter(|at| *at <= until) {
            self.advance(now);
            let mut started = Vec::new();
            loop {
                let commands = self.take_commands();
                if commands.is_empty() {
                    break;
                }
                for command in commands {
                    match command {
                        Command::Retire { id } => self.handle(now, Event::Withdrawn { id }),
                        Command::Terminate { id } => self.exited(now, &id, "exited with status 0", ""),
                        Command::Check { id, .. } => self.handle(now, Event::Answered { id }),
                        Command::Start { .. } => started.push(command),
                        _ => {}
                    }
                }
            }
            self.commands = started;
        }
    }

    fn ids(&self) -> Vec<String> {
        self.status()[0].workers.iter().map(|worker| worker.id.clone()).collect()
    }

    fn demanded(&mut self, now: Timestamp, demands: &[Demand]) {
        self.handle(now, Event::Demanded(demands.to_vec()));
    }
}

fn pools(edit: impl FnOnce(&mut Template)) -> Rig {
    let mut template = Template::new("planner", "PathPlanner");
    edit(&mut template);
    let mut rig = Rig { pools: Pools::new("compute", [template]), commands: Vec::new() };
    rig.advance(Timestamp(0));
    rig
}

fn at(seconds: f64) -> Timestamp {
    Timestamp::from_seconds(seconds)
}

fn started(pools: &mut Rig) -> Vec<String> {
    let id = |command| match command {
        Command::Start { id, .. } => Some(id),
        _ => None,
    };
    pools.take_commands().into_iter().filter_map(id).collect()
}

fn demand(provided: u32, missing: u32) -> [Demand; 1] {
    let requirement =
        Requirement { count: missing.into(), ..Requirement::new(ResourceOperation::Block, "PathPlanner") };
    [Demand {
        requirement,
        kinds: vec!["Planner".to_owned(), "PathPlanner".to_owned()],
        provided: provided.into(),
        queued: Quantity::ZERO,
    }]
}

fn ended(pools: &mut Rig) -> Vec<String> {
    let of = |command: &Command| match command {
        Command::Terminate { id } => Some(id.clone()),
        _ => None,
    };
    pools.commands.iter().filter_map(of).collect()
}

fn seconds(seconds: u64) -> Duration {
    Duration::from_secs(seconds)
}
