//! Retirement: results become real. Every line retires in program order, so the root is the world after a prefix of the program (per region), and
//! a failure leaves it so.
//!
//! A PIA with imprecise exceptions is passed over while it runs: younger instances may run beside it, and it retires when it ends. The exit of a
//! state, and the end of a region, wait for such PIAs inside.

use super::Window;
use super::graph::instance::{Changed, Ended, Instance, LineId, Node, Role, Status};
use super::growth::Departure;
use super::memory::{Difference, Source, User};
use super::waits::Wait;
use crate::binding;
use crate::context::{Context, MAX_IDLE_VISITS, Made, in_circles};
use crate::effects;
use crate::interpreter::Interpreter;
use crate::plan::{Effects, NodeNature, Outcome, SUCCEEDED, gives_outputs};
use crate::protocol::{Command, Note};
use ratn_model::fact::{Change, FactKey};
use ratn_model::id::InstanceId;
use ratn_model::program::{ABORTED, Program, SUCCESS};
use ratn_model::value::Value;
use smallvec::SmallVec;
use std::collections::BTreeMap;
use std::sync::Arc;

/// What an instance has made real.
struct Real {
    /// Outcome and reason of the instance in the actual world.
    outcome: Arc<str>,
    reason: String,
    changes: Vec<Change>,
    /// The earlier values of the facts that it wrote; only if its predicted changes had readers.
    before: BTreeMap<FactKey, Option<Value>>,
}

impl Real {
    /// Whether the result failed when it was to become real.
    fn is_other_than(&self, ended: &Ended) -> bool {
        (&self.outcome, &self.reason) != (&ended.outcome, &ended.reason)
    }
}

/// What the users of a retiring instance are told.
struct News {
    users: SmallVec<[User; 2]>,
    difference: Difference,
    /// Whether it has no outputs after all.
    is_open: bool,
}

/// Whether a head ends something that began before, now: the sequential program follows all ends, then looks at waits, and only then begins states.
/// If it enters a state on its way to the head, that is where it begins.
fn is_end(head: &Instance) -> bool {
    match head.role() {
        Some(Role::Exit | Role::Test | Role::RegionEnd | Role::Join | Role::End) => head.visits_before == 0,
        Some(Role::Condition | Role::Loop | Role::Entry | Role::Fork) => false,
        None => head.ended().is_some() && head.node().is_some_and(|node| ends_now(head, node)),
    }
}

/// Whether a node that has ended has done so at its place. What has run ahead, or takes over a known result, ends later in the sequential program.
fn ends_now(head: &Instance, node: &Node) -> bool {
    head.is_pia() || node.is_at_its_place && (node.has_acted || node.answer.is_none())
}

impl Window {
    /// Retires everything that can retire; true if anything did. All lines come up to their next node before a node retires that has run ahead: in
    /// the sequential program a node that begins now ends later, when the other regions have gone on, too.
    pub(super) fn retire(&mut self, context: &mut Context<'_>) -> bool {
        let mut retired = false;
        loop {
            retired |= self.come_to_nodes(context);
            if !self.retire_lines(context, Window::retire_node) {
                return retired;
            }
            retired = true;
        }
    }

