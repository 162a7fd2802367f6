//! Retirement: what becomes real. Every line retires in program order, so the root is the world after a prefix of the program
//! (per region), and a failure leaves it so.
//!
//! A PIA with imprecise exceptions is passed over while it runs: it retires when it ends, and younger ones may run beside it.

use super::Window;
use super::cursor::{Cursor, Todo};
use super::instance::{Changed, Instance, Line, Role, Status, Wait, gives_outputs};
use crate::binding;
use crate::context::{Context, Made};
use crate::effects;
use crate::plan::NodeNature;
use crate::plan::{Effects, Outcome};
use crate::protocol::{Command, Note};
use ratn_model::id::InstanceId;
use ratn_model::program::{ABORTED, SUCCESS, StateKind};
use smallvec::SmallVec;
use std::sync::Arc;

impl Window {
    /// Retires what can be; whether there was anything.
    pub(super) fn retire(&mut self, context: &mut Context<'_>) -> bool {
        let mut retired = false;
        let mut last = None;
        while let Some(line) = self.next_line_after(last) {
            last = Some(line);
            while let Some(id) = self.head_of(line) {
                if self.pass_over(id) {
                    retired = true;
                    continue;
                }
                let finished = self.instances.get(id).is_some_and(|head| head.status == Status::Finished);
                if !finished || !self.retire_head(context, id) {
                    break;
                }
                retired = true;
            }
        }
        retired
    }

    fn next_line_after(&self, last: Option<Line>) -> Option<Line> {
        let from = last.map_or(0, |line| line + 1);
        self.threads.range(from..).find(|(_, thread)| thread.is_active).map(|(line, _)| *line)
    }

    fn head_of(&self, line: Line) -> Option<InstanceId> {
        let thread = self.threads.get(&line)?;
        if thread.open_regions == 0 { thread.head } else { None }
    }

    /// A running imprecise PIA lets younger ones begin.
    fn pass_over(&mut self, id: InstanceId) -> bool {
        let Some(instance) = self.instances.get_mut(id) else { return false };
        let passes = instance.status == Status::Running
            && instance.is_pia()
            && instance.arms.len() == 1
            && self.plan.state(instance.state).imprecise;
        if passes {
            instance.detached = true;
            let (line, next) = (instance.line, instance.arms[0].next);
            let position = instance.position;
            self.detached.insert(id);
            self.advance(line, position, next);
        }
        passes
    }

    fn advance(&mut self, line: Line, position: u64, next: Option<InstanceId>) {
        if let Some(thread) = self.threads.get_mut(&line) {
            thread.head = None;
            thread.floor = position + 1;
        }
        self.set_head(line, next);
    }

    /// The oldest instance of a line becomes real; false when it may not yet.
    fn retire_head(&mut self, context: &mut Context<'_>, id: InstanceId) -> bool {
        let Some(instance) = self.instances.get(id) else { return false };
        if let Some(beside) = self.conflict_beside(context, instance) {
            self.wait(id, Wait::World(beside));
            return false;
        }
        if let Some(beside) = self.producer_beside(instance).or_else(|| self.inside_beside(instance)) {
            self.wait(id, Wait::Data(beside));
            return false;
        }
        let role = instance.role;
        let users = self.take_users(id);
        let (outcome, reason) = self.make_real(context, id);
        match role {
            Role::Fork => self.begin_regions(context, id),
            Role::RegionEnd => self.region_ended(context, id),
            Role::End => {}
            _ => self.go_on(context, id, &outcome, reason),
        }
        self.compare(context, users);
        true
    }

    /// Of the exit of a state: an imprecise PIA inside of it that still runs. By how it ends the state may be left otherwise.
    fn inside_beside(&self, exit: &Instance) -> Option<InstanceId> {
        if exit.role != Role::Exit {
            return None;
        }
        let is_inside = |id: &&InstanceId| {
            let frames = self.instances.get(**id).and_then(|inside| inside.environment.frames.as_deref());
            **id < exit.id && std::iter::successors(frames, |f| f.below.as_deref()).any(|f| f.owner == exit.state)
        };
        self.detached.iter().find(is_inside).copied()
    }

