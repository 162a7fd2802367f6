//! Circumstances of a simulated run besides its providers: events from outside, messages that arrive late or twice, answers that
//! cross their cancellation.
//!
//! Faults depend on a seed and on the subject of the message (path and attempt), never on time: the same run has the same faults.

use crate::dice::Hash;
use ratn_executive::protocol::{Event, Learned};
use ratn_model::value::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::num::NonZeroUsize;

/// Default limit of the events of a run.
pub const MAX_EVENTS: usize = 1_000_000;

/// The circumstances of a run besides its providers.
#[derive(Debug, Clone, PartialEq)]
pub struct Circumstances {
    /// Number of orders that look-ahead simulates whenever much of the window has changed; 0 is plain dispatch.
    pub orders: usize,
    /// Limit of events.
    pub max_events: usize,
    /// Events from outside, with their triggers.
    pub events: Vec<(Trigger, Event)>,
    /// Faults of messages.
    pub mischief: Mischief,
    /// Checks after every event.
    pub checks: Checks,
    /// Whether to check, after the last event of every moment, that no instance was forgotten that could go on. The check uses a
    /// copy of the executive, so the run does not change.
    pub examines: bool,
    /// States whose acquires are always refused, by their paths without visits.
    pub refused: BTreeSet<String>,
    /// After this number of events the executive is replaced by a new one that is rebuilt from the log.
    pub resume_after: Option<usize>,
    /// What earlier runs have taught.
    pub learned: Learned,
    /// Attributes of the units of a kind, in order.
    pub attributes: BTreeMap<String, Vec<BTreeMap<String, Value>>>,
    /// After every so many events the executive is replaced by one that is restored from a checkpoint of it.
    pub checkpoint_every: Option<NonZeroUsize>,
}

/// The checks after every event of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
pub enum Checks {
    /// None: for predictions, which should be cheap.
    Nothing,
    /// That the resource pool keeps its invariants, and that the executive's mirror equals the root. Each check costs the whole
    /// pool.
    #[default]
    Environment,
    /// The executive's invariants, too. Each check costs the whole window.
    Everything,
}

impl Default for Circumstances {
    fn default() -> Circumstances {
        Circumstances {
            orders: 0,
            max_events: MAX_EVENTS,
            events: Vec::new(),
            mischief: Mischief::default(),
            checks: Checks::default(),
            examines: false,
            refused: BTreeSet::new(),
            resume_after: None,
            learned: Learned::default(),
            attributes: BTreeMap::new(),
            checkpoint_every: None,
        }
    }
}

/// The trigger of an event from outside.
#[derive(Debug, Clone, PartialEq)]
pub enum Trigger {
    /// Before the run begins.
    Before,
    /// This number of seconds after the start.
    At(f64),
    /// When a goal of this path starts.
    Starts(String),
    /// When a goal of this path has ended.
    Ends(String),
}

/// Faults of messages, in percent.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Mischief {
    /// The random seed.
    pub seed: u64,
    /// Messages that arrive twice.
    pub twice_percent: u64,
    /// Messages that arrive up to two seconds late.
    pub late_percent: u64,
    /// Answers that arrive although their goal was cancelled.
    pub crossing_percent: u64,
}

/// The delivery of one message.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Delivery {
    /// Its delay in seconds.
    pub(super) late_s: f64,
    /// The further delay in seconds of a second copy.
    pub(super) again_s: Option<f64>,
}

impl Mischief {
    /// The delivery of the message of this kind about an attempt.
    pub(super) fn delivery(&self, kind: &str, path: &str, attempt: u32) -> Delivery {
        if self.twice_percent == 0 && self.late_percent == 0 {
            return Delivery::default();
        }
        let mut dice = self.dice(kind, path, attempt);
        let late_s = if dice.percent(self.late_percent) { dice.below(20) as f64 / 10.0 } else { 0.0 };
        let again_s = dice.percent(self.twice_percent).then(|| dice.below(80) as f64 / 10.0);
        Delivery { late_s, again_s }
    }

    /// Whether a cancelled attempt is still answered.
    pub(super) fn crosses(&self, path: &str, attempt: u32) -> bool {
        self.crossing_percent > 0 && self.dice("cancel", path, attempt).percent(self.crossing_percent)
    }

    fn dice(&self, kind: &str, path: &str, attempt: u32) -> crate::dice::Dice {
        let mut hash = Hash(self.seed);
        hash.add(kind);
        hash.add(path);
        hash.add_number(u64::from(attempt));
        hash.dice()
    }
}
