//! The workers of one template: as many as its size says, restarted as its restart policy allows.

use super::command::{Command, PoolError};
use super::demand::Demanded;
use super::motion::Motion;
use super::restart::Restarts;
use super::size::{Size, retiring};
use super::worker::Worker;
use crate::demand::Shortage;
use crate::process_manager::machine::Sample;
use crate::process_manager::readiness::Readiness;
use crate::process_manager::template::Template;
use ratn_model::time::Timestamp;
use ratn_proto::types::{PoolStatus, Scale, WorkerStatus};
use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

/// Maximum number of workers of a pool that start at the same time: more would delay each other beyond their start timeout.
pub(super) const STARTING_AT_ONCE: u32 = 32;

#[derive(Debug)]
pub(super) struct Pool {
    template: Template,
    host: String,
    size: Size,
    restarts: Restarts,
    /// Templates that need a ready worker before the first worker is started.
    waits_for: Vec<String>,
    /// By number: the youngest is last.
    workers: BTreeMap<u64, Worker>,
    last_number: u64,
    /// How many more workers than the minimum fit on the machine; `None` where they need nothing of it.
    room: Option<u32>,
    /// Motions of workers that have ended.
    motion: Motion,
    /// Number of workers that ended unasked, and how the last one ended.
    crashes: u64,
    last_exit: String,
    /// How the last worker ended that was never ready, since another one was ready.
    never_ready: String,
}

impl Pool {
    pub(super) fn new(template: Template, host: &str) -> Pool {
        Pool {
            size: Size::new(template.min, template.max_workers(), template.spares),
            restarts: Restarts::new(host, &template.name),
            waits_for: template.after.clone(),
            workers: BTreeMap::new(),
            last_number: 0,
            // Before the first measurement of the machine.
            room: template.needs.is_something().then_some(0),
            motion: Motion::default(),
            crashes: 0,
            last_exit: String::new(),
            never_ready: String::new(),
            host: host.to_owned(),
            template,
        }
    }

    pub(super) fn template(&self) -> &Template {
        &self.template
    }

    pub(super) fn is_empty(&self) -> bool {
        self.workers.is_empty()
    }

    pub(super) fn worker(&mut self, number: u64) -> Option<&mut Worker> {
        self.workers.get_mut(&number)
    }

    pub(super) fn status(&self) -> PoolStatus {
        let (min, max, spares) = self.size.bounds();
        PoolStatus {
            template: self.template.name.clone(),
            kind: self.template.kind.clone(),
            min,
            max,
            workers: self.workers.values().map(Worker::status).collect(),
            failure: self.restarts.failure().to_owned(),
            spares,
            crashes: self.crashes,
            last_exit: self.last_exit.clone(),
        }
    }

    /// The most workers that are possible for now, and why.
    pub(super) fn shortage(&self) -> Option<Shortage> {
        let (name, there, (min, max, _)) = (&self.template.name, self.there(), self.size.bounds());
        let room = self.room.map(|room| there.saturating_add(room).max(min)).filter(|most| *most < max);
        let (most, reason) = if self.restarts.has_failed() {
            (there, format!("`{name}` crash-loops: {}", self.restarts.failure()))
        } else if self.waits() {
            (there, format!("`{name}` waits until there is a worker of {}", self.waits_for.join(", ")))
        } else if let Some(most) = room {
            (most, format!("`{name}` needs {} for one more worker", self.template.needs.words()))
        } else if self.size.is_short() || max < self.template.max_workers() {
            (max, format!("`{name}` has {max} workers at the most"))
        } else if !self.never_ready.is_empty() && !self.has_ready() {
            (max, format!("`{name}` has no worker that became ready, and starts another one: {}", self.never_ready))
        } else {
            return None;
        };
        Some(Shortage { most, reason })
    }

    /// When the passing of time changes something.
    pub(super) fn deadline(&self) -> Option<Timestamp> {
        let restart = self.restarts.pause_until().filter(|_| self.missing() > 0);
        let (_, retires) = self.retiring(Timestamp(0));
        let waits = self.workers.values().any(Worker::waits_for_rest) && !self.moves_until_an_end();
        let rest = waits.then_some(self.motion.until());
        self.workers.values().filter_map(Worker::deadline).chain(restart).chain(retires).chain(rest).min()
    }

    /// Does what is due: kills, health checks, and the end of workers that were surplus for long enough.
    pub(super) fn advance(&mut self, now: Timestamp, commands: &mut Vec<Command>) {
        self.restarts.advance(now);
        self.workers.values_mut().for_each(|worker| worker.advance(now, &self.template, commands));
        self.offer(now, commands);
        for number in self.retiring(now).0 {
            if let Some(worker) = self.workers.get_mut(&number) {
                worker.retire(commands);
            }
        }
    }

