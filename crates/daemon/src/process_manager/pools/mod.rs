//! The worker pools as a pure state machine: which workers there should be, and which to start or end.
//!
//! ```text
//!   Event ─▶ Pools (of which pool, of which worker) ─▶ Pool ─┬─ Worker    one worker's life;  Liveness  when it is asked
//!                                                            ├─ Size      how many there shall be
//!   Vec<Command> ◀───────────────────────────────────────────┴─ Restarts  what follows a crash
//! ```
//! A worker that exits without being asked to has crashed: its resource is withdrawn at once and another worker is started, at once
//! after the first crash, with growing delay after further ones, and not at all after [`Template::crash_limit`] crashes in a row.

mod command;
mod demand;
mod liveness;
mod motion;
mod pool;
mod restart;
mod size;
mod worker;

pub use crate::demand::Shortage;
pub use command::{Command, Event, PoolError};

use super::config::Labels;
use super::template::Template;
use demand::Demanded;
use motion::Motion;
use pool::Pool;
use ratn_model::time::Timestamp;
use ratn_proto::types::{Demand, PoolStatus, Scale, WorkerStatus};
use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;
use worker::Worker;

/// The workers to replace.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Restart {
    /// All workers of a template.
    Template(String),
    /// This worker.
    Worker(String),
}

/// All pools of a host.
#[derive(Debug)]
pub struct Pools {
    host: String,
    labels: Labels,
    pools: BTreeMap<String, Pool>,
    /// By template: motions of workers whose templates are no longer in the config.
    motions_of_unknown: BTreeMap<String, Motion>,
    /// The host takes no new work.
    draining: bool,
    ending: bool,
}

impl Pools {
    /// The pools of these templates, without workers yet.
    pub fn new(host: impl Into<String>, templates: impl IntoIterator<Item = Template>) -> Pools {
        let host = host.into();
        let pools = templates.into_iter().map(|template| (template.name.clone(), Pool::new(template, &host))).collect();
        let motions_of_unknown = BTreeMap::new();
        Pools { host, labels: Labels::new(), pools, motions_of_unknown, draining: false, ending: false }
    }

    /// Sets the labels of the host.
    #[must_use]
    pub fn with_labels(self, labels: Labels) -> Pools {
        Pools { labels, ..self }
    }

    /// Handles an event; returns the commands to perform, in order.
    pub fn handle(&mut self, now: Timestamp, event: Event) -> Vec<Command> {
        let mut commands = Vec::new();
        match event {
            Event::Time => self.advance(now, &mut commands),
            Event::Spawned { id, pid, limits } => {
                if let Some(worker) = self.worker(&id) {
                    worker.spawned(pid, limits, &mut commands);
                }
            }
            Event::Serving { id, endpoint } => {
                self.about(now, &id, &mut commands, |pool, number, c| pool.serving(now, number, &endpoint, c));
            }
            Event::Busy { id } => {
                self.about(now, &id, &mut commands, |pool, number, _| pool.busy(now, number));
            }
            Event::Offered { id } => {
                self.about(now, &id, &mut commands, |pool, number, c| pool.offered(now, number, c));
                self.let_follow(now, &mut commands);
            }
            Event::Refused { id, why } => {
                self.about(now, &id, &mut commands, |pool, number, _| pool.refused(now, number, &why));
            }
            Event::Exited { id, reason, last_words } => {
                self.about(now, &id, &mut commands, |pool, number, commands| {
                    pool.exited(now, number, (&reason, &last_words), commands);
                });
            }
            Event::Used { id, held } => {
                self.about(now, &id, &mut commands, |pool, number, c| pool.used(now, number, held, c));
            }
            Event::Withdrawn { id } => {
                self.about(now, &id, &mut commands, |pool, number, c| pool.withdrawn(now, number, c));
            }
            Event::Kept { id } => {
                if let Some(worker) = self.worker(&id) {
                    worker.kept(now, &mut commands);
                }
            }
            Event::Answered { id } => {
                if let Some(worker) = self.worker(&id) {
                    worker.answered(now);
                }
            }
            Event::Unanswered { id, why } => {
                if let Some(worker) = self.worker(&id) {
                    worker.unanswered(&why, &mut commands);
                }
            }
            Event::Demanded(demands) => self.demanded(now, &demands, &mut commands),
            Event::Looked(sample) => {
                self.pools.values_mut().for_each(|pool| pool.looked(&sample));
                self.advance(now, &mut commands);
            }
        }
        commands
    }

