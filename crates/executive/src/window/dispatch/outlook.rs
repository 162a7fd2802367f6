//! The remaining work as a scheduling problem for look-ahead; of an undecided decision the likelier way.

use super::{DEFAULT_DURATION_S, Dispatch, blocks};
use crate::lookahead::{Problem, Task};
use crate::window::graph::instance::{LineId, Role};
use crate::window::memory::Sight;
use ratn_model::id::InstanceId;
use ratn_model::time::Timestamp;
use std::collections::BTreeMap;

/// Limit of the nodes that look-ahead plans; later ones keep their longest remaining path.
const MAX_TASKS: usize = 2_000;

/// Upper limit of a planned duration, in seconds: a year.
const LONGEST_S: f64 = 365.0 * 24.0 * 3600.0;

impl Dispatch {
    pub(crate) fn outlook(&self, sight: Sight<'_>, now: Timestamp) -> Problem {
        let graph = sight.graph;
        let mut places: BTreeMap<InstanceId, usize> = BTreeMap::new();
        let mut tasks: Vec<Task> = Vec::new();
        // Per line, the last PIA and the tasks since then: the next PIA waits for all of them. A region begins with those before its fork; behind a
        // join stand those of all its regions.
        let mut since: BTreeMap<LineId, Vec<usize>> = BTreeMap::new();
        let (mut at_forks, mut at_joins) = (BTreeMap::new(), BTreeMap::<InstanceId, Vec<usize>>::new());
        for instance in graph.iter().filter(|instance| graph.is_likeliest(instance.segment)) {
            if let Some((fork, _)) = graph.region(instance.line).filter(|_| !since.contains_key(&instance.line)) {
                since.insert(instance.line, at_forks.get(&fork).cloned().unwrap_or_default());
            }
            let line = since.entry(instance.line).or_default();
            match instance.role() {
                Some(Role::Fork) => drop(at_forks.insert(instance.id, line.clone())),
                Some(Role::RegionEnd) => {
                    let join = graph.join_behind(instance.line);
                    join.into_iter().for_each(|join| at_joins.entry(join).or_default().extend_from_slice(line));
                }
                Some(Role::Join) => *line = at_joins.remove(&instance.id).unwrap_or_default(),
                _ => {}
            }
            if instance.role().is_some() || instance.ended().is_some() {
                continue;
            }
            if tasks.len() == MAX_TASKS {
                break;
            }
            let began = instance.node().and_then(|node| node.status.since());
            let elapsed_s = began.map_or(0.0, |began| now.since(began).as_secs_f64());
            let mut after: Vec<usize> = Vec::new();
            if began.is_none() {
                after.extend(sight.producers_of(instance).filter_map(|producer| places.get(&producer)));
                after.extend(instance.waiting.wait().on().and_then(|on| places.get(&on)));
                if instance.is_pia() {
                    after.extend_from_slice(line);
                }
                after.sort_unstable();
                after.dedup();
            }
            if instance.is_pia() {
                line.clear();
            }
            line.push(tasks.len());
            places.insert(instance.id, tasks.len());
            let duration_s = instance.dispatch.duration_s.unwrap_or(DEFAULT_DURATION_S);
            tasks.push(Task {
                instance: instance.id,
                duration_s: (f64::from(duration_s) - elapsed_s).clamp(0.0, LONGEST_S),
                is_running: began.is_some(),
                held_for: Vec::new(),
                is_speculative: graph.is_speculative(instance.segment),
                urgency_s: f64::from(instance.dispatch.remaining_s.unwrap_or(duration_s)),
                probability: graph.probability(instance.segment),
                demands: blocks(sight.plan, instance.state).map(|(kind, count)| (kind.to_owned(), count)).collect(),
                after,
            });
        }
        for task in tasks.iter_mut().filter(|task| !task.is_running) {
            task.held_for = self.held_for(graph, task.instance).filter_map(|id| places.get(&id).copied()).collect();
        }
        Problem { tasks, capacity: self.capacity.clone() }
    }
}
