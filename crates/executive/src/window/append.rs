//! One more instance behind the last one of a path, and what is seen from behind it: its outputs, what it assigns, its effects.

use super::Window;
use super::environment::{Binding, Link, Producer};
use super::instance::{Instance, Role, Status, Wait, gives_outputs};
use crate::context::Context;
use crate::plan::NodeNature;
use crate::plan::{Outcome, Predicate};
use crate::protocol::Note;
use ratn_model::id::{InstanceId, StateId};
use ratn_model::program::State;
use ratn_model::time::Timestamp;
use smallvec::SmallVec;
use std::cell::Cell;
use std::sync::{Arc, OnceLock};

/// Duration assumed of a node that says none, in seconds.
const DEFAULT_DURATION_S: f32 = 1.0;

impl Window {
    #[expect(clippy::too_many_arguments, reason = "all of it is one visit")]
    pub(super) fn append(
        &mut self,
        context: &mut Context<'_>,
        index: usize,
        state: &State,
        role: Role,
        visit: u32,
        iteration: Option<usize>,
        leaves_by: Outcome,
    ) -> InstanceId {
        let id = context.new_instance();
        let plan = self.plan.clone();
        let own = plan.state(state.id);
        let cursor = &mut self.cursors[index];
        cursor.idle = 0;
        let (line, segment, position) = (cursor.line, cursor.segment, cursor.position);
        cursor.position += 1;
        let environment = cursor.environment.clone();
        let tail = cursor.tail.replace((id, 0));
        let left_because = cursor.because.clone();
        let writes_outputs = match role {
            Role::Node | Role::Exit => own.is_read || !own.assigns.is_empty(),
            Role::Entry | Role::RegionEnd => true,
            _ => false,
        };
        // The first of a line, and what follows one that others were let pass, is nobody's next in line.
        let mut is_next = false;
        if let Some((tail, arm)) = tail
            && let Some(older) = self.instances.get_mut(tail)
        {
            is_next = older.role != Role::Fork && !older.detached;
            if let Some(arm) = older.arms.get_mut(arm) {
                arm.next = Some(id);
            }
        }
        let nature = match role {
            Role::Node => context.plan.state(state.id).nature,
            _ => NodeNature::Computes,
        };
        let duration_s = match role {
            Role::Node => self.learned.durations_s.get(&state.path).map_or(DEFAULT_DURATION_S, |s| *s as f32),
            _ => 0.0,
        };
        self.instances.push(Instance {
            id,
            state: state.id,
            visit,
            iteration,
            role,
            nature,
            environment,
            producer: writes_outputs.then(|| Arc::new(Producer { instance: id, real: OnceLock::new() })),
            line,
            segment,
            position,
            arms: SmallVec::new(),
            leaves_by,
            left_because,
            is_head: false,
            detached: false,
            queued: false,
            status: Status::Expanded,
            wait: Wait::Nothing,
            attempt: 1,
            tries: 1,
            has_acted: false,
            crashes: 0,
            not_before: Timestamp(0),
            began: Timestamp(0),
            lease: None,
            projection: None,
            ended: None,
            settled: Cell::new(false),
            routine: None,
            seen: None,
            waiters: SmallVec::new(),
            users: SmallVec::new(),
            duration_s,
            remaining_s: duration_s,
            advised: false,
            asked_with: 0,
        });
        if !is_next && role != Role::Join {
            self.set_head(line, Some(id));
        }
        let speculative = match self.branches.get_mut(&segment) {
            Some(branch) => {
                branch.members.push(id);
                true
            }
            None => false,
        };
        if role == Role::Node {
            let path = self.path(context.program, id);
            context.note(Note::Expanded { instance: id, state: state.id, path, speculative });
        }
        self.grown_since_estimate += 1;
        self.enqueue(id);
        id
    }

    /// The environment behind an instance that ends by an outcome.
    pub(super) fn come_after(
        &mut self,
        index: usize,
        instance: InstanceId,
        id: StateId,
        outcome: Outcome,
        vague: bool,
        writes: &[Predicate],
    ) {
        let producer = self.instances.get(instance).and_then(|i| i.producer.clone());
        for predicate in writes {
            let link = Link { writer: instance, outcome, vague };
            self.cursors[index].environment.writers.set(*predicate, Some(link));
        }
        self.produce(index, producer, id, outcome);
    }

    /// Its outputs and what it assigns are seen from here on.
    pub(super) fn produce(&mut self, index: usize, producer: Option<Arc<Producer>>, id: StateId, outcome: Outcome) {
        let plan = self.plan.clone();
        let own = plan.state(id);
        let environment = &mut self.cursors[index].environment;
        let good = gives_outputs(&own.outcomes[outcome]);
        if let Some(producer) = producer {
            if own.is_read && good {
                environment.producers.set(id.0 as usize, Some(producer.clone()));
            }
            if good || own.is_routine {
                for name in &own.assigns {
                    environment.variables.assign(name, Binding::Assigned(producer.clone()));
                }
            }
        }
    }
}
