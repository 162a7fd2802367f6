//! One node: acquire, project, run, and what its end changes.

use super::{Current, DEFAULT_ATTEMPTS, Interpreter, Phase, Progress, Target};
use crate::analysis::NodeNature;
use crate::binding::{self, Outputs};
use crate::context::Context;
use crate::effects;
use crate::protocol::{Command, Goal, Note};
use ratn_model::expression::FactExpr;
use ratn_model::fact::{Change, FactKey, Footprint};
use ratn_model::id::{InstanceId, StateId};
use ratn_model::program::{ABORTED, SUCCESS, State, StateKind, WORLD_MODEL};
use ratn_model::value::Value;

impl Interpreter {
    pub(super) fn begin(&mut self, context: &mut Context<'_>, id: StateId, path: &str) -> Result<(), String> {
        let (program, analysis) = (context.program, context.analysis);
        let instance = context.new_instance();
        context.note(Note::Expanded { instance, state: id, path: path.to_owned(), speculative: false });
        self.current = Some(Current {
            instance,
            state: id,
            path: path.to_owned(),
            attempt: 1,
            phase: Phase::Acquiring,
            lease: None,
            projection: None,
        });
        let wanted = &analysis.state(id).requirements;
        if self.routine.is_some() || wanted.is_empty() {
            return match self.project_or_run(context) {
                Progress::Busy => Ok(()),
                Progress::Ended { reason, .. } => Err(reason),
            };
        }
        let requirements = self
            .with_scope(context, None, |scope| binding::requirements(program.state(id), wanted, scope))
            .map_err(|e| e.reason())?;
        context.commands.push(Command::Acquire { instance, requirements, priority: i64::MAX });
        Ok(())
    }

    pub(super) fn project_or_run(&mut self, context: &mut Context<'_>) -> Progress {
        let Some(current) = self.current.as_mut() else { return Progress::Busy };
        let analysis = context.analysis.state(current.state);
        if !analysis.requirements.iter().any(|r| r.kind == WORLD_MODEL) {
            return self.run(context);
        }
        current.phase = Phase::Projecting;
        let lease = self.routine.as_ref().map_or(&current.lease, |routine| &routine.lease);
        let lease = lease.as_ref().map(|l| (l.id, l.token));
        let (instance, attempt) = (current.instance, current.attempt);
        let reads = match &analysis.reads {
            None => Footprint::Everything,
            Some(reads) => self.with_scope(context, None, |s| FactExpr::footprint(reads, s)),
        };
        let (base, changes) = match &self.target {
            Target::Actual => (context.root.revision(), Vec::new()),
            Target::Projection { base, changes, .. } => (*base, changes.clone()),
        };
        context.commands.push(Command::Project { instance, attempt, base, changes, reads, lease });
        Progress::Busy
    }

    pub(super) fn run(&mut self, context: &mut Context<'_>) -> Progress {
        let program = context.program;
        let Some(current) = self.current.as_ref() else { return Progress::Busy };
        let state = program.state(current.state);
        let StateKind::Action { provider, action, inputs, .. } = &state.kind else { return Progress::Busy };
        let inputs = match self.with_scope(context, None, |scope| binding::inputs(state, inputs, scope)) {
            Ok(inputs) => inputs,
            Err(error) => return self.leave(context, ABORTED, error.reason()),
        };
        let expected_s = self.with_scope(context, None, |scope| binding::expected_s(state, scope));
        let Some(current) = self.current.as_mut() else { return Progress::Busy };
        current.phase = Phase::Running;
        let (instance, attempt) = (current.instance, current.attempt);
        let goal = Goal {
            provider: provider.clone(),
            action: action.clone(),
            inputs,
            seed: binding::seed(context.seed, &current.path, 1),
            lease: self.routine.as_ref().map_or(&current.lease, |routine| &routine.lease).clone(),
            projection: current.projection,
            expected_s,
            timeout_s: state.annotations.timeout_s,
        };
        context.note(Note::Running { instance, attempt });
        context.commands.push(Command::Start { instance, attempt, goal });
        Progress::Busy
    }

