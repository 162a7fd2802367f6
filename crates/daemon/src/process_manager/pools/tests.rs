//! The pools in virtual time.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

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

#[test]
fn the_minimum_is_kept_and_a_worker_is_ready_once_its_resource_is_there() {
    let mut pools = pools(|template| template.min = 2);
    assert_eq!(started(&mut pools), ["planner-1@compute", "planner-2@compute"]);
    pools.spawned("planner-1@compute");
    pools.serving(at(1.0), "planner-1@compute");
    let commands = pools.take_commands();
    assert!(matches!(&commands[1], Command::Offer { worker, kind, .. }
        if worker.endpoint == "unix:/w" && worker.pid == 4711 && kind == "PathPlanner"));
    assert_eq!(pools.status()[0].workers[0].state, WorkerState::Starting);
    pools.handle(at(1.0), Event::Offered { id: "planner-1@compute".to_owned() });
    assert_eq!(pools.status()[0].workers[0].state, WorkerState::Ready);
}

#[test]
fn a_crash_withdraws_the_resource_at_once_and_starts_another_under_a_new_id() {
    let mut pools = pools(|_| {});
    pools.bring_up(at(0.0), "planner-1@compute");
    pools.take_commands();
    pools.exited(at(60.0), "planner-1@compute", "killed by signal 9", "");
    let commands = pools.take_commands();
    assert_eq!(commands[0], Command::Withdraw { id: "planner-1@compute".into() });
    assert!(matches!(&commands[1], Command::Notify(worker) if worker.reason == "killed by signal 9"));
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
    assert!(
        matches!(waited[..], [first, second] if (75.0..=100.0).contains(&first) && (150.0..=200.0).contains(&second))
    );
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
        pools.bring_up(at(f64::from(round) * 100.0), &ids[0]);
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
    pools.serving(at(3.1), "planner-1@compute");
    assert!(pools.take_commands().is_empty(), "too late is too late");
    pools.exited(at(3.2), "planner-1@compute", "killed by signal 9", "");
    assert!(
        pools
            .take_commands()
            .iter()
            .any(|command| matches!(command, Command::Notify(worker) if worker.reason.starts_with("not ready within 3 s: its endpoint file")))
    );
}

#[test]
fn a_worker_that_computes_while_it_starts_is_waited_for_up_to_a_bound() {
    let mut pools = pools(|template| template.start_timeout_s = 3.0);
    let busy = |pools: &mut Rig, s: f64| pools.handle(at(s), Event::Busy { id: "planner-1@compute".into() });
    pools.take_commands();
    for second in 1..=598 {
        busy(&mut pools, f64::from(second));
        pools.advance(at(f64::from(second)));
        assert_eq!(pools.next_deadline(), Some(at(f64::from(second + 3).min(600.0))));
    }
    assert!(pools.take_commands().is_empty());
    busy(&mut pools, 599.9);
    pools.advance(at(600.0));
    assert_eq!(pools.take_commands(), [Command::Kill { id: "planner-1@compute".into() }]);
    // It is too late.
    busy(&mut pools, 600.1);
    assert_eq!(pools.next_deadline(), None);
}

#[test]
fn a_worker_whose_time_was_over_before_its_process_was_there_is_killed_when_it_is() {
    let mut pools = pools(|template| template.start_timeout_s = 3.0);
    pools.advance(at(3.0));
    pools.take_commands();
    pools.spawned("planner-1@compute");
    assert_eq!(pools.take_commands()[0], Command::Kill { id: "planner-1@compute".into() });
}

#[test]
fn a_worker_stopped_before_its_process_was_there_is_terminated_and_if_late_killed_when_it_is() {
    for (passed, command) in [(0.5, "Terminate"), (3.0, "Kill")] {
        let mut pools = pools(|_| {});
        pools.stop(at(0.0), "planner-1@compute");
        pools.advance(at(passed));
        pools.take_commands();
        pools.spawned("planner-1@compute");
        assert!(format!("{:?}", pools.take_commands()[0]).starts_with(command));
    }
}

