//! Queries: conditions over facts, with variables `?name` that stand for whatever makes all conditions true.
//!
//! ```text
//! at(?box) = ?pose, class(?box, SLC), not in_gripper(?box), weight(?box) < 2
//! ```
//!
//! | condition | true where |
//! |---|---|
//! | `class(?box, SLC)` | there is such a fact, and it is neither false nor null |
//! | `exists at(?box)` | there is such a fact, whatever it says |
//! | `at(?box) = ?pose` | there is such a fact, and that is what it says |
//! | `not a` | there is no answer to `a`; variables that stand nowhere else are any |
//! | `exists (a, b)` | there is an answer to `a, b` |
//! | `a and b` | as two conditions |
//! | `?d = weight(?box) + 1` | gives `?d` its value where nothing else does |
//! | any other expression | it is true; facts in it hold (but for those below `or`, `if` and `exists`, which may be absent) |
//!
//! A query is planned once ([`plan`]): what is bound already decides which index finds a fact, so the condition that has most of
//! its leading arguments bound goes first, in the order of the text where several do; tests go as soon as what they need is
//! bound. It is answered ([`run`]) by nested lookups, in the order of keys, so the answers come in the same order whenever the
//! facts are the same. Both are bounded: conditions, depth, and the number of facts looked at.

mod conditions;
mod plan;
mod run;

pub use plan::{Plan, PlanError, plan};
pub use run::{Flow, RunError, run};

/// A query has no more conditions, those within `not` and `exists` counted.
pub const MAX_CONDITIONS: usize = 64;
/// A `find` finds at most so many.
pub const MAX_FOUND: usize = 10_000;
/// So many facts may be looked at for the answers to one query; beyond, it is refused.
pub const MAX_STEPS: u64 = 2_000_000;
