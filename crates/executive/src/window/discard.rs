//! Discarding instances: the branches that are not taken, and everything behind an outcome that was not computed ahead.

use super::Window;
use super::graph::Pruned;
use super::graph::instance::Status;
use crate::binding::Outputs;
use crate::context::Context;
use crate::protocol::Note;
use ratn_model::id::InstanceId;

impl Window {
    /// A decision is made: the other arms are discarded.
    pub(super) fn take_arm(&mut self, context: &mut Context<'_>, id: InstanceId, taken: usize) {
        let (pruned, certain) = self.graph.take_arm(id, taken);
        self.discard(context, &pruned);
        self.growth.arm_taken(id);
        // What was speculative on the way to this decision is not any more, and everything behind it has become likelier.
        for member in certain {
            self.dispatch.became_certain(member);
            self.waits.enqueue(&mut self.graph, member);
        }
        self.ask_again(context);
    }

    /// Everything behind an instance is discarded.
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
                // A motion beside a failed one: it ends as it ends, and what it does stands.
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

    /// An instance has left the window.
    pub(super) fn forget(&mut self, id: InstanceId) {
        self.dispatch.forget(id);
        self.results.forget(id);
        self.memory.unmark(id);
    }

    /// Discards everything that is in the window: the run ends.
    pub(super) fn stop(&mut self, context: &mut Context<'_>, outcome: &str, reason: String) {
        self.is_ending = true;
        let all: Vec<InstanceId> = self.graph.iter().map(|instance| instance.id).collect();
        for id in all.into_iter().rev() {
            self.discard_one(context, id);
        }
        self.harvest_all(context);
        self.growth.stop();
        self.end = Some(super::End { outcome: outcome.to_owned(), outputs: Outputs::new(), reason });
    }
}
