//! Permission to speak: an actor sends nothing unless it was confirmed a moment ago that it is the one writer of its state.
//!
//! A separate thread checks whether the writer still holds its place, every [`CONFIRM_INTERVAL`], and never waits for a sync. Before every
//! answer the actor checks that the last successful check began less than [`CONFIRMED_FOR`] (G) ago; otherwise nothing is sent. A process
//! that was suspended finds its confirmation too old before it does anything else; so does a process whose machine was suspended
//! ([`BootClock`]).
//!
//! Where the state directory cannot be checked (permissions, a file system that hangs) nothing is confirmed either. The actor is
//! [`Speech::Held`] then, and its health says why until a check succeeds.
//!
//! # Why a predecessor does no harm
//!
//! Let a successor take the place at T. Every check of the predecessor that begins after T fails, so the predecessor sends nothing after
//! T + G.
//!
//! - *Sessions.* A client trusts its session until the time at which it sent its last answered ping, plus the time to live (TTL). The
//!   predecessor answers no ping that was sent after T + G, so no client trusts it beyond T + G + TTL. The successor restores the session
//!   at T or later, and lets it expire no earlier than G + TTL after that ([`ratn_resources::Pool::with_session_grace`]). An answer that is
//!   delayed on its way promises no more: the time counts from the ping.
//! - *Grants, closed sessions, changed times to live.* They are sent when they are on the disk, and whatever is acknowledged there was so
//!   before T (the log checks the place after every sync): the successor has read it.
//! - *Lists and watches* report what was on the disk before T. A client that moves something because of the predecessor's answer does so
//!   for at most G after T, under a lease that the successor knows, too, and does not give to another client before its session has ended.

use ratn_panic_point::panic_point;
use ratn_storage::{Fault, Place};
use ratn_worker::boot_clock::{BootClock, BootInstant};
use ratn_worker::vitals::{CoreFailure, Vitals};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::thread;
use std::time::Duration;
use tokio::sync::watch;

/// G: how long a confirmation is valid.
pub(crate) const CONFIRMED_FOR: Duration = Duration::from_secs(1);
/// Interval between two checks of the place.
const CONFIRM_INTERVAL: Duration = Duration::from_millis(250);

/// An actor that has not ended this long after it lost its place hangs: then its process is ended without it.
const END_PATIENCE: Duration = Duration::from_secs(1);

/// Result of the checks of the place.
#[derive(Debug, Clone)]
enum Confirmed {
    /// No check has succeeded yet.
    NotYet,
    /// The place was held, by a check that began at this instant.
    At(BootInstant),
    /// Another process has the place.
    Lost(Fault),
}

/// What the checks have found.
#[derive(Debug, Clone)]
struct Found {
    confirmed: Confirmed,
    /// Error of the last check, where it failed and nothing is known since.
    unseen: Option<Fault>,
}

/// Whether the actor may send now.
#[derive(Debug)]
pub(super) enum Speech {
    Allowed,
    /// Not for now: the last confirmation is too old. The reason, as far as it is known.
    Held(Option<Fault>),
    /// Never again.
    Over(Fault),
}

/// See the module. Dropping this ends the thread.
#[derive(Debug)]
pub(super) struct MaySpeak {
    found: watch::Receiver<Found>,
    clock: BootClock,
    /// The actor is giving up its place.
    loss_expected: Arc<AtomicBool>,
    _end: mpsc::Sender<()>,
}

impl MaySpeak {
    /// Checks at once, and from then on in a thread.
    pub(super) fn begin(place: Box<dyn Place>, vitals: Vitals) -> std::io::Result<MaySpeak> {
        MaySpeak::begin_by(BootClock::default(), place, vitals)
    }

    fn begin_by(clock: BootClock, place: Box<dyn Place>, vitals: Vitals) -> std::io::Result<MaySpeak> {
        let first = match look(&clock, &*place) {
            Ok(confirmed) => Found { confirmed, unseen: None },
            Err(fault) => Found { confirmed: Confirmed::NotYet, unseen: Some(fault) },
        };
        let (tell, found) = watch::channel(first);
        let (end, ended) = mpsc::channel::<()>();
        let (looking, failing) = (clock.clone(), vitals.clone());
        let loss_expected = Arc::<AtomicBool>::default();
        let expected = loss_expected.clone();
        let keep = move || {
            while let Err(mpsc::RecvTimeoutError::Timeout) = ended.recv_timeout(CONFIRM_INTERVAL) {
                panic_point("may-speak");
                match look(&looking, &*place) {
                    Ok(confirmed) => {
                        let lost = match &confirmed {
                            Confirmed::Lost(fault) => Some(fault.clone()),
                            Confirmed::NotYet | Confirmed::At(_) => None,
                        };
                        tell.send_replace(Found { confirmed, unseen: None });
                        let Some(lost) = lost else { continue };
                        if expected.load(Ordering::SeqCst) {
                            return;
                        }
                        // An actor that still takes turns ends by itself.
                        let hangs = || matches!(ended.recv_timeout(END_PATIENCE), Err(mpsc::RecvTimeoutError::Timeout));
                        if hangs() {
                            let failure = failure_of(&lost);
                            failing.fail(failure.clone());
                            // The runtime may hang together with the actor, and with it everything else that could end the process.
                            if hangs() {
                                std::process::exit(failure.exit_code().into());
                            }
                        }
                        return;
                    }
                    Err(fault) => tell.send_modify(|found| found.unseen = Some(fault)),
                }
            }
        };
        thread::Builder::new()
            .name("may-speak".to_owned())
            .spawn(move || vitals.guard_blocking("the watch of its place", keep))?;
        Ok(MaySpeak { found, clock, loss_expected, _end: end })
    }

