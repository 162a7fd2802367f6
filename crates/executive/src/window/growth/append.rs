//! Appends one instance to a path and updates the environment behind it: its outputs, its assignments, its effects.

use super::Growth;
use super::environment::{Binding, Environment, Link, Producer};
use crate::context::Context;
use crate::plan::{Chain, Outcome, Predicate, Written, gives_outputs};
use crate::protocol::Note;
use crate::window::dispatch::DispatchCell;
use crate::window::graph::Graph;
use crate::window::graph::instance::{Body, Instance, Marker, Node, Role, Status};
use crate::window::memory::MemoryCell;
use crate::window::waits::WaitCell;
use ratn_model::expression::{Lookup, Scope};
use ratn_model::fact::{FactKey, FactPattern};
use ratn_model::id::{InstanceId, StateId};
use ratn_model::program::{Program, State};
use ratn_model::time::Timestamp;
use ratn_model::value::Value;
use smallvec::SmallVec;
use std::borrow::Cow;
use std::sync::Arc;

/// What to append: a node, or a marker that leaves its state by an outcome.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum What {
    Node,
    Marker(Role, Outcome),
}

impl What {
    pub(super) fn marker(role: Role) -> What {
        What::Marker(role, 0)
    }
}

impl Growth {
    pub(super) fn append(
        &mut self,
        graph: &mut Graph,
        context: &mut Context<'_>,
        index: usize,
        state: &State,
        what: What,
        (visit, iteration): (u32, Option<usize>),
    ) -> InstanceId {
        let id = context.new_instance();
        let own = context.plan.state(state.id);
        let cursor = &mut self.cursors[index];
        let (line, segment, position) = (cursor.line, cursor.segment, cursor.position);
        cursor.position += 1;
        let environment = cursor.environment.clone();
        let tail = cursor.tail.replace((id, 0));
        let writes_outputs = match what {
            What::Node | What::Marker(Role::Exit, _) => own.is_read || !own.assigns.is_empty(),
            What::Marker(Role::Entry | Role::RegionEnd, _) => true,
            What::Marker(..) => false,
        };
        let body = match what {
            What::Node => Body::Node(Node {
                nature: own.nature,
                status: Status::Expanded,
                attempt: 1,
                tries: 1,
                crashes: 0,
                not_before: Timestamp(0),
                seen: None,
                answer: None,
                has_acted: false,
                is_detached: false,
                is_at_its_place: false,
            }),
            What::Marker(role, leaves_by) => {
                Body::Marker(Marker { role, leaves_by, because: cursor.because.clone(), ended: None, seen: None })
            }
        };
        if what == What::Node {
            cursor.idle_visits = 0;
        }
        let path = (what == What::Node).then(|| environment.path(&state.name, visit, iteration));
        let instance = Box::new(Instance {
            id,
            state: state.id,
            visit,
            iteration,
            environment,
            producer: writes_outputs.then(|| Arc::new(Producer::new(id))),
            line,
            segment,
            position,
            visits_before: std::mem::take(&mut cursor.visits),
            arms: SmallVec::new(),
            is_head: false,
            is_settled: false,
            body,
            memory: MemoryCell::default(),
            waiting: WaitCell::default(),
            dispatch: DispatchCell::default(),
        });
        let speculative = graph.append(instance, tail);
        if let Some(path) = path {
            context.note(Note::Expanded { instance: id, state: state.id, path, speculative });
        }
        self.grown += 1;
        id
    }

    /// The environment behind an instance that ends with a given outcome.
    pub(super) fn come_after(
        &mut self,
        graph: &Graph,
        context: &Context<'_>,
        index: usize,
        instance: InstanceId,
        link: Link,
        (writes, written): (&[Predicate], &[Written]),
    ) {
        let Some((state, producer)) = graph.get(instance).map(|i| (i.state, i.producer.clone())) else { return };
        let plan = context.plan;
        let environment = &mut self.cursors[index].environment;
        let mut chains: SmallVec<[Chain; 4]> = writes.iter().map(|predicate| plan.chain_of(*predicate)).collect();
        for one in written {
            let known = Fixed { environment, program: context.program };
            plan.chains_written(one, &known, &mut |chain| chains.push(chain));
        }
        for chain in chains {
            environment.writers.set(chain, Some(link));
        }
        self.produce(context, index, producer, state, link.outcome);
    }

    /// Makes its outputs and assignments visible behind it.
    pub(super) fn produce(
        &mut self,
        context: &Context<'_>,
        index: usize,
        producer: Option<Arc<Producer>>,
        id: StateId,
        outcome: Outcome,
    ) {
        let own = context.plan.state(id);
        let environment = &mut self.cursors[index].environment;
        let good = gives_outputs(&own.outcomes[outcome]);
        if let Some(producer) = producer {
            if own.is_read && good {
                environment.producers.set(id.0 as usize, Some(producer.clone()));
                self.is_of_now(index, id);
            }
            let environment = &mut self.cursors[index].environment;
            if good || own.is_routine {
                for name in &own.assigns {
                    environment.variables.assign(name, Binding::Assigned(producer.clone()));
                }
            }
        }
    }
}

/// The scope of what is known when an instance is expanded, and never changes: loop variables and constants.
struct Fixed<'a> {
    environment: &'a Environment,
    program: &'a Program,
}

impl Scope for Fixed<'_> {
    fn variable(&self, name: &str) -> Option<Cow<'_, Value>> {
        match self.environment.variables.get(name) {
            Some(Binding::Known(value)) => Some(Cow::Borrowed(value)),
            Some(Binding::Assigned(_)) => None,
            None => self.environment.loop_variables(self.program).find(|(n, _)| *n == name).map(|(_, value)| value),
        }
    }

    fn output(&self, _: &str) -> Option<Cow<'_, Value>> {
        None
    }

    fn port(&self, _: StateId, _: &str) -> Option<Cow<'_, Value>> {
        None
    }

    fn fact(&self, _: &FactPattern) -> Lookup<'_> {
        Lookup::Unknown
    }

    fn each_fact(&self, _: &FactPattern, _: &mut dyn FnMut(&FactKey, &Value) -> bool) -> bool {
        false
    }
}
