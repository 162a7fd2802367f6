//! What the window decides by itself, without a worker: conditions, lists of loops, deciders, what composite states do at
//! their ends, the end of the task.

use super::cursor::Todo;
use super::environment::{ASSIGNED, assigned};
use super::instance::{Ended, Role, Seen, Wait, gives_outputs};
use super::ready::{facts_of, not_bound};
use super::{End, Window, outside};
use crate::binding::{BindError, Outputs};
use crate::context::Context;
use crate::protocol::Note;
use ratn_model::expression::Expr;
use ratn_model::id::InstanceId;
use ratn_model::program::{ABORTED, SUCCESS, StateKind};
use ratn_model::value::Value;

impl Window {
    /// A condition, or the test of a `while`.
    pub(super) fn decide(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let Some(instance) = self.instances.get(id) else { return };
        let state = context.program.state(instance.state);
        let names = match instance.role {
            Role::Test => ["again", "done"],
            _ => ["then", "else"],
        };
        let (StateKind::Condition { predicate, .. } | StateKind::While { predicate, .. }) = &state.kind else { return };
        if let Some(wait) = self.undecidable(context, instance, std::slice::from_ref(predicate)) {
            return self.wait(id, wait);
        }
        let view = self.sight(context).view(instance, None);
        let taken = match predicate.holds(&view) {
            Ok(true) => 0,
            Ok(false) => 1,
            Err(error) => {
                let reason = BindError::at("its predicate", state)(error).reason();
                return self.end_instance(id, Ended::aborted(reason));
            }
        };
        drop(view);
        let path = self.path(context.program, id);
        context.note(Note::Decided { instance: id, path, decision: names[taken].to_owned() });
        self.end_instance(id, Ended::with(names[taken], Outputs::new()));
        self.take_arm(context, id, taken);
    }

    /// The list of a loop.
    pub(super) fn count(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let Some(instance) = self.instances.get(id) else { return };
        let state = context.program.state(instance.state);
        let StateKind::ForEach { collection, .. } = &state.kind else { return };
        if let Some(wait) = self.undecidable(context, instance, std::slice::from_ref(collection)) {
            return self.wait(id, wait);
        }
        let view = self.sight(context).view(instance, None);
        let elements = match collection.evaluate(&view) {
            Ok(Value::List(elements)) => elements,
            Ok(other) => {
                let reason = format!("it loops over a {}, not a list", other.type_name());
                return self.end_instance(id, Ended::aborted(reason));
            }
            Err(error) => {
                let reason = BindError::at("its list", state)(error).reason();
                return self.end_instance(id, Ended::aborted(reason));
            }
        };
        drop(view);
        let path = self.path(context.program, id);
        context.note(Note::Decided { instance: id, path, decision: elements.len().to_string() });
        let looked = !collection.fact_expressions().is_empty();
        let outputs = looked.then(|| outside::remembered(&elements)).into_iter().collect();
        self.end_instance(id, Ended::success(outputs));
        self.unroll(context, id, elements);
    }

    /// The decider over the outcomes of regions.
    pub(super) fn decide_join(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let Some(instance) = self.instances.get(id) else { return };
        let state = context.program.state(instance.state);
        let StateKind::Concurrency { regions, decide, .. } = &state.kind else { return };
        let expressions: Vec<Expr> = decide.iter().map(|(_, expression)| expression.clone()).collect();
        if !expressions.is_empty()
            && let Some(wait) = self.undecidable(context, instance, &expressions)
        {
            return self.wait(id, wait);
        }
        let (visit, plan) = (instance.visit, self.plan.clone());
        let view = self.sight(context).view(instance, None);
        let mut decision = None;
        for (outcome, holds) in decide {
            match holds.holds(&view) {
                Ok(false) => {}
                Ok(true) => decision = Some((outcome.clone(), None)),
                Err(error) => {
                    let reason = BindError::at(format_args!("`decide.{outcome}`"), state)(error).reason();
                    decision = Some((ABORTED.to_owned(), Some(reason)));
                }
            }
            if decision.is_some() {
                break;
            }
        }
        let (outcome, reason) = decision.unwrap_or_else(|| {
            let outcomes: Vec<String> = regions
                .iter()
                .filter_map(|region| {
                    use ratn_model::expression::Scope;
                    view.port(*region, "outcome").and_then(|value| match value.as_ref() {
                        Value::String(outcome) => Some(outcome.clone()),
                        _ => None,
                    })
                })
                .collect();
            (Window::default_outcome(&outcomes).to_owned(), None)
        });
        drop(view);
        let path = self.path(context.program, id);
        context.note(Note::Decided { instance: id, path: path.clone(), decision: outcome.clone() });
        self.end_instance(id, Ended::with(outcome.as_str(), Outputs::new()));
        let own = plan.state(state.id);
        let number = own.outcome(&outcome).unwrap_or(own.outcomes.len() - 2);
        if let Some(cursor) = self.cursors.iter_mut().find(|cursor| cursor.todo == Todo::Await(id)) {
            let variables = cursor.environment.variables.len();
            cursor.todo = Todo::Exit { state: state.id, visit, outcome: number, variables };
            let reason = reason.map(|reason| format!("{path}: {reason}"));
            cursor.because = reason.map(Into::into).or(cursor.because.take());
        }
    }

