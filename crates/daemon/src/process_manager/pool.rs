//! Which workers there should be, and what to do about it: a pure state machine.
//!
//! ```text
//!            start                health SERVING          resource there
//!   (none) ────────▶ starting ──────────────▶ serving ──────────────▶ ready
//!      ▲                │ too late: kill          │ stop asked: terminate, later kill │
//!      └────────────────┴──────── exited ◀────────┴───────────────────────────────────┘
//! ```
//! A worker that exits without being asked to is a crash: its resource is withdrawn at once and another worker is started,
//! at once after a first crash, later after each further one, not at all after [`Template::crash_limit`] in a row.

use super::config::Template;
use ratn_model::resource::ResourceClass;
use ratn_model::time::Timestamp;
use ratn_model::value::Value;
use ratn_proto::types::{Demand, PoolStatus, WorkerState, WorkerStatus};
use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

/// All pools of a host.
#[derive(Debug)]
pub struct Pools {
    host: String,
    pools: BTreeMap<String, Pool>,
    commands: Vec<Command>,
    ending: bool,
}

/// What the shell shall do.
#[derive(Debug, Clone, PartialEq)]
pub enum Command {
    /// Start a process of a template; answered by [`Pools::spawned`] or [`Pools::exited`].
    Start {
        /// The worker's id.
        id: String,
        /// The template's name.
        template: String,
    },
    /// Send SIGTERM to the worker's process group.
    Terminate {
        /// The worker's id.
        id: String,
    },
    /// Send SIGKILL to the worker's process group.
    Kill {
        /// The worker's id.
        id: String,
    },
    /// Offer the worker to the resource manager; answered by [`Pools::resource_there`].
    Offer {
        /// The worker, with its endpoint.
        worker: WorkerStatus,
        /// The kind of resource that it is.
        kind: String,
    },
    /// Withdraw the worker's resource.
    Withdraw {
        /// The worker's id.
        id: String,
    },
    /// Tell watchers.
    Tell(WorkerStatus),
}

/// A request that is refused.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PoolError {
    /// No such template in the config.
    #[error("there is no template `{template}`; the config has {known}")]
    UnknownTemplate {
        /// What was asked for.
        template: String,
        /// Those there are.
        known: String,
    },
    /// No such worker.
    #[error("there is no worker `{id}`")]
    UnknownWorker {
        /// Which.
        id: String,
    },
    /// The pool would have more than its maximum.
    #[error("`{template}` has {wanted} workers of at most {max}: {count} more are too many")]
    TooMany {
        /// The template.
        template: String,
        /// How many there are to be already.
        wanted: u32,
        /// The template's maximum.
        max: u32,
        /// How many were asked for.
        count: u32,
    },
    /// The process manager is ending.
    #[error("the process manager is ending")]
    Ending,
}

#[derive(Debug)]
struct Pool {
    template: Template,
    /// How many workers there should be.
    wanted: u32,
    /// How many there should be for those who wait; 0 when nobody does.
    demanded: u32,
    workers: BTreeMap<String, Worker>,
    last_number: u64,
    crashes: u32,
    restart_at: Option<Timestamp>,
    failure: String,
    /// More is asked for than there may be.
    short: bool,
}

#[derive(Debug)]
struct Worker {
    phase: Phase,
    pid: u32,
    endpoint: String,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Phase {
    Starting {
        until: Timestamp,
    },
    Serving {
        since: Timestamp,
    },
    Ready {
        since: Timestamp,
    },
    /// Killed because it did not serve in time: its exit is a crash.
    TooLate,
    Stopping {
        kill_at: Option<Timestamp>,
    },
}

impl Pools {
    /// The pools of these templates, without workers yet.
    pub fn new(host: impl Into<String>, templates: impl IntoIterator<Item = Template>) -> Pools {
        let pool = |template: Template| {
            let pool = Pool {
                wanted: template.min,
                demanded: 0,
                workers: BTreeMap::new(),
                last_number: 0,
                crashes: 0,
                restart_at: None,
                failure: String::new(),
                short: false,
                template,
            };
            (pool.template.name.clone(), pool)
        };
        Pools {
            host: host.into(),
            pools: templates.into_iter().map(pool).collect(),
            commands: Vec::new(),
            ending: false,
        }
    }

