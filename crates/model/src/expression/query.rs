//! Queries: conditions over facts, with variables `?name` for all values that make every condition true.
//!
//! ```text
//! at(?box) = ?pose, class(?box, SLC), not in_gripper(?box), weight(?box) < 2
//! ```
//!
//! | condition | true if |
//! |---|---|
//! | `class(?box, SLC)` | there is such a fact, and its value is neither false nor null |
//! | `exists at(?box)` | there is such a fact, with any value |
//! | `at(?box) = ?pose` | there is such a fact with this value |
//! | `not a` | there is no answer to `a`; variables that occur nowhere else may have any value |
//! | `exists (a, b)` | there is an answer to `a, b` |
//! | `a and b` | as two conditions |
//! | `?d = weight(?box) + 1` | binds `?d` if nothing else does |
//! | any other expression | it is true, and the facts in it hold (except those below `or`, `if` and `exists`, which may be absent) |
//!
//! A query is planned once ([`plan`]): the index that finds a fact depends on what is bound already. So the condition with most
//! of its leading arguments bound goes first, among equals the first in the text; tests go as soon as their variables are bound.
//! The query is answered ([`run`]) by nested lookups in the order of keys, so equal facts give the answers in the same order.
//! The numbers of conditions and of visited facts, and the depth, are bounded.

mod conditions;
mod plan;
mod run;

pub use plan::{Plan, PlanError, plan};
pub use run::{Flow, RunError, run};

/// Limit of conditions in a query, including those within `not` and `exists`.
pub const MAX_CONDITIONS: usize = 64;
/// Limit of results of a `find`.
pub const MAX_FOUND: usize = 10_000;
/// Limit of the facts that one query may visit; beyond it, the query is refused.
pub const MAX_STEPS: u64 = 2_000_000;
