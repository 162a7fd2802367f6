//! The executive: what a task control decides.
//!
//! A pure core. [`protocol::Event`]s come in, [`protocol::Command`]s come out, time is an argument. The shell performs
//! commands (over gRPC in `ratn run`, in virtual time in `ratn-simulation`) and answers only with events, so the log of
//! events and commands is the whole story of a run.
//!
//! # What it costs
//!
//! Printed by `cargo bench -p ratn-executive`. In a full window a goal has ended, or a lease or a projection has come;
//! instances finish and retire, others begin, and the window grows. Median microseconds per event on one core of a busy
//! machine, including the time to make the event and to drop the commands:
//!
//! | instances in the window | 10² | 10³ | 10⁴ | 10⁵ | 10⁶ |
//! |---|---|---|---|---|---|
//! | chain: each reads the one before it | 1.6 | 1.6 | 1.8 | 1.8 | 1.9 |
//! | wide fan-out: all run | 1.1 | 1.1 | 1.2 | 1.3 | 1.3 |
//! | random graph, four inputs each | 2.2 | 2.1 | 2.3 | 5.8 | 4.3 |
//! | nested loops, pairs in a row | 1.2 | 1.2 | 1.3 | 1.5 | 1.5 |
//! | resources alone | 0.9 | 0.9 | 1.1 | 1.1 | 1.2 |
//! | one read, one effect, one resource | 1.7 | 2.6 | 3.8 | 4.4 | |
//! | the same, reading what nobody writes | 1.4 | 1.6 | | | |
//! | conditions on facts | 2.8 | 3.8 | 39 | | |
//!
//! A deviation with 10,000 facts in view takes 43 µs with one reader, 200 µs with a hundred. An event allocates 10 to 20 times.
//! `tests/cost.rs` of the simulation holds that chains of effects are linear and that a loop takes constant memory.

mod awaiting;
mod binding;
mod checkpoint;
mod context;
mod effects;
pub mod executive;
mod hold;
mod interpreter;
pub mod lookahead;
mod overtaken;
mod plan;
pub mod protocol;
mod signals;
mod span;
mod turn;
mod way_out;
mod window;

pub use overtaken::was_overtaken;
pub use signals::MOST_SIGNALS_KEPT;