    /// Variables at the entry of a composite state; outputs and assignments at its exit.
    pub(super) fn compute_boundary(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let Some(instance) = self.instances.get(id) else { return };
        let state = context.program.state(instance.state);
        let own = self.plan.state(instance.state);
        let leaves_by = own.outcomes[instance.leaves_by].clone();
        let mut parts: Vec<(String, &Expr, String)> = Vec::new();
        match instance.role {
            Role::Entry => {
                parts.extend(state.variables.iter().map(|(n, e)| (assigned(n), e, format!("variable `{n}`"))));
            }
            _ if gives_outputs(&leaves_by) => {
                if let StateKind::Sequence { outputs, .. } | StateKind::Concurrency { outputs, .. } = &state.kind {
                    parts.extend(outputs.iter().map(|o| (o.name.clone(), &o.value, format!("output `{}`", o.name))));
                }
                let assigns = state.assign.iter();
                parts.extend(assigns.map(|(n, e)| (assigned(n), e, format!("`assign` of `{n}`"))));
            }
            _ => {}
        }
        let mut outputs = Outputs::new();
        let mut seen = Seen::default();
        let mut used = Vec::new();
        let mut failed = None;
        for (name, expression, what) in &parts {
            // Assignments may be made of the outputs.
            let view = self.sight(context).view(instance, Some(&outputs));
            let facts = facts_of(std::slice::from_ref(*expression), &view);
            let value = expression.evaluate(&view);
            if !facts.is_nothing() {
                seen.facts.extend(view.facts(&facts).unwrap_or_default());
                seen.read.push(facts);
            }
            used.extend(view.used());
            match value {
                Ok(value) => drop(outputs.insert(name.clone(), value)),
                Err(error) => {
                    // Left by an outcome of its own, before it was written: there is nobody to wait for.
                    let missing = error.is_not_yet_known() && view.blocker().is_none();
                    if missing && &*leaves_by != SUCCESS && !name.starts_with(ASSIGNED) {
                        continue;
                    }
                    let error = BindError::at(what.clone(), state)(error);
                    failed = Some(not_bound(&view, &error));
                    break;
                }
            }
        }
        if let Some(super::ready::Readiness::Waits(wait)) = failed {
            return self.wait(id, wait);
        }
        // What made it fail may come out otherwise, too.
        if !parts.is_empty() {
            used.extend(self.producers_of(instance));
            used.sort_unstable();
            used.dedup();
            for producer in used {
                if let Some(producer) = self.instances.get_mut(producer) {
                    producer.users.push(id);
                }
            }
        }
        let Some(instance) = self.instances.get_mut(id) else { return };
        instance.seen = Some(Box::new(seen));
        let outcome = if instance.role == Role::Entry { SUCCESS.into() } else { leaves_by };
        let ended = match failed {
            Some(super::ready::Readiness::Failed(reason)) => Ended::aborted(reason),
            _ => Ended::with(outcome, outputs),
        };
        self.end_instance(id, ended);
    }

    /// Everything older has retired: the task is over.
    pub(super) fn end_run(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let Some(instance) = self.instances.get(id) else { return };
        if !instance.is_head {
            return self.wait(id, Wait::Order);
        }
        if let Some(beside) = self.detached.first() {
            return self.wait(id, Wait::Data(*beside));
        }
        let outcome = self.plan.state(instance.state).outcomes[instance.leaves_by].to_string();
        let reason = instance.left_because.as_ref().map_or(String::new(), ToString::to_string);
        let mut end = End { outcome, outputs: Outputs::new(), reason };
        if end.outcome == ratn_model::program::SUCCESS {
            end.reason = String::new();
            let view = self.sight(context).view(instance, None);
            for output in &context.program.outputs {
                match output.value.evaluate(&view) {
                    Ok(value) => {
                        end.outputs.insert(output.name.clone(), value);
                    }
                    Err(error) => {
                        let reason = format!("output `{}`: {error}", output.name);
                        end = End { outcome: ABORTED.to_owned(), outputs: Outputs::new(), reason };
                        break;
                    }
                }
            }
        }
        self.end = Some(end);
    }

    pub(super) fn end_instance(&mut self, id: InstanceId, ended: Ended) {
        if let Some(instance) = self.instances.get_mut(id) {
            instance.status = super::instance::Status::Finished;
            instance.ended = Some(Box::new(ended));
        }
        self.wake_waiters(id);
        self.enqueue(id);
    }
}
