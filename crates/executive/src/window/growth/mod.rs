//! Growing the window: cursors follow the program's transitions and append instances, up to the horizon.
//!
//! It owns the cursors. It reads in the graph which paths are certain and how far lines have retired, and appends to the
//! graph. It knows no results except the lists of loops, which are passed to it.
//!
//! | | |
//! |---|---|
//! | `cursor` | an open end of a path |
//! | `walk` | entering, leaving and following states |
//! | `append` | one more instance, and the environment behind it |
//! | `iterate` | iterations of loops |
//! | `branch` | several ways on from a decision |
//! | `regions` | forks and joins |
//! | `environment`, `table` | what is fixed about a place: variables, ports, writers of facts |

mod append;
mod branch;
mod checkpoint;
mod cursor;
pub(crate) mod environment;
mod iterate;
mod regions;
mod table;
mod walk;

use super::graph::instance::LineId;
use super::graph::{Graph, MAIN, Pruned};
use crate::context::{Context, MAX_IDLE_VISITS, in_circles};
use crate::plan::{Outcome, Plan};
use cursor::{Cursor, Todo};
use environment::{Binding, Environment};
use ratn_model::id::{InstanceId, StateId};
use ratn_model::program::{ABORTED, Program};
use ratn_model::value::Value;
use regions::Regions;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::sync::Arc;

/// The open ends of all paths.
#[derive(Serialize, Deserialize)]
pub(crate) struct Growth {
    cursors: Vec<Cursor>,
    /// By fork, the known ends of its regions.
    regions: BTreeMap<InstanceId, Regions>,
    /// Learned probabilities of outcomes, by the path of the state.
    learned_outcomes: BTreeMap<String, BTreeMap<String, f64>>,
    speculation_width: usize,
    horizon: u64,
    last_order: u64,
    /// Number of instances appended since the last `forget_grown`.
    grown: usize,
}

/// Where a path continues that was left.
pub(crate) struct Departure {
    pub(crate) environment: Environment,
    pub(crate) line: LineId,
    pub(crate) position: u64,
    pub(crate) state: StateId,
    pub(crate) outcome: Outcome,
    pub(crate) because: Arc<str>,
}

impl Growth {
    /// One cursor at the beginning of the program.
    pub(crate) fn new(
        program: &Program,
        plan: &Plan,
        parameters: &BTreeMap<String, Value>,
        learned_outcomes: BTreeMap<String, BTreeMap<String, f64>>,
    ) -> Growth {
        let mut environment = Environment::new(plan);
        for (name, value) in parameters {
            environment.variables.declare(name, Binding::Known(value.clone()));
        }
        let cursor = Cursor {
            environment,
            tail: None,
            line: MAIN,
            segment: 0,
            position: 0,
            todo: Todo::Enter(Program::ROOT),
            because: None,
            visits: 0,
            idle_visits: 0,
            order: 0,
        };
        Growth {
            cursors: vec![cursor],
            regions: BTreeMap::new(),
            learned_outcomes,
            speculation_width: program.speculation_width,
            horizon: program.horizon.max(1) as u64,
            last_order: 0,
            grown: 0,
        }
    }

