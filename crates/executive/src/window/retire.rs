//! Retirement and its opposite: what becomes real, what is discarded.

use crate::analysis::NodeNature;
use crate::binding;
use crate::context::Context;
use crate::effects;
use crate::protocol::{Command, Note};
use crate::window::instance::{Changed, Ended, Role, Status};
use crate::window::place::Place;
use crate::window::{End, SWEEP_INTERVAL, Window, give_back};
use ratn_model::id::InstanceId;
use ratn_model::program::{ABORTED, SUCCESS, StateKind};
use std::collections::BTreeSet;

impl Window {
    /// Retires the oldest instances that have ended, in program order; whether there were any.
    pub(crate) fn retire(&mut self, context: &mut Context<'_>) -> bool {
        let mut retired = false;
        while let Some(id) = self.oldest {
            let Some(instance) = self.instances.alive.get(&id) else { break };
            if instance.status != Status::Finished {
                break;
            }
            retired = true;
            match self.make_real(context, id) {
                Ok(()) => self.forget_retired(context, id),
                Err((outcome, reason)) => {
                    self.end = self.leave(context, id, &outcome, reason);
                    break;
                }
            }
        }
        retired
    }

    /// The effects and resource operations of the oldest instance happen. An error is the outcome by which the task is left.
    fn make_real(&mut self, context: &mut Context<'_>, id: InstanceId) -> Result<(), (String, String)> {
        let (program, analysis) = (context.program, context.analysis);
        let place = Place::root(context.root);
        let Some(instance) = self.instances.alive.get(&id) else { return Ok(()) };
        let state = program.state(instance.state);
        let mut ended = instance.ended.clone().unwrap_or_else(|| Ended::aborted("it never ended".to_owned()));
        let named = |reason: String| {
            if reason.is_empty() { instance.path.clone() } else { format!("{}: {reason}", instance.path) }
        };
        let aborted = |reason: String| (ABORTED.to_owned(), named(reason));
        if let Some(deviation) = self.deviation(id, context.root) {
            return Err(aborted(deviation));
        }
        // What began on a projection had its preconditions checked there; now the actual world decides.
        if instance.role == Role::Node && instance.nature != NodeNature::Irreversible && ended.outcome == SUCCESS {
            match place.with_scope(&self.instances, id, None, |scope| binding::unmet(state, scope)) {
                Some(Ok(Some(reason))) => ended = Ended::aborted(reason),
                Some(Err(error)) => ended = Ended::aborted(error.reason()),
                _ => {}
            }
        }
        let declared = match instance.role {
            Role::Node => effects::declared(state, instance.nature, &ended.outcome),
            Role::Exit => state.annotations.effects.get(&ended.outcome).map_or(Some(&[][..]), |e| Some(e)),
            _ => Some(&[][..]),
        };
        let outputs = Some(&ended.outputs);
        let changes = match &ended.changes {
            Changed::Exactly(changes) => changes.clone(),
            Changed::Declared(measured) => place
                .with_scope(&self.instances, id, outputs, |scope| {
                    effects::actual(declared, &ended.outcome, measured, scope)
                })
                .unwrap_or_else(|| Ok(Vec::new()))
                .map_err(|e| aborted(e.to_string()))?,
        };
        context.commit(id, changes).map_err(aborted)?;
        if ended.outcome != SUCCESS {
            return Err((ended.outcome.clone(), named(ended.reason)));
        }
        let wanted = &analysis.state(instance.state).operations;
        // A routine has performed its own.
        let is_routine = instance.role == Role::Node && !matches!(state.kind, StateKind::Action { .. });
        if matches!(instance.role, Role::Node | Role::Exit) && !is_routine && !wanted.is_empty() {
            let operations = place
                .with_scope(&self.instances, id, outputs, |scope| binding::requirements(state, wanted, scope))
                .unwrap_or_else(|| Ok(Vec::new()))
                .map_err(|e| aborted(e.reason()))?;
            context.commands.push(Command::Operate { instance: id, operations });
        }
        Ok(())
    }

    fn forget_retired(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let Some(instance) = self.instances.alive.remove(&id) else { return };
        if instance.role == Role::Node {
            context.note(Note::Retired { instance: id });
        }
        self.oldest = instance.next.first().copied();
        if let Some(next) = self.oldest.and_then(|next| self.instances.alive.get_mut(&next)) {
            next.older = None;
            next.assumption = None;
        }
        if let Some(ended) = instance.ended {
            self.instances.retired.insert(id, ended.outputs);
        }
        self.retired_since_sweep += 1;
        if self.retired_since_sweep >= SWEEP_INTERVAL {
            self.sweep();
        }
    }