    /// When the passing of time changes something next: [`Event::Time`] is due then.
    pub fn next_deadline(&self) -> Option<Timestamp> {
        self.pools.values().filter_map(Pool::deadline).min()
    }

    /// New workers get other ids than these, which an earlier process manager gave away.
    pub fn go_on_after(&mut self, ids: &[String]) {
        for id in ids {
            if let Some((template, number)) = self.parts_of(id)
                && let Some(pool) = self.pools.get_mut(template)
            {
                pool.go_on_after(number);
            }
        }
    }

    /// Motions of an earlier process manager's workers that may still go on: by template, for how long. Where a template is gone from
    /// the config, every template that moves something may be the same one under a new name.
    pub fn moved_before(&mut self, now: Timestamp, motions: &BTreeMap<String, Duration>) {
        for (template, bound) in motions {
            if let Some(pool) = self.pools.get_mut(template) {
                pool.moved_before(now, *bound);
                continue;
            }
            self.motions_of_unknown.entry(template.clone()).or_default().goes_on(now, *bound);
            let moving = self.pools.values_mut().filter(|pool| pool.template().standstill().is_some());
            moving.for_each(|pool| pool.moved_before(now, *bound));
        }
    }

    /// By template: how long its workers' devices may go on moving if all worker processes end now. A successor has to wait for that.
    pub fn motions(&self, now: Timestamp) -> BTreeMap<String, Duration> {
        let of_pools = self.pools.iter().filter_map(|(name, pool)| Some((name, pool.motion(now)?)));
        let of_unknown = self.motions_of_unknown.iter().filter_map(|(name, motion)| Some((name, motion.bound(now)?)));
        of_pools.chain(of_unknown).map(|(name, bound)| (name.clone(), bound)).collect()
    }

    /// Adopts a serving worker of an earlier process manager, with the bound of its motions; returns the commands. `None` where its pool
    /// is unknown.
    pub fn adopt(
        &mut self,
        now: Timestamp,
        worker: &WorkerStatus,
        standstill: Option<Duration>,
        outdated: bool,
    ) -> Option<Vec<Command>> {
        let mut commands = Vec::new();
        let (_, number) = self.parts_of(&worker.id)?;
        let pool = self.pools.get_mut(&worker.template)?;
        pool.adopt(now, number, worker, (standstill, outdated), &mut commands);
        Some(commands)
    }

    /// Starts more workers, also where the pool has failed; returns their ids and the commands.
    ///
    /// # Errors
    /// An unknown template, too many workers, a drained host, or the end.
    pub fn spawn(
        &mut self,
        now: Timestamp,
        template: &str,
        count: u32,
    ) -> Result<(Vec<String>, Vec<Command>), PoolError> {
        self.takes_work()?;
        let mut commands = Vec::new();
        let started = self.pool(template)?.spawn(now, count, &mut commands)?;
        Ok((started, commands))
    }

    /// Ends a worker once nobody holds it, at the latest after its template's drain time; it is replaced only where the pool would fall
    /// below its minimum.
    ///
    /// # Errors
    /// An unknown worker.
    pub fn stop(&mut self, now: Timestamp, id: &str) -> Result<Vec<Command>, PoolError> {
        let mut commands = Vec::new();
        if !self.about(now, id, &mut commands, |pool, number, commands| pool.stop(now, number, commands)) {
            return Err(PoolError::UnknownWorker { id: id.to_owned() });
        }
        Ok(commands)
    }

