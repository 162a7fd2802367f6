//! Decisions of the window that need no worker: conditions, lists of loops, deciders, entries and exits of composite
//! states, the end of the task.

use super::graph::instance::{Ended, Instance, Role};
use super::growth::environment::{ASSIGNED, assigned};
use super::memory::settled::{undecidable, unsettled};
use super::memory::{Purpose, Seen, facts_of};
use super::outside::remembered;
use super::ready::{Readiness, not_bound};
use super::waits::Wait;
use super::{End, Window};
use crate::binding::{BindError, Outputs};
use crate::context::Context;
use crate::plan::gives_outputs;
use crate::protocol::Note;
use ratn_model::expression::{Expr, Scope};
use ratn_model::id::InstanceId;
use ratn_model::program::{ABORTED, PREEMPTED, SUCCESS, StateKind, VIOLATED};
use ratn_model::value::Value;

impl Window {
    /// What a decision by these expressions waits for, if anything.
    pub(super) fn undecidable(&mut self, context: &Context<'_>, id: InstanceId, from: &[&Expr]) -> Option<Wait> {
        undecidable(&mut self.graph, &self.memory, context, id, from)
    }

    /// Decides by the outcome of a node with several arms, once its result is settled.
    pub(super) fn decide_by_outcome(&mut self, context: &mut Context<'_>, id: InstanceId) {
        self.revise(context);
        if let Some(blocker) = unsettled(&mut self.graph, &self.memory, context, id) {
            return self.wait(id, Wait::Settling(blocker));
        }
        let Some(instance) = self.graph.get(id) else { return };
        let Some(ended) = instance.ended() else { return };
        // `requires` is checked in the actual world when the node retires, and may change the outcome.
        if !context.program.state(instance.state).annotations.requires.is_empty() {
            return self.wait(id, Wait::Order);
        }
        let number = context.plan.state(instance.state).outcome(&ended.outcome);
        let decision = ended.outcome.to_string();
        match number.and_then(|number| instance.arm_of(number)) {
            Some(arm) => {
                let path = self.path(context.program, id);
                context.note(Note::Decided { instance: id, path, decision });
                self.take_arm(context, id, arm);
            }
            None => self.wait(id, Wait::Order),
        }
    }

    /// Decides a condition, or the test of a `while`.
    pub(super) fn decide(&mut self, context: &mut Context<'_>, id: InstanceId) {
        self.revise(context);
        let Some(instance) = self.graph.get(id) else { return };
        let state = context.program.state(instance.state);
        let names = names_of(instance);
        let (StateKind::Condition { predicate, .. } | StateKind::While { predicate, .. }) = &state.kind else { return };
        if let Some(wait) = self.undecidable(context, id, &[predicate]) {
            return self.wait(id, wait);
        }
        let decision = self.look(context, id, None, |_, view| {
            predicate.holds(view).map_err(|error| (error.clone(), view.blocker().filter(|_| error.is_not_yet_known())))
        });
        let Some(decision) = decision else { return };
        let taken = match decision {
            Ok(true) => 0,
            Ok(false) => 1,
            Err((_, Some(blocker))) => return self.wait(id, Wait::World(blocker)),
            Err((error, None)) => {
                let reason = BindError::at("its predicate", state)(error).reason();
                return self.end_instance(id, Ended::aborted(reason));
            }
        };
        let path = self.path(context.program, id);
        context.note(Note::Decided { instance: id, path, decision: names[taken].to_owned() });
        self.end_instance(id, Ended::with(names[taken], Outputs::new()));
        self.take_arm(context, id, taken);
    }

    /// Decides the list of a loop.
    pub(super) fn count(&mut self, context: &mut Context<'_>, id: InstanceId) {
        self.revise(context);
        let Some(instance) = self.graph.get(id) else { return };
        let state = context.program.state(instance.state);
        let StateKind::ForEach { collection, .. } = &state.kind else { return };
        if let Some(wait) = self.undecidable(context, id, &[collection]) {
            return self.wait(id, wait);
        }
        let elements = self.look(context, id, None, |_, view| {
            let elements = collection.evaluate(view);
            elements.map_err(|error| (error.clone(), view.blocker().filter(|_| error.is_not_yet_known())))
        });
        let Some(elements) = elements else { return };
        let elements = match elements {
            Ok(Value::List(elements)) => elements,
            Ok(other) => {
                let reason = format!("it loops over a {}, not a list", other.type_name());
                return self.end_instance(id, Ended::aborted(reason));
            }
            Err((_, Some(blocker))) => return self.wait(id, Wait::World(blocker)),
            Err((error, None)) => {
                let reason = BindError::at("its list", state)(error).reason();
                return self.end_instance(id, Ended::aborted(reason));
            }
        };
        let path = self.path(context.program, id);
        context.note(Note::Decided { instance: id, path, decision: elements.len().to_string() });
        let looked = !collection.fact_expressions().is_empty();
        let outputs = looked.then(|| remembered(elements.clone())).into_iter().collect();
        self.end_instance(id, Ended::success(outputs));
        self.growth.unroll(&self.graph, context, id, elements);
    }