    /// What to do since the last call, in order.
    pub fn take_commands(&mut self) -> Vec<Command> {
        std::mem::take(&mut self.commands)
    }

    /// The next moment at which time alone changes something: call [`Pools::advance`] then.
    pub fn next_deadline(&self) -> Option<Timestamp> {
        let of_worker = |worker: &Worker| match worker.phase {
            Phase::Starting { until } => Some(until),
            Phase::Stopping { kill_at } => kill_at,
            _ => None,
        };
        let of_pool = |pool: &Pool| {
            let restart = pool.restart_at.filter(|_| pool.missing() > 0);
            pool.workers.values().filter_map(of_worker).chain(restart).min()
        };
        self.pools.values().filter_map(of_pool).min()
    }

    /// Kills what is too late, and starts what is missing. The first call starts every pool.
    pub fn advance(&mut self, now: Timestamp) {
        let (host, ending) = (&self.host, self.ending);
        for pool in self.pools.values_mut() {
            for (id, worker) in &mut pool.workers {
                match worker.phase {
                    Phase::Starting { until } if until <= now => {
                        worker.phase = Phase::TooLate;
                        self.commands.push(Command::Kill { id: id.clone() });
                    }
                    Phase::Stopping { kill_at: Some(kill_at) } if kill_at <= now => {
                        worker.phase = Phase::Stopping { kill_at: None };
                        self.commands.push(Command::Kill { id: id.clone() });
                    }
                    _ => {}
                }
            }
            if !ending {
                pool.fill(now, host, &mut self.commands);
            }
        }
    }

    /// A worker's process is there.
    pub fn spawned(&mut self, id: &str, pid: u32) {
        let Some((pool, worker)) = self.worker(id) else { return };
        worker.pid = pid;
        let status = worker.status(id, &pool, String::new());
        // One that was to end before it was there is ended now.
        match worker.phase {
            Phase::Stopping { kill_at: Some(_) } => self.commands.push(Command::Terminate { id: id.to_owned() }),
            Phase::Stopping { kill_at: None } | Phase::TooLate => {
                self.commands.push(Command::Kill { id: id.to_owned() });
            }
            Phase::Starting { .. } | Phase::Serving { .. } | Phase::Ready { .. } => {}
        }
        self.commands.push(Command::Tell(status));
    }

    /// A worker's health is SERVING.
    pub fn serving(&mut self, now: Timestamp, id: &str, endpoint: &str) {
        let Some((pool, worker)) = self.worker(id) else { return };
        if !matches!(worker.phase, Phase::Starting { .. }) {
            return;
        }
        worker.phase = Phase::Serving { since: now };
        endpoint.clone_into(&mut worker.endpoint);
        let worker = worker.status(id, &pool, String::new());
        let kind = self.pools[&pool].template.kind.clone();
        self.commands.push(Command::Offer { worker, kind });
    }

    /// The resource manager has the worker's resource.
    pub fn resource_there(&mut self, id: &str) {
        let Some((pool, worker)) = self.worker(id) else { return };
        if let Phase::Serving { since } = worker.phase {
            worker.phase = Phase::Ready { since };
            let status = worker.status(id, &pool, String::new());
            self.commands.push(Command::Tell(status));
        }
    }

    /// A worker's process is gone (or could not be started). `last_words` is the end of its log.
    pub fn exited(&mut self, now: Timestamp, id: &str, reason: &str, last_words: &str) {
        let Some(pool) = self.pools.values_mut().find(|pool| pool.workers.contains_key(id)) else { return };
        let Some(worker) = pool.workers.remove(id) else { return };
        self.commands.push(Command::Withdraw { id: id.to_owned() });
        let reason = match worker.phase {
            Phase::TooLate => format!("not serving within {} s", pool.template.start_timeout_s),
            _ => reason.to_owned(),
        };
        let state = WorkerState::Exited;
        let status = WorkerStatus { state, ..worker.status(id, &pool.template.name, reason.clone()) };
        self.commands.push(Command::Tell(status));
        if !matches!(worker.phase, Phase::Stopping { .. }) {
            pool.crashed(now, &worker, id, &reason, last_words);
        }
        self.advance(now);
    }

