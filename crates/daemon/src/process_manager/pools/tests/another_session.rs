//! Another session of the process manager: what its workers of before may still move.

use super::*;

fn retires(pools: &mut Rig, id: &str, now: Timestamp) {
    pools.stop(now, id);
    pools.handle(now, Event::Withdrawn { id: id.to_owned() });
    pools.exited(now, id, "exited with status 0", "");
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
