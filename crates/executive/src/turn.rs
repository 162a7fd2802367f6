//! Turns: in which order single waits end, wherever they are under way, in a line of control or inside of a routine. Both modes take their order
//! from here.
//!
//! What is due by its time comes before the event that finds it due: first the wait, limit, backoff or goal whose time was up first. What the world or
//! a signal ends comes in the order in which the waits began. Of those of one moment the one comes first whose region is written first. One ends at a
//! time, and what follows from it comes before the next one.

use ratn_model::id::{InstanceId, StateId};
use ratn_model::time::Timestamp;

/// The turn of one wait under way; earlier ones are less.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Turn {
    /// When its time is up, or since when it waits.
    pub(crate) at: Timestamp,
    /// The place of its region in the program ([`crate::plan::StatePlan::place`]).
    pub(crate) place: u64,
    pub(crate) instance: InstanceId,
    pub(crate) state: StateId,
}