    /// Starts more workers, also where the pool has failed; their ids.
    ///
    /// # Errors
    /// An unknown template, more than its maximum, or the end.
    pub fn spawn(&mut self, now: Timestamp, template: &str, count: u32) -> Result<Vec<String>, PoolError> {
        if self.ending {
            return Err(PoolError::Ending);
        }
        let known = self.pools.keys().cloned().collect::<Vec<_>>().join(", ");
        let Some(pool) = self.pools.get_mut(template) else {
            return Err(PoolError::UnknownTemplate { template: template.to_owned(), known });
        };
        let max = pool.template.max_workers();
        // What a failed pool lacks is wanted no more.
        let wanted = if pool.failure.is_empty() { pool.wanted } else { pool.there() };
        if count > max.saturating_sub(wanted) {
            return Err(PoolError::TooMany { template: template.to_owned(), wanted, max, count });
        }
        pool.wanted = (wanted + count).max(pool.template.min);
        pool.failure.clear();
        (pool.crashes, pool.restart_at) = (0, None);
        let started = pool.fill(now, &self.host, &mut self.commands);
        Ok(started.into_iter().rev().take(count as usize).rev().collect())
    }

    /// What waits for more than exists, as it is now: workers are started for it up to the pool's maximum, also where the pool had
    /// failed before anybody asked. When nobody waits any more, those that do not serve yet are ended; the others stay.
    pub fn demanded(&mut self, now: Timestamp, demands: &[Demand]) {
        if self.ending {
            return;
        }
        let host = Value::String(self.host.clone());
        let of_workers = |name: &str| (name == "host").then_some(Cow::Borrowed(&host));
        let met = |demand: &&Demand| {
            demand.requirement.class.is_none_or(|class| class == ResourceClass::Process)
                && demand.requirement.accepts(of_workers)
        };
        let mut taken = BTreeSet::new();
        for pool in self.pools.values_mut() {
            // Of several templates of a kind the first meets what is asked for.
            let first = taken.insert(pool.template.kind.clone());
            let of_kind = demands.iter().filter(|demand| demand.kinds.contains(&pool.template.kind)).filter(met);
            let most = of_kind.map(|demand| demand.provided.saturating_add(demand.requirement.count)).max();
            let demanded = most.filter(|_| first).unwrap_or(0);
            if pool.demanded == 0 && demanded > 0 && !pool.failure.is_empty() {
                pool.failure.clear();
                (pool.crashes, pool.restart_at) = (0, None);
            }
            pool.short = demanded > pool.template.max_workers();
            pool.demanded = demanded.min(pool.template.max_workers());
            pool.end_surplus(now, &mut self.commands);
        }
        self.advance(now);
    }

    /// Why there are no more workers of a kind, by kind.
    pub fn shortages(&self) -> BTreeMap<String, String> {
        let of = |pool: &Pool| {
            let name = &pool.template.name;
            let reason = match pool.failure.as_str() {
                "" if pool.short => format!("`{name}` has {} workers at the most", pool.template.max_workers()),
                "" => return None,
                failure => format!("`{name}` crash-loops: {failure}"),
            };
            Some((pool.template.kind.clone(), reason))
        };
        self.pools.values().filter_map(of).collect()
    }

    /// Ends a worker; it is replaced only where the pool would fall below its minimum.
    ///
    /// # Errors
    /// An unknown worker.
    pub fn stop(&mut self, now: Timestamp, id: &str) -> Result<(), PoolError> {
        let unknown = || PoolError::UnknownWorker { id: id.to_owned() };
        let pool = self.pools.values_mut().find(|pool| pool.workers.contains_key(id)).ok_or_else(unknown)?;
        let kill_at = now + pool.template.stop_timeout();
        let Some(worker) = pool.workers.get_mut(id) else { return Err(unknown()) };
        if worker.stop(id, kill_at, &mut self.commands) {
            pool.wanted = pool.wanted.saturating_sub(1).max(pool.template.min);
        }
        self.advance(now);
        Ok(())
    }

