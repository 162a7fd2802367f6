//! The three daemons: [`resource_manager`], [`world_pool`], [`process_manager`]. One folder each: `config.rs`, `actor.rs` (the one task that owns the state;
//! everything else sends it messages; where the state is durable, a core in a `durable_actor`), `service.rs` (the gRPC adapter) and `status.rs` (errors as gRPC
//! statuses).
//!
//! All of them share [`service`] (who may connect and do what: [`access`], [`audit`]), [`telemetry`], [`metrics`], [`config`] (also where state is kept),
//! [`supervisor`] and [`reload`].
//!
//! Every daemon is one `run(config, directory, shutdown)`, or `run_as` with a [`ratn_worker::server::Serving`]: it listens, publishes `<role>.endpoint` in the
//! runtime directory once it is ready, serves until the token is cancelled, and withdraws. Signals, the parent's end and command lines are the caller's
//! business. Decisions are made in cores (`ratn-resources`, `ratn-world`, [`process_manager::pools`]), never here.

pub mod access;
pub mod audit;
pub mod config;
mod demand;
mod details;
mod durable_actor;
mod link;
pub mod metrics;
mod paging;
pub mod process_manager;
pub mod processor_demand;
pub mod quota;
pub mod reload;
pub mod resource_manager;
pub mod service;
mod standby;
mod stream_calls;
pub mod supervisor;
pub mod telemetry;
mod watch_stream;
pub mod world_pool;
