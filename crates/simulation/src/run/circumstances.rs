//! Circumstances of a simulated run besides its providers: what a user asks for, messages that come late or twice, answers that
//! cross their cancellation.
//!
//! Which messages go wrong follows from a seed and from what they are about (path and attempt), never from the time: the same
//! run has the same faults.

use crate::dice::Hash;
use ratn_executive::protocol::{Event, Learned};
use ratn_model::value::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::num::NonZeroUsize;

/// More events than this is an endless run.
pub const MAX_EVENTS: usize = 1_000_000;

/// What happens to a run beside what its providers do.
#[derive(Debug, Clone, PartialEq)]
pub struct Circumstances {
    /// So many orders of what is still to be done are simulated whenever much of the window has changed; 0 is plain dispatch.
    pub orders: usize,
    /// More events than this is an endless run.
    pub max_events: usize,
    /// What comes from outside, and when.
    pub events: Vec<(Trigger, Event)>,
    /// How messages go wrong.
    pub mischief: Mischief,
    /// What is checked after every event.
    pub checks: Checks,
    /// After the last event of every moment it is checked that nobody could go on who was not woken; on a copy of the executive, so
    /// that the run is the same without.
    pub examines: bool,
    /// States that are refused whatever they ask for, by their paths without visits.
    pub refused: BTreeSet<String>,
    /// After so many events the executive is thrown away, and another one made from the log goes on.
    pub resume_after: Option<usize>,
    /// What earlier runs have taught.
    pub learned: Learned,
    /// Attributes of the resources of a kind, one after the other.
    pub attributes: BTreeMap<String, Vec<BTreeMap<String, Value>>>,
    /// After every so many events the executive's state is written down, and the run goes on with an executive that is made of it.
    pub checkpoint_every: Option<NonZeroUsize>,
}

/// How much is checked after every event of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
pub enum Checks {
    /// Nothing: the run is a prediction, and shall cost what it does.
    Nothing,
    /// That the resource pool keeps its promises, and the executive's mirror is the root. Costs all that is in the pool each time.
    #[default]
    Environment,
    /// The executive's invariants, too. Costs the whole window each time.
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

/// When something comes from outside.
#[derive(Debug, Clone, PartialEq)]
pub enum Trigger {
    /// Before the run begins.
    Before,
    /// So many seconds after the start.
    At(f64),
    /// When a goal of this path starts.
    Starts(String),
    /// When a goal of this path has ended.
    Ends(String),
}

/// How messages go wrong: of a hundred, so many.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Mischief {
    /// What the choices are derived from.
    pub seed: u64,
    /// Come twice.
    pub twice_percent: u64,
    /// Come up to two seconds late.
    pub late_percent: u64,
    /// Answers come although their goal was cancelled.
    pub crossing_percent: u64,
}

/// How one message goes.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Delivery {
    /// So many seconds late.
    pub(super) late_s: f64,
    /// Once more, so many seconds after that.
    pub(super) again_s: Option<f64>,
}

impl Mischief {
    /// How the message of this kind about an attempt goes.
    pub(super) fn delivery(&self, kind: &str, path: &str, attempt: u32) -> Delivery {
        if self.twice_percent == 0 && self.late_percent == 0 {
            return Delivery::default();
        }
        let mut dice = self.dice(kind, path, attempt);
        let late_s = if dice.percent(self.late_percent) { dice.below(20) as f64 / 10.0 } else { 0.0 };
        let again_s = dice.percent(self.twice_percent).then(|| dice.below(80) as f64 / 10.0);
        Delivery { late_s, again_s }
    }

    /// Whether the answer of a cancelled attempt comes all the same.
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