    /// The line goes on behind an instance that is real, where its outcome leads.
    fn go_on(&mut self, context: &mut Context<'_>, id: InstanceId, outcome: &str, reason: String) {
        let Some(instance) = self.instances.get(id) else { return };
        let plan = self.plan.clone();
        let own = plan.state(instance.state);
        let arm = match instance.role {
            Role::Condition | Role::Test => (!is_failure(outcome)).then_some(0),
            Role::Join => Some(0),
            Role::Exit if own.outcomes[instance.leaves_by].as_ref() == outcome => Some(0),
            Role::Exit => None,
            Role::Entry | Role::Loop => (outcome == SUCCESS).then_some(0),
            _ => own.outcome(outcome).and_then(|n| instance.arms.iter().position(|arm| arm.outcomes & (1 << n) != 0)),
        };
        match arm {
            Some(arm) => {
                if instance.arms.len() > 1 {
                    self.take_arm(context, id, arm);
                }
                let next = self.instances.get(id).and_then(|instance| instance.arms.first()?.next);
                if let Some(instance) = self.remove_retired(context, id)
                    && !instance.2
                {
                    self.advance(instance.0, instance.1, next);
                }
            }
            None => {
                let number = own.outcome(outcome).unwrap_or(own.outcomes.len() - 2);
                self.leave_path(context, id, number, reason);
            }
        }
    }

    /// An instance ended otherwise than was computed ahead: what was expanded behind it is discarded, and the path goes on where
    /// its outcome leads.
    fn leave_path(&mut self, context: &mut Context<'_>, id: InstanceId, outcome: Outcome, reason: String) {
        let path = self.path(context.program, id);
        let Some(instance) = self.instances.get(id) else { return };
        let (line, state, position, producer) =
            (instance.line, instance.state, instance.position, instance.producer.clone());
        let is_node = instance.role == Role::Node;
        let because: Arc<str> = if reason.is_empty() { path.into() } else { format!("{path}: {reason}").into() };
        let mut environment = instance.environment.clone();
        environment.test = None;
        self.squash_behind(context, id);
        self.remove_retired(context, id);
        self.next_order += 1;
        self.cursors.push(Cursor {
            environment,
            tail: None,
            line,
            segment: 0,
            position: position + 1,
            todo: Todo::Leave(state, outcome),
            probability: 1.0,
            because: Some(because),
            idle: 0,
            order: self.next_order,
        });
        if is_node {
            let cursor = self.cursors.len() - 1;
            self.produce(cursor, producer, state, outcome);
        }
        if let Some(thread) = self.threads.get_mut(&line) {
            thread.head = None;
            thread.floor = position + 1;
        }
    }

    /// Effects and resource operations happen. The outcome by which it is left, and why.
    fn make_real(&mut self, context: &mut Context<'_>, id: InstanceId) -> (Arc<str>, String) {
        let (program, plan) = (context.program, context.plan);
        let aborted = |reason: String| (Arc::from(ABORTED), reason);
        let Some(instance) = self.instances.get(id) else { return aborted(String::new()) };
        let state = program.state(instance.state);
        let Some(ended) = instance.ended.as_deref() else { return aborted("it never ended".to_owned()) };
        let (mut outcome, mut reason) = (ended.outcome.clone(), ended.reason.clone());
        let own = self.plan.state(instance.state);
        let view = self.sight(context).view(instance, Some(&ended.outputs));
        // What began on a projection had its preconditions checked there, if at all; now the actual world decides.
        let checks = match instance.role {
            Role::Node => instance.nature != NodeNature::Irreversible && !is_failure(&outcome),
            Role::Entry => outcome.as_ref() == SUCCESS,
            _ => false,
        };
        if checks && !state.annotations.requires.is_empty() {
            match binding::unmet(state, &view) {
                Ok(None) => {}
                Ok(Some(unmet)) => return aborted(unmet),
                Err(error) => return aborted(error.reason()),
            }
        }
        if !matches!(instance.role, Role::Node | Role::Exit) {
            return (outcome, reason);
        }
        let is_routine = instance.role == Role::Node && !matches!(state.kind, StateKind::Action { .. });
        let declared = match own.outcome(&outcome).map(|number| &own.effects[number]) {
            Some(Effects::Declared(declared)) => Some(declared.as_slice()),
            _ => None,
        };
        let made = match &ended.changes {
            Changed::Exactly(made) => Ok(made.clone()),
            Changed::Declared(..) if is_routine => Ok(Made::default()),
            Changed::Declared(measured, evidence) => effects::actual(declared, &outcome, measured, &view)
                .map(|changes| Made { changes, evidence: evidence.clone() }),
        };
        let wanted = &plan.state(instance.state).operations;
        let operations = if is_routine || wanted.is_empty() || outcome.as_ref() != SUCCESS {
            // A routine has performed its own.
            Ok(Vec::new())
        } else {
            binding::requirements(state, wanted, &view)
        };
        drop(view);
        match made {
            Ok(made) => {
                let writer = self.path(program, id);
                if let Err(problem) = context.commit(id, writer, made) {
                    return aborted(problem);
                }
            }
            Err(problem) => return aborted(problem.to_string()),
        }
        match operations {
            Ok(operations) if operations.is_empty() => {}
            Ok(operations) => context.commands.push(Command::Operate { instance: id, operations }),
            Err(error) => (outcome, reason) = aborted(error.reason()),
        }
        (outcome, reason)
    }

