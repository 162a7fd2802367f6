//! Regions: threads of control that begin at a fork and end at a join. Each is a line of its own, with its own horizon, order
//! and heads.

use super::Growth;
use super::append::What;
use super::cursor::{Cursor, Todo};
use super::environment::{Binding, Collector, Environment, Frame, Link, Producer, Restored};
use crate::checkpoint::Broken;
use crate::context::Context;
use crate::plan::Chain;
use crate::window::graph::instance::{Ended, Role};
use crate::window::graph::{Graph, Pruned};
use ratn_model::id::{InstanceId, StateId};
use ratn_model::program::{SUCCESS, State, StateKind};
use ratn_model::value::Value;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::sync::Arc;

/// The end of one path of a region, with the environment there.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct RegionExit {
    end: InstanceId,
    #[serde(skip)]
    environment: Environment,
    producer: Arc<Producer>,
    /// Reason why the path left by an outcome that is not success.
    because: Option<Arc<str>>,
}

/// A fork whose join may still be lost with an end of a region, and is then expanded again.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Regions {
    /// The concurrency and its visit.
    state: StateId,
    visit: u32,
    /// By region, the ends of its paths.
    ends: Vec<Vec<RegionExit>>,
    is_joined: bool,
    /// The cursor that goes on behind the join.
    waiting: Cursor,
}

impl Regions {
    /// The reasons why paths of the regions, or the path up to them, left by an outcome that is not success.
    pub(super) fn reasons_mut(&mut self) -> impl Iterator<Item = &mut Option<Arc<str>>> {
        self.ends.iter_mut().flatten().map(|exit| &mut exit.because).chain([&mut self.waiting.because])
    }
}

impl Growth {
    /// Enters a concurrency: begins every region.
    pub(super) fn fork(
        &mut self,
        graph: &mut Graph,
        context: &mut Context<'_>,
        index: usize,
        state: &State,
        (visit, path, variables): (u32, &Arc<str>, usize),
        regions: &[StateId],
    ) {
        let fork = self.append(graph, context, index, state, What::marker(Role::Fork), (visit, None));
        graph.note_fork(fork);
        let template = self.cursors[index].clone();
        for region in regions {
            let (line, arm) = graph.open_region(fork, context.plan.state(*region).place);
            let frame = Frame {
                below: template.environment.frames.clone(),
                owner: state.id,
                visit,
                path: path.clone(),
                visits: Vec::new(),
                iteration: None,
                variables,
                fork: Some(fork),
                earlier: Vec::new(),
            };
            let order = self.next_order();
            let mut cursor = Cursor { line, position: 0, order, idle_visits: 0, ..template.clone() };
            cursor.environment.frames = Some(Arc::new(frame));
            cursor.tail = Some((fork, arm));
            cursor.todo = Todo::Enter(*region);
            self.cursors.push(cursor);
        }
        let waiting = Cursor { todo: Todo::Await(fork), tail: None, ..template };
        self.cursors[index] = waiting.clone();
        let ends = vec![Vec::new(); regions.len()];
        self.regions.insert(fork, Regions { state: state.id, visit, ends, is_joined: false, waiting });
    }

    /// A path of a region has come to its end.
    pub(super) fn end_region(
        &mut self,
        graph: &mut Graph,
        context: &mut Context<'_>,
        index: usize,
        region: StateId,
        outcome: &str,
    ) {
        let state = context.program.state(region);
        let number = context.plan.state(region).outcome(outcome).unwrap_or(0);
        let end = self.append(graph, context, index, state, What::Marker(Role::RegionEnd, number), (1, None));
        self.cursors[index].todo = Todo::Done;
        let Cursor { environment, because, line, .. } = self.cursors[index].clone();
        let because = because.filter(|_| outcome != SUCCESS);
        let outputs = [("outcome".to_owned(), Value::String(outcome.to_owned()))];
        graph.end(end, Ended::with(outcome, outputs.into_iter().collect()));
        let Some(producer) = graph.get(end).and_then(|end| end.producer.clone()) else { return };
        if let Some((fork, place)) = graph.region(line)
            && let Some(regions) = self.regions.get_mut(&fork)
        {
            regions.ends[place].push(RegionExit { end, environment, producer, because });
        }
    }

    /// Expands the join of each fork whose regions have one end each, which nothing inside of the region can change.
    pub(super) fn join_regions(&mut self, graph: &mut Graph, context: &mut Context<'_>) {
        let is_single = |regions: &Regions, ends: &Vec<RegionExit>| match ends.as_slice() {
            [exit] => graph.get(exit.end).is_none_or(|end| graph.is_same_stretch(end.segment, regions.waiting.segment)),
            _ => false,
        };
        let is_ready =
            |regions: &Regions| !regions.is_joined && regions.ends.iter().all(|ends| is_single(regions, ends));
        let ready: Vec<InstanceId> =
            self.regions.iter().filter(|(_, regions)| is_ready(regions)).map(|(id, _)| *id).collect();
        for id in ready {
            self.join(graph, context, id);
        }
    }

