//! Discarding instances: the branches that are not taken, and everything behind an outcome that was not computed ahead.

use super::Window;
use super::beside::is_in_order;
use super::graph::Pruned;
use super::graph::instance::{Instance, Node, Role, Status};
use super::growth::environment::{Binding, Environment, assigned};
use super::memory::Sight;
use crate::binding::Outputs;
use crate::context::Context;
use crate::protocol::Note;
use crate::way_out::{WayOut, Within};
use ratn_model::id::{InstanceId, StateId};
use ratn_model::program::PREEMPTED;
use ratn_model::value::Value;
use std::borrow::Cow;
use std::collections::BTreeSet;

impl Window {
    /// Applies a decision: the arms that are not taken are discarded.
    pub(super) fn take_arm(&mut self, context: &mut Context<'_>, id: InstanceId, taken: usize) {
        let (pruned, certain) = self.graph.take_arm(id, taken);
        self.discard(context, &pruned);
        self.growth.arm_taken(id);
        // Instances that depended only on this decision become certain, and everything behind it becomes more likely.
        for member in certain {
            self.dispatch.became_certain(member);
            self.waits.enqueue(&mut self.graph, member);
        }
        self.ask_again(context);
    }

    /// Discards everything behind an instance.
    pub(super) fn cut_behind(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let pruned = self.graph.cut_behind(id);
        self.discard(context, &pruned);
    }

    fn discard(&mut self, context: &mut Context<'_>, pruned: &Pruned) {
        self.growth.prune(&self.graph, pruned);
        for id in &pruned.instances {
            self.discard_one(context, *id);
        }
    }

    fn discard_one(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let Some(instance) = self.graph.get(id) else { return };
        let is_node = instance.role().is_none();
        if let Some(node) = instance.node()
            && instance.is_pia()
            && !context.program.state(instance.state).is_pause()
            && !self.is_ending
        {
            match node.status {
                // A motion beside a failed one runs to its end, and its effects stay.
                Status::Running(_) | Status::RunningRoutine(..) => {
                    instance.memory.forget_users();
                    return self.graph.orphan(id);
                }
                Status::Finished(_) if node.has_acted => return self.retire_orphan(context, id),
                _ => {}
            }
        }
        self.keep_result(context, id);
        self.stop_node(context, id);
        self.waits.wake(&mut self.graph, id);
        self.graph.remove(id);
        self.forget(id);
        if is_node {
            context.note(Note::Squashed { instance: id });
        }
    }

    pub(super) fn forget(&mut self, id: InstanceId) {
        self.dispatch.forget(id);
        self.results.forget(id);
        self.memory.unmark(id);
    }

    /// Ends the run now: motions that have ended become real, everything else in the window is discarded.
    pub(super) fn stop(&mut self, context: &mut Context<'_>, outcome: &str, reason: String) {
        self.make_done_real(context);
        self.discard_all(context, outcome, reason);
    }

    /// Retires motions that have ended but were waiting for older ones beside them; their lines go on.
    fn make_done_real(&mut self, context: &mut Context<'_>) {
        let program = context.program;
        let ends = self.graph.iter().filter_map(|one| Some((one.id, one.end_to_take()?.clone())));
        for (id, end) in ends.collect::<Vec<_>>() {
            let end = self.end_of_answer(context, id, end);
            self.finish_now(context, id, end);
        }
        let is_done = |head: &&Instance| {
            let has_acted = |node: &Node| node.has_acted && matches!(node.status, Status::Finished(_));
            head.is_pia() && !program.state(head.state).is_pause() && head.node().is_some_and(has_acted)
        };
        let mut any = false;
        while let Some(id) = self.graph.active_heads().filter(is_done).map(|head| head.id).min() {
            self.retire_now(context, id);
            any = true;
        }
        if any {
            self.grow(context);
        }
    }

    /// Cancels running routines, and running nodes that declare effects for `preempted`, in the order of threads of control, as the sequential
    /// program does. Within a thread the oldest comes last, because only that one is at its place in the sequential program.
    fn say_what_is_cut_short(&mut self, context: &mut Context<'_>) {
        let declares = |instance: &Instance| {
            let declared = context.program.state(instance.state).annotations.effects.get(PREEMPTED);
            declared.is_some_and(|declared| !declared.is_empty())
        };
        let says = |instance: &&Instance| match instance.node().map(|node| &node.status) {
            Some(Status::RunningRoutine(..)) => true,
            Some(Status::Running(_)) => declares(instance),
            _ => false,
        };
        let order = |instance: &Instance| (instance.line, std::cmp::Reverse(instance.id));
        let mut saying: Vec<_> = self.graph.iter().filter(says).map(order).collect();
        saying.sort_unstable();
        for (_, std::cmp::Reverse(id)) in saying {
            self.stop_node(context, id);
            self.graph.begin_again(id);
        }
    }

    fn discard_all(&mut self, context: &mut Context<'_>, outcome: &str, reason: String) {
        self.is_ending = true;
        self.say_what_is_cut_short(context);
        let all: Vec<InstanceId> = self.graph.iter().map(|instance| instance.id).collect();
        for id in all.into_iter().rev() {
            self.discard_one(context, id);
        }
        self.harvest_all(context);
        self.growth.stop();
        self.end = Some(super::End::new(outcome, reason));
    }