    /// Drops the outputs that nothing in the window, and nothing still to be expanded, can name.
    fn sweep(&mut self) {
        self.retired_since_sweep = 0;
        let mut named: BTreeSet<InstanceId> = self.cursors.iter().flat_map(|c| c.producers()).collect();
        for instance in self.instances.alive.values() {
            named.extend(instance.environment.producers.values());
        }
        self.instances.retired.retain(|id, _| named.contains(id));
    }

    /// The task is left by an outcome that is not success: every hierarchy around the state declares what that does, then it ends.
    fn leave(&mut self, context: &mut Context<'_>, id: InstanceId, outcome: &str, mut reason: String) -> Option<End> {
        let program = context.program;
        let state = self.instances.alive.get(&id).map(|i| i.state);
        let mut around = state.and_then(|state| program.state(state).parent);
        while let Some(state) = around.map(|state| program.state(state)) {
            if let Some(declared) = state.annotations.effects.get(outcome) {
                let place = Place::root(context.root);
                let changes = place.with_scope(&self.instances, id, None, |scope| {
                    effects::actual(Some(declared), outcome, &[], scope)
                });
                let made = match changes {
                    Some(Ok(changes)) => context.commit(id, changes),
                    Some(Err(error)) => Err(error.to_string()),
                    None => Ok(()),
                };
                if let Err(problem) = made {
                    reason = format!("{reason}; then {}: {problem}", state.path);
                }
            }
            around = state.parent;
        }
        self.stop(context, outcome, reason)
    }

    /// Discards everything that is in the window.
    pub(crate) fn stop(&mut self, context: &mut Context<'_>, outcome: &str, reason: String) -> Option<End> {
        let all: Vec<InstanceId> = self.instances.alive.keys().copied().collect();
        for id in all {
            self.squash(context, id);
        }
        self.cursors.clear();
        self.oldest = None;
        self.end = Some(End { outcome: outcome.to_owned(), outputs: Default::default(), reason });
        self.end.clone()
    }

    /// A condition is decided: the other branch is discarded.
    pub(crate) fn take_branch(&mut self, context: &mut Context<'_>, condition: InstanceId, taken: bool) {
        let Some(instance) = self.instances.alive.get_mut(&condition) else { return };
        let next = std::mem::take(&mut instance.next);
        let assumes = |window: &Self, id: &InstanceId| window.instances.alive.get(id).and_then(|i| i.assumption);
        let (kept, lost): (Vec<_>, Vec<_>) = next.into_iter().partition(|id| assumes(self, id) == Some(taken));
        for id in &kept {
            if let Some(younger) = self.instances.alive.get_mut(id) {
                younger.assumption = None;
            }
        }
        if let Some(instance) = self.instances.alive.get_mut(&condition) {
            instance.next = kept;
        }
        let mut open = lost;
        let mut squashed = BTreeSet::new();
        while let Some(id) = open.pop() {
            open.extend(self.instances.alive.get(&id).map(|i| i.next.clone()).unwrap_or_default());
            squashed.insert(id);
            self.squash(context, id);
        }
        self.cursors.retain_mut(|cursor| match cursor.tail {
            Some(tail) if squashed.contains(&tail) => false,
            Some(tail) if tail == condition && cursor.assumption == Some(!taken) => false,
            Some(tail) if tail == condition => {
                cursor.assumption = None;
                true
            }
            _ => true,
        });
    }

    fn squash(&mut self, context: &mut Context<'_>, id: InstanceId) {
        self.stop_instance(context, id);
        if let Some(instance) = self.instances.alive.remove(&id)
            && instance.role == Role::Node
        {
            context.note(Note::Squashed { instance: id });
        }
    }

    /// Takes back what was asked for an instance; it holds nothing afterwards.
    pub(crate) fn stop_instance(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let Some(instance) = self.instances.alive.get_mut(&id) else { return };
        match instance.status {
            Status::Acquiring => context.commands.push(Command::Withdraw { instance: id }),
            Status::Projecting => {
                context.commands.push(Command::Cancel { instance: id, attempt: instance.attempt });
            }
            Status::Running => match instance.routine.take() {
                Some(mut routine) => {
                    routine.abort(context);
                    instance.lease = routine.lease().cloned();
                }
                None => context.commands.push(Command::Cancel { instance: id, attempt: instance.attempt }),
            },
            Status::Expanded | Status::Granted | Status::Finished => {}
        }
        give_back(context, instance);
    }

    /// Whether a condition on an instance's path is undecided.
    pub(crate) fn is_speculative(&self, id: InstanceId) -> bool {
        let mut at = self.instances.alive.get(&id).and_then(|i| i.older);
        while let Some(older) = at.and_then(|id| self.instances.alive.get(&id)) {
            if older.is_undecided() {
                return true;
            }
            at = older.older;
        }
        false
    }
}