#[test]
fn of_a_crowd_some_are_started_at_a_time_and_nobody_is_late_because_of_the_others() {
    let crowd = pool::STARTING_AT_ONCE * 3;
    let mut pools = pools(|template| (template.min, template.max) = (0, Some(crowd)));
    let promised = pools.spawn(at(0.0), "planner", crowd).unwrap();
    assert_eq!(promised.len(), crowd as usize);
    let mut begun = started(&mut pools);
    assert_eq!(begun.len(), pool::STARTING_AT_ONCE as usize);
    for ready in 0..promised.len() {
        // All of them together take much longer to start than one may.
        pools.advance(at(5.0 * ready as f64 / f64::from(pool::STARTING_AT_ONCE)));
        let id = begun[ready].clone();
        pools.bring_up(at(5.0 * ready as f64 / f64::from(pool::STARTING_AT_ONCE)), &id);
        begun.extend(started(&mut pools));
        assert!(begun.len() - (ready + 1) <= pool::STARTING_AT_ONCE as usize);
    }
    assert_eq!(begun, promised);
    assert!(pools.status()[0].workers.iter().all(|worker| worker.state == WorkerState::Ready));
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
    pools.bring_up(at(0.0), &second);
    pools.take_commands();
    pools.stop(at(1.0), &second);
    assert_eq!(pools.take_commands(), [Command::Retire { id: second.clone() }]);
    pools.handle(at(1.0), Event::Withdrawn { id: second.clone() });
    assert_eq!(
        pools.take_commands(),
        [Command::Withdraw { id: second.clone() }, Command::Terminate { id: second.clone() }]
    );
    pools.advance(at(3.0));
    assert_eq!(pools.take_commands(), [Command::Kill { id: second.clone() }]);
    pools.exited(at(3.1), &second, "killed by signal 9", "");
    assert!(started(&mut pools).is_empty());
    pools.stop(at(4.0), &first);
    assert_eq!(started(&mut pools), ["planner-3@compute"], "the minimum is kept");
}

