//! What instances waited for, by cause: resources by their holders, results by their instances, and the rest.

use super::names::Names;
use super::timeline::{Cause, Phase, Stage, Timeline};
use ratn_event_log::without_visits;
use serde::Serialize;
use std::collections::BTreeMap;
use std::fmt::Write as _;

/// Maximum number of causes shown to people.
const MOST_SHOWN: usize = 12;
/// Shorter waits are not counted: they are the latency of a request.
const SHORTEST_S: f64 = 0.05;

/// All waits of one cause.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Waiting {
    /// The cause.
    pub cause: String,
    /// Number of waits.
    pub times: usize,
    /// Total duration, of all instances together.
    pub total_s: f64,
    /// The longest.
    pub longest_s: f64,
}

/// The waits by cause, the largest total first. Instances that were discarded are not counted.
pub fn by_cause(run: &Timeline) -> Vec<Waiting> {
    let mut by: BTreeMap<String, Waiting> = BTreeMap::new();
    let mut add = |cause: String, length_s: f64| {
        if length_s < SHORTEST_S {
            return;
        }
        let new = || Waiting { cause: cause.clone(), times: 0, total_s: 0.0, longest_s: 0.0 };
        let all = by.entry(cause.clone()).or_insert_with(new);
        (all.times, all.total_s) = (all.times + 1, all.total_s + length_s);
        all.longest_s = all.longest_s.max(length_s);
    };
    for one in run.instances().filter(|one| !one.squashed && !one.jobs.is_empty()) {
        for Phase { from_s, to_s, ended_by, .. } in one.awaited() {
            let cause = match ended_by {
                Cause::Result(id, _) if *id == one.id => "its own next try".to_owned(),
                Cause::Result(_, path) => format!("the result of {}", without_visits(path)),
                other => other.awaited(),
            };
            add(cause, to_s - from_s);
        }
        for phase in one.phases.iter().filter(|phase| phase.stage == Stage::Preparing) {
            add("a projection".to_owned(), phase.to_s - phase.from_s);
        }
        for wait in &one.waits {
            let kinds = wait.kinds.join(", ");
            let cause = match wait.behind.first() {
                Some(behind) => format!("{kinds}, held by {}", without_visits(&behind.holder)),
                None => format!("{kinds}, from the resource manager"),
            };
            add(cause, wait.to_s - wait.from_s);
        }
    }
    let mut all: Vec<Waiting> = by.into_values().collect();
    all.sort_by(|a, b| b.total_s.total_cmp(&a.total_s).then(a.cause.cmp(&b.cause)));
    all
}

/// A table for people.
pub fn table(all: &[Waiting]) -> String {
    let mut text = String::new();
    if all.is_empty() {
        return text;
    }
    let shown = &all[..all.len().min(MOST_SHOWN)];
    let names = Names::of(shown.iter().map(|one| one.cause.as_str()), 22);
    let width = names.width;
    let _ = writeln!(text, "\n{:<w$} times  total s longest s", "waited for", w = width + 2);
    for (name, one) in names.iter().zip(shown) {
        let _ = writeln!(text, "  {name:<width$} {:>5} {:>8.1} {:>9.1}", one.times, one.total_s, one.longest_s);
    }
    if all.len() > MOST_SHOWN {
        let _ = writeln!(text, "  and {} more causes", all.len() - MOST_SHOWN);
    }
    text
}