    /// Grows at every cursor that may grow; true if anything was appended.
    pub(crate) fn grow(&mut self, graph: &mut Graph, context: &mut Context<'_>) -> bool {
        let mut grew = false;
        'again: loop {
            if !self.regions.is_empty() {
                self.join_regions(graph, context);
            }
            if self.grow_alone(graph, context) {
                grew = true;
            }
            if self.cursors.len() == 1 && !graph.has_branches() && self.regions.is_empty() {
                return grew;
            }
            self.cursors.retain(|cursor| cursor.todo != Todo::Done);
            graph.awaken(self.speculation_width);
            let mut awake: Vec<usize> =
                (0..self.cursors.len()).filter(|index| graph.is_awake(self.cursors[*index].segment)).collect();
            awake.sort_by_key(|index| self.cursors[*index].order);
            for index in awake {
                let cursors = self.cursors.len();
                while self.may_grow(graph, index) {
                    grew = true;
                    self.step(graph, context, index);
                    if self.cursors.len() != cursors || self.cursors[index].todo == Todo::Done {
                        continue 'again;
                    }
                }
            }
            return grew;
        }
    }

    /// The common case of a single cursor, where there is nothing to choose.
    fn grow_alone(&mut self, graph: &mut Graph, context: &mut Context<'_>) -> bool {
        let mut grew = false;
        while self.cursors.len() == 1 && !graph.has_branches() && self.may_grow(graph, 0) {
            grew = true;
            self.step(graph, context, 0);
        }
        grew
    }

    fn may_grow(&self, graph: &Graph, index: usize) -> bool {
        let cursor = &self.cursors[index];
        !matches!(cursor.todo, Todo::Await(_) | Todo::Done) && cursor.position < graph.floor(cursor.line) + self.horizon
    }

    fn step(&mut self, graph: &mut Graph, context: &mut Context<'_>, index: usize) {
        let cursor = &mut self.cursors[index];
        if cursor.idle_visits > MAX_IDLE_VISITS {
            let path = cursor.environment.frames.as_ref().map_or("", |frame| &frame.path);
            cursor.because = Some(in_circles(path).into());
            return self.end_of_task(graph, context, index, ABORTED);
        }
        match std::mem::replace(&mut cursor.todo, Todo::Done) {
            Todo::Enter(state) => self.enter(graph, context, index, state),
            Todo::Leave(state, outcome) => self.follow(graph, context, index, state, outcome),
            Todo::Exit { state, visit, outcome, variables } => {
                self.exit(graph, context, index, state, visit, outcome, variables);
            }
            Todo::Iterate => self.iterate(graph, context, index),
            todo @ (Todo::Await(_) | Todo::Done) => self.cursors[index].todo = todo,
        }
    }

    fn next_order(&mut self) -> u64 {
        self.last_order += 1;
        self.last_order
    }

    /// Number of instances appended since the last `forget_grown`.
    pub(crate) fn grown(&self) -> usize {
        self.grown
    }

    /// Resets that number.
    pub(crate) fn forget_grown(&mut self) {
        self.grown = 0;
    }

    /// An instance ended otherwise than computed ahead: continues its path where its outcome leads.
    pub(crate) fn depart(
        &mut self,
        context: &Context<'_>,
        departure: Departure,
        producer: Option<Arc<environment::Producer>>,
    ) {
        let Departure { mut environment, line, position, state, outcome, because } = departure;
        environment.test = None;
        let order = self.next_order();
        self.cursors.push(Cursor {
            environment,
            tail: None,
            line,
            segment: 0,
            position: position + 1,
            todo: Todo::Leave(state, outcome),
            because: Some(because),
            visits: 0,
            idle_visits: 0,
            order,
        });
        let index = self.cursors.len() - 1;
        self.produce(context, index, producer, state, outcome);
    }

    /// The reason why a path is left by the outcome of a state is known: it was only known which state that is.
    pub(crate) fn explain(&mut self, path: &str, because: &Arc<str>) {
        let cursors = self.cursors.iter_mut().map(|cursor| &mut cursor.because);
        let exits = self.regions.values_mut().flat_map(|regions| regions.reasons_mut());
        for reason in cursors.chain(exits).filter(|reason| reason.as_deref() == Some(path)) {
            *reason = Some(because.clone());
        }
    }

    /// An instance decides again: expands the paths behind it again.
    pub(crate) fn reopen(&mut self, graph: &mut Graph, context: &Context<'_>, id: InstanceId) {
        let Some(instance) = graph.get(id) else { return };
        let (line, segment, position) = (instance.line, instance.segment, instance.position);
        let (role, visit, iteration) = (instance.role(), instance.visit, instance.iteration);
        let mut environment = instance.environment.clone();
        environment.test = None;
        let because = instance.marker().and_then(|marker| marker.because.clone());
        let order = self.next_order();
        self.cursors.push(Cursor {
            environment,
            tail: Some((id, 0)),
            line,
            segment,
            position: position + 1,
            todo: Todo::Await(id),
            because,
            visits: 0,
            idle_visits: 0,
            order,
        });
        let index = self.cursors.len() - 1;
        use super::graph::instance::Role;
        match role {
            Some(Role::Condition) => self.branch_on_condition(graph, context, index, id, visit),
            Some(Role::Test) => self.branch_on_test(graph, context, index, id, visit, iteration.unwrap_or(0)),
            Some(Role::Loop) => graph.single_arm(id, 1),
            Some(Role::Join) => graph.single_arm(id, u64::MAX),
            _ => {}
        }
    }

    /// Removes the cursors of lost paths.
    pub(crate) fn prune(&mut self, graph: &Graph, pruned: &Pruned) {
        let behind = pruned.behind;
        self.cursors.retain(|cursor| {
            let is_lost = |id: InstanceId| pruned.instances.contains(&id) || behind == Some(id);
            let waits_for_lost = matches!(cursor.todo, Todo::Await(id) if is_lost(id));
            !(pruned.segments.contains(&cursor.segment)
                || pruned.lines.contains(&cursor.line)
                || pruned.stopped_line == Some(cursor.line)
                || cursor.tail.is_some_and(|(tail, _)| is_lost(tail))
                || waits_for_lost)
        });
        self.prune_regions(graph, pruned);
    }

    /// A decision is made: only one way on is left.
    pub(crate) fn arm_taken(&mut self, id: InstanceId) {
        for cursor in &mut self.cursors {
            if let Some((tail, arm)) = &mut cursor.tail
                && *tail == id
            {
                *arm = 0;
            }
        }
    }

    /// The run ends: stops growing.
    pub(crate) fn stop(&mut self) {
        self.cursors.clear();
        self.regions.clear();
    }

    /// Checks the cursors.
    pub(crate) fn check_invariants(&self, graph: &Graph) -> Result<(), String> {
        for cursor in &self.cursors {
            if let Todo::Await(id) = cursor.todo
                && !graph.contains(id)
                && !self.regions.contains_key(&id)
            {
                return Err(format!("a cursor of line {:?} waits for {id}, which is not in the window", cursor.line));
            }
            if !graph.has_line(cursor.line) {
                return Err(format!("a cursor is on line {:?}, which is gone", cursor.line));
            }
        }
        Ok(())
    }
}