#[test]
fn in_the_end_everything_is_stopped_and_nothing_is_started() {
    let mut pools = pools(|template| template.min = 2);
    let ids = started(&mut pools);
    pools.pools.shut_down(at(1.0), Duration::from_millis(500));
    assert_eq!(pools.next_deadline(), Some(at(1.5)));
    for id in ids {
        pools.exited(at(1.1), &id, "exited with status 0", "");
    }
    assert!(started(&mut pools).is_empty());
    assert!(pools.is_empty());
    assert_eq!(pools.spawn(at(2.0), "planner", 1), Err(PoolError::Ending));
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

#[test]
fn for_those_who_wait_workers_are_started_once_and_up_to_the_maximum() {
    let now = Timestamp(0);
    let mut pools = pools(|template| (template.min, template.max) = (0, Some(3)));
    pools.advance(now);
    assert_eq!(started(&mut pools).len(), 0);
    pools.demanded(now, &demand(0, 2));
    assert_eq!(started(&mut pools).len(), 2);
    // One of them is ready: as many are wanted as before.
    pools.serving(now, "planner-1@compute");
    pools.handle(at(1.0), Event::Offered { id: "planner-1@compute".to_owned() });
    pools.demanded(now, &demand(1, 1));
    assert_eq!((started(&mut pools).len(), pools.shortages().len()), (0, 0));
    pools.demanded(now, &demand(1, 9));
    assert_eq!(started(&mut pools).len(), 1);
    assert_eq!(pools.shortages()["PathPlanner"], shortage(3, "`planner` has 3 workers at the most"));
    // No more demand: the workers that do not serve yet are ended, the other one stays.
    pools.demanded(now, &[]);
    let ended: Vec<Command> = pools.take_commands();
    let terminated = ended.iter().filter_map(|command| match command {
        Command::Terminate { id } => Some(id.as_str()),
        _ => None,
    });
    assert_eq!(terminated.collect::<Vec<_>>(), ["planner-3@compute", "planner-2@compute"]);
    assert!(pools.shortages().is_empty());
}

/// This many requests wait for held workers.
fn queue(provided: u32, queued: u32) -> [Demand; 1] {
    demand(provided, queued).map(|demand| Demand { queued: queued.into(), ..demand })
}

#[test]
fn a_worker_is_started_for_those_who_wait_for_what_is_held_and_ends_when_it_has_been_idle() {
    let mut pools = pools(|template| (template.max, template.idle_s) = (Some(2), 20.0));
    pools.bring_up(at(0.0), "planner-1@compute");
    pools.used(at(0.0), "planner-1@compute", true);
    pools.take_commands();
    pools.demanded(at(1.0), &queue(1, 3));
    assert_eq!(started(&mut pools), ["planner-2@compute"]);
    assert!(pools.shortages().is_empty(), "nothing is missing");
    // The wait is over before the worker is ready: the worker is not ended, and the next wait starts no other one.
    pools.demanded(at(1.2), &[]);
    pools.demanded(at(1.4), &queue(1, 1));
    pools.demanded(at(1.6), &[]);
    assert_eq!(pools.take_commands(), []);
    pools.bring_up(at(2.0), "planner-2@compute");
    pools.run_until(at(21.9));
    assert_eq!(pools.ids().len(), 2);
    pools.run_until(at(22.0));
    assert_eq!(pools.ids(), ["planner-1@compute"]);
}

#[test]
fn what_does_not_come_up_is_not_tried_again_when_nobody_waits_any_more() {
    let mut pools = pools(|template| template.max = Some(2));
    pools.bring_up(at(0.0), "planner-1@compute");
    pools.used(at(0.0), "planner-1@compute", true);
    pools.take_commands();
    pools.demanded(at(1.0), &queue(1, 1));
    assert_eq!(started(&mut pools), ["planner-2@compute"]);
    pools.demanded(at(1.2), &[]);
    pools.exited(at(2.0), "planner-2@compute", "exited with status 1", "");
    pools.run_until(at(100.0));
    assert_eq!(started(&mut pools).len(), 0);
}

#[test]
fn who_waits_for_a_worker_that_never_becomes_ready_hears_why_while_others_are_tried() {
    let mut pools = pools(|template| template.crash_limit = 100);
    assert!(pools.shortages().is_empty());
    pools.spawned("planner-1@compute");
    pools.exited(at(1.0), "planner-1@compute", "exited with status 3", "no model");
    let why = "`planner` has no worker that became ready, and starts another one: planner-1@compute: exited with status 3; \
               its last words: no model";
    assert_eq!(pools.shortages()["PathPlanner"], shortage(1, why), "as many may come as before");
    pools.bring_up(at(2.0), "planner-2@compute");
    assert!(pools.shortages().is_empty());
    pools.exited(at(3.0), "planner-2@compute", "killed by signal 9", "");
    assert!(pools.shortages().is_empty(), "one that was ready");
}

#[test]
fn of_what_moves_there_are_no_more_because_others_wait_for_it() {
    let mut pools = pools(|template| (template.max, template.standstill_ms) = (Some(2), Some(100)));
    pools.bring_up(at(0.0), "planner-1@compute");
    pools.used(at(0.0), "planner-1@compute", true);
    pools.take_commands();
    pools.demanded(at(1.0), &queue(1, 1));
    assert_eq!(started(&mut pools).len(), 0);
    pools.demanded(at(2.0), &demand(1, 1));
    assert_eq!(started(&mut pools).len(), 1, "what is missing is another matter");
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

#[test]
fn what_was_started_for_a_demand_ends_when_it_has_been_idle_and_the_minimum_stays() {
    let mut pools = pools(|template| (template.max, template.idle_s) = (Some(3), 20.0));
    pools.bring_up(at(0.0), "planner-1@compute");
    pools.demanded(at(1.0), &demand(1, 2));
    for id in ["planner-2@compute", "planner-3@compute"] {
        pools.bring_up(at(2.0), id);
        pools.used(at(2.0), id, true);
    }
    pools.used(at(2.0), "planner-1@compute", true);
    pools.demanded(at(2.0), &[]);
    pools.run_until(at(100.0));
    assert_eq!(pools.ids().len(), 3, "who is held does not end, however long");
    pools.used(at(100.0), "planner-2@compute", false);
    pools.used(at(110.0), "planner-1@compute", false);
    pools.run_until(at(119.9));
    assert_eq!(pools.ids().len(), 3);
    pools.run_until(at(120.0));
    assert_eq!(pools.ids(), ["planner-1@compute", "planner-3@compute"]);
    pools.used(at(125.0), "planner-3@compute", false);
    pools.run_until(at(1_000.0));
    assert_eq!(pools.ids(), ["planner-3@compute"], "the longest idle ended, and nobody beyond the minimum");
    assert!(started(&mut pools).iter().all(|id| id != "planner-4@compute"), "and none was started for them");
}

#[test]
fn who_is_held_in_the_moment_of_its_end_stays() {
    let mut pools = pools(|template| (template.min, template.max, template.idle_s) = (0, Some(1), 20.0));
    pools.demanded(at(0.0), &demand(0, 1));
    pools.bring_up(at(0.0), "planner-1@compute");
    pools.demanded(at(0.0), &[]);
    pools.advance(at(20.0));
    let id = || "planner-1@compute".to_owned();
    assert!(pools.take_commands().contains(&Command::Retire { id: id() }));
    pools.handle(at(20.0), Event::Kept { id: id() });
    pools.used(at(20.0), &id(), true);
    assert_eq!(pools.take_commands(), [Command::Keep { id: id() }]);
    pools.run_until(at(500.0));
    assert_eq!(pools.ids(), [id()]);
    pools.used(at(500.0), &id(), false);
    pools.run_until(at(520.0));
    assert!(pools.is_empty());
}

#[test]
fn spares_take_the_place_of_those_that_are_held_and_end_when_they_are_free_again() {
    let mut pools = pools(|template| (template.max, template.spares, template.idle_s) = (Some(4), 1, 20.0));
    assert_eq!(started(&mut pools), ["planner-1@compute", "planner-2@compute"], "the minimum, and a spare");
    pools.bring_up(at(0.0), "planner-1@compute");
    pools.bring_up(at(0.0), "planner-2@compute");
    pools.used(at(1.0), "planner-1@compute", true);
    assert!(started(&mut pools).is_empty(), "one is free still");
    pools.used(at(1.0), "planner-2@compute", true);
    assert_eq!(started(&mut pools), ["planner-3@compute"]);
    pools.bring_up(at(2.0), "planner-3@compute");
    pools.used(at(3.0), "planner-1@compute", false);
    pools.used(at(3.0), "planner-2@compute", false);
    pools.run_until(at(1_000.0));
    assert_eq!(pools.ids().len(), 2);
}

#[test]
fn a_worker_that_does_not_answer_is_taken_away_at_once_and_replaced() {
    let mut pools = pools(|template| template.liveness.interval_s = 2.0);
    pools.bring_up(at(0.0), "planner-1@compute");
    pools.take_commands();
    let id = || "planner-1@compute".to_owned();
    let within = Duration::from_secs(10);
    pools.advance(at(2.0));
    assert_eq!(pools.take_commands(), [Command::Check { id: id(), within }]);
    pools.handle(at(2.1), Event::Answered { id: id() });
    pools.advance(at(4.1));
    assert_eq!(pools.take_commands(), [Command::Check { id: id(), within }]);
    pools.handle(at(14.1), Event::Unanswered { id: id(), why: "not serving within 10.0 s".to_owned() });
    assert_eq!(pools.take_commands(), [Command::Withdraw { id: id() }, Command::Kill { id: id() }]);
    pools.exited(at(14.2), &id(), "killed by signal 9", "");
    let commands = pools.take_commands();
    assert!(matches!(&commands[1], Command::Notify(worker) if worker.reason == "hung: not serving within 10.0 s"));
    assert!(matches!(&commands[2], Command::Start { id, .. } if id == "planner-2@compute"));
}

#[test]
fn a_template_starts_after_those_it_waits_for() {
    let template = |name: &str, after: &[&str]| Template {
        after: after.iter().map(|&name| name.to_owned()).collect(),
        ..Template::new(name, "Any")
    };
    let pools = Pools::new("compute", [template("a", &["b", "c"]), template("b", &["c"]), template("c", &[])]);
    let mut pools = Rig { pools, commands: Vec::new() };
    pools.advance(at(0.0));
    assert_eq!(started(&mut pools), ["c-1@compute"]);
    assert_eq!(pools.shortages()["Any"], shortage(0, "`a` waits until there is a worker of b, c"));
    pools.bring_up(at(1.0), "c-1@compute");
    assert_eq!(started(&mut pools), ["b-1@compute"]);
    // A worker that has ended since then still counts as having been ready.
    pools.exited(at(2.0), "c-1@compute", "killed by signal 9", "");
    pools.bring_up(at(3.0), "b-1@compute");
    assert_eq!(started(&mut pools), ["c-2@compute", "a-1@compute"]);
}

#[test]
fn those_that_are_replaced_go_one_by_one_each_once_its_successor_is_ready() {
    let mut pools = pools(|template| {
        template.min = 2;
        template.max = Some(2);
    });
    for id in ["planner-1@compute", "planner-2@compute"] {
        pools.bring_up(at(0.0), id);
    }
    pools.used(at(1.0), "planner-1@compute", true);
    pools.take_commands();
    let (going, commands) = pools.pools.restart(at(1.0), &Restart::Template("planner".into())).unwrap();
    assert_eq!(going, ["planner-1@compute", "planner-2@compute"]);
    assert!(matches!(&commands[..], [Command::Start { id, .. }] if id == "planner-3@compute"), "{commands:?}");
    pools.bring_up(at(2.0), "planner-3@compute");
    let retired = |pools: &mut Rig| {
        let commands = pools.take_commands().into_iter();
        commands.filter(|c| matches!(c, Command::Retire { .. } | Command::Start { .. })).collect::<Vec<_>>()
    };
    let retire = |id: &str| Command::Retire { id: id.to_owned() };
    assert_eq!(retired(&mut pools), [retire("planner-2@compute")], "who is not held goes first");
    pools.handle(at(2.0), Event::Withdrawn { id: "planner-2@compute".into() });
    assert_eq!(retired(&mut pools), [], "one at a time");
    pools.exited(at(3.0), "planner-2@compute", "exited with status 0", "");
    assert!(matches!(&retired(&mut pools)[..], [Command::Start { id, .. }] if id == "planner-4@compute"));
    pools.bring_up(at(4.0), "planner-4@compute");
    assert_eq!(retired(&mut pools), [retire("planner-1@compute")]);
    pools.used(at(5.0), "planner-1@compute", false);
    pools.handle(at(5.0), Event::Withdrawn { id: "planner-1@compute".into() });
    pools.exited(at(5.0), "planner-1@compute", "exited with status 0", "");
    assert_eq!(pools.ids(), ["planner-3@compute", "planner-4@compute"]);
    assert_eq!(pools.status()[0].crashes, 0);
}

#[test]
fn where_the_new_ones_crash_the_old_ones_stay() {
    let mut pools = pools(|template| template.crash_limit = 2);
    pools.bring_up(at(0.0), "planner-1@compute");
    pools.pools.restart(at(1.0), &Restart::Template("planner".into())).unwrap();
    pools.exited(at(1.0), "planner-2@compute", "exited with status 1", "");
    pools.run_until(at(2.0));
    pools.exited(at(2.0), "planner-3@compute", "exited with status 1", "");
    pools.run_until(at(90.0));
    let pool = pools.status().remove(0);
    assert!(pool.failure.starts_with("2 crashes in a row"), "{pool:?}");
    assert_eq!((pools.ids(), pool.workers[0].state), (vec!["planner-1@compute".to_owned()], WorkerState::Ready));
    assert_eq!((pool.crashes, pool.last_exit.as_str()), (2, "planner-3@compute: exited with status 1"));
}

#[test]
fn of_those_that_cannot_be_two_the_old_one_goes_before_the_new_one_is_started() {
    let mut pools = pools(|template| template.readiness = Readiness::Port { port: 7_000 });
    pools.bring_up(at(0.0), "planner-1@compute");
    pools.take_commands();
    let (_, commands) = pools.pools.restart(at(1.0), &Restart::Worker("planner-1@compute".into())).unwrap();
    assert_eq!(commands, [Command::Retire { id: "planner-1@compute".into() }]);
    pools.handle(at(1.0), Event::Withdrawn { id: "planner-1@compute".into() });
    assert_eq!(started(&mut pools), [] as [&str; 0]);
    pools.exited(at(1.5), "planner-1@compute", "exited with status 0", "");
    assert_eq!(started(&mut pools), ["planner-2@compute"]);
}

#[test]
fn a_drained_host_starts_nothing_whoever_asks_and_all_of_it_again_when_that_is_over() {
    let mut pools = pools(|template| template.max = Some(3));
    pools.bring_up(at(0.0), "planner-1@compute");
    pools.used(at(0.0), "planner-1@compute", true);
    pools.take_commands();
    let commands = pools.pools.drain(at(1.0), true);
    assert_eq!(commands, [Command::Retire { id: "planner-1@compute".into() }]);
    assert_eq!(pools.pools.spawn(at(1.0), "planner", 1), Err(PoolError::Drained { host: "compute".into() }));
    assert_eq!(pools.shortages()["PathPlanner"], shortage(0, "the host `compute` is drained"));
    pools.demanded(at(2.0), &demand(0, 2));
    pools.used(at(3.0), "planner-1@compute", false);
    pools.handle(at(3.0), Event::Withdrawn { id: "planner-1@compute".into() });
    pools.exited(at(3.0), "planner-1@compute", "exited with status 0", "");
    pools.run_until(at(100.0));
    assert_eq!((pools.ids(), started(&mut pools)), (Vec::<String>::new(), Vec::new()));
    let commands = pools.pools.drain(at(100.0), false);
    assert_eq!(commands.len(), 2, "what is demanded is started: {commands:?}");
}

#[test]
fn more_than_the_minimum_are_started_only_where_the_machine_has_room() {
    let mut pools = pools(|template| {
        template.max = Some(5);
        template.needs = Needs { free_memory_mib: Some(2_048), idle_cores: None };
    });
    assert_eq!(started(&mut pools), ["planner-1@compute"], "the minimum, whatever there is");
    pools.bring_up(at(0.0), "planner-1@compute");
    pools.used(at(0.0), "planner-1@compute", true);
    let free = |mib: u64| {
        Event::Looked(Sample {
            cores: 4,
            load_per_core: 0.0,
            idle_cores: 4.0,
            memory_bytes: 16 << 30,
            free_memory_bytes: mib << 20,
            disk_bytes: 1,
            free_disk_bytes: 1,
            battery: None,
        })
    };
    pools.handle(at(1.0), free(1_000));
    pools.demanded(at(1.0), &demand(1, 3));
    assert_eq!(started(&mut pools), [] as [&str; 0]);
    let at_most = |most| shortage(most, "`planner` needs 2048 MiB of free memory for one more worker");
    assert_eq!(pools.shortages()["PathPlanner"], at_most(1));
    pools.handle(at(2.0), free(5_000));
    assert_eq!(started(&mut pools), ["planner-2@compute", "planner-3@compute"]);
    assert_eq!(pools.shortages()["PathPlanner"], at_most(3), "those that are starting count");
    pools.handle(at(3.0), free(5_000));
    assert_eq!(started(&mut pools), [] as [&str; 0], "those have not taken theirs yet");
    for id in ["planner-2@compute", "planner-3@compute"] {
        pools.bring_up(at(4.0), id);
    }
    pools.handle(at(5.0), free(3_000));
    assert_eq!(started(&mut pools), ["planner-4@compute"]);
    assert_eq!(pools.shortages()["PathPlanner"], at_most(4));
    pools.handle(at(6.0), free(5_000));
    assert!(pools.shortages().is_empty(), "for the fifth there is room");
}

fn retires(pools: &mut Rig, id: &str, now: Timestamp) {
    pools.stop(now, id);
    pools.handle(now, Event::Withdrawn { id: id.to_owned() });
    pools.exited(now, id, "exited with status 0", "");
}

fn ended(pools: &mut Rig) -> Vec<String> {
    let of = |command: &Command| match command {
        Command::Terminate { id } => Some(id.clone()),
        _ => None,
    };
    pools.commands.iter().filter_map(of).collect()
}

fn offered(pools: &mut Rig) -> Vec<String> {
    let of = |command| match command {
        Command::Offer { worker, .. } => Some(worker.id),
        _ => None,
    };
    pools.take_commands().into_iter().filter_map(of).collect()
}

const SELDOM: Liveness = Liveness { interval_s: 1_000.0, timeout_s: 1.0 };

fn moving(edit: impl FnOnce(&mut Template)) -> Rig {
    pools(|template| {
        (template.standstill_ms, template.liveness) = (Some(6_000), SELDOM);
        edit(template);
    })
}

#[test]
fn under_another_session_every_worker_ends_at_once_also_one_that_only_serves_or_starts() {
    let mut pools = pools(|template| (template.min, template.max) = (4, Some(4)));
    let all = started(&mut pools);
    pools.bring_up(at(0.0), &all[0]);
    pools.used(at(0.0), &all[0], true);
    for id in &all[1..3] {
        pools.spawned(id);
    }
    pools.serving(at(0.5), &all[1]);
    pools.take_commands();
    pools.renew(at(1.0));
    assert_eq!(ended(&mut pools), all);
    let withdrawn = all.iter().all(|id| pools.commands.contains(&Command::Withdraw { id: id.clone() }));
    assert!(withdrawn, "{:?}", pools.commands);
    let next = started(&mut pools);
    assert_eq!(next, ["planner-5@compute", "planner-6@compute", "planner-7@compute", "planner-8@compute"]);
    // A later report from it does not make it a resource.
    pools.serving(at(1.1), &all[2]);
    pools.handle(at(1.1), Event::Offered { id: all[1].clone() });
    assert_eq!(offered(&mut pools), [] as [&str; 0]);
    // Its process was started only after it was told to end.
    pools.spawned(&all[3]);
    assert_eq!(pools.take_commands()[0], Command::Terminate { id: all[3].clone() });
    pools.advance(at(3.0));
    let kill = |id: &String| Command::Kill { id: id.clone() };
    assert_eq!(pools.take_commands(), all.iter().map(kill).collect::<Vec<_>>());
    for id in &all {
        pools.exited(at(3.1), id, "killed by signal 9", "");
    }
    for id in &next {
        pools.bring_up(at(3.2), id);
    }
    let status = pools.status().remove(0);
    assert_eq!((status.crashes, pools.ids()), (0, next));
    assert!(status.workers.iter().all(|worker| worker.state == WorkerState::Ready));
}

#[test]
fn under_another_session_also_one_that_leaves_ends_at_once() {
    let mut pools = pools(|_| {});
    pools.bring_up(at(0.0), "planner-1@compute");
    pools.used(at(0.0), "planner-1@compute", true);
    pools.stop(at(0.5), "planner-1@compute");
    pools.take_commands();
    pools.renew(at(1.0));
    assert_eq!(ended(&mut pools), ["planner-1@compute", "planner-2@compute"], "its successor was told of it, too");
    assert_eq!(started(&mut pools), ["planner-3@compute"]);
}

#[test]
fn under_another_session_a_machine_without_room_has_the_minimum_again() {
    let mut pools = pools(|template| {
        (template.min, template.max) = (2, Some(2));
        template.needs = Needs { free_memory_mib: Some(2_048), idle_cores: None };
    });
    for id in started(&mut pools) {
        pools.bring_up(at(0.0), &id);
    }
    pools.renew(at(1.0));
    assert_eq!(started(&mut pools), ["planner-3@compute", "planner-4@compute"]);
}

#[test]
fn under_another_session_those_that_cannot_be_two_end_before_another_is_started() {
    let mut pools = pools(|template| template.readiness = Readiness::Port { port: 7_000 });
    pools.spawned("planner-1@compute");
    pools.serving(at(0.0), "planner-1@compute");
    pools.take_commands();
    pools.renew(at(1.0));
    assert_eq!(ended(&mut pools), ["planner-1@compute"]);
    assert_eq!(started(&mut pools), [] as [&str; 0]);
    pools.exited(at(1.5), "planner-1@compute", "exited with status 0", "");
    assert_eq!(started(&mut pools), ["planner-2@compute"]);
}

#[test]
fn under_another_session_what_moves_is_offered_when_the_bound_has_passed_since_the_last_process_of_before() {
    let mut pools = moving(|template| (template.min, template.max) = (2, Some(2)));
    for id in started(&mut pools) {
        pools.bring_up(at(0.0), &id);
        pools.used(at(0.0), &id, true);
    }
    pools.take_commands();
    pools.renew(at(1.0));
    assert_eq!(ended(&mut pools), ["planner-1@compute", "planner-2@compute"]);
    assert_eq!(started(&mut pools), [] as [&str; 0], "two of them for one robot");
    pools.exited(at(1.5), "planner-1@compute", "exited with status 0", "");
    assert_eq!(started(&mut pools), ["planner-3@compute"]);
    pools.spawned("planner-3@compute");
    pools.serving(at(1.7), "planner-3@compute");
    let reason = &pools.status()[0].workers[1].reason;
    assert!(reason.contains("may still move"), "{reason}");
    // The bound after the end of the first worker is not enough: the second one may still move.
    pools.advance(at(3.0));
    pools.advance(at(8.0));
    assert_eq!(offered(&mut pools), [] as [&str; 0]);
    pools.exited(at(8.5), "planner-2@compute", "killed by signal 9", "");
    assert_eq!(pools.next_deadline(), Some(at(14.5)));
    pools.advance(at(14.4));
    assert_eq!(offered(&mut pools), [] as [&str; 0]);
    pools.advance(at(14.5));
    assert_eq!(offered(&mut pools), ["planner-3@compute"]);
    pools.handle(at(14.6), Event::Offered { id: "planner-3@compute".to_owned() });
    assert_eq!(pools.status()[0].workers[0].reason, "");
    pools.spawned("planner-4@compute");
    pools.serving(at(15.0), "planner-4@compute");
    assert_eq!(offered(&mut pools), ["planner-4@compute"], "at once");
}

#[test]
fn under_another_session_what_moves_and_was_never_offered_may_have_been_moved_by_whoever_has_the_session() {
    let mut pools = moving(|_| {});
    pools.spawned("planner-1@compute");
    pools.renew(at(1.0));
    pools.exited(at(2.0), "planner-1@compute", "exited with status 0", "");
    pools.spawned("planner-2@compute");
    pools.serving(at(3.0), "planner-2@compute");
    assert_eq!(offered(&mut pools), [] as [&str; 0]);
    pools.advance(at(8.0));
    assert_eq!(offered(&mut pools), ["planner-2@compute"]);
}

#[test]
fn a_drained_host_has_no_worker_more_under_another_session() {
    let mut pools = pools(|_| {});
    pools.bring_up(at(0.0), "planner-1@compute");
    pools.used(at(0.0), "planner-1@compute", true);
    pools.pools.drain(at(1.0), true);
    pools.take_commands();
    pools.renew(at(1.0));
    assert_eq!((ended(&mut pools).len(), started(&mut pools).len()), (1, 0));
}

#[test]
fn what_moved_for_somebody_is_offered_anew_when_the_bound_has_passed_and_at_once_where_it_was_given_back() {
    let next = |pools: &mut Rig, now: Timestamp| {
        let id = started(pools).remove(0);
        pools.spawned(&id);
        pools.serving(now, &id);
        offered(pools) == [id]
    };
    let mut pools = moving(|template| template.drain_s = 1.0);
    assert!(next(&mut pools, at(0.0)));
    let first = pools.ids().remove(0);
    pools.handle(at(0.0), Event::Offered { id: first.clone() });
    pools.used(at(0.0), &first, true);
    pools.exited(at(20.0), &first, "killed by signal 9", "");
    assert!(!next(&mut pools, at(20.0)), "its process is gone, and what it moves may go on");
    pools.advance(at(25.9));
    assert_eq!(offered(&mut pools), [] as [&str; 0]);
    pools.advance(at(26.0));
    assert_eq!(offered(&mut pools), ["planner-2@compute"]);
    pools.handle(at(26.0), Event::Offered { id: "planner-2@compute".to_owned() });

    retires(&mut pools, "planner-2@compute", at(40.0));
    assert!(next(&mut pools, at(40.0)), "nobody held it");
    pools.handle(at(40.0), Event::Offered { id: "planner-3@compute".to_owned() });

    // Waiting for a holder is bounded.
    pools.used(at(41.0), "planner-3@compute", true);
    pools.stop(at(41.0), "planner-3@compute");
    pools.advance(at(42.0));
    assert_eq!(ended(&mut pools), ["planner-3@compute"]);
    pools.exited(at(42.5), "planner-3@compute", "exited with status 0", "");
    assert!(!next(&mut pools, at(43.0)));
    pools.advance(at(48.5));
    assert_eq!(offered(&mut pools), ["planner-4@compute"]);
}

#[test]
fn one_that_moves_is_restarted_after_the_end_of_the_one_before_it() {
    let mut pools = moving(|_| {});
    pools.bring_up(at(0.0), "planner-1@compute");
    pools.take_commands();
    let (_, commands) = pools.pools.restart(at(1.0), &Restart::Worker("planner-1@compute".into())).unwrap();
    assert_eq!(commands, [Command::Retire { id: "planner-1@compute".into() }]);
    pools.handle(at(1.0), Event::Withdrawn { id: "planner-1@compute".into() });
    assert_eq!(started(&mut pools), [] as [&str; 0]);
    pools.exited(at(1.5), "planner-1@compute", "exited with status 0", "");
    assert_eq!(started(&mut pools), ["planner-2@compute"]);
}

fn seconds(seconds: u64) -> Duration {
    Duration::from_secs(seconds)
}

#[test]
fn what_moved_for_a_process_manager_of_before_is_offered_when_the_wider_bound_has_passed() {
    let wide = 30.0;
    for (template, of_then, from) in
        [("planner", 6, 6.0), ("planner", 2, 6.0), ("planner", 30, wide), ("gone", 30, wide)]
    {
        let mut pools = moving(|_| {});
        let motions = [(template.to_owned(), seconds(of_then))].into();
        pools.pools.moved_before(at(0.0), &motions);
        assert_eq!(
            pools.motions(at(0.0)).get(template),
            Some(&Duration::from_secs_f64(from)),
            "of that a successor hears"
        );
        let id = pools.ids().remove(0);
        pools.spawned(&id);
        pools.serving(at(1.0), &id);
        pools.advance(at(from - 0.1));
        assert_eq!(offered(&mut pools).len(), 0, "{template}, {of_then} s");
        pools.advance(at(from));
        assert_eq!(offered(&mut pools), [id], "{template}, {of_then} s");
    }
}

#[test]
fn what_moved_for_a_process_manager_of_before_is_waited_for_also_where_its_template_moves_nothing_any_more() {
    let mut pools = pools(|_| {});
    pools.pools.moved_before(at(0.0), &[("planner".to_owned(), seconds(6))].into());
    pools.spawned("planner-1@compute");
    pools.serving(at(1.0), "planner-1@compute");
    assert_eq!(offered(&mut pools), [] as [&str; 0]);
    pools.advance(at(6.0));
    assert_eq!(offered(&mut pools), ["planner-1@compute"]);
}

#[test]
fn a_successor_hears_of_what_moves_from_its_offer_on_until_it_rests() {
    let mut pools = moving(|_| {});
    let motion = |pools: &Rig, now: f64| pools.motions(at(now)).get("planner").copied();
    pools.spawned("planner-1@compute");
    assert_eq!(motion(&pools, 0.0), None, "nobody can hold it yet");
    pools.serving(at(1.0), "planner-1@compute");
    assert_eq!(motion(&pools, 1.0), Some(seconds(6)));
    pools.exited(at(20.0), "planner-1@compute", "killed by signal 9", "");
    assert_eq!((motion(&pools, 25.9), motion(&pools, 26.0)), (Some(seconds(6)), None));
    pools.bring_up(at(26.0), "planner-2@compute");
    assert_eq!(motion(&pools, 26.0), Some(seconds(6)));
    retires(&mut pools, "planner-2@compute", at(40.0));
    assert_eq!(motion(&pools, 40.0), None, "nobody held it");
}

#[test]
fn one_that_was_adopted_has_the_bound_that_it_was_adopted_with() {
    let mut pools = moving(|_| {});
    let mut left = moving(|_| {});
    left.bring_up(at(0.0), "planner-1@compute");
    let left = left.status()[0].workers[0].clone();
    // Replaces the worker that was started at the beginning.
    pools.exited(at(0.0), "planner-1@compute", "was not there", "");
    let commands = pools.pools.adopt(at(0.0), &left, Some(seconds(30)), false).unwrap();
    let bound = |command: &Command| match command {
        Command::Offer { standstill, .. } => Some(*standstill),
        _ => None,
    };
    assert_eq!(commands.iter().find_map(bound), Some(Some(seconds(30))));
    pools.handle(at(0.0), Event::Offered { id: left.id.clone() });
    pools.exited(at(1.0), &left.id, "killed by signal 9", "");
    assert_eq!((pools.motions(at(30.9)).len(), pools.motions(at(31.0)).len()), (1, 0));
}

#[test]
fn a_machine_that_was_not_looked_at_has_room_for_the_minimum_only() {
    let mut pools = pools(|template| {
        template.max = Some(5);
        template.needs = Needs { free_memory_mib: Some(1), idle_cores: None };
    });
    pools.demanded(at(0.0), &demand(0, 3));
    assert_eq!(started(&mut pools), ["planner-1@compute"]);
}