    pub(super) fn now(&self) -> Speech {
        let found = self.found.borrow();
        match &found.confirmed {
            Confirmed::At(began) if self.clock.now() < *began + CONFIRMED_FOR => Speech::Allowed,
            Confirmed::At(_) | Confirmed::NotYet => Speech::Held(found.unseen.clone()),
            Confirmed::Lost(fault) => Speech::Over(fault.clone()),
        }
    }

    /// From now on the actor may give up its place itself: the loss is no failure, however long the actor takes to end.
    pub(super) fn expect_loss(&self) {
        self.loss_expected.store(true, Ordering::SeqCst);
    }

    /// Returns after the next check.
    pub(super) async fn changed(&mut self) {
        if self.found.changed().await.is_err() && !matches!(self.now(), Speech::Over(_)) {
            std::future::pending::<()>().await;
        }
    }
}

/// The failure of a core that has lost its place.
pub(super) fn failure_of(lost: &Fault) -> CoreFailure {
    let what = lost.to_string();
    match lost {
        Fault::Deposed { .. } => CoreFailure::Deposed { what },
        _ => CoreFailure::Fenced { what },
    }
}

/// An error says that the check itself failed: nothing is known.
fn look(clock: &BootClock, place: &dyn Place) -> Result<Confirmed, Fault> {
    let began = clock.now();
    match place.check() {
        Ok(()) => Ok(Confirmed::At(began)),
        Err(fault) if fault.is_lost_place() => Ok(Confirmed::Lost(fault)),
        Err(fault) => Err(fault),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use std::sync::Mutex;

    /// A file system that hangs while a test holds the lock.
    #[derive(Debug)]
    struct HangingPlace(Arc<Mutex<()>>);

    impl Place for HangingPlace {
        fn check(&self) -> Result<(), Fault> {
            drop(self.0.lock().unwrap());
            Ok(())
        }
    }

    /// A place that is lost from a moment on.
    #[derive(Debug)]
    struct GivenUp(Arc<AtomicBool>);

    impl Place for GivenUp {
        fn check(&self) -> Result<(), Fault> {
            match self.0.load(Ordering::SeqCst) {
                true => Err(Fault::Deposed { place: "a test".to_owned() }),
                false => Ok(()),
            }
        }
    }

    #[tokio::test]
    async fn a_place_that_the_actor_gives_up_itself_is_no_failure_however_long_it_takes_to_end() {
        let (given_up, vitals) = (Arc::<AtomicBool>::default(), Vitals::default());
        let mut speech = MaySpeak::begin(Box::new(GivenUp(given_up.clone())), vitals.clone()).unwrap();
        speech.expect_loss();
        given_up.store(true, Ordering::SeqCst);
        // Waits until the thread has ended.
        while speech.found.changed().await.is_ok() {}
        assert!(matches!(speech.now(), Speech::Over(_)));
        assert_eq!(vitals.condition().borrow().failure, None);
    }

    #[tokio::test]
    async fn a_machine_that_wakes_up_says_nothing_before_the_next_look() {
        let (hangs, clock) = (Arc::new(Mutex::new(())), BootClock::suspendable());
        let place = Box::new(HangingPlace(hangs.clone()));
        let mut speech = MaySpeak::begin_by(clock.clone(), place, Vitals::default()).unwrap();
        {
            // No check ends before the machine sleeps, and `Instant` does not count the time asleep.
            let _hanging = hangs.lock().unwrap();
            clock.suspend(CONFIRMED_FOR);
            assert!(matches!(speech.now(), Speech::Held(None)));
        }
        while !matches!(speech.now(), Speech::Allowed) {
            speech.changed().await;
        }
    }

    #[tokio::test]
    async fn nothing_is_said_while_a_look_hangs_and_again_when_it_has_ended() {
        let hangs = Arc::new(Mutex::new(()));
        let mut speech = MaySpeak::begin(Box::new(HangingPlace(hangs.clone())), Vitals::default()).unwrap();
        assert!(matches!(speech.now(), Speech::Allowed));
        {
            let _hanging = hangs.lock().unwrap();
            while !matches!(speech.now(), Speech::Held(None)) {
                thread::yield_now();
            }
        }
        while !matches!(speech.now(), Speech::Allowed) {
            speech.changed().await;
        }
    }
}
