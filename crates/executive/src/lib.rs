//! The executive: what a task control decides.
//!
//! A pure core. [`protocol::Event`]s come in, [`protocol::Command`]s come out, time is an argument. The shell performs
//! commands (over gRPC in `ratn run`, in virtual time in `ratn-simulation`) and answers only with events, so the log of
//! events and commands is the whole story of a run.

mod analysis;
mod binding;
mod context;
mod effects;
pub mod executive;
mod hold;
mod interpreter;
pub mod lookahead;
pub mod protocol;
mod window;
