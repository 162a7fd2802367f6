//! The one task that owns a durable state: takes messages in order, ends what time has ended, and lets nothing out before the records
//! of what it tells of are on the disk. The resource manager and the world pool are both a [`Core`] in it.
//!
//! ```text
//!   inbox ──message──▶ Core (the state) ──records──▶ journal ──durable──▶ outbox ──▶ answers, watchers
//! ```
//! What came together is written down together. When records cannot be written, every change is refused from then on; what can be read
//! is the state that is on the disk. Nothing at all is said unless this is known to be the one writer ([`may_speak`]), and no deadline
//! counts the time in which the process was not running, or might say nothing ([`clock`]).

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

/// A state and what is done with it: everything that is not the same for every daemon.
pub(crate) trait Core: Sized + Send + 'static {
    /// What is kept over a restart.
    type State: Journaled;
    /// What the service asks.
    type Message: Send + 'static;
    /// What goes before every message.
    type Urgent: Send + 'static;
    /// What the state has to say beside answers; it waits for the disk as they do.
    type Said: Send + 'static;
    /// What watchers are told.
    type Update: Clone + Send + 'static;
    /// What is told from outside, of which only the newest counts.
    type Signal: Send + Sync + 'static;

    /// What the journal writes down.
    fn state(&mut self) -> &mut Self::State;

    /// The journal cannot be written any more: the state is what it holds.
    ///
    /// # Errors
    /// Where it cannot be read either.
    fn restore(&mut self, journal: &Journal, context: &TurnContext<Self>) -> Result<(), JournalError>;

    /// When [`Core::advance`] is due.
    fn next_deadline(&self, context: &TurnContext<Self>) -> Option<Timestamp>;

    /// Ends what time has ended.
    fn advance(&mut self, context: &mut TurnContext<Self>);

    /// One message. It also comes when nothing can be written any more ([`TurnContext::stopped`]): then nothing may change.
    fn receive(&mut self, message: Self::Message, context: &mut TurnContext<Self>);

    /// As [`Core::receive`], of what goes before every message.
    fn receive_urgent(&mut self, urgent: Self::Urgent, context: &mut TurnContext<Self>);

    /// The newest signal.
    fn signal(&mut self, signal: &Self::Signal, context: &mut TurnContext<Self>);

    /// Passes on what the state has to say since the last call ([`TurnContext::say`]), in order.
    fn collect(&mut self, context: &mut TurnContext<Self>);

    /// What was said is on the disk: it leaves.
    fn hand_out(&mut self, said: Self::Said, context: &mut TurnContext<Self>);

    /// The disk is behind. A message that would add to it is answered with `status`; one that would not comes back.
    fn refuse(message: Self::Message, status: &Status) -> Option<Self::Message>;

    /// Puts messages that arrived together into another order.
    fn order(_messages: &mut [Self::Message]) {}

    /// Whether a message may change so much that it is written down on its own.
    fn is_large(_message: &Self::Message) -> bool {
        false
    }

    /// Nobody is made to wait any more.
    fn drain(&mut self, _desk: &mut TurnContext<Self>) {}

    /// A turn has ended.
    fn turned(&mut self, _desk: &mut TurnContext<Self>) {}
}

/// Starts the actor. With `draining` whoever waits is told to ask the successor; with `over` it ends, when everything is on the disk.
/// How it is, also that it has panicked, is in the `vitals`.
///
/// # Errors
/// Where the thread cannot be started that watches the writer's place.
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