    /// An imprecise PIA that others were let pass by has ended.
    pub(super) fn retire_detached(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let users = self.take_users(id);
        let (outcome, reason) = self.make_real(context, id);
        self.detached.remove(&id);
        let Some(instance) = self.instances.get(id) else { return };
        let number = self.plan.state(instance.state).outcome(&outcome);
        let expected = number.is_some_and(|n| instance.arms.first().is_some_and(|arm| arm.outcomes & (1 << n) != 0));
        if expected || instance.is_orphan() || !self.threads.contains_key(&instance.line) {
            self.remove_retired(context, id);
        } else {
            let number = number.unwrap_or(self.plan.state(instance.state).outcomes.len() - 2);
            self.leave_path(context, id, number, reason);
        }
        self.compare(context, users);
    }

    /// A motion that has ended, and whose path was left before it could retire: what it did stands.
    pub(super) fn retire_orphan(&mut self, context: &mut Context<'_>, id: InstanceId) {
        self.make_real(context, id);
        self.leave_head(id);
        self.remove_retired(context, id);
    }

    /// Takes a retired instance out of the window: its line, its position, whether its line had passed it before.
    fn remove_retired(&mut self, context: &mut Context<'_>, id: InstanceId) -> Option<(Line, u64, bool)> {
        self.wake_waiters(id);
        let instance = self.instances.remove(id)?;
        self.active.remove(&id);
        if instance.role == Role::Node {
            context.note(Note::Retired { instance: id });
        }
        if instance.role == Role::Join {
            self.joins.remove(&id);
            self.forks.retain(|_, fork| fork.join != Some(id));
        }
        if let (Some(producer), Some(ended)) = (&instance.producer, instance.ended) {
            let good = gives_outputs(&ended.outcome) || instance.role == Role::RegionEnd;
            let mut outputs = ended.outputs;
            if !good {
                outputs.retain(|port, _| port.starts_with(super::environment::ASSIGNED));
            }
            let _ = producer.real.set(outputs);
        }
        Some((instance.line, instance.position, instance.detached))
    }

    fn begin_regions(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let Some((line, position, _)) = self.remove_retired(context, id) else { return };
        let Some(fork) = self.forks.get(&id) else { return };
        let (regions, join) = (fork.regions.clone(), fork.join);
        if let Some(thread) = self.threads.get_mut(&line) {
            thread.open_regions = regions.len();
            thread.floor = position + 1;
            thread.head = None;
        }
        for region in &regions {
            let head = self.threads.get_mut(region).and_then(|thread| {
                thread.is_active = true;
                thread.head
            });
            self.set_head(*region, head);
        }
        if regions.is_empty() {
            self.set_head(line, join);
        }
    }

    fn region_ended(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let Some((region, _, _)) = self.remove_retired(context, id) else { return };
        let Some(fork) = self.threads.remove(&region).and_then(|thread| thread.fork) else { return };
        let Some(fork) = self.forks.get(&fork) else { return };
        let (line, join) = (fork.line, fork.join);
        let Some(thread) = self.threads.get_mut(&line) else { return };
        thread.open_regions -= 1;
        if thread.open_regions == 0 {
            self.set_head(line, join);
        }
    }

    /// The oldest instance of a line from now on.
    pub(super) fn set_head(&mut self, line: Line, head: Option<InstanceId>) {
        let Some(thread) = self.threads.get_mut(&line) else { return };
        thread.head = head;
        let Some(instance) = head.and_then(|head| self.instances.get_mut(head)) else { return };
        thread.floor = instance.position;
        if thread.is_active && thread.open_regions == 0 {
            instance.is_head = true;
            let id = instance.id;
            self.enqueue(id);
        }
    }

    fn take_users(&mut self, id: InstanceId) -> SmallVec<[InstanceId; 2]> {
        let mut users = self.instances.get_mut(id).map(|i| std::mem::take(&mut i.users)).unwrap_or_default();
        users.sort_unstable();
        users.dedup();
        users
    }

    /// What was made of predicted effects is compared with what they came to.
    fn compare(&mut self, context: &mut Context<'_>, users: SmallVec<[InstanceId; 2]>) {
        for user in users {
            self.revalidate(context, user);
        }
    }
}

fn is_failure(outcome: &str) -> bool {
    !gives_outputs(outcome)
}
