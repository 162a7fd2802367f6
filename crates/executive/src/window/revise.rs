//! Revision: a result that was made of something which came out otherwise is made again, and so is what was made of it.
//!
//! Instances whose outputs or effects may be otherwise are marked, and looked at oldest first: each once, however many ways lead
//! to it, and without recursion. PIAs are never made again: they begin when everything older is real.

use super::graph::instance::{Instance, Role};
use super::memory::{Deviation, Difference, Purpose, Source, User};
use super::{Wait, Window};
use crate::context::Context;
use crate::protocol::Note;
use ratn_model::id::InstanceId;
use smallvec::SmallVec;

impl Window {
    /// Looks at everything that is marked; whether anything was.
    pub(super) fn revise(&mut self, context: &mut Context<'_>) -> bool {
        let mut any = false;
        while let Some(id) = self.memory.next_stale() {
            any = true;
            self.look_again(context, id);
        }
        any
    }

    /// An instance may have put out or changed something else than its users know.
    fn look_again(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let Some(instance) = self.graph.get(id) else { return };
        if !instance.memory.has_users() && instance.waiting.waiters().is_empty() {
            return;
        }
        let users = instance.memory.users();
        let refreshed = self.sight(context).refresh(id, self.tolerance_of(context));
        let is_open = instance.ended().is_none();
        if refreshed.is_known_now {
            self.waits.wake(&mut self.graph, id);
        }
        self.tell(context, id, &users, &refreshed.difference, is_open, refreshed.is_known_now);
    }

    /// Tells the users of an instance what came out otherwise. `is_open`: its outputs are not there (any more).
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
            // Whoever waits for the environment to look as it does at its place looks again; and whoever waits for what another instance
            // computes of the same, which what is tolerated makes another result.
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
                        self.invalidate(context, user.id, deviation.sentence());
                    }
                }
                _ => {}
            }
        }
    }

    /// The first of some deviations of an older instance that a reader has looked at and no younger writer hides from it.
    fn concerns<'d>(
        &self,
        context: &Context<'_>,
        reader: InstanceId,
        writer: InstanceId,
        difference: &'d Difference,
    ) -> Option<&'d Deviation> {
        let instance = self.graph.get(reader)?;
        let seen = instance.seen()?;
        // What is tolerated is forgiven by actions, which take their time; the window's own computations are exact.
        let forgives = instance.role().is_none();
        let mut looked_at = difference.that_count(forgives).filter(|deviation| seen.overlaps(&deviation.pattern));
        looked_at.find(|deviation| {
            let pattern = std::slice::from_ref(&deviation.pattern);
            self.look(context, reader, None, |_, view| view.is_visible(writer, pattern)).unwrap_or(false)
        })
    }

    /// A result, or what is to become one, is made again.
    pub(super) fn invalidate(&mut self, context: &mut Context<'_>, id: InstanceId, reason: String) {
        let Some(instance) = self.graph.get(id) else { return };
        if !is_revisable(instance) {
            if !instance.is_under_way() && instance.ended().is_none() {
                // It has not begun: what it waits for may be another instance now, or none.
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

    /// The users of an instance that leaves the window: they have nothing more to hear from it.
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
