//! The paper's tables, replayed.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_executive::protocol::{LogLine, Mode};
use ratn_simulation::tables::{Row, scenarios, tables};

/// Seconds of the sums in the paper's notes, per row.
const HSM_S: [f64; 5] = [81.3, 124.4, 167.5, 170.4, 255.6];

fn improvement_percent(row: &Row) -> f64 {
    100.0 * (1.0 - row.cdtn_2mp_s / row.hsm_s)
}

#[test]
fn hsm_mode_takes_the_sum_of_all_durations() {
    for (row, expected) in tables().unwrap().iter().zip(HSM_S) {
        assert!((row.hsm_s - expected).abs() < 1e-6, "{row:?}: expected {expected}");
    }
}

#[test]
fn no_row_improves_less_than_the_paper_s() {
    for (row, scenario) in tables().unwrap().iter().zip(scenarios()) {
        let improvement = improvement_percent(row);
        let paper = scenario.paper.improvement_percent;
        assert!(improvement + 0.05 >= paper, "{row:?}: {improvement:.1} %, the paper's {paper} %");
    }
}

#[test]
fn a_replay_is_the_same_every_time() {
    let scenario = &scenarios()[2];
    let (a, b) = (scenario.replay(Mode::Cdtn, 2).unwrap(), scenario.replay(Mode::Cdtn, 2).unwrap());
    assert_eq!(a.log, b.log);
}

#[test]
fn every_line_of_an_event_log_reads_back_as_it_was_written() {
    for line in scenarios()[1].replay(Mode::Cdtn, 2).unwrap().log {
        let text = serde_json::to_string(&line).unwrap();
        assert_eq!(serde_json::from_str::<LogLine>(&text).unwrap(), line, "{text}");
    }
}

/// How the planning of a row could be scheduled: chains of three planning nodes per object, each ready when its object is
/// detected, one arm that takes the objects in program order.
struct Problem {
    /// When the first object may be planned for; the others follow a second apart.
    detected_s: f64,
    /// Per object: its three plans, and the five motions.
    objects: Vec<([f64; 3], [f64; 5])>,
    /// A plan that depends on nothing but the object list, and when that is there.
    stow: Option<(f64, f64)>,
    /// What the arm and the head do after the last object.
    tail_s: f64,
}

impl Problem {
    fn end_s(&self, planned: &[[f64; 3]], stowed: f64) -> f64 {
        let mut t: f64 = 0.0;
        for ((_, motions), [approach, transfer, retract]) in self.objects.iter().zip(planned) {
            let [m_approach, grasp, m_transfer, release, m_retract] = motions;
            t = t.max(*approach) + m_approach + grasp;
            t = t.max(*transfer) + m_transfer + release;
            t = t.max(*retract) + m_retract;
        }
        t.max(stowed) + self.tail_s
    }

    /// The best of all active schedules of the plans on `planners`, by exhaustive search: among them is an optimal one.
    fn optimum_s(&self, planners: usize) -> f64 {
        let stow_open = self.stow.is_some();
        let planned = vec![[f64::NAN; 3]; self.objects.len()];
        self.search(&planned, stow_open, f64::NEG_INFINITY, &vec![Vec::new(); planners])
    }

    fn search(&self, planned: &[[f64; 3]], stow_open: bool, stowed: f64, busy: &[Vec<(f64, f64)>]) -> f64 {
        let mut best = f64::INFINITY;
        let mut done = true;
        for (object, ends) in planned.iter().enumerate() {
            let Some(next) = ends.iter().position(|end| end.is_nan()) else { continue };
            done = false;
            let ready = if next == 0 { self.detected_s + object as f64 } else { ends[next - 1] };
            let (end, busy) = place(busy, ready, self.objects[object].0[next]);
            let mut planned = planned.to_vec();
            planned[object][next] = end;
            best = best.min(self.search(&planned, stow_open, stowed, &busy));
        }
        if let (true, Some((ready, duration))) = (stow_open, self.stow) {
            let (end, busy) = place(busy, ready, duration);
            return best.min(self.search(planned, false, end, &busy));
        }
        if done { self.end_s(planned, stowed) } else { best }
    }
}

/// The earliest gap on any planner.
fn place(busy: &[Vec<(f64, f64)>], ready: f64, duration: f64) -> (f64, Vec<Vec<(f64, f64)>>) {
    let start = |taken: &[(f64, f64)]| {
        let mut at = ready;
        for (from, to) in taken {
            if at + duration <= from + 1e-9 {
                break;
            }
            at = at.max(*to);
        }
        at
    };
    let (planner, at) = busy.iter().map(|taken| start(taken)).enumerate().min_by(|a, b| a.1.total_cmp(&b.1)).unwrap();
    let mut busy = busy.to_vec();
    busy[planner].push((at, at + duration));
    busy[planner].sort_by(|a, b| a.0.total_cmp(&b.0));
    (at + duration, busy)
}

#[test]
fn every_row_is_within_half_a_percent_of_the_optimum() {
    let boxes = |count| Problem {
        detected_s: 19.2,
        objects: vec![([12.0, 13.9, 8.0], [2.5, 1.1, 3.2, 0.8, 0.6]); count],
        stow: Some((18.2, 1.5)),
        tail_s: 18.5,
    };
    let bowl = ([5.0, 7.0, 3.4], [8.0, 3.0, 9.6, 3.0, 5.0]);
    let fork = ([3.7, 5.2, 2.5], [8.0, 3.2, 9.0, 2.8, 4.8]);
    // For the dishes what the arm and the first plan need is a bound from below, and it is reached.
    let dishes = |each: usize| {
        let motions: f64 = [bowl, fork].iter().map(|(_, motions)| motions.iter().sum::<f64>() * each as f64).sum();
        1.0 + 5.0 + motions
    };
    let optima = [
        (boxes(1).optimum_s(1), boxes(1).optimum_s(2)),
        (boxes(2).optimum_s(1), boxes(2).optimum_s(2)),
        (boxes(3).optimum_s(1), boxes(3).optimum_s(2)),
        (dishes(2), dishes(2)),
        (dishes(3), dishes(3)),
    ];
    for (row, (one, two)) in tables().unwrap().iter().zip(optima) {
        assert!(row.cdtn_1mp_s <= 1.005 * one, "{row:?}: optimum with one planner {one}");
        assert!(row.cdtn_2mp_s <= 1.005 * two, "{row:?}: optimum with two planners {two}");
        assert!(
            row.cdtn_1mp_s >= one - 1e-6 && row.cdtn_2mp_s >= two - 1e-6,
            "{row:?} beats the optimum: a wrong bound"
        );
    }
}