    /// Like `stop`, but the end also contains the way out (`finally`) of the states that are entered.
    pub(super) fn cut_short(&mut self, context: &mut Context<'_>, outcome: &str, reason: String) {
        self.make_done_real(context);
        let way_out = self.way_out(context);
        self.discard_all(context, outcome, reason);
        if let Some(end) = &mut self.end {
            end.way_out = way_out;
        }
    }

    /// The instances at which the sequential program would be, one per thread of control: the oldest ones that are not real. If a line is expanded
    /// past a running imprecise PIA, this is that PIA, and the regions of a younger fork have not begun there.
    fn places(&self) -> Vec<&Instance> {
        let detached = self.graph.detached().iter().filter_map(|id| self.graph.get(*id));
        // The sequential program has not begun a motion whose path was left.
        let detached: Vec<&Instance> = detached.filter(|motion| !motion.is_orphan()).collect();
        let is_after = |one: &Instance| detached.iter().any(|motion| motion.id < one.id && is_in_order(motion, one));
        let all = detached.iter().copied().chain(self.graph.active_heads());
        all.filter(|one| !is_after(one)).collect()
    }

    /// The entered states with a `finally`, by thread of control.
    fn way_out(&self, context: &Context<'_>) -> WayOut {
        let mut way = WayOut::default();
        let mut forks = BTreeSet::new();
        let sight = self.sight(context);
        for head in self.places() {
            let routine = self.status_of_routine(head.id);
            let within = routine.and_then(|routine| routine.way_out_within(context.program, &mut way));
            // A join or an exit comes after everything inside of its state, but the state is not left yet.
            let is_in = matches!(head.role(), Some(Role::Join | Role::Exit));
            let path = |environment: &Environment| {
                environment.path(&context.program.state(head.state).name, head.visit, head.iteration)
            };
            let own = is_in.then(|| (head.state, path(&head.environment)));
            let mut next = self.add_way_out(context, sight, &head.environment, (own, within), &mut way);
            while let Some((fork, own)) = next {
                let Some(around) = self.growth.around(fork).filter(|_| forks.insert(fork)) else { break };
                next = self.add_way_out(context, sight, around, (Some(own), None), &mut way);
            }
        }
        way.hold = self.hold.clone();
        way
    }

    /// Adds the way out of one line, up to its fork, which is returned with the concurrency and its path. `own` is the state at the line's head
    /// if it is not left yet, `within` the place inside of a routine there.
    fn add_way_out(
        &self,
        context: &Context<'_>,
        sight: Sight<'_>,
        environment: &Environment,
        (own, within): (Option<(StateId, String)>, Option<Within>),
        way: &mut WayOut,
    ) -> Option<(InstanceId, (StateId, String))> {
        let program = context.program;
        let frames = || std::iter::successors(environment.frames.as_deref(), |frame| frame.below.as_deref());
        let fork = frames().find_map(|frame| Some((frame.fork?, (frame.owner, frame.path.to_string()))));
        let of_line = frames().take_while(|frame| frame.fork.is_none());
        let frames = of_line.map(|frame| (frame.owner, frame.path.to_string()));
        // Whether the `finally` is under way already.
        let mut inside = None;
        let places = own.into_iter().chain(frames).map(|(owner, path)| {
            let last = program.state(owner).annotations.finally.as_ref().and_then(|f| f.lastly.get(PREEMPTED));
            let visits = u32::from(last.is_some() && last.copied() == inside);
            inside = Some(owner);
            (owner, path, visits)
        });
        let within = within.unwrap_or_default();
        let variables = || {
            let names = environment.variables.iter().enumerate();
            let scoped = names.filter_map(|(place, (name, _))| {
                Some((name.to_string(), self.variable_now(sight, environment, place)?.into_owned()))
            });
            let looping = environment.loop_variables(program);
            let looping = looping.map(|(name, value)| (name.to_owned(), value.into_owned()));
            // Later bindings win: what the routine has assigned replaces earlier values.
            scoped.chain(looping).chain(within.variables).collect()
        };
        let outputs = || {
            let ids = program.states.iter().map(|state| state.id);
            let before = ids.filter_map(|id| Some((id, self.outputs_now(sight, environment, id)?.clone())));
            before.chain(within.outputs).collect()
        };
        way.add(program, within.places.into_iter().chain(places), variables, outputs);
        fork
    }

    /// The present value of a variable, by its index among those in scope. An imprecise motion that still runs has assigned nothing yet.
    fn variable_now<'a>(
        &'a self,
        sight: Sight<'a>,
        environment: &'a Environment,
        place: usize,
    ) -> Option<Cow<'a, Value>> {
        let mut environment = environment;
        loop {
            let (name, binding) = environment.variables.iter().nth(place)?;
            let producer = match binding {
                Binding::Known(value) => return Some(Cow::Borrowed(value)),
                Binding::Assigned(producer) => producer,
            };
            if let Some(outputs) = sight.assigned_by(producer) {
                return outputs.get(&assigned(name)).map(Cow::Borrowed);
            }
            environment = &self.graph.get(producer.instance)?.environment;
        }
    }

    /// The present outputs of a state, found in the same way.
    fn outputs_now<'a>(
        &'a self,
        sight: Sight<'a>,
        environment: &'a Environment,
        state: StateId,
    ) -> Option<&'a Outputs> {
        let mut environment = environment;
        loop {
            let producer = environment.producer(state)?;
            if let Some(outputs) = sight.outputs_of(producer) {
                return Some(outputs);
            }
            environment = &self.graph.get(producer.instance)?.environment;
        }
    }
}