    /// The surplus workers that end now, and when the next one does.
    fn retiring(&self, now: Timestamp) -> (Vec<u64>, Option<Timestamp>) {
        let surplus = self.there().saturating_sub(self.wanted() + self.surge());
        let idle = self.workers.iter().filter_map(|(number, worker)| Some((worker.idle_since()?, *number)));
        retiring(idle, surplus, self.template.idle(), now)
    }

    /// Takes a measurement of the machine; workers that are starting have not used their share yet.
    pub(super) fn looked(&mut self, sample: &Sample) {
        let starting = self.count(Worker::is_starting);
        self.room = self.template.needs.room(sample).map(|room| room.saturating_sub(starting));
    }

    /// Whether the pool still waits for other templates.
    pub(super) fn waits(&self) -> bool {
        !self.waits_for.is_empty()
    }

    /// These templates have a ready worker.
    pub(super) fn follow(&mut self, ready: &BTreeSet<String>) {
        self.waits_for.retain(|name| !ready.contains(name));
    }

    pub(super) fn has_ready(&self) -> bool {
        self.workers.values().any(Worker::is_ready)
    }

    /// Starts missing workers, unless that has to wait; returns their ids. If workers are to be replaced, the next one ends where that is
    /// possible.
    pub(super) fn fill(&mut self, now: Timestamp, commands: &mut Vec<Command>) -> Vec<String> {
        if self.count(Worker::is_starting) == 0 {
            self.size.all_started();
        }
        self.roll(now, commands);
        if !self.restarts.allow(now) {
            return Vec::new();
        }
        (0..self.missing()).map(|_| self.start(now, commands)).collect()
    }

    fn start(&mut self, now: Timestamp, commands: &mut Vec<Command>) -> String {
        self.last_number += 1;
        self.room = self.room.map(|room| room.saturating_sub(1));
        let (id, template) = (self.id(self.last_number), self.template.name.clone());
        self.workers.insert(self.last_number, Worker::starting(now, id.clone(), &self.template));
        commands.push(Command::Start { id: id.clone(), template });
        id
    }

    fn id(&self, number: u64) -> String {
        format!("{}-{number}@{}", self.template.name, self.host)
    }

    /// Later workers get numbers above this one.
    pub(super) fn go_on_after(&mut self, number: u64) {
        self.last_number = self.last_number.max(number);
    }

    /// Adopts a worker that serves already.
    pub(super) fn adopt(
        &mut self,
        now: Timestamp,
        number: u64,
        worker: &WorkerStatus,
        (standstill, outdated): (Option<Duration>, bool),
        commands: &mut Vec<Command>,
    ) {
        self.go_on_after(number);
        let mut adopted = Worker::starting(now, worker.id.clone(), &self.template).with_standstill(standstill);
        adopted.spawned(worker.pid, worker.limits.clone(), commands);
        adopted.serving(now, &worker.endpoint);
        adopted.offer(&self.template.kind, commands);
        adopted.ask_at_once(now);
        if outdated {
            adopted.outdate();
        }
        self.workers.insert(number, adopted);
    }

    /// A worker's process has ended.
    pub(super) fn exited(
        &mut self,
        now: Timestamp,
        number: u64,
        (reason, last_words): (&str, &str),
        commands: &mut Vec<Command>,
    ) {
        let Some(worker) = self.workers.remove(&number) else { return };
        let id = worker.id();
        commands.push(Command::Withdraw { id: id.to_owned() });
        let exited = worker.exited(reason);
        let reason = exited.reason.clone();
        commands.push(Command::Notify(exited));
        if let Some(bound) = worker.motion() {
            self.motion.goes_on(now, bound);
        }
        if !worker.is_stopping() {
            let words = if last_words.is_empty() { String::new() } else { format!("; its last words: {last_words}") };
            let what = format!("{id}: {reason}{words}");
            self.crashes += 1;
            self.last_exit.clone_from(&what);
            if worker.serves_since().is_none() {
                self.never_ready.clone_from(&what);
            }
            self.restarts.crashed(now, &self.template, worker.serves_since(), &what);
        }
    }

    /// A worker serves: another one may be started now.
    pub(super) fn serving(&mut self, now: Timestamp, number: u64, endpoint: &str, commands: &mut Vec<Command>) {
        if let Some(worker) = self.workers.get_mut(&number) {
            worker.serving(now, endpoint);
        }
        self.offer(now, commands);
    }

    /// Offers the workers that serve, unless a device of an ended worker may still move for its former holder.
    fn offer(&mut self, now: Timestamp, commands: &mut Vec<Command>) {
        if self.motion.is_over(now) && !self.moves_until_an_end() {
            self.workers.values_mut().for_each(|worker| worker.offer(&self.template.kind, commands));
        }
    }

