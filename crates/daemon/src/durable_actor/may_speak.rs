//! May speak until: nothing leaves an actor unless it was confirmed a moment ago that it is the one writer of its state.
//!
//! A thread of its own looks whether the writer's place is still held, every [`CONFIRM_INTERVAL`], and never waits for a sync. Before
//! every answer the actor compares: the last look that found the place held began less than [`CONFIRMED_FOR`] (G) ago, or nothing
//! leaves. A process that was suspended finds its confirmation too old, before anything else that it does.
//!
//! # Why a predecessor does no harm
//!
//! Let a successor take the place at T. Every look of the predecessor that began after T fails, so it says nothing after T + G.
//!
//! - *Sessions.* A client believes in its session until its ping was asked plus the time to live. The predecessor answers no ping
//!   that was asked after T + G, so nobody believes in it beyond T + G + TTL. The successor restores the session at T or later, and
//!   lets it expire no earlier than G + TTL after that ([`ratn_resources::Pool::with_session_grace`]). An answer that is delayed on its way
//!   promises no more: it counts from its question.
//! - *Grants, closed sessions, changed times to live.* They leave when they are on the disk, and what is acknowledged there was so
//!   before T (the log looks at the place after every sync): the successor has read it.
//! - *Lists and watches* tell of what was on the disk before T. Who moves something by what the predecessor said does so for at most
//!   G after T, under a lease that the successor has, too, and does not give to another before its session has ended.

use ratn_panic_point::panic_point;
use ratn_storage::{Fault, Place};
use ratn_worker::vitals::Vitals;
use std::sync::mpsc;
use std::thread;
use std::time::{Duration, Instant};
use tokio::sync::watch;

/// G: a confirmation holds for so long.
pub(crate) const CONFIRMED_FOR: Duration = Duration::from_secs(1);
/// The place is looked at so often.
const CONFIRM_INTERVAL: Duration = Duration::from_millis(250);

/// What is known of the place.
#[derive(Debug, Clone)]
enum Confirmed {
    /// No look has found it held.
    NotYet,
    /// It was held at a look that began then.
    At(Instant),
    /// Somebody else has it.
    Lost(Fault),
}

/// What may be said now.
#[derive(Debug)]
pub(super) enum Speech {
    Allowed,
    /// Not for now: the last confirmation is too old.
    Held,
    /// Never again.
    Over(Fault),
}

/// See the module. The thread ends with it.
#[derive(Debug)]
pub(super) struct MaySpeak {
    confirmed: watch::Receiver<Confirmed>,
    _end: mpsc::Sender<()>,
}

impl MaySpeak {
    /// Looks at once, and from then on beside.
    pub(super) fn begin(place: Box<dyn Place>, vitals: Vitals) -> std::io::Result<MaySpeak> {
        let (confirm, confirmed) = watch::channel(look(&*place).unwrap_or(Confirmed::NotYet));
        let (end, ended) = mpsc::channel::<()>();
        let keep = move || {
            while let Err(mpsc::RecvTimeoutError::Timeout) = ended.recv_timeout(CONFIRM_INTERVAL) {
                panic_point("may-speak");
                match look(&*place) {
                    Ok(found) => {
                        let over = matches!(found, Confirmed::Lost(_));
                        confirm.send_replace(found);
                        if over {
                            return;
                        }
                    }
                    Err(fault) => {
                        tracing::warn!(%fault, "it cannot be seen who has this state: nothing is said until it can")
                    }
                }
            }
        };
        thread::Builder::new()
            .name("may-speak".to_owned())
            .spawn(move || vitals.guard_blocking("the watch of its place", keep))?;
        Ok(MaySpeak { confirmed, _end: end })
    }

    pub(super) fn now(&self) -> Speech {
        match &*self.confirmed.borrow() {
            Confirmed::At(began) if began.elapsed() < CONFIRMED_FOR => Speech::Allowed,
            Confirmed::At(_) | Confirmed::NotYet => Speech::Held,
            Confirmed::Lost(fault) => Speech::Over(fault.clone()),
        }
    }

    /// Returns at the next confirmation.
    pub(super) async fn changed(&mut self) {
        if self.confirmed.changed().await.is_err() && !matches!(self.now(), Speech::Over(_)) {
            std::future::pending::<()>().await;
        }
    }
}

/// Nothing is known where the look itself fails.
fn look(place: &dyn Place) -> Result<Confirmed, Fault> {
    let began = Instant::now();
    match place.check() {
        Ok(()) => Ok(Confirmed::At(began)),
        Err(fault) if fault.is_lost_place() => Ok(Confirmed::Lost(fault)),
        Err(fault) => Err(fault),
    }
}
