//! The life of a node: the changes of its status, each with what the status owns.

use super::Graph;
use super::instance::{Body, Held, Instance, Node, Status};
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

    /// It has asked for its resources.
    pub(crate) fn acquire(&mut self, id: InstanceId, priority: i64) {
        if let Some(node) = self.node_mut(id) {
            node.status = Status::Acquiring { priority };
        }
    }

    /// It has its resources, or needs none.
    pub(crate) fn grant(&mut self, id: InstanceId, lease: Option<Lease>, now: Timestamp) {
        if let Some(node) = self.node_mut(id) {
            let lease = lease.map(Box::new);
            node.status = Status::Granted(Held { lease, projection: None, since: now });
        }
    }

    /// It waits for its projection.
    pub(crate) fn project(&mut self, id: InstanceId) {
        if let Some(node) = self.node_mut(id) {
            let held = node.status.take_held();
            node.status = Status::Projecting(held);
        }
    }

    /// It has its projection.
    pub(crate) fn projected(&mut self, id: InstanceId, projection: ProjectionId) {
        if let Some(node) = self.node_mut(id) {
            let held = node.status.take_held();
            node.status = Status::Granted(Held { projection: Some(projection), ..held });
        }
    }

    /// Its goal is under way.
    pub(crate) fn run(&mut self, id: InstanceId) {
        if let Some(node) = self.node_mut(id) {
            let held = node.status.take_held();
            node.status = Status::Running(held);
        }
    }

    /// What it contains is under way; the lease is the interpreter's from now on.
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

    /// A routine has ended, or is ended: its interpreter. What it held is still to be given back.
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

    /// What it held, which it does not hold any more.
    pub(crate) fn take_held(&mut self, id: InstanceId) -> Held {
        self.node_mut(id).map(|node| node.status.take_held()).unwrap_or_default()
    }

    /// Its result is a better one, of which nobody has used what is otherwise.
    pub(crate) fn improve(&mut self, id: InstanceId, outputs: Outputs) {
        if let Some(Node { status: Status::Finished(ended), .. }) = self.node_mut(id) {
            ended.outputs = outputs;
        }
    }

    /// It begins again, as another attempt; what it was made of stays known.
    pub(crate) fn begin_again(&mut self, id: InstanceId) {
        if let Some(node) = self.node_mut(id) {
            node.status = Status::Expanded;
            node.attempt += 1;
        }
    }

    /// It is tried again, not before a moment.
    pub(crate) fn try_again(&mut self, id: InstanceId, not_before: Timestamp) {
        self.begin_again(id);
        if let Some(node) = self.node_mut(id) {
            node.tries += 1;
            node.not_before = not_before;
        }
    }

    /// Its tries begin again: it is made of something else now.
    pub(crate) fn forget_tries(&mut self, id: InstanceId) {
        if let Some(node) = self.node_mut(id) {
            node.tries = 1;
            // Of what only a prediction made of it nobody else knows.
            node.crashes = 0;
        }
    }

    /// Its worker died once more: how often by now.
    pub(crate) fn count_crash(&mut self, id: InstanceId) -> u32 {
        self.node_mut(id).map_or(0, |node| {
            node.crashes += 1;
            node.crashes
        })
    }

    /// Whether its goal was under way when it ended.
    pub(crate) fn set_acted(&mut self, id: InstanceId, has_acted: bool) {
        if let Some(node) = self.node_mut(id) {
            node.has_acted = has_acted;
        }
    }
}

impl Status {
    /// What it held; the status is to be replaced.
    fn take_held(&mut self) -> Held {
        match self {
            Status::Granted(held) | Status::Projecting(held) | Status::Running(held) => std::mem::take(held),
            _ => Held::default(),
        }
    }
}
