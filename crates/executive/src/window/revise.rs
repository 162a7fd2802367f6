//! Revision: a result whose inputs came out otherwise is made again, and so are the results that depend on it.
//!
//! Instances whose outputs or effects may have changed are marked and examined oldest first: each once, however many dependencies lead to
//! it, and without recursion. PIAs are never made again, because they begin when everything older is real.

use super::graph::instance::{Instance, Role};
use super::growth::environment::ASSIGNED;
use super::memory::{Deviation, Difference, Looked, Purpose, Source, User};
use super::{Wait, Window, ready};
use crate::context::Context;
use crate::plan::{NodeNature, gives_outputs};
use crate::protocol::Note;
use ratn_model::expression::FactExpr;
use ratn_model::fact::Footprint;
use ratn_model::id::InstanceId;
use smallvec::SmallVec;

impl Window {
    /// Examines all marked instances; true if there were any.
    pub(super) fn revise(&mut self, context: &mut Context<'_>) -> bool {
        let mut any = false;
        while let Some(id) = self.memory.next_stale() {
            any = true;
            self.look_again(context, id);
        }
        any
    }

    /// Examines a marked instance and tells its users what has changed.
    fn look_again(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let Some(instance) = self.graph.get(id) else { return };
        if !instance.memory.has_users() && instance.waiting.waiters().is_empty() {
            return instance.memory.forget_forecasts();
        }
        let users = instance.memory.users();
        let refreshed = self.sight(context).refresh(id, self.tolerance_of(context));
        let is_open = instance.ended().is_none();
        if refreshed.is_known_now {
            self.waits.wake(&mut self.graph, id);
        }
        self.tell(context, id, &users, &refreshed.difference, is_open, refreshed.is_known_now);
    }

    /// Tells the users of an instance about deviations. `is_open`: its outputs do not exist (any more).
    pub(super) fn tell(
        &mut self,
        context: &mut Context<'_>,
        id: InstanceId,
        users: &[User],
        difference: &Difference,
        is_open: bool,
        is_known_now: bool,
    ) {
        for user in users.iter().filter(|user| user.of == Source::World && user.purpose == Purpose::Result) {
            // A sensing node that waits for the environment is examined again. So is an instance that waits for its twin: even a tolerated
            // deviation makes the twin's result a different one.
            let waits = |user: &Instance| user.is_sensing() || matches!(user.waiting.wait(), Wait::Twin(_));
            if self.graph.get(user.id).is_some_and(|user| waits(user) && !user.is_under_way()) {
                self.waits.enqueue(&mut self.graph, user.id);
            }
        }
        for user in users {
            match (user.of, user.purpose) {
                (Source::Outputs, Purpose::Effects) => self.memory.mark(user.id),
                (Source::World, Purpose::Effects) if is_known_now || !difference.is_empty() => {
                    self.memory.mark(user.id)
                }
                (Source::Outputs, Purpose::Result) if is_open => {
                    self.invalidate(context, user.id, "an input is computed again".to_owned());
                }
                (Source::World, Purpose::Result) if !difference.is_empty() => {
                    if let Some(deviation) = self.concerns(context, user.id, id, difference) {
                        self.came_otherwise(context, user.id, deviation.is_tolerated, deviation.sentence());
                    }
                }
                _ => {}
            }
        }
    }

