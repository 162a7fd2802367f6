//! Workers that start, crash, are late, and are stopped.

use super::*;

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