    /// Replaces one worker or all workers of a template, each once its successor is ready; returns the ids of the workers that will end,
    /// and the commands.
    ///
    /// # Errors
    /// An unknown worker or template, a drained host, or the end.
    pub fn restart(&mut self, now: Timestamp, which: &Restart) -> Result<(Vec<String>, Vec<Command>), PoolError> {
        self.takes_work()?;
        let mut commands = Vec::new();
        let (pool, only) = match which {
            Restart::Template(name) => (self.pool(name)?, None),
            Restart::Worker(id) => {
                let unknown = PoolError::UnknownWorker { id: id.clone() };
                let (pool, number) = self.find(id).ok_or(unknown)?;
                (pool, Some(number))
            }
        };
        let going = pool.restart(only);
        pool.fill(now, &mut commands);
        Ok((going, commands))
    }

    /// Another session offers the workers from now on. Workers that know only the old session, which is another caller's, are useless:
    /// all are ended at once, held or not, and replaced.
    pub fn renew(&mut self, now: Timestamp) -> Vec<Command> {
        let mut commands = Vec::new();
        let takes_work = self.takes_work().is_ok();
        for pool in self.pools.values_mut() {
            pool.renew(now, &mut commands);
            if takes_work {
                pool.fill(now, &mut commands);
            }
        }
        commands
    }

    /// Changes the number of workers of a template; returns the changed pool and the commands.
    ///
    /// # Errors
    /// An unknown template, or more than its config allows.
    pub fn scale(
        &mut self,
        now: Timestamp,
        template: &str,
        scale: Scale,
    ) -> Result<(PoolStatus, Vec<Command>), PoolError> {
        let mut commands = Vec::new();
        let takes_work = self.takes_work().is_ok();
        let pool = self.pool(template)?;
        let status = pool.scale(now, scale, &mut commands)?;
        if takes_work {
            pool.fill(now, &mut commands);
        }
        Ok((status, commands))
    }

    /// Drains the host: starts no more workers and ends existing ones, each once nobody holds it; or ends the drain.
    pub fn drain(&mut self, now: Timestamp, draining: bool) -> Vec<Command> {
        self.draining = draining;
        let mut commands = Vec::new();
        if draining {
            self.pools.values_mut().for_each(|pool| pool.drain(now, &mut commands));
        } else {
            self.advance(now, &mut commands);
        }
        commands
    }

    /// Whether the host is drained.
    pub fn is_draining(&self) -> bool {
        self.draining
    }

    /// Ends every worker, and starts no more. Workers that have not ended after `patience` are killed.
    pub fn shut_down(&mut self, now: Timestamp, patience: Duration) -> Vec<Command> {
        self.ending = true;
        let mut commands = Vec::new();
        self.pools.values_mut().for_each(|pool| pool.shut_down(now, patience, &mut commands));
        commands
    }

    /// The kinds of which there can be no more workers for now, and why. Where several templates have the same kind, the first one
    /// counts, as for demand.
    pub fn shortages(&self) -> BTreeMap<String, Shortage> {
        let drained = || Shortage { most: 0, reason: format!("the host `{}` is drained", self.host) };
        let shortage = |pool: &Pool| if self.draining { Some(drained()) } else { pool.shortage() };
        let mut first = BTreeMap::new();
        for pool in self.pools.values() {
            first.entry(&pool.template().kind).or_insert_with(|| shortage(pool));
        }
        first.into_iter().filter_map(|(kind, shortage)| Some((kind.clone(), shortage?))).collect()
    }

    /// Whether no worker is left.
    pub fn is_empty(&self) -> bool {
        self.pools.values().all(Pool::is_empty)
    }

    /// Whether a worker with this id exists.
    pub fn knows(&mut self, id: &str) -> bool {
        self.find(id).is_some()
    }

    /// Every pool with its workers, oldest first.
    pub fn status(&self) -> Vec<PoolStatus> {
        self.pools.values().map(Pool::status).collect()
    }

    /// The template of that name.
    pub fn template(&self, name: &str) -> Option<&Template> {
        self.pools.get(name).map(Pool::template)
    }