    /// An earlier process manager's workers may go on moving something for `bound`, or for as long as the template says now if that is
    /// longer.
    pub(super) fn moved_before(&mut self, now: Timestamp, bound: Duration) {
        self.motion.goes_on(now, bound.max(self.template.standstill().unwrap_or_default()));
    }

    /// How long devices may go on moving if all of its processes end now; `None` where nothing moves.
    pub(super) fn motion(&self, now: Timestamp) -> Option<Duration> {
        self.workers.values().filter_map(Worker::motion).chain(self.motion.bound(now)).max()
    }

    /// Whether a worker that is being ended may move something until its process has ended, and for the bound after that.
    fn moves_until_an_end(&self) -> bool {
        self.workers.values().any(|worker| worker.is_ending() && worker.motion().is_some())
    }

    /// A worker's resource was accepted.
    pub(super) fn offered(&mut self, now: Timestamp, number: u64, commands: &mut Vec<Command>) {
        self.never_ready.clear();
        if let Some(worker) = self.workers.get_mut(&number) {
            worker.offered(now, commands);
        }
    }

    /// A worker computes while it starts.
    pub(super) fn busy(&mut self, now: Timestamp, number: u64) {
        if let Some(worker) = self.workers.get_mut(&number) {
            worker.busy(now, &self.template);
        }
    }

    /// A worker's resource was refused.
    pub(super) fn refused(&mut self, now: Timestamp, number: u64, why: &str) {
        if let Some(worker) = self.workers.get_mut(&number) {
            worker.refused(now + self.template.start_timeout(), why);
        }
    }

    /// Starts `count` more workers, also where the pool has failed; returns their ids.
    pub(super) fn spawn(
        &mut self,
        now: Timestamp,
        count: u32,
        commands: &mut Vec<Command>,
    ) -> Result<Vec<String>, PoolError> {
        // Workers that a failed pool lacks are not wanted any more.
        let wanted = if self.restarts.has_failed() { self.there() } else { self.size.asked() };
        if !self.size.ask(wanted, count) {
            let template = self.template.name.clone();
            return Err(PoolError::TooMany { template, wanted, max: self.size.bounds().1, count });
        }
        self.restarts.forgive();
        let mut started = self.fill(now, commands);
        // The others follow in this order.
        started.extend((1..=u64::from(self.lacking())).map(|ahead| self.id(self.last_number + ahead)));
        Ok(started.split_off(started.len().saturating_sub(count as usize)))
    }

    /// Sets the demand. Surplus workers that do not serve yet are ended; the others stay. A pool that moves something does not grow for
    /// requests that wait for a held worker.
    pub(super) fn demanded(&mut self, now: Timestamp, demanded: Demanded, commands: &mut Vec<Command>) {
        let queued = if self.template.grows_with_the_queue() { demanded.queued } else { 0 };
        if self.size.demand(Demanded { queued, ..demanded }) && self.restarts.has_failed() {
            self.restarts.forgive();
        }
        let surplus = self.there().saturating_sub(self.wanted()) as usize;
        let kill_at = now + self.template.stop_timeout();
        for worker in self.workers.values_mut().rev().filter(|worker| worker.is_starting()).take(surplus) {
            worker.stop(kill_at, commands);
        }
    }

    /// A worker's resource is held now, or no longer held.
    pub(super) fn used(&mut self, now: Timestamp, number: u64, held: bool, commands: &mut Vec<Command>) {
        if let Some(worker) = self.workers.get_mut(&number) {
            worker.used(now, held, commands);
        }
    }

    /// A worker's resource was withdrawn as requested.
    pub(super) fn withdrawn(&mut self, now: Timestamp, number: u64, commands: &mut Vec<Command>) {
        let kill_at = now + self.template.stop_timeout();
        if let Some(worker) = self.workers.get_mut(&number) {
            worker.withdrawn(now, kill_at, commands);
        }
    }

    /// Ends a worker once nobody holds it; it is replaced only where the pool would fall below its minimum.
    pub(super) fn stop(&mut self, now: Timestamp, number: u64, commands: &mut Vec<Command>) {
        let (until, kill_at) = (now + self.template.drain(), now + self.template.stop_timeout());
        if self.workers.get_mut(&number).is_some_and(|worker| worker.drain(until, kill_at, commands)) {
            self.size.one_less();
        }
    }

    /// Marks this worker, or all, for replacement; returns the ids of those that will end. A failed pool is tried again.
    pub(super) fn restart(&mut self, only: Option<u64>) -> Vec<String> {
        self.restarts.forgive();
        let chosen = |number: &u64| only.is_none_or(|only| only == *number);
        let workers = self.workers.iter_mut().filter(|(number, _)| chosen(number));
        workers.filter_map(|(_, worker)| worker.outdate().then(|| worker.id().to_owned())).collect()
    }