    /// Ends every worker, and starts none any more. What has not ended after `patience` is killed.
    pub fn shut_down(&mut self, now: Timestamp, patience: Duration) {
        self.ending = true;
        for pool in self.pools.values_mut() {
            for (id, worker) in &mut pool.workers {
                worker.stop(id, now + patience.min(pool.template.stop_timeout()), &mut self.commands);
            }
        }
    }

    /// Whether no worker is left.
    pub fn is_empty(&self) -> bool {
        self.pools.values().all(|pool| pool.workers.is_empty())
    }

    /// Every pool with its workers.
    pub fn status(&self) -> Vec<PoolStatus> {
        let of = |pool: &Pool| PoolStatus {
            template: pool.template.name.clone(),
            kind: pool.template.kind.clone(),
            min: pool.template.min,
            max: pool.template.max_workers(),
            workers: pool.workers.iter().map(|(id, w)| w.status(id, &pool.template.name, String::new())).collect(),
            failure: pool.failure.clone(),
        };
        self.pools.values().map(of).collect()
    }

    /// The template of that name.
    pub fn template(&self, name: &str) -> Option<&Template> {
        self.pools.get(name).map(|pool| &pool.template)
    }

    fn worker(&mut self, id: &str) -> Option<(String, &mut Worker)> {
        let (name, pool) = self.pools.iter_mut().find(|(_, pool)| pool.workers.contains_key(id))?;
        pool.workers.get_mut(id).map(|worker| (name.clone(), worker))
    }
}

impl Pool {
    fn there(&self) -> u32 {
        let there = self.workers.values().filter(|worker| !matches!(worker.phase, Phase::Stopping { .. })).count();
        u32::try_from(there).unwrap_or(u32::MAX)
    }

    fn missing(&self) -> u32 {
        if self.failure.is_empty() { self.wanted.max(self.demanded).saturating_sub(self.there()) } else { 0 }
    }

    /// Ends those that do not serve yet and are wanted no more, the youngest first.
    fn end_surplus(&mut self, now: Timestamp, commands: &mut Vec<Command>) {
        let mut surplus = self.there().saturating_sub(self.wanted.max(self.demanded));
        let kill_at = now + self.template.stop_timeout();
        for (id, worker) in self.workers.iter_mut().rev() {
            if surplus > 0 && matches!(worker.phase, Phase::Starting { .. }) {
                worker.stop(id, kill_at, commands);
                surplus -= 1;
            }
        }
    }

    /// Starts what is missing, unless it has to wait; the ids.
    fn fill(&mut self, now: Timestamp, host: &str, commands: &mut Vec<Command>) -> Vec<String> {
        if self.restart_at.is_some_and(|at| at > now) {
            return Vec::new();
        }
        self.restart_at = None;
        let missing = self.missing();
        let start = |_| {
            self.last_number += 1;
            let id = format!("{}-{}@{host}", self.template.name, self.last_number);
            let phase = Phase::Starting { until: now + self.template.start_timeout() };
            self.workers.insert(id.clone(), Worker { phase, pid: 0, endpoint: String::new() });
            commands.push(Command::Start { id: id.clone(), template: self.template.name.clone() });
            id
        };
        (0..missing).map(start).collect()
    }

