//! Evaluates an event log: the run's timeline, statistics, critical path and Gantt chart.
//!
//! This crate folds the lines of a log into what each instance did when and why ([`timeline`]). From that it computes figures
//! ([`statistics`]), what the run waited for ([`critical`], [`waiting`]), a comparison of several runs ([`report`]) and charts ([`gantt`],
//! with overlapping spans in [`lanes`]); also the motions ([`motions`]) and the world as believed ([`believed`]). It needs no task file, no
//! running system and no network, and prints nothing: the same lines give the same bytes. `ratn_event_log` reads the lines from a file.

pub mod believed;
#[cfg(test)]
mod cost;
pub mod critical;
pub mod gantt;
pub mod lanes;
pub mod motions;
mod names;
pub mod report;
pub mod statistics;
pub mod timeline;
pub mod waiting;

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::gantt::{self, By};
    use super::report::{self, Report, Spread};
    use super::statistics::Statistics;
    use super::timeline::Timeline;
    use super::{critical, waiting};
    use ratn_event_log as log;
    use ratn_executive::protocol::{LogLine, Mode};
    use std::path::Path;

    /// A run with a wait, a crash and its second attempt, a discarded plan and an aborted motion.
    fn two_boxes() -> Timeline {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("src/fixtures/two_boxes.jsonl");
        Timeline::of(&log::read(&path).unwrap().lines)
    }

    #[test]
    fn statistics_of_a_small_run() {
        insta::assert_snapshot!(Statistics::of(&two_boxes()));
    }

    #[test]
    fn the_chart_of_a_small_run() {
        insta::assert_snapshot!(gantt::svg(&two_boxes(), None));
    }

    #[test]
    fn where_the_time_went_adds_up_to_the_makespan() {
        let statistics = Statistics::of(&two_boxes());
        let time = statistics.time;
        let sum = time.motion_s + time.detection_s + time.other_s + time.planning_waited_for_s + time.idle_s;
        assert!((sum - statistics.makespan_s).abs() < 1e-9);
    }

    /// A log with pauses and steps, two motions at once, a result that was invalidated, and a time without task control.
    fn incidents() -> Timeline {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("src/fixtures/incidents.jsonl");
        Timeline::of(&log::read(&path).unwrap().lines)
    }

    #[test]
    fn what_does_not_happen_in_most_runs_is_said() {
        let text = Statistics::of(&incidents()).to_string();
        let said: Vec<&str> = text.lines().filter(|line| line.starts_with("  ")).skip(6).take(4).collect();
        insta::assert_snapshot!(said.join("\n"), @r"
        results invalidated and computed again: 1; taken from an equal one: 1
        paused for 3.0 s; single steps: 1
        task control was gone for 2.0 s
        exceptions were imprecise: turn began beside move, which might have failed (1 in all)
        ");
    }

    /// A log of one run: a look ahead on two branches, of which the second reuses the result of the first, and a label that is read.
    fn told(lines: &str) -> Timeline {
        let lines: Vec<LogLine> = lines.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
        Timeline::of(&lines)
    }

    const WITH_A_LABEL: &str = r#"{"at":0,"event":"started","task":"t","digest":"d","mode":"cdtn","parameters":{},"seed":7,"world":[],"revision":1,"origin":{"run":"r","natures":{"computes":["plan"],"actuating":["Arm"]}}}
{"at":0,"command":"note","note":"expanded","instance":1,"state":1,"path":"read","speculative":false}
{"at":0,"command":"note","note":"expanded","instance":2,"state":2,"path":"move","speculative":false}
{"at":0,"command":"note","note":"expanded","instance":3,"state":3,"path":"plan","speculative":true}
{"at":0,"command":"note","note":"expanded","instance":4,"state":3,"path":"plan","speculative":true}
{"at":0,"command":"start","instance":1,"attempt":1,"goal":{"provider":"reader","action":"read","inputs":{},"seed":1,"lease":{"id":1,"token":1,"resources":[{"id":"label-1@compute","kind":"LabelReader","endpoint":""}]},"projection":null,"expected_s":null}}
{"at":0,"command":"start","instance":3,"attempt":1,"goal":{"provider":"brain","action":"think","inputs":{},"seed":1,"lease":null,"projection":null,"expected_s":null}}
{"at":2000000000,"event":"finished","instance":1,"attempt":1,"outcome":"success","outputs":{},"measured":[],"reason":""}
{"at":3000000000,"event":"finished","instance":3,"attempt":1,"outcome":"success","outputs":{},"measured":[],"reason":""}
{"at":3000000000,"command":"start","instance":2,"attempt":1,"goal":{"provider":"arm","action":"move","inputs":{},"seed":1,"lease":{"id":2,"token":2,"resources":[{"id":"arm@sim","kind":"Arm","endpoint":""}]},"projection":null,"expected_s":null}}
{"at":4000000000,"event":"finished","instance":2,"attempt":1,"outcome":"success","outputs":{},"measured":[],"reason":""}
{"at":4000000000,"command":"note","note":"squashed","instance":3}
{"at":4000000000,"command":"note","note":"reused","instance":4}"#;

    #[test]
    fn what_holds_nothing_that_moves_is_no_motion() {
        let time = Statistics::of(&told(WITH_A_LABEL)).time;
        assert_eq!(
            (time.motion_s, time.other_s, time.planning_waited_for_s, time.detection_s, time.idle_s),
            (1.0, 2.0, 1.0, 0.0, 0.0)
        );
        assert!(Statistics::of(&told(WITH_A_LABEL)).to_string().contains("other work"));
    }

    #[test]
    fn work_whose_result_an_equal_visit_took_is_not_discarded() {
        let chart = gantt::svg(&told(WITH_A_LABEL), None);
        assert!(chart.contains("its result was used by an equal visit") && !chart.contains(", discarded<"), "{chart}");
        let alone = WITH_A_LABEL.rsplit_once('\n').unwrap().0;
        assert!(gantt::svg(&told(alone), None).contains(", discarded<"));
        let ahead = |lines: &str| Statistics::of(&told(lines)).ahead_of_time;
        assert_eq!((ahead(WITH_A_LABEL).used, ahead(alone).used), (1, 0));
    }

    #[test]
    fn a_chart_shows_pauses_absences_and_what_was_done_again() {
        let chart = gantt::svg(&incidents(), None);
        for shown in [
            "paused from 2.0 to 5.0 s",
            "task control was gone from 7.0 to 9.0 s",
            "done again: at(box) came out otherwise",
            ">paused</text>",
            ">task control gone</text>",
        ] {
            assert!(chart.contains(shown), "{shown}: {chart}");
        }
    }

    /// `look`, then `plan`, which waits until `other` releases the only planner, then `move` along that plan.
    const CHAIN: &str = r#"{"at":0,"event":"started","task":"t","digest":"d","mode":"cdtn","parameters":{},"seed":7,"world":[],"revision":1,"capacity":{"PathPlanner":1},"origin":{"run":"r","natures":{"computes":["plan","other"],"actuating":["Arm"]}}}
{"at":0,"command":"note","note":"expanded","instance":1,"state":1,"path":"look","speculative":false}
{"at":0,"command":"note","note":"expanded","instance":2,"state":2,"path":"other","speculative":false}
{"at":0,"command":"note","note":"expanded","instance":3,"state":3,"path":"plan","speculative":false}
{"at":0,"command":"note","note":"expanded","instance":4,"state":4,"path":"move","speculative":false}
{"at":0,"command":"acquire","instance":2,"requirements":[{"operation":"block","kind":"PathPlanner","class":null,"attributes":{},"count":1}],"priority":1}
{"at":0,"command":"start","instance":1,"attempt":1,"goal":{"provider":"eye","action":"look","inputs":{},"seed":1,"lease":null,"projection":null,"expected_s":null}}
{"at":0,"event":"granted","instance":2,"lease":{"id":1,"token":1,"resources":[{"id":"p1@compute","kind":"PathPlanner","endpoint":""}]}}
{"at":0,"command":"start","instance":2,"attempt":1,"goal":{"provider":"path_planner","action":"plan","inputs":{},"seed":1,"lease":{"id":1,"token":1,"resources":[{"id":"p1@compute","kind":"PathPlanner","endpoint":""}]},"projection":1,"expected_s":null}}
{"at":2000000000,"event":"finished","instance":1,"attempt":1,"outcome":"success","outputs":{},"measured":[],"reason":""}
{"at":2000000000,"command":"note","note":"finished","instance":1,"outcome":"success"}
{"at":2000000000,"command":"acquire","instance":3,"requirements":[{"operation":"block","kind":"PathPlanner","class":null,"attributes":{},"count":1}],"priority":1}
{"at":4000000000,"event":"finished","instance":2,"attempt":1,"outcome":"success","outputs":{},"measured":[],"reason":""}
{"at":4000000000,"command":"note","note":"finished","instance":2,"outcome":"success"}
{"at":4000000000,"command":"release","instance":2,"lease":1,"projection":1}
{"at":4100000000,"event":"granted","instance":3,"lease":{"id":2,"token":2,"resources":[{"id":"p1@compute","kind":"PathPlanner","endpoint":""}]}}
{"at":4100000000,"command":"start","instance":3,"attempt":1,"goal":{"provider":"path_planner","action":"plan","inputs":{},"seed":1,"lease":{"id":2,"token":2,"resources":[{"id":"p1@compute","kind":"PathPlanner","endpoint":""}]},"projection":2,"expected_s":null}}
{"at":6000000000,"event":"finished","instance":3,"attempt":1,"outcome":"success","outputs":{},"measured":[],"reason":""}
{"at":6000000000,"command":"note","note":"finished","instance":3,"outcome":"success"}
{"at":6000000000,"command":"acquire","instance":4,"requirements":[{"operation":"block","kind":"Arm","class":null,"attributes":{},"count":1}],"priority":1}
{"at":6200000000,"event":"granted","instance":4,"lease":{"id":3,"token":3,"resources":[{"id":"arm@sim","kind":"Arm","endpoint":""}]}}
{"at":6200000000,"command":"start","instance":4,"attempt":1,"goal":{"provider":"arm","action":"follow","inputs":{},"seed":1,"lease":{"id":3,"token":3,"resources":[{"id":"arm@sim","kind":"Arm","endpoint":""}]},"projection":null,"expected_s":null}}
{"at":9000000000,"event":"finished","instance":4,"attempt":1,"outcome":"success","outputs":{},"measured":[],"reason":""}
{"at":9000000000,"command":"note","note":"finished","instance":4,"outcome":"success"}
{"at":9000000000,"command":"end","outcome":"success","outputs":{},"reason":""}"#;

    #[test]
    fn the_critical_path_goes_through_whoever_held_what_was_waited_for() {
        let text = critical::table(&critical::path(&told(CHAIN)));
        insta::assert_snapshot!(text, @r"
        critical path             from s    to s  length  was          began on
          other                      0.0     4.0     4.0  running      the start
          plan                       4.0     4.1     0.1  asking       p1@compute, given back by other
          plan                       4.1     6.0     1.9  running      look
          move                       6.0     6.2     0.2  asking       Arm
          move                       6.2     9.0     2.8  running      plan
          9.0 s in 5 links, 0 of them shorter than 0.05 s and not shown
        ");
        // No link occurs twice, and no two overlap.
        for run in [told(CHAIN), two_boxes(), incidents(), told(WITH_A_LABEL)] {
            let links = critical::path(&run);
            assert!(links.windows(2).all(|pair| pair[0].to_s <= pair[1].from_s + 1e-9), "{links:?}");
        }
    }

    /// `move`, then `ready`, which waits until the world is changed from outside, then `turn`, then `rest`, which waits for a time. All are
    /// in the window from the beginning.
    const WAITS: &str = r#"{"at":0,"event":"started","task":"t","digest":"d","mode":"cdtn","parameters":{},"seed":7,"world":[],"revision":1,"capacity":{},"origin":{"run":"r","natures":{"computes":[],"actuating":["Arm"]}}}
{"at":0,"command":"note","note":"expanded","instance":1,"state":1,"path":"move","speculative":false}
{"at":0,"command":"note","note":"expanded","instance":2,"state":2,"path":"ready","speculative":false}
{"at":0,"command":"note","note":"expanded","instance":3,"state":3,"path":"turn","speculative":false}
{"at":0,"command":"note","note":"expanded","instance":4,"state":4,"path":"rest","speculative":false}
{"at":0,"command":"start","instance":1,"attempt":1,"goal":{"provider":"arm","action":"move","inputs":{},"seed":1,"lease":{"id":1,"token":1,"resources":[{"id":"arm@sim","kind":"Arm","endpoint":""}]},"projection":null,"expected_s":null}}
{"at":2000000000,"event":"finished","instance":1,"attempt":1,"outcome":"success","outputs":{},"measured":[],"reason":""}
{"at":2000000000,"command":"note","note":"finished","instance":1,"outcome":"success"}
{"at":2000000000,"command":"note","note":"awaiting","instance":2,"awaits":"condition","condition":"open(door)"}
{"at":5000000000,"event":"world_changed","revision":7,"facts":[]}
{"at":5000000000,"command":"note","note":"finished","instance":2,"outcome":"success"}
{"at":5000000000,"command":"start","instance":3,"attempt":1,"goal":{"provider":"arm","action":"turn","inputs":{},"seed":1,"lease":{"id":2,"token":2,"resources":[{"id":"arm@sim","kind":"Arm","endpoint":""}]},"projection":null,"expected_s":null}}
{"at":6000000000,"event":"finished","instance":3,"attempt":1,"outcome":"success","outputs":{},"measured":[],"reason":""}
{"at":6000000000,"command":"note","note":"finished","instance":3,"outcome":"success"}
{"at":6000000000,"command":"note","note":"awaiting","instance":4,"awaits":"time","until":8500000000}
{"at":8500000000,"event":"woken"}
{"at":8500000000,"command":"note","note":"finished","instance":4,"outcome":"success"}
{"at":8500000000,"command":"end","outcome":"success","outputs":{},"reason":""}"#;

    #[test]
    fn the_critical_path_goes_through_what_waits_for_a_condition_or_a_time() {
        insta::assert_snapshot!(critical::table(&critical::path(&told(WAITS))), @r"
        critical path             from s    to s  length  was          began on
          move                       0.0     2.0     2.0  running      the start
          ready                      2.0     5.0     3.0  waiting      `open(door)`
          turn                       5.0     6.0     1.0  running      ready
          rest                       6.0     8.5     2.5  waiting      its time
          8.5 s in 4 links, 0 of them shorter than 0.05 s and not shown
        ");
    }

    #[test]
    fn what_was_waited_for_is_told_by_cause() {
        insta::assert_snapshot!(waiting::table(&waiting::by_cause(&told(CHAIN))), @r"
        waited for                       times  total s longest s
          the result of plan                 1      6.0       6.0
          PathPlanner, held by other         1      2.1       2.1
          the result of look                 1      2.0       2.0
          Arm, from the resource manager     1      0.2       0.2
        ");
    }

    /// A log whose names contain terminal control codes, reverse the text direction, are markup, and are too long for a table.
    #[test]
    fn names_of_a_hostile_log_do_nothing_and_leave_a_table_readable() {
        let evil = "\u{1b}[2J\r\u{202e}\u{7}\u{ffff}<b>";
        let long = "a/".repeat(33_000);
        let lines = WITH_A_LABEL.replace("\"read\"", &serde_json::to_string(&format!("{long}{evil}")).unwrap());
        let lines = lines.replace("arm@sim", serde_json::to_string(evil).unwrap().trim_matches('"'));
        let run = told(&lines.replace("\"task\":\"t\"", &format!("\"task\":{}", serde_json::to_string(evil).unwrap())));
        let is_obeyed = |c: char| (c.is_control() && c != '\n') || c == '\u{202e}';
        let (text, chart) = (Report::of(&run).to_string(), gantt::stacked(&[&run], By::Node, None));
        assert!(text.contains("\\u{1b}[2J") && !text.contains(is_obeyed), "{text}");
        assert!(text.lines().all(|line| line.chars().count() < 300), "{text}");
        assert!(chart.contains("&lt;b&gt;") && !chart.contains(|c| is_obeyed(c) || c == '\u{ffff}'));
        assert!(!report::table(&report::repeated(&[run])).contains(is_obeyed));
    }

    #[test]
    fn what_is_reported_of_a_run() {
        let text = Report::of(&two_boxes()).to_string();
        let behind = text.split_once("\nwork ahead of time").unwrap().1;
        insta::assert_snapshot!(behind, @r"
        , in jobs: 1 of use (8.0 s), 1 discarded (3.3 s), 0 open

        critical path             from s    to s  length  was          began on
          look                       0.0     0.1     0.1  asking       PanTilt
          look                       0.1     3.5     3.4  running      the start
          segment                    3.5     3.6     0.1  asking       Camera, Detector
          segment                    3.6    10.5     6.9  running      look
          fetch[1]/move             28.6    28.7     0.1  asking       Arm
          fetch[1]/move             28.7    32.0     3.3  running      the resources of when_empty/plan
          13.9 s in 6 links, 0 of them shorter than 0.05 s and not shown

        waited for                                    times  total s longest s
          the resources of when_empty/plan                1     18.1      18.1
          PathPlanner, held by fetch/plan                 1     10.1      10.1
          the resources of fetch[1]/plan                  1     10.0      10.0
          the result of look                              1      3.5       3.5
          PathPlanner, from the resource manager          2      0.5       0.4
          Arm, from the resource manager                  2      0.2       0.1
          a projection                                    2      0.2       0.1
          Camera, Detector, from the resource manager     1      0.1       0.1
          PanTilt, from the resource manager              1      0.1       0.1
        ");
    }

    #[test]
    fn repeated_runs_have_a_mean_and_a_spread_and_cdtn_is_compared_with_hsm() {
        let run = |mode: Mode, end_s: f64| {
            let mut run = told(CHAIN);
            (run.mode, run.end_s) = (mode, end_s);
            run
        };
        let mut failed = run(Mode::Hsm, 99.0);
        failed.outcome = Some("aborted".to_owned());
        let mut runs = vec![run(Mode::Cdtn, 8.0), run(Mode::Hsm, 12.0), run(Mode::Cdtn, 10.0), failed];
        insta::assert_snapshot!(report::table(&report::repeated(&runs)), @r"
        task       mode  runs  makespan s        least  largest  two at once s   planning awaited s
        t          CDTN     2  9.0 ± 1.4           8.0     10.0  2.0 ± 0.0       3.9 ± 0.0
        t          HSM    1/2  12.0 ± 0.0         12.0     12.0  2.0 ± 0.0       3.9 ± 0.0
        t: CDTN is 25.0 % shorter than HSM
        ");
        // Runs with other parameters are not grouped together.
        runs[0].parameters.insert("boxes".to_owned(), ratn_model::value::Value::Int(3));
        let together = report::repeated(&runs);
        assert_eq!(
            together.iter().map(|one| (one.with.join(","), one.runs)).collect::<Vec<_>>(),
            [("boxes=3".to_owned(), 1), (String::new(), 2), (String::new(), 1)]
        );
        assert_eq!(Spread::of(&[]), Spread::default());
        assert_eq!(Spread::of(&[2.0, 4.0]).deviation, 2.0_f64.sqrt());
    }

    #[test]
    fn several_runs_stand_below_each_other_on_one_time_axis() {
        let (short, long) = (told(CHAIN), two_boxes());
        let chart = gantt::stacked(&[&short, &long], By::Resource, None);
        assert_eq!(chart.matches("seconds of the robot's time").count(), 2);
        // Both axes end with the longer run.
        assert_eq!(chart.matches(">30</text>").count(), 2, "{chart}");
        assert_eq!(chart.matches("<g transform=\"translate(0 ").count(), 1);
        assert_eq!(gantt::svg(&long, None), gantt::stacked(&[&long], By::Resource, None));
    }

    #[test]
    fn a_chart_by_node_has_a_row_for_each_state_and_for_visits_that_overlap() {
        let chart = gantt::stacked(&[&two_boxes()], By::Node, None);
        for row in [">look</text>", ">fetch/plan</text>", ">fetch/move</text>", ">when_empty/plan</text>"] {
            assert!(chart.contains(row), "{row}: {chart}");
        }
        assert!(!chart.contains("fetch/plan (2)"), "the plans do not overlap: {chart}");
    }
}