    pub(super) fn decide_join(&mut self, context: &mut Context<'_>, id: InstanceId) {
        self.revise(context);
        let Some(instance) = self.graph.get(id) else { return };
        let state = context.program.state(instance.state);
        let StateKind::Concurrency { regions, decide, .. } = &state.kind else { return };
        let expressions: Vec<&Expr> = decide.iter().map(|(_, expression)| expression).collect();
        if !expressions.is_empty()
            && let Some(wait) = self.undecidable(context, id, &expressions)
        {
            return self.wait(id, wait);
        }
        let decided = self.look(context, id, None, |_, view| {
            for (outcome, holds) in decide {
                match holds.holds(view) {
                    Ok(false) => {}
                    Ok(true) => return Ok((outcome.clone(), None)),
                    Err(error) => {
                        if let Some(blocker) = view.blocker().filter(|_| error.is_not_yet_known()) {
                            return Err(blocker);
                        }
                        let reason = BindError::at(format_args!("`decide.{outcome}`"), state)(error).reason();
                        return Ok((ABORTED.to_owned(), Some(reason)));
                    }
                }
            }
            let outcome = |value: &Value| match value {
                Value::String(outcome) => Some(outcome.clone()),
                _ => None,
            };
            let outcomes: Vec<String> = regions
                .iter()
                .filter_map(|region| view.port(*region, "outcome").as_deref().and_then(outcome))
                .collect();
            Ok((default_outcome(&outcomes).to_owned(), None))
        });
        let (outcome, reason) = match decided {
            None => return,
            Some(Err(blocker)) => return self.wait(id, Wait::World(blocker)),
            Some(Ok(decided)) => decided,
        };
        let path = self.path(context.program, id);
        context.note(Note::Decided { instance: id, path: path.clone(), decision: outcome.clone() });
        self.end_instance(id, Ended::with(outcome.as_str(), Outputs::new()));
        let own = context.plan.state(state.id);
        let number = own.outcome(&outcome).unwrap_or(own.outcomes.len() - 2);
        let because = reason.map(|reason| format!("{path}: {reason}").into());
        self.growth.leave_join(&self.graph, id, number, because);
    }

    /// Computes a boundary: variables at the entry of a composite state; outputs and assignments at its exit.
    pub(super) fn compute_boundary(&mut self, context: &mut Context<'_>, id: InstanceId) {
        self.follow_root(context);
        let Some(instance) = self.graph.get(id) else { return };
        let Some(marker) = instance.marker() else { return };
        let own = context.plan.state(instance.state);
        let leaves_by = own.outcomes[marker.leaves_by].clone();
        let outcome = if marker.role == Role::Entry { SUCCESS.into() } else { leaves_by };
        let (computed, seen) = self.compute_parts(context, instance);
        let ended = match computed {
            Ok(outputs) => Ended::with(outcome, outputs),
            Err(Readiness::Failed(reason)) => Ended::aborted(reason),
            Err(Readiness::Waits(wait)) => return self.wait(id, wait),
            Err(Readiness::Ready(..)) => return,
        };
        self.graph.set_seen(id, Some(seen));
        self.end_instance(id, ended);
    }