    /// Lets one line after the other retire something; true if any did. Where a line comes to its end, the line around it goes on next.
    fn retire_lines(
        &mut self,
        context: &mut Context<'_>,
        retires: fn(&mut Window, &mut Context<'_>, LineId) -> bool,
    ) -> bool {
        let mut retired = false;
        let mut last = None;
        while let Some(line) = self.graph.next_active_line(last) {
            retired |= retires(self, context, line);
            last = self.graph.has_line(line).then_some(line);
        }
        retired
    }

    /// Retires what comes before the next nodes of the lines, as the sequential program goes on: it follows all ends, ends one wait if one is over and
    /// follows that, and only then the first line begins its next state. True if there was anything.
    fn come_to_nodes(&mut self, context: &mut Context<'_>) -> bool {
        let mut retired = false;
        loop {
            while self.end.is_none() && (self.retire_lines(context, Window::follow_ends) || self.ends_a_wait(context)) {
                retired = true;
            }
            let mut last = None;
            loop {
                let Some(line) = self.graph.next_active_line(last).filter(|_| self.end.is_none()) else {
                    if self.take_turns(context) {
                        break;
                    }
                    return retired;
                };
                if !self.begin_next(context, line) {
                    last = Some(line);
                    continue;
                }
                retired = true;
                // What has ended with it may end waits, or let the line around it go on.
                self.follow_ends(context, line);
                if !self.graph.has_line(line) || self.ends_a_wait(context) {
                    break;
                }
            }
        }
    }

    /// Begins, inside of routines, what has waited there for its turn at the routine's units; true if there was anything.
    fn take_turns(&mut self, context: &mut Context<'_>) -> bool {
        let heads = self.graph.active_heads().map(|head| head.id).filter(|id| self.goes_on_in_turn(*id));
        heads.collect::<Vec<_>>().into_iter().any(|id| {
            let takes = |routine: &mut Interpreter, context: &mut Context<'_>| {
                let takes = routine.take_turns(context);
                if !takes {
                    routine.renew_leases(context);
                }
                takes
            };
            self.end.is_none() && self.with_routine(context, id, takes) == Some(true)
        })
    }

    /// Retires the ends at which a line stands; true if there were any.
    fn follow_ends(&mut self, context: &mut Context<'_>, line: LineId) -> bool {
        let mut retired = false;
        while self.end.is_none() {
            // A decision that depends on facts changed by another region must be made again before it retires.
            retired |= self.tell_of_crossings(context);
            if self.graph.lacks_head(line) && self.grow(context) {
                continue;
            }
            let Some(id) = self.graph.head_of(line) else { break };
            if self.goes_on_in_turn(id) && self.with_routine(context, id, Interpreter::follow_end) == Some(true) {
                retired = true;
                continue;
            }
            let Some(head) = self.graph.get(id).filter(|head| is_end(head)) else { break };
            let has_ended = head.ended().is_some();
            if self.waits.takes(&mut self.graph, id) {
                self.examine(context, id);
            } else if has_ended && self.retire_head(context, id) {
                retired = true;
            } else {
                break;
            }
        }
        retired
    }

    /// Begins the next state of a line, or a part of that; true if there was anything to begin.
    fn begin_next(&mut self, context: &mut Context<'_>, line: LineId) -> bool {
        self.tell_of_crossings(context);
        let Some(head) = self.graph.head_of(line).and_then(|id| self.graph.get(id)).filter(|head| !is_end(head)) else {
            return false;
        };
        let (id, is_node, has_ended) = (head.id, head.role().is_none(), head.ended().is_some());
        // The sequential program goes on here before it goes on in the next region.
        if self.waits.takes(&mut self.graph, id) {
            self.examine(context, id);
            return true;
        }
        if self.goes_on_in_turn(id) {
            return self.with_routine(context, id, Interpreter::begin_next) == Some(true);
        }
        if is_node {
            self.come_to_its_place(context, id);
            return self.graph.get(id).is_some_and(is_end)
                || self.fails_at_its_place(context, id) && self.retire_head(context, id);
        }
        has_ended && self.retire_head(context, id)
    }

    /// Retires the head of a line, or passes it over, if it is a node; true if it did.
    fn retire_node(&mut self, context: &mut Context<'_>, line: LineId) -> bool {
        if self.end.is_some() {
            return false;
        }
        let told = self.tell_of_crossings(context);
        let Some(head) = self.graph.head_of(line).and_then(|id| self.graph.get(id)) else { return told };
        let (id, has_ended) = (head.id, head.ended().is_some());
        if head.role().is_some() {
            return told;
        }
        if self.passes(context, id) {
            self.graph.pass_over(id);
            return true;
        }
        (has_ended && self.retire_head(context, id)) || told
    }

