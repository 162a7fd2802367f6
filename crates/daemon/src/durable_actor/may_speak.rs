//! May speak until: nothing leaves an actor unless it was confirmed a moment ago that it is the one writer of its state.
//!
//! A thread of its own looks whether the writer's place is still held, every [`CONFIRM_INTERVAL`], and never waits for a sync. Before
//! every answer the actor compares: the last look that found the place held began less than [`CONFIRMED_FOR`] (G) ago, or nothing
//! leaves. A process that was suspended finds its confirmation too old, before anything else that it does; so does one whose machine was
//! suspended ([`BootClock`]).
//!
//! Where the state directory cannot be looked at (permissions, a file system that hangs) nothing is confirmed either. The actor is
//! [`Speech::Held`] then, and its health says why until a look succeeds.
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
use ratn_worker::boot_clock::{BootClock, BootInstant};
use ratn_worker::vitals::{CoreFailure, Vitals};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::thread;
use std::time::Duration;
use tokio::sync::watch;

/// G: a confirmation holds for so long.
pub(crate) const CONFIRMED_FOR: Duration = Duration::from_secs(1);
/// The place is looked at so often.
const CONFIRM_INTERVAL: Duration = Duration::from_millis(250);

/// An actor that does not end for so long when its place is lost hangs: then its process ends without it.
const END_PATIENCE: Duration = Duration::from_secs(1);

/// What is known of the place.
#[derive(Debug, Clone)]
enum Confirmed {
    /// No look has found it held.
    NotYet,
    /// It was held at a look that began then.
    At(BootInstant),
    /// Somebody else has it.
    Lost(Fault),
}

/// What the looks have found.
#[derive(Debug, Clone)]
struct Found {
    confirmed: Confirmed,
    /// Why nothing is known since: what the system said to the last look.
    unseen: Option<Fault>,
}

/// What may be said now.
#[derive(Debug)]
pub(super) enum Speech {
    Allowed,
    /// Not for now: the last confirmation is too old. Why, as far as is known.
    Held(Option<Fault>),
    /// Never again.
    Over(Fault),
}

/// See the module. The thread ends with it.
#[derive(Debug)]
pub(super) struct MaySpeak {
    found: watch::Receiver<Found>,
    clock: BootClock,
    /// The actor gives its place up.
    loss_expected: Arc<AtomicBool>,
    _end: mpsc::Sender<()>,
}

impl MaySpeak {
    /// Looks at once, and from then on beside.
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
                        // An actor that takes its turns ends by itself.
                        let hangs = || matches!(ended.recv_timeout(END_PATIENCE), Err(mpsc::RecvTimeoutError::Timeout));
                        if hangs() {
                            let failure = failure_of(&lost);
                            failing.fail(failure.clone());
                            // With the actor its runtime may hang, and with that everything that could end the process.
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

    /// From now on the place may be given up by the actor itself, however long it takes it to end then: that is no failure.
    pub(super) fn expect_loss(&self) {
        self.loss_expected.store(true, Ordering::SeqCst);
    }

    /// Returns after the next look.
    pub(super) async fn changed(&mut self) {
        if self.found.changed().await.is_err() && !matches!(self.now(), Speech::Over(_)) {
            std::future::pending::<()>().await;
        }
    }
}

/// The end of a core whose place is lost.
pub(super) fn failure_of(lost: &Fault) -> CoreFailure {
    let what = lost.to_string();
    match lost {
        Fault::Deposed { .. } => CoreFailure::Deposed { what },
        _ => CoreFailure::Fenced { what },
    }
}

/// Nothing is known where the look itself fails.
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

    /// Lost from a moment on.
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
        // Until the thread has ended.
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
            // No look ends before the machine sleeps, and `Instant` does not see that it did.
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
