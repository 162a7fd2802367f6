//! What an event log says about a run: its statistics and its Gantt chart.

pub(crate) mod gantt;
pub(crate) mod statistics;
pub(crate) mod timeline;

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::{gantt, statistics::Statistics, timeline::Timeline};
    use crate::task_control::log;
    use std::path::Path;

    /// A run with a wait, a crash and its second attempt, a discarded plan and an aborted motion.
    fn two_boxes() -> Timeline {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("src/report/fixtures/two_boxes.jsonl");
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
        let sum = time.motion_s + time.detection_s + time.planning_waited_for_s + time.idle_s;
        assert!((sum - statistics.makespan_s).abs() < 1e-9);
    }

    /// Paused and stepped, a motion beside another, a result that did not count, and task control gone for a while.
    fn incidents() -> Timeline {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("src/report/fixtures/incidents.jsonl");
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