    /// Whether the head is an imprecise PIA that runs and may be passed over, because only one way on, that of its success, is computed ahead.
    fn passes(&self, context: &Context<'_>, id: InstanceId) -> bool {
        self.graph.get(id).is_some_and(|head| {
            head.is_pia()
                && head.arms.len() == 1
                && head.arm_of(SUCCEEDED).is_some()
                && context.plan.state(head.state).imprecise
                && head.node().is_some_and(|node| node.status.is_running())
                && head.end_to_take().is_none()
        })
    }

    /// Retires the head of a line; false if it may not retire yet.
    fn retire_head(&mut self, context: &mut Context<'_>, id: InstanceId) -> bool {
        let Some(instance) = self.graph.get(id) else { return false };
        if let Some(beside) = self.conflict_beside(context, instance) {
            self.wait(id, Wait::World(beside));
            return false;
        }
        let sight = self.sight(context);
        let beside = self.producer_beside(sight, instance).or_else(|| self.inside_beside(instance));
        if let Some(beside) = beside {
            self.wait(id, Wait::Data(beside));
            return false;
        }
        if !self.goes_in_circles(context, id) {
            self.retire_now(context, id);
        }
        true
    }

    /// Retires the head of a line now.
    pub(super) fn retire_now(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let Some(instance) = self.graph.get(id) else { return };
        let (role, line, position) = (instance.role(), instance.line, instance.position);
        let real = self.make_real(context, id);
        let news = self.news_of_real(context, id, &real);
        self.correct(context, id, &real);
        match role {
            Some(Role::Fork) => {
                self.remove_retired(context, id);
                self.graph.begin_regions(id, line, position);
            }
            Some(Role::RegionEnd) => {
                self.remove_retired(context, id);
                self.graph.end_region(line);
            }
            Some(Role::End) => {}
            _ => self.follow(context, id, &real.outcome, real.reason),
        }
        // Younger results with changed inputs must be revised before they retire.
        self.tell_news(context, id, &news);
        self.revise(context);
    }

    /// Stops the run if a line has gone in circles (too many visits without an action); true if it did.
    pub(super) fn goes_in_circles(&mut self, context: &mut Context<'_>, id: InstanceId) -> bool {
        let Some(instance) = self.graph.get(id) else { return false };
        let is_too_long =
            self.graph.idle_visits(instance.line).saturating_add(instance.visits_before) > MAX_IDLE_VISITS;
        let routine = instance.ended().filter(|ended| ended.in_circles).map(|ended| ended.reason.clone());
        let reason = match routine {
            Some(reason) => reason,
            None if !is_too_long => return false,
            // The test of a loop is a place beside the loop, not in its body.
            None if instance.role() == Some(Role::Test) => {
                let name = &context.program.state(instance.state).name;
                in_circles(&instance.environment.path(name, instance.visit, None))
            }
            None => in_circles(instance.environment.frames.as_ref().map_or("", |frame| &frame.path)),
        };
        self.stop(context, ABORTED, reason);
        true
    }

    /// For the exit of a state or the end of a region: a detached PIA inside that still runs. The way in which it ends may change how the state
    /// is left.
    fn inside_beside(&self, end: &Instance) -> Option<InstanceId> {
        let role = end.role()?;
        let is_inside = |id: &&InstanceId| {
            let Some(inside) = self.graph.get(**id).filter(|inside| inside.id < end.id) else { return false };
            let mut frames =
                std::iter::successors(inside.environment.frames.as_deref(), |frame| frame.below.as_deref());
            match role {
                Role::RegionEnd => inside.line == end.line,
                _ => frames.any(|frame| frame.owner == end.state),
            }
        };
        matches!(role, Role::Exit | Role::RegionEnd).then(|| self.graph.detached().iter().find(is_inside).copied())?
    }