    fn takes_work(&self) -> Result<(), PoolError> {
        match (self.ending, self.draining) {
            (true, _) => Err(PoolError::Ending),
            (false, true) => Err(PoolError::Drained { host: self.host.clone() }),
            (false, false) => Ok(()),
        }
    }

    fn advance(&mut self, now: Timestamp, commands: &mut Vec<Command>) {
        let takes_work = self.takes_work().is_ok();
        for pool in self.pools.values_mut() {
            pool.advance(now, commands);
            if takes_work {
                pool.fill(now, commands);
            }
        }
    }

    /// Starts the pools that waited for others, where those have a ready worker now.
    fn let_follow(&mut self, now: Timestamp, commands: &mut Vec<Command>) {
        let ready: BTreeSet<String> =
            self.pools.iter().filter(|(_, pool)| pool.has_ready()).map(|(name, _)| name.clone()).collect();
        let takes_work = self.takes_work().is_ok();
        for pool in self.pools.values_mut().filter(|pool| pool.waits()) {
            pool.follow(&ready);
            if takes_work {
                pool.fill(now, commands);
            }
        }
    }

    /// Starts workers for the demand, up to the pool's maximum, also where the pool had failed before. When there is no more demand,
    /// workers that do not serve yet are ended; the others stay.
    fn demanded(&mut self, now: Timestamp, demands: &[Demand], commands: &mut Vec<Command>) {
        if self.ending {
            return;
        }
        let mut taken = BTreeSet::new();
        for pool in self.pools.values_mut() {
            // Where several templates have the same kind, the first one meets the demand.
            let kind = pool.template().kind.clone();
            let demanded = demand::demanded(demands, &kind, (&self.host, &self.labels));
            pool.demanded(now, if taken.insert(kind) { demanded } else { Demanded::default() }, commands);
        }
        self.advance(now, commands);
    }

    fn pool(&mut self, template: &str) -> Result<&mut Pool, PoolError> {
        let known = self.pools.keys().cloned().collect::<Vec<_>>().join(", ");
        self.pools.get_mut(template).ok_or(PoolError::UnknownTemplate { template: template.to_owned(), known })
    }

    /// Applies `act` to a worker in its pool, and then starts missing workers. False where the worker is unknown.
    fn about(
        &mut self,
        now: Timestamp,
        id: &str,
        commands: &mut Vec<Command>,
        act: impl FnOnce(&mut Pool, u64, &mut Vec<Command>),
    ) -> bool {
        let takes_work = self.takes_work().is_ok();
        let Some((pool, number)) = self.find(id) else { return false };
        act(pool, number, commands);
        if takes_work {
            pool.fill(now, commands);
        }
        true
    }

    /// Template and number in a worker's id.
    fn parts_of<'i>(&self, id: &'i str) -> Option<(&'i str, u64)> {
        parts_of(id, &self.host)
    }

    /// The pool of a worker, and its number there.
    fn find(&mut self, id: &str) -> Option<(&mut Pool, u64)> {
        let (name, number) = self.parts_of(id)?;
        let pool = self.pools.get_mut(name)?;
        pool.worker(number).is_some_and(|worker| worker.id() == id).then_some((pool, number))
    }

    fn worker(&mut self, id: &str) -> Option<&mut Worker> {
        let (pool, number) = self.find(id)?;
        pool.worker(number)
    }
}

/// The number of a worker of this template on this host; `None` where the id belongs to another.
pub(super) fn number_of(id: &str, template: &str, host: &str) -> Option<u64> {
    parts_of(id, host).filter(|(name, _)| *name == template).map(|(_, number)| number)
}

/// Template and number in the id of a worker on this host.
fn parts_of<'i>(id: &'i str, host: &str) -> Option<(&'i str, u64)> {
    let (name, number) = id.strip_suffix(host)?.strip_suffix('@')?.rsplit_once('-')?;
    Some((name, number.parse().ok()?))
}

#[cfg(test)]
mod tests;