    fn join(&mut self, graph: &mut Graph, context: &mut Context<'_>, id: InstanceId) {
        let Some(index) = self.cursors.iter().position(|cursor| cursor.todo == Todo::Await(id)) else { return };
        let Some(record) = self.regions.get_mut(&id) else { return };
        record.is_joined = true;
        let ends: Vec<RegionExit> = record.ends.iter().flatten().cloned().collect();
        let visit = record.visit;
        let state = context.program.state(record.state);
        let StateKind::Concurrency { regions, .. } = &state.kind else { return };
        let states = context.plan.len();
        let before = self.cursors[index].environment.clone();
        let mut merged: BTreeMap<Chain, Vec<Link>> = BTreeMap::new();
        for (region, RegionExit { environment, producer, .. }) in regions.iter().zip(&ends) {
            for (predicate, link) in environment.writers.iter() {
                if before.writer(predicate) != Some(*link) {
                    merged.entry(predicate).or_default().push(*link);
                }
            }
            let behind = &mut self.cursors[index].environment;
            for (slot, producer) in environment.producers.iter() {
                let known = before.producers.get(slot).map(|old| old.instance);
                if known != Some(producer.instance) {
                    behind.producers.set(slot, Some(producer.clone()));
                }
            }
            behind.producers.set(states + region.0 as usize, Some(producer.clone()));
            let theirs: Vec<_> = environment.variables.iter().take(before.variables.len()).cloned().collect();
            for ((name, binding), (_, old)) in theirs.into_iter().zip(before.variables.iter()) {
                if let Binding::Assigned(new) = &binding
                    && !matches!(old, Binding::Assigned(old) if old.instance == new.instance)
                {
                    behind.variables.assign(&name, binding);
                }
            }
        }
        let reasons: Vec<&str> = ends.iter().filter_map(|end| end.because.as_deref()).collect();
        if !reasons.is_empty() {
            self.cursors[index].because = Some(reasons.join("; ").into());
        }
        let join = self.append(graph, context, index, state, What::marker(Role::Join), (visit, None));
        for (predicate, links) in &merged {
            let link = match links.as_slice() {
                [only] => *only,
                _ => Link { writer: join, outcome: 0, vague: false },
            };
            self.cursors[index].environment.writers.set(*predicate, Some(link));
        }
        let several = merged.into_iter().filter(|(_, links)| links.len() > 1);
        let links: Vec<_> = several.flat_map(|(p, links)| links.into_iter().map(move |link| (p, link))).collect();
        // The decider sees the outputs of the regions.
        graph.join_fork(id, join, self.cursors[index].environment.clone(), links);
        self.cursors[index].todo = Todo::Await(join);
    }

    /// The environment of a fork's concurrency.
    pub(crate) fn around(&self, fork: InstanceId) -> Option<&Environment> {
        self.regions.get(&fork).map(|regions| &regions.waiting.environment)
    }

    /// A join has decided: leaves the concurrency by an outcome.
    pub(crate) fn leave_join(&mut self, graph: &Graph, join: InstanceId, outcome: usize, because: Option<Arc<str>>) {
        let Some(instance) = graph.get(join) else { return };
        let (state, visit) = (instance.state, instance.visit);
        if let Some(cursor) = self.cursors.iter_mut().find(|cursor| cursor.todo == Todo::Await(join)) {
            let variables = cursor.environment.variables.len();
            cursor.todo = Todo::Exit { state, visit, outcome, variables };
            cursor.because = because.or(cursor.because.take());
        }
    }

    /// Removes the regions of lost forks; a fork that has lost only its join or an end of a region waits again.
    pub(super) fn prune_regions(&mut self, graph: &Graph, pruned: &Pruned) {
        for (fork, end) in &pruned.region_ends {
            if let Some(regions) = self.regions.get_mut(fork) {
                regions.ends.iter_mut().for_each(|ends| ends.retain(|exit| exit.end != *end));
            }
        }
        for fork in &pruned.without_join {
            let Some(regions) = self.regions.get_mut(fork) else { continue };
            regions.is_joined = false;
            let waiting = regions.waiting.clone();
            if graph.has_line(waiting.line) {
                let order = self.next_order();
                self.cursors.push(Cursor { order, ..waiting });
            }
        }
        self.forget_joined(graph);
    }

    /// Removes forks whose join has retired.
    pub(crate) fn forget_joined(&mut self, graph: &Graph) {
        self.regions.retain(|fork, _| graph.has_fork(*fork));
    }
}

/// For a checkpoint: the environments of the ends of regions.
impl Regions {
    pub(super) fn collect<'a>(&'a self, places: &mut Collector<'a>) {
        places.add(&self.waiting.environment);
        for exit in self.ends.iter().flatten() {
            places.add(&exit.environment);
            places.add_producer(&exit.producer);
        }
    }

    pub(super) fn restore(&mut self, places: &mut Restored) -> Result<(), Broken> {
        self.waiting.environment = places.environment()?;
        for exit in self.ends.iter_mut().flatten() {
            (exit.environment, exit.producer) = (places.environment()?, places.producer()?);
        }
        Ok(())
    }
}
