//! Leaving a composite state: outputs, assignments, effects, resource operations.

use super::{Interpreter, Target};
use crate::binding::{self, Outputs};
use crate::context::{Context, Made};
use crate::effects;
use ratn_model::fact::FactKey;
use ratn_model::id::{InstanceId, StateId};
use ratn_model::program::{ABORTED, Program, SUCCESS, State, is_failure};
use ratn_model::value::Value;
use std::sync::Arc;

/// Number of variables before a state was entered, given `variables` of its frame. The frame of a loop also counts the loop's own scoped
/// variables, because they exist in every iteration.
pub(super) fn outside(state: &State, variables: usize) -> usize {
    if state.is_loop() { variables.saturating_sub(state.variables.len()) } else { variables }
}

impl Interpreter {
    /// Leaves a composite state. An error on the way makes its outcome `aborted`.
    #[expect(clippy::too_many_arguments, reason = "all of it is one activation")]
    pub(super) fn exit(
        &mut self,
        context: &mut Context<'_>,
        thread: u64,
        id: StateId,
        path: &str,
        variables: usize,
        mut outcome: String,
        mut reason: String,
    ) {
        let state = context.program.state(id);
        let result = self.boundary(context, thread, state, path, variables, &outcome);
        // The task's outputs may use the task's own variables.
        if id != Program::ROOT
            && let Some(thread) = self.threads.get_mut(&thread)
        {
            thread.variables.truncate(outside(state, variables));
        }
        match result {
            Ok(assigned) => self.assign(thread, assigned),
            Err(problem) => {
                outcome = ABORTED.to_owned();
                reason = format!("{path}: {problem}");
            }
        }
        self.ended(thread, id, outcome, reason);
    }

    /// Everything that the exit does; returns the new values of variables.
    fn boundary(
        &mut self,
        context: &mut Context<'_>,
        thread: u64,
        state: &State,
        path: &str,
        variables: usize,
        outcome: &str,
    ) -> Result<Vec<(String, Value)>, String> {
        // Loop variables end here; the loop's scoped variables are still visible.
        if state.is_loop()
            && let Some(thread) = self.threads.get_mut(&thread)
        {
            thread.variables.truncate(variables);
        }
        let good = !is_failure(outcome);
        let mut written = Outputs::new();
        if good {
            for output in state.outputs() {
                match self.with_scope(context, thread, Some(&written), |scope| output.value.evaluate(scope)) {
                    Ok(value) => {
                        written.insert(output.name.clone(), value);
                    }
                    // The state was left by an outcome of its own before this port was written.
                    Err(error) if outcome != SUCCESS && error.is_not_yet_known() => {}
                    Err(error) => return Err(format!("output `{}`: {error}", output.name)),
                }
            }
        }
        let assigned = if good { self.assigned(context, thread, state, &written)? } else { Vec::new() };
        self.change(context, thread, (InstanceId(0), state), path, outcome, &written)?;
        if outcome == SUCCESS {
            self.operate(context, thread, state, InstanceId(0), &written)?;
        }
        if good {
            self.write(state.id, written);
        }
        Ok(assigned)
    }

    /// Applies the effects that a state declares for an outcome. They belong to the action's instance, or to instance 0 for a composite
    /// state.
    pub(super) fn change(
        &mut self,
        context: &mut Context<'_>,
        thread: u64,
        (instance, state): (InstanceId, &State),
        path: &str,
        outcome: &str,
        outputs: &Outputs,
    ) -> Result<(), String> {
        let Some(declared) = state.annotations.effects.get(outcome) else { return Ok(()) };
        let changes = self
            .with_scope(context, thread, Some(outputs), |s| effects::actual(Some(declared), outcome, &[], s))
            .map_err(|error| error.to_string())?;
        self.apply(context, instance, path, changes.into())
    }

    /// The values that a state assigns to variables, evaluated.
    pub(super) fn assigned(
        &self,
        context: &Context<'_>,
        thread: u64,
        state: &State,
        outputs: &Outputs,
    ) -> Result<Vec<(String, Value)>, String> {
        let value = |(name, value): &(String, ratn_model::expression::Expr)| {
            let value = self.with_scope(context, thread, Some(outputs), |scope| value.evaluate(scope));
            value.map(|value| (name.clone(), value)).map_err(|error| format!("`assign` of `{name}`: {error}"))
        };
        state.assign.iter().map(value).collect()
    }

    /// Assigns new values, each to the innermost variable of its name.
    pub(super) fn assign(&mut self, thread: u64, assigned: Vec<(String, Value)>) {
        let Some(thread) = self.threads.get_mut(&thread) else { return };
        for (name, value) in assigned {
            if let Some((_, variable)) = thread.variables.iter_mut().rev().find(|(n, _)| *n == name) {
                *variable = Arc::new(value);
            }
        }
    }

    pub(super) fn apply(
        &mut self,
        context: &mut Context<'_>,
        instance: InstanceId,
        path: &str,
        made: Made,
    ) -> Result<(), String> {
        self.has_changed |= !made.changes.is_empty();
        match &mut self.target {
            Target::Actual => context.commit(instance, path.to_owned(), made),
            Target::Projection { changes, writers, evidence, world, .. } => {
                context.allows(world, &made)?;
                world.apply(&made.changes).map_err(|e| e.to_string())?;
                writers.extend(std::iter::repeat_n(Arc::from(path), made.changes.len()));
                // The evidence of a fact that is written again is replaced or dropped.
                let again = |fact: &FactKey| made.changes.iter().any(|change| change.pattern().matches(fact));
                evidence.retain(|(fact, _)| !again(fact));
                evidence.extend(made.evidence);
                changes.extend(made.changes);
                Ok(())
            }
        }
    }

    pub(super) fn operate(
        &self,
        context: &mut Context<'_>,
        thread: u64,
        state: &State,
        instance: InstanceId,
        outputs: &Outputs,
    ) -> Result<(), String> {
        let wanted = &context.plan.state(state.id).operations;
        if wanted.is_empty() {
            return Ok(());
        }
        let operations = self
            .with_scope(context, thread, Some(outputs), |s| binding::requirements(state, wanted, s))
            .map_err(|e| e.reason())?;
        context.commands.push(crate::protocol::Command::Operate { instance, operations });
        Ok(())
    }
}
