//! The inbox of the actor. Urgent messages overtake all others.

use super::Core;
use crate::details::ending;
use futures::FutureExt;
use std::fmt;
use tokio::sync::{mpsc, oneshot};
use tokio::task::coop::unconstrained;
use tonic::Status;

/// Capacity for messages to the actor; beyond it senders wait.
const INBOX: usize = 1_024;
/// Capacity for urgent messages.
const URGENT: usize = 1_024;

/// The receiving ends of the inbox.
pub(super) struct Inbox<C: Core> {
    pub(super) messages: mpsc::Receiver<C::Message>,
    pub(super) urgent: mpsc::Receiver<C::Urgent>,
}

/// Sends messages to the actor.
pub(crate) struct Handle<C: Core> {
    messages: mpsc::Sender<C::Message>,
    urgent: mpsc::Sender<C::Urgent>,
}

pub(super) fn open<C: Core>() -> (Handle<C>, Inbox<C>) {
    let (sender, messages) = mpsc::channel(INBOX);
    let (urgent_sender, urgent) = mpsc::channel(URGENT);
    (Handle { messages: sender, urgent: urgent_sender }, Inbox { messages, urgent })
}

impl<C: Core> Handle<C> {
    /// Sends a message and waits for the answer.
    pub(crate) async fn ask<T>(&self, message: impl FnOnce(oneshot::Sender<T>) -> C::Message) -> Result<T, Status> {
        let (answer, answered) = oneshot::channel();
        self.send(message(answer)).await?;
        answered.await.map_err(|_| ending())
    }

    /// As [`Handle::ask`], where the answer may be a refusal.
    pub(crate) async fn request<T>(
        &self,
        message: impl FnOnce(oneshot::Sender<Result<T, Status>>) -> C::Message,
    ) -> Result<T, Status> {
        self.ask(message).await?
    }

    /// As [`Handle::ask`], for an urgent message.
    pub(crate) async fn ask_urgently<T>(
        &self,
        urgent: impl FnOnce(oneshot::Sender<T>) -> C::Urgent,
    ) -> Result<T, Status> {
        let (answer, answered) = oneshot::channel();
        self.urgent.send(urgent(answer)).await.map_err(|_| ending())?;
        answered.await.map_err(|_| ending())
    }

    pub(crate) async fn send(&self, message: C::Message) -> Result<(), Status> {
        self.messages.send(message).await.map_err(|_| ending())
    }

    /// Sends a message from a place that cannot wait. If the inbox is full, messages that are sent later may overtake it.
    pub(crate) fn send_later(&self, message: C::Message) {
        if let Err(mpsc::error::TrySendError::Full(message)) = self.messages.try_send(message) {
            let messages = self.messages.clone();
            let mut sending = Box::pin(unconstrained(async move { messages.send(message).await }));
            // Polled once here, to queue for room now: the spawned task may run after later messages are sent.
            if sending.as_mut().now_or_never().is_none() {
                tokio::spawn(sending);
            }
        }
    }
}

impl<C: Core> Clone for Handle<C> {
    fn clone(&self) -> Handle<C> {
        Handle { messages: self.messages.clone(), urgent: self.urgent.clone() }
    }
}

impl<C: Core> fmt::Debug for Handle<C> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Handle").finish_non_exhaustive()
    }
}