    /// Evaluates the parts of a boundary in order, each under its name; also returns the facts that they depend on.
    pub(super) fn compute_parts(
        &self,
        context: &Context<'_>,
        instance: &Instance,
    ) -> (Result<Outputs, Readiness>, Seen) {
        let state = context.program.state(instance.state);
        let parts = parts_of(context, instance);
        let is_success = |outcome: &str| outcome == SUCCESS;
        let marker_outcome = instance.marker().map_or(0, |marker| marker.leaves_by);
        let leaves_by = &context.plan.state(instance.state).outcomes[marker_outcome];
        let mut outputs = Outputs::new();
        let mut seen = Seen::default();
        for (name, expression, what) in parts {
            // Assignments may use the outputs.
            let value = self.look(context, instance.id, Some(&outputs), |instance, view| {
                let mut looked = Seen::default();
                let value = expression.evaluate(view).map_err(|error| {
                    // The state was left early by an outcome of its own, so nobody will write this port.
                    let missing = error.is_not_yet_known() && view.blocker().is_none();
                    let is_left_out = missing && !is_success(leaves_by) && !name.starts_with(ASSIGNED);
                    (!is_left_out).then(|| not_bound(view, &BindError::at(&what, state)(error)))
                });
                let facts = facts_of([expression], view);
                // Facts that are not known yet still count as read, even if they turn out not to be needed.
                if view.see(facts.clone(), &mut looked).is_err() {
                    looked.look_at(facts);
                }
                let is_made = !matches!(value, Err(Some(Readiness::Waits(_))));
                if is_made {
                    // A failure may come out differently, too.
                    view.use_outputs(view.sight.producers_of(view.instance));
                    view.register(Purpose::Result);
                }
                debug_assert!(instance.marker().is_some(), "only markers are boundaries");
                (value, looked)
            });
            let Some((value, looked)) = value else { break };
            seen.extend(looked);
            match value {
                Ok(value) => drop(outputs.insert(name, value)),
                Err(None) => {}
                Err(Some(failed)) => return (Err(failed), seen),
            }
        }
        (Ok(outputs), seen)
    }

    /// Everything older has retired: ends the run with the task's outputs.
    pub(super) fn end_run(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let Some(instance) = self.graph.get(id) else { return };
        if !instance.is_head {
            return self.wait(id, Wait::Order);
        }
        if let Some(beside) = self.graph.detached().first().copied() {
            return self.wait(id, Wait::Data(beside));
        }
        if self.goes_in_circles(context, id) {
            return;
        }
        let Some(instance) = self.graph.get(id) else { return };
        let Some(marker) = instance.marker() else { return };
        let outcome = context.plan.state(instance.state).outcomes[marker.leaves_by].to_string();
        let reason = marker.because.as_ref().map_or(String::new(), ToString::to_string);
        let mut end = End::new(&outcome, reason);
        if end.outcome == SUCCESS {
            end.reason = String::new();
            let outputs = self.look(context, id, None, |_, view| {
                let value = |output: &ratn_model::program::TaskOutput| {
                    let value = output.value.evaluate(view);
                    let named = |error| format!("output `{}`: {error}", output.name);
                    value.map(|value| (output.name.clone(), value)).map_err(named)
                };
                context.program.outputs.iter().map(value).collect::<Result<Outputs, String>>()
            });
            match outputs {
                Some(Ok(outputs)) => end.outputs = outputs,
                Some(Err(reason)) => end = End::new(ABORTED, reason),
                None => {}
            }
        }
        self.harvest_all(context);
        self.end = Some(end);
    }
}

/// The names of the two decisions of a condition or of a test.
pub(super) fn names_of(instance: &Instance) -> [&'static str; 2] {
    if instance.role() == Some(Role::Test) { ["again", "done"] } else { ["then", "else"] }
}

/// The outcome of a concurrency if its decider gives none.
fn default_outcome(outcomes: &[String]) -> &'static str {
    if outcomes.iter().all(|outcome| outcome == SUCCESS) {
        SUCCESS
    } else if outcomes.iter().any(|outcome| outcome == ABORTED || outcome == VIOLATED) {
        ABORTED
    } else {
        PREEMPTED
    }
}

/// The parts of a boundary: the name of each, its expression, and its description for messages.
fn parts_of<'p>(context: &Context<'p>, instance: &Instance) -> Vec<(String, &'p Expr, String)> {
    let state = context.program.state(instance.state);
    let own = context.plan.state(instance.state);
    let mut parts: Vec<(String, &Expr, String)> = Vec::new();
    let Some(marker) = instance.marker() else { return parts };
    if marker.role == Role::Entry {
        parts.extend(state.variables.iter().map(|(n, e)| (assigned(n), e, format!("variable `{n}`"))));
    } else if gives_outputs(&own.outcomes[marker.leaves_by]) {
        let outputs = state.outputs().iter();
        parts.extend(outputs.map(|o| (o.name.clone(), &o.value, format!("output `{}`", o.name))));
        parts.extend(state.assign.iter().map(|(n, e)| (assigned(n), e, format!("`assign` of `{n}`"))));
    }
    parts
}
