#![allow(clippy::unwrap_used, reason = "a test may panic")]

use super::*;
use insta::assert_snapshot;

/// Two planners: `plan_approach[3]` and `plan_retract[1]` hold both, `plan_transfer[2]` wants one.
const TWO_PLANNERS: &str = r#"
{"at":0,"event":"started","task":"t","digest":"d","mode":"cdtn","parameters":{},"seed":1,"world":[],"revision":0,"capacity":{"PathPlanner":2}}
{"at":0,"command":"note","note":"expanded","instance":1,"state":1,"path":"plan_approach[3]","speculative":false}
{"at":0,"command":"note","note":"expanded","instance":2,"state":2,"path":"plan_retract[1]","speculative":false}
{"at":0,"command":"note","note":"expanded","instance":3,"state":3,"path":"plan_transfer[2]","speculative":true}
{"at":0,"command":"acquire","instance":1,"requirements":[{"operation":"block","kind":"PathPlanner","class":null,"attributes":{},"count":1}],"priority":9}
{"at":1000000000,"event":"granted","instance":1,"lease":{"id":1,"token":1,"resources":[{"id":"p1@compute","kind":"PathPlanner","endpoint":""}]}}
{"at":1000000000,"command":"start","instance":1,"attempt":1,"goal":{"provider":"path_planner","action":"plan","inputs":{},"seed":1,"lease":null,"projection":7,"expected_s":null}}
{"at":4000000000,"event":"granted","instance":2,"lease":{"id":2,"token":2,"resources":[{"id":"p2@compute","kind":"PathPlanner","endpoint":""}]}}
{"at":4000000000,"command":"start","instance":2,"attempt":1,"goal":{"provider":"path_planner","action":"plan","inputs":{},"seed":1,"lease":null,"projection":8,"expected_s":null}}
{"at":4500000000,"command":"acquire","instance":3,"requirements":[{"operation":"block","kind":"PathPlanner","class":null,"attributes":{},"count":1},{"operation":"block","kind":"WorldModel","class":null,"attributes":{},"count":1}],"priority":2}
{"at":5000000000,"event":"progressed","instance":1,"attempt":1,"message":"first path"}
{"at":7000000000,"event":"finished","instance":2,"attempt":1,"outcome":"success","outputs":{},"measured":[],"reason":""}
{"at":7000000000,"command":"note","note":"finished","instance":2,"outcome":"success"}
{"at":7000000000,"command":"release","instance":2,"lease":2,"projection":8}
{"at":7100000000,"event":"granted","instance":3,"lease":{"id":3,"token":3,"resources":[{"id":"p2@compute","kind":"PathPlanner","endpoint":""},{"id":"w@compute","kind":"WorldModel","endpoint":""}]}}
{"at":7100000000,"command":"project","instance":3,"attempt":1,"base":0,"changes":[],"writers":["plan_approach[3]"],"reads":"everything","lease":null}
{"at":7300000000,"event":"projected","instance":3,"attempt":1,"projection":9}
{"at":7300000000,"command":"start","instance":3,"attempt":1,"goal":{"provider":"path_planner","action":"plan","inputs":{},"seed":1,"lease":null,"projection":9,"expected_s":null}}
{"at":8000000000,"event":"finished","instance":1,"attempt":1,"outcome":"success","outputs":{},"measured":[],"reason":""}
{"at":8000000000,"command":"note","note":"finished","instance":1,"outcome":"success"}
{"at":8000000000,"command":"note","note":"retired","instance":1}
{"at":8000000000,"command":"note","note":"retired","instance":2}
{"at":8000000000,"command":"commit","instance":2,"writer":"plan_retract[1]","changes":[],"revision":4}
{"at":8000000000,"command":"release","instance":1,"lease":1,"projection":7}
{"at":9000000000,"command":"cancel","instance":3,"attempt":1}
{"at":9000000000,"command":"release","instance":3,"lease":3,"projection":9}
{"at":9000000000,"command":"note","note":"squashed","instance":3}
{"at":9000000000,"command":"end","outcome":"success","outputs":{},"reason":""}
"#;

fn lines(text: &str) -> Vec<LogLine> {
    text.trim().lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

fn of_path<'a>(run: &'a Timeline, path: &str) -> &'a Instance {
    run.instances().find(|one| *one.path == *path).unwrap()
}

