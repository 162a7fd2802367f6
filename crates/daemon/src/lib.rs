//! The three daemons: [`resource_manager`], [`world_pool`], [`process_manager`]. One folder each: `config.rs`, `actor.rs`
//! (the one task that owns the state; everything else sends it messages), `service.rs` (the gRPC adapter) and `status.rs`
//! (errors as gRPC statuses).
//!
//! Every daemon is one `run(config, directory, shutdown)`: it listens, publishes `<role>.endpoint` in the runtime directory
//! once it is ready, serves until the token is cancelled, and withdraws. Signals, the parent's end and command lines are
//! the caller's business. Decisions are made in cores (`ratn-resources`, `ratn-world`, [`process_manager::pool`]), never here.

pub mod config;
mod details;
mod link;
pub mod process_manager;
pub mod resource_manager;
pub mod telemetry;
pub mod world_pool;