    pub(super) fn crashed(&mut self, context: &mut Context<'_>, reason: &str) -> Progress {
        let Some(mut current) = self.current.take() else { return Progress::Busy };
        let state = context.program.state(current.state);
        self.give_back(context, &current);
        let again = context.analysis.state(current.state).nature != NodeNature::Irreversible
            && current.attempt < state.annotations.attempts.unwrap_or(DEFAULT_ATTEMPTS);
        if !again {
            let (path, attempt) = (current.path.clone(), current.attempt);
            current.lease = None;
            current.projection = None;
            self.current = Some(current);
            return self.leave(context, ABORTED, format!("{path} crashed in attempt {attempt}: {reason}"));
        }
        let (instance, id) = (current.instance, current.state);
        let requirements = match &mut self.routine {
            // Nothing of it moves between two nodes: it gives everything back and asks for all of it again.
            Some(routine) => {
                let lease = routine.lease.take().map(|l| l.id);
                if lease.is_some() {
                    context.commands.push(Command::Release { instance, lease, projection: None });
                }
                Ok(routine.requirements.clone())
            }
            None => self.with_scope(context, None, |scope| {
                binding::requirements(state, &context.analysis.state(id).requirements, scope)
            }),
        };
        let requirements = match requirements {
            Ok(requirements) => requirements,
            Err(error) => return self.leave(context, ABORTED, error.reason()),
        };
        let phase = Phase::Acquiring;
        let attempt = current.attempt + 1;
        self.current = Some(Current { attempt, phase, lease: None, projection: None, ..current });
        if requirements.is_empty() {
            return self.project_or_run(context);
        }
        context.commands.push(Command::Acquire { instance, requirements, priority: i64::MAX });
        Progress::Busy
    }

    pub(super) fn finished(
        &mut self,
        context: &mut Context<'_>,
        mut outcome: String,
        outputs: Outputs,
        measured: &[(FactKey, Value)],
        mut reason: String,
    ) -> Progress {
        let Some(current) = self.current.take() else { return Progress::Busy };
        let program = context.program;
        let state = program.state(current.state);
        let (id, instance) = (current.state, current.instance);
        if let StateKind::Action { outputs: declared, .. } = &state.kind
            && outcome == SUCCESS
            && let Some(problem) = binding::missing_output(declared, &outputs)
        {
            (outcome, reason) = (ABORTED.to_owned(), problem);
        }
        let nature = context.analysis.state(id).nature;
        let declared = effects::declared(state, nature, &outcome);
        let changes = self.with_scope(context, Some(&outputs), |s| effects::actual(declared, &outcome, measured, s));
        if outcome == SUCCESS {
            self.outputs.insert(id, outputs);
        }
        let made = changes.map_err(|e| e.to_string()).and_then(|changes| self.apply(context, instance, changes));
        if let Err(problem) = made {
            (outcome, reason) = (ABORTED.to_owned(), format!("{}: {problem}", current.path));
        }
        context.note(Note::Finished { instance, outcome: outcome.clone() });
        if outcome == SUCCESS
            && let Err(problem) = self.operate(context, state, instance, self.outputs.get(&id).cloned())
        {
            (outcome, reason) = (ABORTED.to_owned(), problem);
        }
        self.give_back(context, &current);
        if matches!(self.target, Target::Actual) {
            context.note(Note::Retired { instance });
        }
        if outcome == SUCCESS {
            return self.advance(context);
        }
        let reason = if reason.starts_with(&current.path) { reason } else { format!("{}: {reason}", current.path) };
        self.leave(context, &outcome, reason)
    }

    pub(super) fn apply(
        &mut self,
        context: &mut Context<'_>,
        instance: InstanceId,
        changes: Vec<Change>,
    ) -> Result<(), String> {
        match &mut self.target {
            Target::Actual => context.commit(instance, changes),
            Target::Projection { changes: all, world, .. } => {
                world.apply(&changes).map_err(|e| e.to_string())?;
                all.extend(changes);
                Ok(())
            }
        }
    }

    pub(super) fn operate(
        &self,
        context: &mut Context<'_>,
        state: &State,
        instance: InstanceId,
        outputs: Option<Outputs>,
    ) -> Result<(), String> {
        let wanted = &context.analysis.state(state.id).operations;
        if wanted.is_empty() {
            return Ok(());
        }
        let operations = self
            .with_scope(context, outputs.as_ref(), |s| binding::requirements(state, wanted, s))
            .map_err(|e| e.reason())?;
        context.commands.push(Command::Operate { instance, operations });
        Ok(())
    }

    pub(super) fn give_back(&self, context: &mut Context<'_>, current: &Current) {
        let lease = current.lease.as_ref().map(|l| l.id);
        if lease.is_some() || current.projection.is_some() {
            context.commands.push(Command::Release {
                instance: current.instance,
                lease,
                projection: current.projection,
            });
        }
    }
}
