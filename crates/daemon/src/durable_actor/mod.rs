//! The one task that owns a durable state. It takes messages in order, expires what is due, and sends nothing before the records that
//! it depends on are on the disk. The resource manager and the world pool are both a [`Core`] in it.
//!
//! ```text
//!   inbox ──message──▶ Core (the state) ──records──▶ journal ──durable──▶ outbox ──▶ answers, watchers
//! ```
//! Changes of messages that arrive together are written together. When records cannot be written, every change is refused from then
//! on, and readers see the state that is on the disk. Nothing at all is sent unless this is confirmed to be the one writer
//! ([`may_speak`]), and no deadline counts the time in which the process was not running or was not allowed to send ([`clock`]).

mod actor;
mod clock;
mod inbox;
pub(crate) mod journal;
mod may_speak;
mod outbox;
#[cfg(test)]
pub(crate) mod slow_disk;
#[cfg(test)]
mod tests;
mod turn_context;
mod watchers;

pub(crate) use inbox::Handle;
pub(crate) use journal::{Journal, JournalError, Journaled, floor};
pub(crate) use may_speak::CONFIRMED_FOR;
pub(crate) use turn_context::TurnContext;

use actor::Actor;
use ratn_model::time::Timestamp;
use ratn_worker::vitals::Vitals;
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tonic::Status;

/// A state and its operations: everything that differs between the daemons.
pub(crate) trait Core: Sized + Send + 'static {
    /// The state that is kept over a restart.
    type State: Journaled;
    /// Requests of the service.
    type Message: Send + 'static;
    /// Requests that overtake every message.
    type Urgent: Send + 'static;
    /// What the state sends apart from answers; it waits for the disk like answers.
    type Said: Send + 'static;
    /// An update for watchers.
    type Update: Clone + Send + 'static;
    /// Input from outside of which only the newest value counts.
    type Signal: Send + Sync + 'static;

    /// The state that the journal writes.
    fn state(&mut self) -> &mut Self::State;

    /// The journal cannot be written any more: replaces the state by what the journal holds.
    ///
    /// # Errors
    /// Where the journal cannot be read either.
    fn restore(&mut self, journal: &Journal, context: &TurnContext<Self>) -> Result<(), JournalError>;

    /// When [`Core::advance`] is due.
    fn next_deadline(&self, context: &TurnContext<Self>) -> Option<Timestamp>;

    /// Expires what is due.
    fn advance(&mut self, context: &mut TurnContext<Self>);

    /// Handles a message. It is also called when nothing can be written any more ([`TurnContext::stopped`]): then nothing may change.
    fn receive(&mut self, message: Self::Message, context: &mut TurnContext<Self>);

    /// As [`Core::receive`], for an urgent message.
    fn receive_urgent(&mut self, urgent: Self::Urgent, context: &mut TurnContext<Self>);

    /// Handles the newest signal.
    fn signal(&mut self, signal: &Self::Signal, context: &mut TurnContext<Self>);

    /// Passes on what the state has to say since the last call ([`TurnContext::say`]), in order.
    fn collect(&mut self, context: &mut TurnContext<Self>);

    /// Sends `said`, whose records are on the disk now.
    fn hand_out(&mut self, said: Self::Said, context: &mut TurnContext<Self>);

    /// The disk cannot keep up. A message that would write more is answered with `status`; any other is returned.
    fn refuse(message: Self::Message, status: &Status) -> Option<Self::Message>;

    /// Puts messages that arrived together into another order.
    fn order(_messages: &mut [Self::Message]) {}

    /// Whether a message may change so much that it gets an entry of its own.
    fn is_large(_message: &Self::Message) -> bool {
        false
    }

    /// From now on no caller is made to wait.
    fn drain(&mut self, _desk: &mut TurnContext<Self>) {}

    /// A turn has ended.
    fn turned(&mut self, _desk: &mut TurnContext<Self>) {}
}

/// Starts the actor. `draining` tells everybody who waits to ask the successor; `over` ends the actor when everything is on the disk.
/// Its condition, a panic included, is in `vitals`.
///
/// # Errors
/// Where the thread that checks the writer's place cannot be started.
pub(crate) fn start<C: Core>(
    core: C,
    mut journal: Journal,
    signals: watch::Receiver<C::Signal>,
    vitals: Vitals,
    draining: CancellationToken,
    over: CancellationToken,
) -> Result<(Handle<C>, JoinHandle<()>), JournalError> {
    let may_speak = journal.may_speak(vitals.clone())?;
    let (handle, inbox) = inbox::open();
    let actor = Actor::new(core, journal, may_speak, vitals.clone());
    let running = async move {
        let _ = vitals.guard("the actor", actor.run(inbox, signals, draining, over)).await;
    };
    Ok((handle, tokio::spawn(running)))
}
