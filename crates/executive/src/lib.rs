//! The executive: what a task control decides.
//!
//! A pure core. [`protocol::Event`]s come in, [`protocol::Command`]s come out, time is an argument. The shell performs
//! commands (over gRPC in `ratn run`, in virtual time in `ratn-simulation`) and answers only with events, so the log of
//! events and commands is the whole story of a run.
//!
//! # What it costs
//!
//! `cargo bench -p ratn-executive` prints it: a goal has ended in a full window, so that its instance finishes and retires, another
//! begins and the window grows by one. Median microseconds per event, one core of a shared machine, the making of the event and
//! the dropping of the commands included:
//!
//! | instances in the window | 10² | 10³ | 10⁴ | 10⁵ | 10⁶ |
//! |---|---|---|---|---|---|
//! | chain: each reads the one before it | 1.6 | 1.6 | 1.2 | 1.6 | 1.7 |
//! | wide fan-out: all run | 1.0 | 1.0 | 1.1 | 1.1 | 1.1 |
//! | random graph, four inputs each | 1.8 | 1.8 | 1.8 | 1.9 | 1.9 |
//! | nested loops, pairs in a row | 1.2 | 1.3 | 1.3 | 1.0 | 1.6 |
//!
//! A million instances are expanded, executed and retired in 1.0 s; one takes 660 to 740 bytes; a state machine of 10,000 states
//! becomes a window in 26 ms. An event allocates 10 to 17 times; another allocator changes little, so what is left is work: of a
//! third each, growing the window by one, finding out that one may begin, and finishing and retiring one.

mod binding;
mod checkpoint;
mod context;
mod effects;
pub mod executive;
mod hold;
mod interpreter;
pub mod lookahead;
mod plan;
pub mod protocol;
mod window;
