//! The place of a computing or sensing node in the sequential program. Before everything older is real the node runs ahead, on a prediction. It
//! comes to its place when everything older on its path is real; from then on it is executed as the sequential program executes it.

use super::graph::instance::{Instance, Status};
use super::memory::Seen;
use super::{Window, ready};
use crate::binding;
use crate::context::Context;
use ratn_model::id::InstanceId;
use ratn_model::program::StateKind;

impl Window {
    /// Lets a computing or sensing node come to its place, if it has not ended before and everything older is real. Tries that were made ahead count
    /// if they have seen what is there now; from now on every try counts.
    pub(super) fn come_to_its_place(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let Some(instance) = self.graph.get(id).filter(|instance| self.may_come_to_its_place(instance)) else { return };
        if self.has_tried_otherwise(context, instance) {
            self.graph.forget_tries(id);
            // Without earlier tries there is no backoff.
            self.waits.enqueue(&mut self.graph, id);
        }
        self.graph.come_to_its_place(id);
    }

    fn may_come_to_its_place(&self, instance: &Instance) -> bool {
        let runs_ahead = instance.node().is_some_and(|node| !node.is_at_its_place) && !instance.is_pia();
        runs_ahead && instance.is_head && instance.ended().is_none() && self.older_beside(instance).is_none()
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
