//! The worker pools as a pure state machine: which workers there should be, and which to start or end.
//!
//! ```text
//!   Event ─▶ Pools (of which pool, of which worker) ─▶ Pool ─┬─ Worker    one worker's life;  Liveness  when it is asked
//!                                                            ├─ Size      how many there shall be
//!   Vec<Command> ◀───────────────────────────────────────────┴─ Restarts  what follows a crash
//! ```
//! A worker that exits without being asked to is a crash: its resource is withdrawn at once and another worker is started,
//! at once after a first crash, later after each further one, not at all after [`Template::crash_limit`] in a row.

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

/// Who is to be replaced.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Restart {
    /// All workers of a template.
    Template(String),
    /// This one.
    Worker(String),
}

/// All pools of a host.
#[derive(Debug)]
pub struct Pools {
    host: String,
    labels: Labels,
    pools: BTreeMap<String, Pool>,
    /// By template: what workers of templates that are gone from the config moved.
    motions_of_unknown: BTreeMap<String, Motion>,
    /// It takes no new work.
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

    /// On a host of which this is said.
    #[must_use]
    pub fn with_labels(self, labels: Labels) -> Pools {
        Pools { labels, ..self }
    }

    /// Takes in what has happened; what to do now, in order.
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

    /// The next moment at which time alone changes something: [`Event::Time`] is due then.
    pub fn next_deadline(&self) -> Option<Timestamp> {
        self.pools.values().filter_map(Pool::deadline).min()
    }

    /// New workers have other ids than these, which a process manager before this one gave away.
    pub fn go_on_after(&mut self, ids: &[String]) {
        for id in ids {
            if let Some((template, number)) = self.parts_of(id)
                && let Some(pool) = self.pools.get_mut(template)
            {
                pool.go_on_after(number);
            }
        }
    }

    /// What workers of a process manager before this one moved may still move: by template, for how long. Where a template is gone, each
    /// one that moves something may be that template under another name.
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

    /// By template: for how long what its workers moved may go on when all of their processes end now. A successor has to wait for that.
    pub fn motions(&self, now: Timestamp) -> BTreeMap<String, Duration> {
        let of_pools = self.pools.iter().filter_map(|(name, pool)| Some((name, pool.motion(now)?)));
        let of_unknown = self.motions_of_unknown.iter().filter_map(|(name, motion)| Some((name, motion.bound(now)?)));
        of_pools.chain(of_unknown).map(|(name, bound)| (name.clone(), bound)).collect()
    }

    /// Takes over a worker that serves already, of a process manager that is gone, with the bound of what it moves; what to do. Nothing
    /// where its pool is not known.
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

    /// Starts more workers, also where the pool has failed; their ids, and what to do.
    ///
    /// # Errors
    /// An unknown template, more than its maximum, or the end.
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

    /// Ends a worker once nobody holds it, at the latest when its template's time for that is over; it is replaced only where the
    /// pool would fall below its minimum.
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

    /// Lets other workers take the place of a template's, or of one worker, each once its successor is ready; the ids of those that
    /// will go, and what to do.
    ///
    /// # Errors
    /// Who is not known, a host that is drained, or the end.
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

    /// Another session offers the workers from now on. Those that were told of the one before, which is another caller's, are of no use:
    /// every one is ended at once, held or not, and others take their places.
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

    /// Changes how many workers a template has; the pool as it is then.
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

    /// Starts no worker any more and ends those there are, each once nobody holds it; or takes work again.
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

    /// Whether it takes no new work.
    pub fn is_draining(&self) -> bool {
        self.draining
    }

    /// Ends every worker, and starts none any more. What has not ended after `patience` is killed.
    pub fn shut_down(&mut self, now: Timestamp, patience: Duration) -> Vec<Command> {
        self.ending = true;
        let mut commands = Vec::new();
        self.pools.values_mut().for_each(|pool| pool.shut_down(now, patience, &mut commands));
        commands
    }

    /// Of which kinds there can be no more workers for now, and why. Of several templates of a kind the first counts, as for demand.
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

    /// Whether there is a worker of that id.
    pub fn knows(&mut self, id: &str) -> bool {
        self.find(id).is_some()
    }

    /// Every pool with its workers, the oldest first.
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

    /// Starts the pools that have been waiting for others, where those have somebody ready now.
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

    /// Workers are started for what waits, up to the pool's maximum, also where the pool had failed before anybody asked. When
    /// nobody waits any more, those that do not serve yet are ended; the others stay.
    fn demanded(&mut self, now: Timestamp, demands: &[Demand], commands: &mut Vec<Command>) {
        if self.ending {
            return;
        }
        let mut taken = BTreeSet::new();
        for pool in self.pools.values_mut() {
            // Of several templates of a kind the first meets what is asked for.
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

    /// Lets its pool do something about a worker, and then start what is missing. False where the worker is not known.
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

    /// Template and number of a worker's id.
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

/// The number of a worker of this template on this host; nothing where the id is another one's.
pub(super) fn number_of(id: &str, template: &str, host: &str) -> Option<u64> {
    parts_of(id, host).filter(|(name, _)| *name == template).map(|(_, number)| number)
}

/// Template and number of the id of a worker on this host.
fn parts_of<'i>(id: &'i str, host: &str) -> Option<(&'i str, u64)> {
    let (name, number) = id.strip_suffix(host)?.strip_suffix('@')?.rsplit_once('-')?;
    Some((name, number.parse().ok()?))
}

#[cfg(test)]
mod tests;
