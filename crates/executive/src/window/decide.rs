//! What the window decides by itself, without a worker: conditions, lists of loops, outputs of composites, the end.

use crate::binding::Outputs;
use crate::context::Context;
use crate::protocol::Note;
use crate::window::instance::Ended;
use crate::window::place::Place;
use crate::window::{End, Window};
use ratn_model::expression::FactExpr;
use ratn_model::fact::Footprint;
use ratn_model::id::InstanceId;
use ratn_model::program::{SUCCESS, StateKind};
use ratn_model::value::Value;

impl Window {
    /// A condition or a loop decides once what it is made of is settled.
    pub(super) fn decide(&mut self, context: &mut Context<'_>, id: InstanceId, place: &Place) -> bool {
        let Some(instance) = self.instances.alive.get(&id) else { return false };
        let state = context.program.state(instance.state);
        let expression = match &state.kind {
            StateKind::Condition { predicate, .. } => predicate,
            StateKind::ForEach { collection, .. } => collection,
            _ => return false,
        };
        let flows: Vec<_> = expression.flows().into_iter().collect();
        let facts = expression.fact_expressions();
        let settled = self.instances.flows_settled(&instance.environment, &flows)
            && facts.iter().all(|fact| {
                let read = place.with_scope(&self.instances, id, None, |scope| fact.pattern(scope));
                read.is_some_and(|pattern| !place.written.overlaps(&Footprint::Patterns(vec![pattern])))
            });
        if !settled || place.speculative {
            return false;
        }
        let value = place.with_scope(&self.instances, id, None, |scope| match &state.kind {
            StateKind::Condition { .. } => expression.holds(scope).map(Value::Bool),
            _ => expression.evaluate(scope),
        });
        let decision = match value {
            Some(Ok(Value::Bool(taken))) => {
                self.take_branch(context, id, taken);
                if taken { "then".to_owned() } else { "else".to_owned() }
            }
            Some(Ok(Value::List(elements))) => {
                let count = elements.len();
                let path = self.path(id).to_owned();
                for cursor in &mut self.cursors {
                    cursor.unroll(id, state.id, elements.clone(), path.clone());
                }
                count.to_string()
            }
            Some(Ok(other)) => {
                let reason = format!("it loops over a {}, not a list", other.type_name());
                return self.end_instance(id, Ended::aborted(reason));
            }
            Some(Err(error)) => return self.end_instance(id, Ended::aborted(error.to_string())),
            None => return false,
        };
        let path = self.path(id).to_owned();
        context.note(Note::Decided { instance: id, path, decision });
        self.end_instance(id, Ended::success(Outputs::new()))
    }

    /// The outputs of a composite are written as soon as what they are made of is.
    pub(super) fn leave_composite(&mut self, context: &Context<'_>, id: InstanceId, place: &Place) -> bool {
        let Some(instance) = self.instances.alive.get(&id) else { return false };
        let mut written = Outputs::new();
        let mut reads = Footprint::NOTHING;
        if let StateKind::Sequence { outputs, .. } = &context.program.state(instance.state).kind {
            for output in outputs {
                let facts: Vec<_> = output.value.fact_expressions().into_iter().cloned().collect();
                let value = place.with_scope(&self.instances, id, None, |scope| {
                    reads = std::mem::replace(&mut reads, Footprint::NOTHING).union(FactExpr::footprint(&facts, scope));
                    output.value.evaluate(scope)
                });
                match value {
                    Some(Ok(value)) => {
                        written.insert(output.name.clone(), value);
                    }
                    Some(Err(error)) if error.is_not_yet_known() => return false,
                    Some(Err(error)) => {
                        return self.end_instance(id, Ended::aborted(format!("output `{}`: {error}", output.name)));
                    }
                    None => return false,
                }
            }
        }
        if let Some(instance) = self.instances.alive.get_mut(&id) {
            instance.reads = reads;
            instance.seen = Some(place.world.clone());
        }
        self.end_instance(id, Ended::success(written))
    }

    pub(super) fn end_run(&mut self, context: &mut Context<'_>, id: InstanceId, place: &Place) -> bool {
        let mut outputs = Outputs::new();
        for output in &context.program.outputs {
            match place.with_scope(&self.instances, id, None, |scope| output.value.evaluate(scope)) {
                Some(Ok(value)) => {
                    outputs.insert(output.name.clone(), value);
                }
                Some(Err(error)) => {
                    return self.end_instance(id, Ended::aborted(format!("output `{}`: {error}", output.name)));
                }
                None => {}
            }
        }
        self.end = Some(End { outcome: SUCCESS.to_owned(), outputs, reason: String::new() });
        true
    }
}