    fn crashed(&mut self, now: Timestamp, worker: &Worker, id: &str, reason: &str, last_words: &str) {
        let stable = match worker.phase {
            Phase::Serving { since } | Phase::Ready { since } => now.since(since) >= self.template.stable(),
            _ => false,
        };
        self.crashes = if stable { 1 } else { self.crashes + 1 };
        if self.crashes >= self.template.crash_limit {
            let words = if last_words.is_empty() { String::new() } else { format!("; its last words: {last_words}") };
            self.failure = format!("{} crashes in a row; {id}: {reason}{words}", self.crashes);
            return;
        }
        if self.crashes > 1 {
            let doublings = (self.crashes - 2).min(20);
            let milliseconds = self.template.backoff_ms.saturating_mul(1 << doublings);
            self.restart_at = Some(now + Duration::from_millis(milliseconds.min(self.template.max_backoff_ms)));
        }
    }
}

impl Worker {
    /// Whether it was not stopping already.
    fn stop(&mut self, id: &str, kill_at: Timestamp, commands: &mut Vec<Command>) -> bool {
        if matches!(self.phase, Phase::Stopping { .. }) {
            return false;
        }
        self.phase = Phase::Stopping { kill_at: Some(kill_at) };
        commands.push(Command::Withdraw { id: id.to_owned() });
        commands.push(Command::Terminate { id: id.to_owned() });
        true
    }

