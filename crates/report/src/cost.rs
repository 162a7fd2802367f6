//! Tests that the cost of a report grows no faster than the log: sixteen times as many nodes take about sixteen times as long. Measured in
//! processor time of this thread, which other processes on the machine do not affect.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use crate::gantt::{self, By};
use crate::report::Report;
use crate::timeline::Timeline;
use ratn_executive::protocol::LogLine;
use rustix::time::{ClockId, clock_gettime};

const FEW: u64 = 400;
const TIMES: u64 = 16;
/// Maximum growth of the time per node. Quadratic cost would give 16.
const MOST_PER_NODE: f64 = 2.5;

const STARTED: &str = r#"{"at":0,"event":"started","task":"t","digest":"d","mode":"cdtn","parameters":{},"seed":7,"world":[],"revision":1}"#;

/// A node that requests a resource, gets it a moment later, and runs.
fn begins(at: u64, id: u64, attempt: u64, path: &str, resource: &str) -> String {
    let lease = format!(r#"{{"id":{id},"token":1,"resources":[{{"id":"{resource}","kind":"K","endpoint":""}}]}}"#);
    let then = at + 400_000_000;
    format!(
        r#"{{"at":{at},"command":"note","note":"expanded","instance":{id},"state":1,"path":"{path}","speculative":false}}
{{"at":{at},"command":"acquire","instance":{id},"requirements":[{{"operation":"block","kind":"K","class":null,"attributes":{{}},"count":1}}],"priority":1}}
{{"at":{then},"event":"granted","instance":{id},"lease":{lease}}}
{{"at":{then},"command":"start","instance":{id},"attempt":{attempt},"goal":{{"provider":"p","action":"a","inputs":{{}},"seed":1,"lease":{lease},"projection":null,"expected_s":null}}}}
"#
    )
}

fn ends(at: u64, id: u64, attempt: u64) -> String {
    format!(
        r#"{{"at":{at},"event":"finished","instance":{id},"attempt":{attempt},"outcome":"success","outputs":{{}},"measured":[],"reason":""}}
{{"at":{at},"command":"note","note":"finished","instance":{id},"outcome":"success"}}
{{"at":{at},"command":"release","instance":{id},"lease":{id},"projection":null}}
{{"at":{at},"command":"note","note":"retired","instance":{id}}}
"#
    )
}

fn crashes(at: u64, id: u64, attempt: u64) -> String {
    format!(
        r#"{{"at":{at},"event":"crashed","instance":{id},"attempt":{attempt},"reason":"r"}}
{{"at":{at},"command":"release","instance":{id},"lease":{id},"projection":null}}
"#
    )
}

/// A log in which each of `nodes` nodes takes a second, followed by the end.
fn log(nodes: u64, node: impl Fn(u64, u64) -> String) -> Vec<LogLine> {
    let text: String = (1..=nodes).map(|id| node(id * 1_000_000_000, id)).collect();
    let end = (nodes + 1) * 1_000_000_000;
    let end = format!(r#"{{"at":{end},"command":"end","outcome":"success","outputs":{{}},"reason":""}}"#);
    format!("{STARTED}\n{text}{end}").lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

fn cpu_s(lines: &[LogLine]) -> f64 {
    let now = || clock_gettime(ClockId::ThreadCPUTime);
    let once = |_| {
        let began = now();
        let run = Timeline::of(lines);
        let report = Report::of(&run);
        assert!(!report.to_string().is_empty() && !serde_json::to_string(&report).unwrap().is_empty());
        assert!(!gantt::stacked(&[&run, &run], By::Node, None).is_empty() && !gantt::svg(&run, None).is_empty());
        let ended = now();
        (ended.tv_sec - began.tv_sec) as f64 + (ended.tv_nsec - began.tv_nsec) as f64 / 1e9
    };
    (0..3).map(once).fold(f64::INFINITY, f64::min)
}

#[track_caller]
fn check(node: impl Fn(u64, u64) -> String) {
    let (few_s, many_s) = (cpu_s(&log(FEW, &node)), cpu_s(&log(TIMES * FEW, &node)));
    let per_node = many_s / few_s / TIMES as f64;
    assert!(per_node < MOST_PER_NODE, "{few_s:.3} s for {FEW} nodes, {many_s:.3} s for {TIMES} times as many");
}

#[test]
fn a_report_of_many_visits_of_one_state_takes_time_in_proportion() {
    check(|at, id| begins(at, id, 1, &format!("loop[{id}]/n"), "r") + &ends(at + 900_000_000, id, 1));
}

#[test]
fn a_report_of_many_states_with_a_resource_each_takes_time_in_proportion() {
    check(|at, id| begins(at, id, 1, &format!("s{id}"), &format!("r{id}")) + &ends(at + 900_000_000, id, 1));
}

#[test]
fn a_report_of_many_nodes_at_once_takes_time_in_proportion() {
    check(|at, id| begins(at, id, 1, &format!("loop[{id}]/n"), &format!("r{id}")));
}

#[test]
fn a_report_of_many_attempts_of_one_instance_takes_time_in_proportion() {
    check(|at, attempt| begins(at, 1, attempt, "n", "r") + &crashes(at + 900_000_000, 1, attempt));
}