    /// The first deviation of an older instance that a reader has seen and no younger writer hides.
    fn concerns<'d>(
        &self,
        context: &Context<'_>,
        reader: InstanceId,
        writer: InstanceId,
        difference: &'d Difference,
    ) -> Option<&'d Deviation> {
        let instance = self.graph.get(reader)?;
        let seen = instance.seen()?;
        let is_seen = |deviation: &&'d Deviation| {
            let pattern = std::slice::from_ref(&deviation.pattern);
            seen.overlaps(&deviation.pattern)
                && self.look(context, reader, None, |_, view| view.is_visible(writer, pattern)).unwrap_or(false)
        };
        difference.that_are(false).find(is_seen).or_else(|| {
            let mut tolerated = difference.that_are(true).peekable();
            tolerated.peek()?;
            let exact = self.exact(context, instance);
            tolerated.find(|deviation| Looked::at(&exact).overlaps(&deviation.pattern) && is_seen(deviation))
        })
    }

    /// The facts for which an instance tolerates no deviation. Actions tolerate deviations, because they are expensive; the window's own
    /// computations do not.
    pub(super) fn exact(&self, context: &Context<'_>, instance: &Instance) -> Footprint {
        if instance.role().is_some() {
            return Footprint::Everything;
        }
        let exact = &context.plan.state(instance.state).exact;
        let exact = self.look(context, instance.id, None, |_, view| FactExpr::footprint(exact, view));
        exact.unwrap_or(Footprint::Everything)
    }

    /// A fact came out otherwise than an instance has seen it.
    pub(super) fn came_otherwise(
        &mut self,
        context: &mut Context<'_>,
        id: InstanceId,
        is_tolerated: bool,
        reason: String,
    ) {
        let Some(instance) = self.graph.get(id) else { return };
        let is_forgiven =
            match (is_tolerated && instance.role().is_none(), context.plan.state(instance.state).is_routine) {
                (false, _) => false,
                // In an action only the assignments depend on tolerated deviations.
                (true, false) => self.assign_again(context, id),
                (true, true) => self.sees_the_same(context, instance),
            };
        if !is_forgiven {
            self.invalidate(context, id, reason);
        }
    }

    /// Whether an instance has already seen the facts as they are now, because it was computed after the change.
    pub(super) fn sees_the_same(&self, context: &Context<'_>, instance: &Instance) -> bool {
        let now = match instance.role() {
            Some(_) => Some(self.compute_parts(context, instance).1),
            None => self
                .look(context, instance.id, None, |_, view| ready::look(context, view, NodeNature::Computes).ok())
                .flatten(),
        };
        now.is_some_and(|now| instance.seen().is_some_and(|seen| seen.saw_the_same(&now)))
    }

    /// Evaluates an action's assignments again with the present facts, if it has a result; false if that failed.
    fn assign_again(&mut self, context: &mut Context<'_>, id: InstanceId) -> bool {
        let Some(instance) = self.graph.get(id) else { return true };
        let Some(ended) = instance.ended() else { return true };
        let mut again = ended.clone();
        again.outputs.retain(|port, _| !port.starts_with(ASSIGNED));
        // Its assignments may have failed before, too.
        if !gives_outputs(&ended.outcome) || self.assign(context, id, &mut again).is_err() {
            return false;
        }
        if again.outputs != ended.outputs {
            let users = instance.memory.users();
            self.graph.end(id, again);
            self.assigned_again.insert(id);
            self.tell(context, id, &users, &Difference::default(), true, false);
        }
        true
    }

    /// Discards a result, or a running attempt: it is made again.
    pub(super) fn invalidate(&mut self, context: &mut Context<'_>, id: InstanceId, reason: String) {
        let Some(instance) = self.graph.get(id) else { return };
        if !is_revisable(instance) {
            if !instance.is_under_way() && instance.ended().is_none() {
                // It has not begun, but may now wait for another instance, or for none.
                self.waits.enqueue(&mut self.graph, id);
            }
            return;
        }
        let is_node = instance.role().is_none();
        self.keep_result(context, id);
        self.stop_node(context, id);
        self.graph.reopen(id);
        if is_node {
            context.note(Note::Invalidated { instance: id, reason });
        }
        self.memory.mark(id);
        self.waits.wake(&mut self.graph, id);
        self.waits.enqueue(&mut self.graph, id);
    }

    /// Takes the users of an instance that leaves the window; they hear no more from it.
    pub(super) fn take_users(&mut self, id: InstanceId) -> SmallVec<[User; 2]> {
        let Some(instance) = self.graph.get(id) else { return SmallVec::new() };
        let users = instance.memory.users();
        instance.memory.forget_users();
        self.memory.unmark(id);
        users
    }
}

/// Whether an instance has a result, or works on one, that may be made again.
fn is_revisable(instance: &Instance) -> bool {
    let has_begun = instance.ended().is_some() || instance.is_under_way();
    let can_be = match instance.role() {
        None => !instance.is_pia() && !instance.is_detached(),
        Some(role) => matches!(role, Role::Entry | Role::Exit),
    };
    has_begun && can_be && !instance.is_settled
}
