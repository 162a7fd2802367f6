//! The outbox: replies are held back until their records are on the disk, and are sent in order.
//!
//! An answer waits for the last entry written before the answer was made, even when its request changed nothing: the answer may
//! show what other requests changed.

use ratn_storage::Position;
use std::collections::VecDeque;
use tokio::sync::oneshot;
use tonic::Status;

/// With this many replies held back an actor accepts no new work: the disk cannot keep up.
pub(super) const MOST_HELD: usize = 16_384;

/// Sends an answer, or a status instead of it.
pub(super) type SendAnswer = Box<dyn FnOnce(Option<&Status>) + Send>;

/// An answer that can be held back until the records that it depends on are on the disk, or are known to be lost.
pub(super) fn send_answer<T: Send + 'static>(
    answer: oneshot::Sender<Result<T, Status>>,
    result: Result<T, Status>,
) -> SendAnswer {
    Box::new(move |refused| drop(answer.send(refused.map_or(result, |status| Err(status.clone())))))
}

/// Replies in the order in which they are sent.
#[derive(Debug)]
pub(super) struct Outbox<T> {
    held: VecDeque<(Position, T)>,
}

impl<T> Outbox<T> {
    /// Queues a reply behind all others.
    pub(super) fn hold(&mut self, position: Position, outgoing: T) {
        self.held.push_back((position, outgoing));
    }

    /// The position for which the first reply waits.
    pub(super) fn waits_for(&self) -> Option<Position> {
        self.held.front().map(|(position, _)| *position)
    }

    pub(super) fn take(&mut self) -> Option<T> {
        self.held.pop_front().map(|(_, outgoing)| outgoing)
    }

    pub(super) fn take_all(&mut self) -> Vec<T> {
        std::mem::take(&mut self.held).into_iter().map(|(_, outgoing)| outgoing).collect()
    }

    pub(super) fn is_full(&self) -> bool {
        self.held.len() >= MOST_HELD
    }
}

impl<T> Default for Outbox<T> {
    fn default() -> Outbox<T> {
        Outbox { held: VecDeque::new() }
    }
}
