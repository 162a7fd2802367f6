//! Workers that are started for those who wait, and ended when idle.

use super::*;

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
