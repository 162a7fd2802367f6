//! How a daemon's core is, as the core itself says: whether it takes its turns, whether it can do what it is for, and why it has ended.
//!
//! ```text
//!   core ── beat, at every turn ──────────▶ systemd's watchdog (a core that hangs is silent)
//!        ── unwell / well ────────────────▶ gRPC health, systemd's status
//!        ── fail (panicked, fenced) ──────▶ serving ends at once, the process with a code of its own
//! ```
//! Clones are the same.

use std::any::Any;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use tokio::sync::watch;

/// The exit code of a daemon whose core has ended by a defect (`EX_SOFTWARE` of `sysexits.h`).
pub const EXIT_CODE_PANICKED: u8 = 70;
/// The exit code of a daemon whose state another process has taken over (`EX_IOERR` of `sysexits.h`).
pub const EXIT_CODE_FENCED: u8 = 74;

/// Why a core has ended before its time.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CoreFailure {
    /// By a defect.
    #[error("{part} has ended by a defect, and the process with it: {what}; please report it")]
    Panicked {
        /// What of the daemon.
        part: String,
        /// What the panic said.
        what: String,
    },
    /// Another process has its state. It says nothing more, and ends.
    #[error("{what}")]
    Fenced {
        /// Which state, and what to do.
        what: String,
    },
}

impl CoreFailure {
    /// Of a panic that was caught.
    pub fn of_panic(part: &str, panic: &(dyn Any + Send)) -> CoreFailure {
        let text = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
        let what = text.or_else(|| panic.downcast_ref::<String>().cloned()).unwrap_or_else(|| "it panicked".to_owned());
        CoreFailure::Panicked { part: part.to_owned(), what }
    }

    /// What the process ends with.
    pub fn exit_code(&self) -> u8 {
        match self {
            CoreFailure::Panicked { .. } => EXIT_CODE_PANICKED,
            CoreFailure::Fenced { .. } => EXIT_CODE_FENCED,
        }
    }
}

/// What is known of a core.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Condition {
    /// Why it cannot do what it is for; it is served all the same, for what it still can.
    pub unwell: Option<String>,
    /// Why it has ended. The first reason stays.
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
    /// The core takes its turn. From the first beat on others are waited for.
    pub fn beat(&self) {
        self.0.beats.fetch_add(1, Ordering::Relaxed);
        self.0.beating.store(true, Ordering::Relaxed);
    }

    /// How often it did; nothing for a process that has no core that beats.
    pub fn beats(&self) -> Option<u64> {
        self.0.beating.load(Ordering::Relaxed).then(|| self.0.beats.load(Ordering::Relaxed))
    }

    /// It cannot do what it is for.
    pub fn unwell(&self, why: impl Into<String>) {
        let why = Some(why.into());
        self.0.condition.send_if_modified(|condition| {
            let news = condition.unwell != why;
            condition.unwell = why;
            news
        });
    }

    /// It can again.
    pub fn well(&self) {
        self.0.condition.send_if_modified(|condition| condition.unwell.take().is_some());
    }

    /// It has ended.
    pub fn fail(&self, failure: CoreFailure) {
        tracing::error!(%failure, "the process ends");
        self.0.condition.send_if_modified(|condition| {
            let first = condition.failure.is_none();
            condition.failure.get_or_insert(failure);
            first
        });
    }

    /// How it is, and every change of it.
    pub fn condition(&self) -> watch::Receiver<Condition> {
        self.0.condition.subscribe()
    }

    /// Resolves when it has ended before its time.
    pub async fn failed(&self) -> CoreFailure {
        let mut condition = self.condition();
        let failed =
            condition.wait_for(|condition| condition.failure.is_some()).await.map(|found| found.failure.clone());
        match failed.ok().flatten() {
            Some(failure) => failure,
            // Nobody can say so any more.
            None => std::future::pending().await,
        }
    }

    /// Does `work`; a panic in it is the core's end.
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

    /// As [`Vitals::guard`], of what blocks.
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
