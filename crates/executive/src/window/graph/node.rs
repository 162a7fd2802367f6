//! The life of a node: every change of its status, with the data that the status owns.

use super::Graph;
use super::instance::{Body, Ended, Held, Instance, Node, Status};
use crate::binding::Outputs;
use crate::interpreter::Interpreter;
use ratn_model::id::{InstanceId, ProjectionId};
use ratn_model::resource::Lease;
use ratn_model::time::Timestamp;

impl Graph {
    fn node_mut(&mut self, id: InstanceId) -> Option<&mut Node> {
        match &mut self.get_mut(id)?.body {
            Body::Node(node) => Some(node),
            Body::Marker(_) => None,
        }
    }

    pub(crate) fn node(&self, id: InstanceId) -> Option<&Node> {
        self.get(id).and_then(Instance::node)
    }

    /// Acquiring: the node has asked for its resources.
    pub(crate) fn acquire(&mut self, id: InstanceId, priority: i64) {
        if let Some(node) = self.node_mut(id) {
            node.status = Status::Acquiring { priority };
        }
    }

    /// Granted: the node has its resources, or needs none.
    pub(crate) fn grant(&mut self, id: InstanceId, lease: Option<Lease>, now: Timestamp) {
        if let Some(node) = self.node_mut(id) {
            let lease = lease.map(Box::new);
            node.status = Status::Granted(Held { lease, projection: None, since: now });
        }
    }

    /// Projecting: the node waits for its projection.
    pub(crate) fn project(&mut self, id: InstanceId) {
        if let Some(node) = self.node_mut(id) {
            let held = node.status.take_held();
            node.status = Status::Projecting(held);
        }
    }

    pub(crate) fn projected(&mut self, id: InstanceId, projection: ProjectionId) {
        if let Some(node) = self.node_mut(id) {
            let held = node.status.take_held();
            node.status = Status::Granted(Held { projection: Some(projection), ..held });
        }
    }

    /// Running: the goal, or the wait, begins now.
    pub(crate) fn run(&mut self, id: InstanceId, now: Timestamp) {
        if let Some(node) = self.node_mut(id) {
            let held = node.status.take_held();
            node.status = Status::Running(Held { since: now, ..held });
        }
    }

    /// Running, for a routine: its parts are under way; from now on the interpreter owns the lease.
    pub(crate) fn run_routine(&mut self, id: InstanceId, interpreter: Box<Interpreter>) {
        if let Some(node) = self.node_mut(id) {
            let since = node.status.since().unwrap_or_default();
            node.status = Status::RunningRoutine(interpreter, since);
        }
    }

    /// The interpreter of a routine under way.
    pub(crate) fn interpreter(&mut self, id: InstanceId) -> Option<&mut Interpreter> {
        match &mut self.node_mut(id)?.status {
            Status::RunningRoutine(interpreter, _) => Some(interpreter),
            _ => None,
        }
    }

    /// Takes the interpreter of a routine that ends. Its lease is still to be given back.
    pub(crate) fn end_routine(&mut self, id: InstanceId) -> Option<Box<Interpreter>> {
        let node = self.node_mut(id)?;
        match std::mem::replace(&mut node.status, Status::Expanded) {
            Status::RunningRoutine(interpreter, since) => {
                let lease = interpreter.lease().cloned().map(Box::new);
                node.status = Status::Running(Held { lease, projection: None, since });
                Some(interpreter)
            }
            other => {
                node.status = other;
                None
            }
        }
    }

    /// Takes what the node holds.
    pub(crate) fn take_held(&mut self, id: InstanceId) -> Held {
        self.node_mut(id).map(|node| node.status.take_held()).unwrap_or_default()
    }

    /// Keeps the answer of the node's goal for other instances with the same inputs.
    pub(crate) fn answer(&mut self, id: InstanceId, answer: Ended) {
        if let Some(node) = self.node_mut(id) {
            node.answer = Some(Box::new(answer));
        }
    }

    /// Replaces the result by a better one; nobody has used the outputs that differ.
    pub(crate) fn improve(&mut self, id: InstanceId, outputs: Outputs) {
        if let Some(Node { status: Status::Finished(ended), answer, .. }) = self.node_mut(id) {
            if let Some(answer) = answer {
                answer.outputs.clone_from(&outputs);
            }
            ended.outputs = outputs;
        }
    }

    /// The node begins again, as a new attempt; the facts of its earlier result stay known.
    pub(crate) fn begin_again(&mut self, id: InstanceId) {
        if let Some(node) = self.node_mut(id) {
            node.status = Status::Expanded;
            node.answer = None;
            node.attempt += 1;
        }
    }

    /// The node is tried again, not before a given time.
    pub(crate) fn try_again(&mut self, id: InstanceId, not_before: Timestamp) {
        self.begin_again(id);
        if let Some(node) = self.node_mut(id) {
            node.tries += 1;
            node.not_before = not_before;
        }
    }

    /// The count of tries begins again, because the inputs have changed. The sequential program counts tries at the node's place whatever they have
    /// seen.
    pub(crate) fn forget_tries(&mut self, id: InstanceId) {
        if let Some(node) = self.node_mut(id).filter(|node| !node.is_at_its_place) {
            node.tries = 1;
            node.not_before = Timestamp(0);
            // Only this instance has crashed on the mispredicted inputs.
            node.crashes = 0;
        }
    }

    /// The node has come to its place in the sequential program.
    pub(crate) fn come_to_its_place(&mut self, id: InstanceId) {
        if let Some(node) = self.node_mut(id) {
            node.is_at_its_place = true;
        }
    }

    /// The node is not at its place yet after all.
    pub(crate) fn leave_its_place(&mut self, id: InstanceId) {
        if let Some(node) = self.node_mut(id) {
            node.is_at_its_place = false;
        }
    }

    /// Counts a crash; returns the number of crashes so far.
    pub(crate) fn count_crash(&mut self, id: InstanceId) -> u32 {
        self.node_mut(id).map_or(0, |node| {
            node.crashes += 1;
            node.crashes
        })
    }

    /// Stores whether the goal was under way when the node ended.
    pub(crate) fn set_acted(&mut self, id: InstanceId, has_acted: bool) {
        if let Some(node) = self.node_mut(id) {
            node.has_acted = has_acted;
        }
    }
}

impl Status {
    /// Takes what the node holds; the caller replaces the status.
    fn take_held(&mut self) -> Held {
        match self {
            Status::Granted(held) | Status::Projecting(held) | Status::Running(held) => std::mem::take(held),
            _ => Held::default(),
        }
    }
}