    fn status(&self, id: &str, template: &str, reason: String) -> WorkerStatus {
        let state = match self.phase {
            Phase::Ready { .. } => WorkerState::Ready,
            _ => WorkerState::Starting,
        };
        WorkerStatus {
            id: id.to_owned(),
            template: template.to_owned(),
            state,
            pid: self.pid,
            endpoint: self.endpoint.clone(),
            reason,
            resident_bytes: 0,
            cpu_millicores: 0,
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    fn pools(edit: impl FnOnce(&mut Template)) -> Pools {
        let mut template = Template::new("planner", "PathPlanner");
        edit(&mut template);
        let mut pools = Pools::new("compute", [template]);
        pools.advance(Timestamp(0));
        pools
    }

    fn at(seconds: f64) -> Timestamp {
        Timestamp::from_seconds(seconds)
    }

    fn started(pools: &mut Pools) -> Vec<String> {
        let id = |command| match command {
            Command::Start { id, .. } => Some(id),
            _ => None,
        };
        pools.take_commands().into_iter().filter_map(id).collect()
    }

    fn bring_up(pools: &mut Pools, now: Timestamp, id: &str) {
        pools.spawned(id, 4711);
        pools.serving(now, id, "unix:/w");
        pools.resource_there(id);
    }

    #[test]
    fn the_minimum_is_kept_and_a_worker_is_ready_once_its_resource_is_there() {
        let mut pools = pools(|template| template.min = 2);
        assert_eq!(started(&mut pools), ["planner-1@compute", "planner-2@compute"]);
        pools.spawned("planner-1@compute", 4711);
        pools.serving(at(1.0), "planner-1@compute", "unix:/w");
        let commands = pools.take_commands();
        assert!(matches!(&commands[1], Command::Offer { worker, kind }
            if worker.endpoint == "unix:/w" && worker.pid == 4711 && kind == "PathPlanner"));
        assert_eq!(pools.status()[0].workers[0].state, WorkerState::Starting);
        pools.resource_there("planner-1@compute");
        assert_eq!(pools.status()[0].workers[0].state, WorkerState::Ready);
    }

    #[test]
    fn a_crash_withdraws_the_resource_at_once_and_starts_another_under_a_new_id() {
        let mut pools = pools(|_| {});
        bring_up(&mut pools, at(0.0), "planner-1@compute");
        pools.take_commands();
        pools.exited(at(60.0), "planner-1@compute", "killed by signal 9", "");
        let commands = pools.take_commands();
        assert_eq!(commands[0], Command::Withdraw { id: "planner-1@compute".into() });
        assert!(matches!(&commands[1], Command::Tell(worker) if worker.reason == "killed by signal 9"));
        assert!(matches!(&commands[2], Command::Start { id, .. } if id == "planner-2@compute"));
    }

    #[test]
    fn crashes_in_a_row_wait_longer_and_longer_and_then_fail_the_pool() {
        let mut pools = pools(|template| template.crash_limit = 4);
        let mut now = 0.0;
        let mut waited = Vec::new();
        for number in 1.. {
            let ids = started(&mut pools);
            if ids.is_empty() {
                let Some(deadline) = pools.next_deadline() else { break };
                waited.push((deadline.seconds() - now) * 1000.0);
                now = deadline.seconds();
                pools.advance(deadline);
                continue;
            }
            assert!(number < 20);
            pools.exited(at(now), &ids[0], "exited with status 1", "cannot open the model");
        }
        assert_eq!(waited.iter().map(|ms| ms.round()).collect::<Vec<_>>(), [100.0, 200.0]);
        let failure = &pools.status()[0].failure;
        assert_eq!(
            failure,
            "4 crashes in a row; planner-4@compute: exited with status 1; its last words: cannot open the model"
        );
        pools.spawn(at(now), "planner", 1).unwrap();
        assert_eq!(started(&mut pools).len(), 1, "somebody who asks starts it again");
    }

    #[test]
    fn a_stable_worker_that_crashes_is_not_part_of_a_crash_loop() {
        let mut pools = pools(|template| template.crash_limit = 2);
        for round in 0..5 {
            let ids = started(&mut pools);
            assert_eq!(ids.len(), 1);
            bring_up(&mut pools, at(f64::from(round) * 100.0), &ids[0]);
            pools.exited(at(f64::from(round) * 100.0 + 50.0), &ids[0], "killed by signal 9", "");
        }
        assert_eq!(pools.status()[0].failure, "");
    }

    #[test]
    fn a_worker_that_does_not_serve_in_time_is_killed_and_counts_as_a_crash() {
        let mut pools = pools(|template| template.start_timeout_s = 3.0);
        pools.take_commands();
        assert_eq!(pools.next_deadline(), Some(at(3.0)));
        pools.advance(at(3.0));
        assert_eq!(pools.take_commands(), [Command::Kill { id: "planner-1@compute".into() }]);
        pools.serving(at(3.1), "planner-1@compute", "unix:/late");
        assert!(pools.take_commands().is_empty(), "too late is too late");
        pools.exited(at(3.2), "planner-1@compute", "killed by signal 9", "");
        assert!(
            pools
                .take_commands()
                .iter()
                .any(|command| matches!(command, Command::Tell(worker) if worker.reason == "not serving within 3 s"))
        );
    }

    #[test]
    fn a_worker_whose_time_was_over_before_its_process_was_there_is_killed_when_it_is() {
        let mut pools = pools(|template| template.start_timeout_s = 3.0);
        pools.advance(at(3.0));
        pools.take_commands();
        pools.spawned("planner-1@compute", 4711);
        assert_eq!(pools.take_commands()[0], Command::Kill { id: "planner-1@compute".into() });
    }

    #[test]
    fn a_worker_stopped_before_its_process_was_there_is_terminated_and_if_late_killed_when_it_is() {
        for (passed, command) in [(0.5, "Terminate"), (3.0, "Kill")] {
            let mut pools = pools(|_| {});
            pools.stop(at(0.0), "planner-1@compute").unwrap();
            pools.advance(at(passed));
            pools.take_commands();
            pools.spawned("planner-1@compute", 4711);
            assert!(format!("{:?}", pools.take_commands()[0]).starts_with(command));
        }
    }

    #[test]
    fn a_failed_pool_at_its_maximum_starts_again_when_somebody_asks() {
        let mut pools = pools(|template| (template.min, template.crash_limit) = (2, 1));
        for id in started(&mut pools) {
            pools.exited(at(0.0), &id, "exited with status 1", "");
        }
        assert!(started(&mut pools).is_empty() && !pools.status()[0].failure.is_empty());
        let asked = pools.spawn(at(1.0), "planner", 1).unwrap();
        assert_eq!(asked.len(), 1);
        assert_eq!(started(&mut pools).len(), 2, "the minimum is kept again");
        assert!(matches!(pools.spawn(at(1.0), "planner", 1), Err(PoolError::TooMany { wanted: 2, .. })));
    }

    #[test]
    fn a_stopped_worker_is_terminated_then_killed_and_replaced_only_below_the_minimum() {
        let mut pools = pools(|template| template.max = Some(2));
        let first = started(&mut pools).remove(0);
        let second = pools.spawn(at(0.0), "planner", 1).unwrap().remove(0);
        let refused = pools.spawn(at(0.0), "planner", 1).unwrap_err().to_string();
        assert_eq!(refused, "`planner` has 2 workers of at most 2: 1 more are too many");
        bring_up(&mut pools, at(0.0), &second);
        pools.take_commands();
        pools.stop(at(1.0), &second).unwrap();
        assert_eq!(
            pools.take_commands(),
            [Command::Withdraw { id: second.clone() }, Command::Terminate { id: second.clone() }]
        );
        pools.advance(at(3.0));
        assert_eq!(pools.take_commands(), [Command::Kill { id: second.clone() }]);
        pools.exited(at(3.1), &second, "killed by signal 9", "");
        assert!(started(&mut pools).is_empty());
        pools.stop(at(4.0), &first).unwrap();
        assert_eq!(started(&mut pools), ["planner-3@compute"], "the minimum is kept");
    }

    #[test]
    fn in_the_end_everything_is_stopped_and_nothing_is_started() {
        let mut pools = pools(|template| template.min = 2);
        let ids = started(&mut pools);
        pools.shut_down(at(1.0), Duration::from_millis(500));
        pools.take_commands();
        assert_eq!(pools.next_deadline(), Some(at(1.5)));
        for id in ids {
            pools.exited(at(1.1), &id, "exited with status 0", "");
        }
        assert!(started(&mut pools).is_empty());
        assert!(pools.is_empty());
        assert_eq!(pools.spawn(at(2.0), "planner", 1), Err(PoolError::Ending));
    }

    fn demand(provided: u32, missing: u32) -> [Demand; 1] {
        let requirement = ratn_model::resource::Requirement {
            count: missing,
            ..ratn_model::resource::Requirement::new(ratn_model::resource::ResourceOperation::Block, "PathPlanner")
        };
        [Demand { requirement, kinds: vec!["Planner".to_owned(), "PathPlanner".to_owned()], provided }]
    }

    #[test]
    fn for_those_who_wait_workers_are_started_once_and_up_to_the_maximum() {
        let now = Timestamp(0);
        let mut pools = pools(|template| (template.min, template.max) = (0, Some(3)));
        pools.advance(now);
        assert_eq!(started(&mut pools).len(), 0);
        pools.demanded(now, &demand(0, 2));
        assert_eq!(started(&mut pools).len(), 2);
        // One of them is there: as many are wanted as before.
        pools.serving(now, "planner-1@compute", "unix:/1");
        pools.resource_there("planner-1@compute");
        pools.demanded(now, &demand(1, 1));
        assert_eq!((started(&mut pools).len(), pools.shortages().len()), (0, 0));
        pools.demanded(now, &demand(1, 9));
        assert_eq!(started(&mut pools).len(), 1);
        assert_eq!(pools.shortages()["PathPlanner"], "`planner` has 3 workers at the most");
        // Nobody waits any more: what does not serve yet is ended, the other one stays.
        pools.demanded(now, &[]);
        let ended: Vec<Command> = pools.take_commands();
        let terminated = ended.iter().filter_map(|command| match command {
            Command::Terminate { id } => Some(id.as_str()),
            _ => None,
        });
        assert_eq!(terminated.collect::<Vec<_>>(), ["planner-3@compute", "planner-2@compute"]);
        assert!(pools.shortages().is_empty());
    }

    #[test]
    fn demand_that_no_worker_of_this_host_would_meet_starts_none() {
        let mut pools = pools(|template| template.min = 0);
        let mut elsewhere = demand(0, 1);
        elsewhere[0].requirement.attributes.insert("host".to_owned(), Value::String("elsewhere".to_owned()));
        pools.demanded(Timestamp(0), &elsewhere);
        assert_eq!(started(&mut pools).len(), 0);
        elsewhere[0].requirement.attributes.insert("host".to_owned(), Value::String("compute".to_owned()));
        pools.demanded(Timestamp(0), &elsewhere);
        assert_eq!(started(&mut pools).len(), 1);
    }
}