    /// Continues the line behind a retired instance, along its outcome.
    fn follow(&mut self, context: &mut Context<'_>, id: InstanceId, outcome: &str, reason: String) {
        let Some(instance) = self.graph.get(id) else { return };
        let (own, is_node) = (context.plan.state(instance.state), instance.marker().is_none());
        let arm = match instance.marker() {
            None => own.outcome(outcome).and_then(|number| instance.arm_of(number)),
            Some(marker) => match marker.role {
                Role::Condition | Role::Test => gives_outputs(outcome).then_some(0),
                Role::Exit => (own.outcomes[marker.leaves_by].as_ref() == outcome).then_some(0),
                Role::Entry | Role::Loop => (outcome == SUCCESS).then_some(0),
                Role::Join | Role::Fork | Role::RegionEnd | Role::End => Some(0),
            },
        };
        let Some(arm) = arm else {
            let number = own.outcome(outcome).unwrap_or(own.outcomes.len() - 2);
            return self.leave_path(context, id, number, reason);
        };
        if instance.arms.len() > 1 {
            self.take_arm(context, id, arm);
        }
        if is_node && outcome != SUCCESS {
            let because = self.because(context, id, reason);
            let path = self.path(context.program, id);
            self.graph.explain(&path, &because);
            self.growth.explain(&path, &because);
        }
        let Some(instance) = self.graph.get(id) else { return };
        let (line, position, is_detached) = (instance.line, instance.position, instance.is_detached());
        let next = instance.arms.first().and_then(|arm| arm.next);
        self.remove_retired(context, id);
        if !is_detached {
            self.graph.advance(line, position, next);
        }
    }

    /// An instance ended otherwise than computed ahead: discards everything behind it and continues the path where its outcome leads.
    fn leave_path(&mut self, context: &mut Context<'_>, id: InstanceId, outcome: Outcome, reason: String) {
        let because = self.because(context, id, reason);
        self.cut_behind(context, id);
        self.remove_and_depart(context, id, outcome, because);
    }

    /// Why an instance ended as it did, for people: the state, and the reason if there is one. A routine that was under way says where inside of it.
    fn because(&self, context: &Context<'_>, id: InstanceId, reason: String) -> Arc<str> {
        let says_where = self.graph.get(id).is_some_and(|instance| {
            context.plan.state(instance.state).is_routine && instance.node().is_some_and(|node| node.has_acted)
        });
        match (reason.is_empty(), says_where) {
            (true, _) => self.path(context.program, id).into(),
            (false, true) => reason.into(),
            (false, false) => format!("{}: {reason}", self.path(context.program, id)).into(),
        }
    }

    fn remove_and_depart(&mut self, context: &mut Context<'_>, id: InstanceId, outcome: Outcome, because: Arc<str>) {
        let Some(instance) = self.graph.get(id) else { return };
        let (line, position, state) = (instance.line, instance.position, instance.state);
        let producer = instance.producer.clone().filter(|_| instance.role().is_none());
        let mut environment = instance.environment.clone();
        // The state's own variables go out of scope.
        if state != Program::ROOT && matches!(instance.role(), Some(Role::Exit | Role::Loop | Role::Test)) {
            let own = context.program.state(state).variables.len();
            environment.variables.truncate(environment.variables.len().saturating_sub(own));
        }
        self.remove_retired(context, id);
        let departure = Departure { environment, line, position, state, outcome, because };
        self.growth.depart(context, departure, producer);
        self.graph.advance(line, position, None);
    }

