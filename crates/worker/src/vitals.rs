//! The condition of a daemon's core, as the core reports it: whether it takes its turns, whether it can do its work, and why it has ended.
//!
//! ```text
//!   core ── beat, at every turn ──────────▶ systemd's watchdog (a core that hangs does not beat)
//!        ── unwell / well ────────────────▶ gRPC health, systemd's status
//!        ── fail (panicked, fenced) ──────▶ serving ends at once, the process exits with its own code
//! ```
//! Clones share one condition.

use std::any::Any;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use tokio::sync::watch;

/// The exit code of a daemon whose core has ended by a defect (`EX_SOFTWARE` of `sysexits.h`).
pub const EXIT_CODE_PANICKED: u8 = 70;
/// The exit code of a daemon whose state another process has taken over (`EX_IOERR` of `sysexits.h`).
pub const EXIT_CODE_FENCED: u8 = 74;
/// The exit code of a daemon that has lost the leadership to another one (`EX_TEMPFAIL` of `sysexits.h`): started again, it stands by.
pub const EXIT_CODE_DEPOSED: u8 = 75;

/// Why a core has ended early.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CoreFailure {
    /// A defect of the program: a panic.
    #[error("{part} has ended by a defect, and the process with it: {what}; please report it")]
    Panicked {
        /// The part of the process.
        part: String,
        /// The message of the panic.
        what: String,
    },
    /// Another process has taken over the state. This process answers no more calls, and ends.
    #[error("{what}")]
    Fenced {
        /// The state, and advice.
        what: String,
    },
    /// Another process leads, which is normal if several share a state. This process answers no more calls, and ends.
    #[error("{what}")]
    Deposed {
        /// The state.
        what: String,
    },
}

impl CoreFailure {
    /// The failure of a part whose panic was caught.
    pub fn of_panic(part: &str, panic: &(dyn Any + Send)) -> CoreFailure {
        let text = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
        let what = text.or_else(|| panic.downcast_ref::<String>().cloned()).unwrap_or_else(|| "it panicked".to_owned());
        CoreFailure::Panicked { part: part.to_owned(), what }
    }

    /// The exit code of the process.
    pub fn exit_code(&self) -> u8 {
        match self {
            CoreFailure::Panicked { .. } => EXIT_CODE_PANICKED,
            CoreFailure::Fenced { .. } => EXIT_CODE_FENCED,
            CoreFailure::Deposed { .. } => EXIT_CODE_DEPOSED,
        }
    }
}

/// The condition of a core.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Condition {
    /// Why the core cannot do its work. It still answers the calls that it can.
    pub unwell: Option<String>,
    /// Why the core has ended. The first reason stays.
    pub failure: Option<CoreFailure>,
}

/// See the module.
#[derive(Debug, Clone, Default)]
pub struct Vitals(Arc<Inner>);

#[derive(Debug, Default)]
struct Inner {
    beats: AtomicU64,
    beating: AtomicBool,
    condition: watch::Sender<Condition>,
}

impl Vitals {
    /// Records a turn of the core. From the first beat on, the watchdog expects more.
    pub fn beat(&self) {
        self.0.beats.fetch_add(1, Ordering::Relaxed);
        self.0.beating.store(true, Ordering::Relaxed);
    }

    /// The number of beats; `None` for a process whose core does not beat.
    pub fn beats(&self) -> Option<u64> {
        self.0.beating.load(Ordering::Relaxed).then(|| self.0.beats.load(Ordering::Relaxed))
    }

    /// Reports that the core cannot do its work.
    pub fn unwell(&self, why: impl Into<String>) {
        let why = Some(why.into());
        self.0.condition.send_if_modified(|condition| {
            let news = condition.unwell != why;
            condition.unwell = why;
            news
        });
    }

    /// Reports that the core can do its work again.
    pub fn well(&self) {
        self.0.condition.send_if_modified(|condition| condition.unwell.take().is_some());
    }

    /// Reports that the core has ended.
    pub fn fail(&self, failure: CoreFailure) {
        tracing::error!(%failure, "the process ends");
        self.0.condition.send_if_modified(|condition| {
            let first = condition.failure.is_none();
            condition.failure.get_or_insert(failure);
            first
        });
    }

    /// The condition, and every change of it.
    pub fn condition(&self) -> watch::Receiver<Condition> {
        self.0.condition.subscribe()
    }

    /// Resolves when the core has ended early.
    pub async fn failed(&self) -> CoreFailure {
        let mut condition = self.condition();
        let failed =
            condition.wait_for(|condition| condition.failure.is_some()).await.map(|found| found.failure.clone());
        match failed.ok().flatten() {
            Some(failure) => failure,
            // All senders are gone.
            None => std::future::pending().await,
        }
    }

    /// Performs `work`. A panic in it ends the core.
    pub async fn guard<T>(&self, part: &str, work: impl Future<Output = T>) -> Option<T> {
        use futures::FutureExt;
        match std::panic::AssertUnwindSafe(work).catch_unwind().await {
            Ok(done) => Some(done),
            Err(panic) => {
                self.fail(CoreFailure::of_panic(part, &*panic));
                None
            }
        }
    }

    /// As [`Vitals::guard`], for work that blocks its thread.
    pub fn guard_blocking<T>(&self, part: &str, work: impl FnOnce() -> T) -> Option<T> {
        match std::panic::catch_unwind(std::panic::AssertUnwindSafe(work)) {
            Ok(done) => Some(done),
            Err(panic) => {
                self.fail(CoreFailure::of_panic(part, &*panic));
                None
            }
        }
    }
}
