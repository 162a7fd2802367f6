//! Workers that are replaced: they do not answer, their template has changed, or their host is drained.

use super::*;

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