    /// Commits the effects and performs the resource operations of an instance.
    fn make_real(&mut self, context: &mut Context<'_>, id: InstanceId) -> Real {
        let mut real =
            Real { outcome: ABORTED.into(), reason: String::new(), changes: Vec::new(), before: BTreeMap::new() };
        let Some((outcome, made, operations)) = self.what_happens(context, id, &mut real) else { return real };
        let made = match made {
            Ok(made) => made,
            Err(problem) => {
                real.reason = problem;
                return real;
            }
        };
        if !made.changes.is_empty() {
            let has_readers = self.graph.get(id).is_some_and(|instance| instance.memory.has_users());
            if has_readers {
                let written = made.changes.iter().filter_map(|change| match change {
                    Change::Set { fact, .. } | Change::Increase { fact, .. } => Some(fact),
                    Change::Delete { .. } => None,
                });
                real.before = written.map(|fact| (fact.clone(), context.root.get(fact).cloned())).collect();
            }
            let may_cross = !context.plan.crossing.is_nothing();
            let changes = if has_readers || may_cross { made.changes.clone() } else { Vec::new() };
            let writer = self.path(context.program, id);
            if let Err(problem) = context.commit(id, writer, made) {
                real.reason = problem;
                return real;
            }
            self.note_crossing(context, id, changes.iter());
            if has_readers {
                real.changes = changes;
            }
        }
        if let Some(Changed::Foreseen(changes)) =
            self.graph.get(id).and_then(Instance::ended).map(|ended| &ended.changes)
        {
            real.changes.clone_from(changes);
        }
        match operations {
            Ok(operations) if operations.is_empty() => {}
            Ok(operations) => context.commands.push(Command::Operate { instance: id, operations }),
            Err(reason) => {
                real.reason = reason;
                return real;
            }
        }
        real.outcome = outcome;
        real
    }

    /// The outcome of an instance, its changes and its resource operations, in the actual world; `None` if a precondition does not hold there, so
    /// that it counts as never executed. The reason is then in `real`.
    #[expect(clippy::type_complexity, reason = "three parts of one answer, used once")]
    fn what_happens(
        &self,
        context: &Context<'_>,
        id: InstanceId,
        real: &mut Real,
    ) -> Option<(Arc<str>, Result<Made, String>, Result<Vec<ratn_model::resource::Requirement>, String>)> {
        let instance = self.graph.get(id)?;
        let Some(ended) = instance.ended() else {
            real.reason = "it never ended".to_owned();
            return None;
        };
        let state = context.program.state(instance.state);
        let own = context.plan.state(instance.state);
        // Preconditions of what has ended before it came to its place were checked on a projection, if at all; now the actual world decides.
        let has_run_ahead = |node: &Node| node.nature != NodeNature::Irreversible && !node.is_at_its_place;
        let checks = match instance.role() {
            None => instance.node().is_some_and(has_run_ahead),
            Some(Role::Entry) => ended.outcome.as_ref() == SUCCESS,
            Some(_) => false,
        };
        real.reason.clone_from(&ended.reason);
        if checks && !state.annotations.requires.is_empty() {
            let unmet = self.look(context, id, Some(&ended.outputs), |_, view| binding::unmet(state, view))?;
            match unmet {
                Ok(None) => {}
                Ok(Some(unmet)) => {
                    real.reason = unmet;
                    return None;
                }
                Err(error) => {
                    real.reason = error.reason();
                    return None;
                }
            }
        }
        let outcome = ended.outcome.clone();
        if !matches!(instance.role(), None | Some(Role::Exit)) {
            return Some((outcome, Ok(Made::default()), Ok(Vec::new())));
        }
        let declared = match own.outcome(&outcome).map(|number| &own.effects[number]) {
            Some(Effects::Declared(declared)) => Some(declared.as_slice()),
            _ => None,
        };
        let is_routine = own.is_routine && instance.role().is_none();
        let made = match &ended.changes {
            Changed::Exactly(made) => Ok(made.clone()),
            Changed::Foreseen(_) => Ok(Made::default()),
            Changed::Declared(..) if is_routine => Ok(Made::default()),
            Changed::Declared(measured, _) if declared.is_some_and(<[_]>::is_empty) && measured.is_empty() => {
                Ok(Made::default())
            }
            Changed::Declared(measured, evidence) => {
                let changes = self.look(context, id, Some(&ended.outputs), |_, view| {
                    effects::actual(declared, &outcome, measured, view).map_err(|problem| problem.to_string())
                })?;
                changes.map(|changes| Made { changes, evidence: evidence.clone() })
            }
        };
        // A routine has performed its operations already.
        let operations = if is_routine || own.operations.is_empty() || outcome.as_ref() != SUCCESS {
            Ok(Vec::new())
        } else {
            self.look(context, id, Some(&ended.outputs), |_, view| {
                binding::requirements(state, &own.operations, view).map_err(|error| error.reason())
            })?
        };
        Some((outcome, made, operations))
    }

