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
}
