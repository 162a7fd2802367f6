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

/// How many variables there were before a state was entered, where `variables` are those of its frame: the scoped ones of a loop are there in
/// every iteration, and its frame counts them.
pub(super) fn outside(state: &State, variables: usize) -> usize {
    if state.is_loop() { variables.saturating_sub(state.variables.len()) } else { variables }
}

impl Interpreter {
    /// A composite state is left. What fails on the way makes it `aborted`.
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
        // The task's own variables are seen by its outputs.
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

    /// What it does; the new values of variables.
    fn boundary(
        &mut self,
        context: &mut Context<'_>,
        thread: u64,
        state: &State,
        path: &str,
        variables: usize,
        outcome: &str,
    ) -> Result<Vec<(String, Value)>, String> {
        // Its loop variables are gone, its scoped ones are still seen.
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
                    // Left by an outcome of its own, before it was written.
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

    /// The effects that a state declares for an outcome happen: those of an action are its instance's, those of a composite state nobody's.
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

    /// The values that a state assigns to variables.
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

    /// Variables get new values, each the innermost of its name.
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
                // What is written again was measured anew, or not at all.
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