    /// Compares the predicted effects, on which users depend, with the actual ones.
    fn news_of_real(&mut self, context: &Context<'_>, id: InstanceId, real: &Real) -> News {
        let users = self.take_users(id);
        let mut news = News { users, difference: Difference::default(), is_open: false };
        let Some(instance) = self.graph.get(id).filter(|_| !news.users.is_empty()) else { return news };
        if news.users.iter().any(|user| user.of == Source::World) {
            let before = |key: &FactKey| match real.before.get(key) {
                Some(before) => before.clone(),
                None => context.root.get(key).cloned(),
            };
            news.difference =
                self.sight(context).compare_with_actual(instance, &real.changes, self.tolerance_of(context), before);
        }
        // A failure that was not computed ahead has no outputs.
        news.is_open = instance.ended().is_none_or(|ended| real.is_other_than(ended));
        news
    }

    /// Corrects a result that failed when it was to become real: it has no outputs, and a routine leaves variables as they were.
    fn correct(&mut self, context: &Context<'_>, id: InstanceId, real: &Real) {
        let Some(ended) = self.graph.get(id).and_then(Instance::ended) else { return };
        if !real.is_other_than(ended) {
            return;
        }
        let outputs = self.unassigned(context, id);
        self.graph.end(id, Ended { outputs, ..Ended::aborted(real.reason.clone()) });
    }

    fn tell_news(&mut self, context: &mut Context<'_>, id: InstanceId, news: &News) {
        self.tell(context, id, &news.users, &news.difference, news.is_open, false);
    }

    pub(super) fn retire_detached(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let real = self.make_real(context, id);
        let news = self.news_of_real(context, id, &real);
        self.correct(context, id, &real);
        let Some(instance) = self.graph.get(id) else { return };
        let own = context.plan.state(instance.state);
        let number = own.outcome(&real.outcome);
        let is_expected = number.is_some_and(|number| instance.arm_of(number).is_some());
        if is_expected || instance.is_orphan() || !self.graph.has_line(instance.line) {
            self.remove_retired(context, id);
        } else {
            let number = number.unwrap_or(own.outcomes.len() - 2);
            self.leave_path(context, id, number, real.reason);
        }
        self.tell_news(context, id, &news);
        self.revise(context);
    }

    /// Retires a motion that has ended after its path was left: its effects stay.
    pub(super) fn retire_orphan(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let real = self.make_real(context, id);
        let news = self.news_of_real(context, id, &real);
        self.remove_retired(context, id);
        self.tell_news(context, id, &news);
    }

    /// Takes a retired instance out of the window.
    fn remove_retired(&mut self, context: &mut Context<'_>, id: InstanceId) {
        self.waits.wake(&mut self.graph, id);
        let Some(instance) = self.graph.remove(id) else { return };
        self.forget(id);
        let is_wait = context.program.state(instance.state).is_pause();
        let started = instance.node().is_some_and(|node| match &node.status {
            Status::Finished(ended) => node.has_acted || (ended.reason.is_empty() && !is_wait),
            _ => false,
        });
        self.graph.count_visits(instance.line, instance.visits_before, started);
        if instance.role().is_none() {
            context.note(Note::Retired { instance: id });
        }
        if instance.role() == Some(Role::Join) {
            self.growth.forget_joined(&self.graph);
        }
        let Some(producer) = &instance.producer else { return };
        let Some(ended) = instance.ended() else { return };
        let mut outputs = ended.outputs.clone();
        if !gives_outputs(&ended.outcome) && instance.role() != Some(Role::RegionEnd) {
            outputs.retain(|port, _| port.starts_with(super::growth::environment::ASSIGNED));
        }
        let _ = producer.real.set(outputs);
    }
}