/// The state at a moment: what waits and why, what runs, holders and queues.
fn looked_at(moment_s: f64) -> String {
    let run = Timeline::at(&lines(TWO_PLANNERS), moment_s);
    let waiting = run.waiting().filter_map(|one| run.explain(one.id));
    let running =
        run.running().into_iter().map(|(one, job)| format!("{} runs {}/{}", one.path, job.provider, job.action));
    let held = run.resources.held().map(|one| format!("{} has {} since {}", one.holder, one.resource, one.from_s));
    let queue = run.resources.queue().into_iter().map(|one| format!("{} wants {}", one.instance, one.kinds.join(", ")));
    waiting.chain(running).chain(held).chain(queue).collect::<Vec<_>>().join("\n")
}

#[test]
fn who_waits_for_what_others_hold_says_who_and_for_how_long() {
    assert_snapshot!(looked_at(5.0), @r"
    plan_transfer[2] waits for PathPlanner: both are held, by plan_approach[3] for 4 s and plan_retract[1] for 1 s
    plan_approach[3] runs path_planner/plan
    plan_retract[1] runs path_planner/plan
    plan_approach[3] has p1@compute since 1
    plan_retract[1] has p2@compute since 4
    i3 wants PathPlanner
    ");
}

#[test]
fn who_has_not_asked_yet_says_what_is_before_it() {
    assert_snapshot!(looked_at(1.0), @r"
    plan_retract[1] waits for what is before it: plan_approach[3] (running for 0 s)
    plan_transfer[2] waits for what is before it: plan_approach[3] (running for 0 s)
    plan_approach[3] runs path_planner/plan
    plan_approach[3] has p1@compute since 1
    ");
    assert_snapshot!(looked_at(0.0), @r"
    plan_approach[3] has waited for 0 s for the resource manager, which it asked for PathPlanner
    plan_retract[1] waits for what is before it: plan_approach[3]
    plan_transfer[2] waits for what is before it: plan_approach[3]
    i1 wants PathPlanner
    ");
}

#[test]
fn who_has_everything_but_its_projection_says_so() {
    assert_snapshot!(looked_at(7.1), @r"
    plan_transfer[2] waits for its projection
    plan_approach[3] runs path_planner/plan
    plan_approach[3] has p1@compute since 1
    plan_transfer[2] has p2@compute since 7.1
    ");
}

#[test]
fn the_stages_of_an_instance_say_what_ended_each() {
    let run = Timeline::of(&lines(TWO_PLANNERS));
    let said = |path: &str| {
        let one = of_path(&run, path);
        let phase = |phase: &Phase| {
            format!("{} {}..{} until {}", phase.stage.name(), phase.from_s, phase.to_s, phase.ended_by.awaited())
        };
        let last = format!("{} since {}", one.stage.name(), one.since_s);
        one.phases.iter().map(phase).chain([last]).collect::<Vec<_>>().join("\n")
    };
    assert_snapshot!(said("plan_transfer[2]"), @r"
    waiting 0..4.5 until the resources of plan_retract[1]
    asking 4.5..7.1 until the resources of plan_transfer[2]
    preparing 7.1..7.3 until the projection of plan_transfer[2]
    running 7.3..9 until plan_approach[3]
    waiting 9..9 until plan_approach[3]
    squashed since 9
    ");
    assert_snapshot!(said("plan_retract[1]"), @r"
    waiting 0..4 until the resources of plan_retract[1]
    running 4..7 until plan_retract[1]
    finished 7..8 until plan_approach[3]
    retired since 8
    ");
}

#[test]
fn a_wait_names_those_who_held_what_was_waited_for() {
    let run = Timeline::of(&lines(TWO_PLANNERS));
    let wait = &of_path(&run, "plan_transfer[2]").waits[0];
    let behind = |one: &Behind| format!("{} {}..{} {}", one.holder, one.from_s, one.to_s, one.released);
    assert_snapshot!(wait.behind.iter().map(behind).collect::<Vec<_>>().join("\n"), @r"
    plan_approach[3] 1..7.1 false
    plan_retract[1] 4..7 true
    ");
    assert_eq!((wait.kinds.join(","), wait.resources.join(",")), ("PathPlanner".into(), "p2@compute".into()));
    // No instance held what the first one requested.
    assert_eq!(of_path(&run, "plan_approach[3]").waits[0].behind, []);
}

#[test]
fn work_ahead_of_time_is_useful_or_wasted() {
    let run = |moment_s| Timeline::at(&lines(TWO_PLANNERS), moment_s).speculation();
    let expected = Speculation { useful: 1, useful_s: 3.0, wasted: 1, wasted_s: 9.0 - 7.3, open: 0 };
    assert_eq!(run(f64::INFINITY), expected);
    assert_eq!((run(7.5).useful, run(7.5).wasted, run(7.5).open), (0, 0, 2));
    let sequential = lines(&TWO_PLANNERS.replace("\"cdtn\"", "\"hsm\""));
    assert_eq!(Timeline::of(&sequential).speculation(), Speculation::default());
}

#[test]
fn what_is_held_ends_when_it_is_given_back() {
    let mut run = Timeline::new();
    let released: Vec<Holding> = lines(TWO_PLANNERS).iter().flat_map(|line| run.apply(line).released).collect();
    let said = |one: &Holding| format!("{} {} {}..{}", one.resource, one.holder, one.from_s, one.to_s);
    assert_snapshot!(released.iter().map(said).collect::<Vec<_>>().join("\n"), @r"
    p2@compute plan_retract[1] 4..7
    p1@compute plan_approach[3] 1..8
    p2@compute plan_transfer[2] 7.1..9
    w@compute plan_transfer[2] 7.1..9
    ");
    assert_eq!(run.resources.held().count(), 0);
    assert_eq!(run.commits.len(), 1);
    assert_eq!(run.commits[0].writer, "plan_retract[1]");
}

#[test]
fn a_timeline_that_follows_gives_away_what_has_left_and_keeps_the_figures() {
    let (all, mut following) = (Timeline::of(&lines(TWO_PLANNERS)), Timeline::following(1));
    let mut left: Vec<InstanceId> = Vec::new();
    for line in lines(TWO_PLANNERS) {
        left.extend(following.apply(&line).left.iter().map(|one| one.id));
        assert!(following.instances().filter(|one| one.has_left()).count() <= 1);
    }
    assert_eq!(left, [InstanceId(1), InstanceId(2)]);
    left.extend(following.close().left.iter().map(|one| one.id));
    assert_eq!(left, [InstanceId(1), InstanceId(2), InstanceId(3)]);
    assert_eq!(following.speculation(), all.speculation());
    assert_eq!((following.count, following.instances().len()), (all.count, 0));
}

#[test]
fn time_goes_on_without_a_line() {
    let mut run = Timeline::new();
    lines(TWO_PLANNERS).iter().take_while(|line| line.at.seconds() <= 5.0).for_each(|line| drop(run.apply(line)));
    run.wait_until(6.0);
    let waiting = run.waiting().next().unwrap().id;
    assert_snapshot!(run.explain(waiting).unwrap(), @"plan_transfer[2] waits for PathPlanner: both are held, by plan_approach[3] for 5 s and plan_retract[1] for 2 s");
}

#[test]
fn a_loop_that_decides_is_no_instance_and_nothing_is_ahead_of_it() {
    let decided = r#"{"at":0,"command":"note","note":"decided","instance":9,"path":"for_box","decision":"3"}"#;
    let mut run = Timeline::new();
    run.apply(&serde_json::from_str(decided).unwrap());
    assert_eq!((run.instances().len(), run.count.expanded, run.oldest_open().is_none()), (0, 0, true));
}

/// The run reaches `a` and stops at the breakpoint there; then it goes on, and the breakpoints change.
const STOPPED: &str = r#"
{"at":0,"event":"started","task":"t","digest":"d","mode":"cdtn","parameters":{},"seed":1,"world":[],"revision":0,"capacity":{},"breakpoints":["a"]}
{"at":0,"command":"note","note":"expanded","instance":1,"state":1,"path":"a","speculative":false}
{"at":1000000000,"command":"note","note":"stopped","instance":1}
{"at":3000000000,"event":"breakpoints_set","states":["b/c","d"]}
{"at":4000000000,"event":"step_requested"}
"#;

#[test]
fn a_breakpoint_pauses_a_run_and_says_where() {
    let lines = lines(STOPPED);
    let at = |moment_s: f64| {
        let mut run = Timeline::new();
        for line in lines.iter().take_while(|line| line.at.seconds() <= moment_s) {
            run.apply(line);
        }
        let stopped_at = run.stopped_at().map(|one| one.path.to_string());
        (run.breakpoints.join(", "), run.is_paused(), stopped_at)
    };
    let stopped = Some("a".to_owned());
    assert_eq!(at(0.5), ("a".to_owned(), false, None));
    assert_eq!(at(2.0), ("a".to_owned(), true, stopped.clone()));
    assert_eq!(at(3.0), ("b/c, d".to_owned(), true, stopped), "what is set meanwhile lets nothing go");
    assert_eq!(at(4.0), ("b/c, d".to_owned(), true, None), "the step lets it go, and the run stays paused");
    let mut run = Timeline::new();
    lines.iter().take(3).for_each(|line| _ = run.apply(line));
    let why = run.explain(InstanceId(1)).unwrap();
    assert_eq!(why, "a waits for the operator: the run is paused at a breakpoint here");
}
