//! What an event log tells of a run: its timeline, its statistics and its Gantt chart.
//!
//! It owns the fold of a log's lines into what each instance did when ([`timeline`]), the figures made of that ([`statistics`]) and
//! the chart drawn of it ([`gantt`]). It needs no task file, no system that runs and no network, and prints nothing: the same
//! lines give the same bytes. Reading the lines from a file is `ratn_event_log`'s.

pub mod gantt;
pub mod statistics;
pub mod timeline;

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::{gantt, statistics::Statistics, timeline::Timeline};
    use ratn_event_log as log;
    use ratn_executive::protocol::LogLine;
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

    /// Paused and stepped, a motion beside another, a result that did not count, and task control gone for a while.
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

    /// A log of one run: a look ahead on two branches, of which the second takes the result of the first, and a label that is read.
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
}