    /// Another session offers the workers from now on: all existing ones end now and are replaced. Another caller grants leases of the old
    /// session, and these workers accept them: so they may move their devices until their processes have ended.
    pub(super) fn renew(&mut self, now: Timestamp, commands: &mut Vec<Command>) {
        self.restarts.forgive();
        let kill_at = now + self.template.stop_timeout();
        for worker in self.workers.values_mut() {
            worker.disown(kill_at, commands);
        }
    }

    /// Ends a worker that is to be replaced once there is one more than wanted and all are ready. One at a time.
    fn roll(&mut self, now: Timestamp, commands: &mut Vec<Command>) {
        let leaving = self.workers.values().any(Worker::is_leaving);
        let ready = self.workers.values().all(Worker::is_ready);
        let spared = self.there() > self.wanted() || self.is_single();
        let next =
            self.workers.values_mut().filter(|worker| worker.is_outdated()).min_by_key(|worker| worker.is_held());
        let (until, kill_at) = (now + self.template.drain(), now + self.template.stop_timeout());
        if let Some(worker) = next.filter(|_| !leaving && ready && spared) {
            worker.drain(until, kill_at, commands);
        }
    }

    /// Number of workers to start beyond the wanted ones to replace another: 0 or 1.
    fn surge(&self) -> u32 {
        let leaving = self.workers.values().any(Worker::is_leaving);
        let surges = !leaving && !self.is_single() && self.workers.values().any(Worker::is_outdated);
        u32::from(surges)
    }

    /// Whether there can never be one more than wanted, not even for a moment: they share one port, or move one robot.
    fn is_single(&self) -> bool {
        matches!(self.template.readiness, Readiness::Port { .. }) || self.template.standstill().is_some()
    }

    /// Changes the size. Workers above the new maximum end now, or once nobody holds them.
    ///
    /// # Errors
    /// [`PoolError::Size`].
    pub(super) fn scale(
        &mut self,
        now: Timestamp,
        scale: Scale,
        commands: &mut Vec<Command>,
    ) -> Result<PoolStatus, PoolError> {
        let template = || self.template.name.clone();
        self.size.scale(scale).map_err(|why| PoolError::Size { template: template(), why })?;
        let (_, max, _) = self.size.bounds();
        let surplus = self.there().saturating_sub(max) as usize;
        let (until, kill_at) = (now + self.template.drain(), now + self.template.stop_timeout());
        let mut there: Vec<&mut Worker> = self.workers.values_mut().filter(|worker| !worker.is_leaving()).collect();
        there.sort_by_key(|worker| worker.is_held());
        for worker in there.into_iter().take(surplus) {
            worker.drain(until, kill_at, commands);
        }
        Ok(self.status())
    }

    /// Ends every worker, each once nobody holds it.
    pub(super) fn drain(&mut self, now: Timestamp, commands: &mut Vec<Command>) {
        let (until, kill_at) = (now + self.template.drain(), now + self.template.stop_timeout());
        for worker in self.workers.values_mut() {
            worker.drain(until, kill_at, commands);
        }
    }

    /// Ends every worker. Workers that have not ended after `patience` are killed.
    pub(super) fn shut_down(&mut self, now: Timestamp, patience: Duration, commands: &mut Vec<Command>) {
        let kill_at = now + patience.min(self.template.stop_timeout());
        for worker in self.workers.values_mut() {
            worker.stop(kill_at, commands);
        }
    }

    fn there(&self) -> u32 {
        self.count(|worker| !worker.is_leaving())
    }

    fn wanted(&self) -> u32 {
        self.size.wanted(self.count(|worker| worker.is_ready() && worker.is_held()))
    }

    /// Number of workers to start now.
    fn missing(&self) -> u32 {
        self.lacking().min(STARTING_AT_ONCE.saturating_sub(self.count(Worker::is_starting)))
    }

    /// Number of workers to start, now or after others have started.
    fn lacking(&self) -> u32 {
        let there = if self.is_single() { self.count(|_| true) } else { self.there() };
        let wanted = self.wanted() + self.surge();
        let kept = self.size.bounds().0.saturating_sub(there);
        let possible = self.room.map_or(u32::MAX, |room| room.max(kept));
        if self.restarts.has_failed() || self.waits() { 0 } else { wanted.saturating_sub(there).min(possible) }
    }

    fn count(&self, of: impl Fn(&Worker) -> bool) -> u32 {
        u32::try_from(self.workers.values().filter(|worker| of(worker)).count()).unwrap_or(u32::MAX)
    }
}
