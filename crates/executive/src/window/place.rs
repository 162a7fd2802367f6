//! The place of a computing or sensing node in the sequential program. Before everything older is real the node runs ahead, on a prediction. It
//! comes to its place when everything older on its path is real; from then on it is executed as the sequential program executes it.

use super::Window;
use super::graph::instance::{Instance, Node, Status};
use super::memory::Seen;
use super::ready::{self, Readiness, not_bound};
use super::waits::Wait;
use crate::binding;
use crate::context::Context;
use ratn_model::fact::FactPattern;
use ratn_model::id::InstanceId;
use ratn_model::program::StateKind;

impl Window {
    /// Lets a computing or sensing node come to its place, if it has not ended before and everything older is real. Tries that were made ahead count
    /// if they have seen what is there now; from now on every try counts. What it requires has to hold now, because the sequential program begins it
    /// now.
    pub(super) fn come_to_its_place(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let comes = |instance: &&Instance| instance.ended().is_none() && self.comes(instance);
        let Some(instance) = self.graph.get(id).filter(comes) else { return };
        if self.has_tried_otherwise(context, instance) {
            self.graph.forget_tries(id);
            // Without earlier tries there is no backoff.
            self.waits.enqueue(&mut self.graph, id);
        }
        // It keeps out of nobody's way any more.
        if self.graph.get(id).is_some_and(|instance| matches!(instance.waiting.wait(), Wait::Writer(_))) {
            self.waits.enqueue(&mut self.graph, id);
        }
        self.graph.come_to_its_place(id);
        self.just_come.insert(id);
        let is_under_way = self.graph.get(id).is_some_and(Instance::is_under_way);
        if is_under_way && let Some(Readiness::Failed(reason)) = self.unmet(context, id) {
            self.stop_node(context, id);
            self.fail(context, id, reason);
        }
    }

    /// Whether a node that has ended ahead comes to its place, and what it requires does not hold there: the sequential program does not begin it.
    pub(super) fn fails_at_its_place(&self, context: &Context<'_>, id: InstanceId) -> bool {
        let comes = self.graph.get(id).is_some_and(|instance| instance.ended().is_some() && self.comes(instance));
        comes && matches!(self.unmet(context, id), Some(Readiness::Failed(_)))
    }

    /// Whether a node begins in the actual world, where its preconditions have to hold. They are checked when it begins and when it has its resources,
    /// not again when it has its projection.
    pub(super) fn begins_for_real(instance: &Instance) -> bool {
        let has_no_projection =
            |node: &Node| matches!(&node.status, Status::Granted(held) if held.projection.is_none());
        instance.is_pia() || instance.node().is_some_and(|node| node.is_at_its_place && has_no_projection(node))
    }

    /// Why a precondition of a node does not hold at its place; `None` if all hold.
    pub(super) fn unmet(&self, context: &Context<'_>, id: InstanceId) -> Option<Readiness> {
        let state = context.program.state(self.graph.get(id)?.state);
        if state.annotations.requires.is_empty() {
            return None;
        }
        let unmet = self.look(context, id, None, |_, view| match binding::unmet(state, view) {
            Ok(None) => None,
            Ok(Some(reason)) => Some(Readiness::Failed(reason)),
            Err(error) => Some(not_bound(view, &error)),
        });
        unmet.flatten()
    }

    /// Whether a node is under way where the sequential program would also be at it: everything before it in its region has ended, and what runs ahead
    /// has had its turn since. Then it goes on, whatever others change meanwhile: of a routine the parts that have not begun find the changes.
    pub(super) fn goes_on(&mut self, context: &Context<'_>, id: InstanceId) -> bool {
        if self.only_asks(context, id) {
            // It comes to its place once more, with what it finds then.
            self.just_come.remove(&id);
            self.graph.leave_its_place(id);
            return false;
        }
        let is_at_its_place = self.is_under_way_at_its_place(id);
        if is_at_its_place && let Some(routine) = self.graph.interpreter(id) {
            routine.project_anew(context.root);
        }
        is_at_its_place
    }

    fn is_under_way_at_its_place(&self, id: InstanceId) -> bool {
        self.graph.get(id).is_some_and(|instance| {
            let has_come = instance.is_pia() || instance.node().is_some_and(|node| node.is_at_its_place);
            has_come && instance.is_head && instance.is_under_way() && self.older_beside(instance).is_none()
        })
    }

    /// Others have changed facts which a routine under way at its place may have changed before.
    pub(super) fn overwrites(&mut self, context: &Context<'_>, facts: &[FactPattern]) {
        for id in self.dispatch.active().collect::<Vec<_>>() {
            if self.is_under_way_at_its_place(id)
                && let Some(routine) = self.graph.interpreter(id)
            {
                routine.was_overwritten(facts);
                routine.project_anew(context.root);
            }
        }
    }

    /// Whether the sequential program only asks for a node's resources at present, and looks at the world when it has them: the node has run ahead, has
    /// its resources, and has come to its place in this event.
    fn only_asks(&self, context: &Context<'_>, id: InstanceId) -> bool {
        let has_resources = |instance: &Instance| instance.node().is_some_and(|node| node.status.since().is_some());
        let asks = |instance: &Instance| !context.plan.state(instance.state).requirements.is_empty();
        self.just_come.contains(&id)
            && self.graph.get(id).is_some_and(|instance| has_resources(instance) && asks(instance))
    }

    /// Whether what has run ahead comes to its place: everything older is real.
    fn comes(&self, instance: &Instance) -> bool {
        let has_run_ahead = instance.node().is_some_and(|node| !node.is_at_its_place) && !instance.is_pia();
        has_run_ahead && instance.is_head && self.older_beside(instance).is_none()
    }

    /// Whether a node that waits for its next try has made the earlier ones with other inputs. One that is under way has compared them when it began.
    fn has_tried_otherwise(&self, context: &Context<'_>, instance: &Instance) -> bool {
        let has_tried = |status: &Status, number: u32| matches!(status, Status::Expanded) && number > 0;
        let Some(node) = instance.node().filter(|node| has_tried(&node.status, node.tries - 1 + node.crashes)) else {
            return false;
        };
        let now = self.sees_now(context, instance.id);
        !now.is_some_and(|now| node.seen.as_ref().is_some_and(|before| before.is_like(&now)))
    }

    /// The inputs that a node would have if it began now; `None` if they are not known.
    fn sees_now(&self, context: &Context<'_>, id: InstanceId) -> Option<Seen> {
        let looked = self.look(context, id, None, |instance, view| {
            let mut seen = ready::look(context, view, instance.node()?.nature).ok()?;
            let state = context.program.state(instance.state);
            if let StateKind::Action { inputs, .. } = &state.kind {
                seen.see_inputs(&binding::inputs(state, inputs, view).ok()?);
            }
            Some(seen)
        });
        looked.flatten()
    }
}
