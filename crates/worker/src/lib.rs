//! The worker SDK: the library for a process that takes part in a ratn system (a worker, a driver of a robot's module, a client). It is
//! light: it links no planner, no store and no clap. [`worker::Worker`] is where a worker begins; docs/workers.md shows a whole one.
//!
//! # Serving
//! - [`endpoint::Endpoint`]: `http://host:port`, `https://…`, `host:port` or `unix:/path`; parse, print, [`endpoint::connect`].
//! - [`runtime_directory::RuntimeDirectory`]: `create`, `publish(role, &endpoint) -> Published` (a guard), `find(role)`,
//!   `wait_for(role, deadline)`.
//! - [`server`]: `bind(&endpoint) -> Bound` (port 0 and Unix sockets too), `Services::new().with(service)`,
//!   `bound.serve(services, shutdown_token)`: adds gRPC health and reflection, drains with a hard deadline.
//! - [`gate::Gate`] sees every call with the [`gate::Identity`] of its caller. A server uses [`access::RoleGate`] unless it brings a gate
//!   of its own; [`access`] says which role may call what. [`tls`] says which certificates are shown and trusted; [`trace`] carries
//!   a W3C trace context from call to call; [`multiplex`] carries many calls over one stream.
//! - [`shutdown`]: `on_signals(&token)`, `exit_with_parent(&token)`.
//!
//! # Performing actions
//! - [`action::Action`]: the trait; [`action::GoalContext`]: inputs by type (`goal.input_joints("start")?`), `seed`, `lease`,
//!   `cancelled`, `progress("…")`, `world(&patterns)`, `call("Camera", "capture", inputs)`.
//! - [`action::ActionServer`]: fencing, idempotent goals, one at a time where asked, cancel, bounded results.
//! - [`lease_watch::LeaseWatch`]: the holders of this provider's resources, as reported by the resource manager; a goal ends with its
//!   lease.
//! - [`worker::Worker`]: all of this in one builder; [`worker::Worker::from_args`] reads the arguments of a worker process.
//!   [`prelude`] has the names that a worker needs, [`testing::perform`] performs a goal in a test.
//! - [`action::Signature`]: the ports, outcomes and annotations of an action.
//! - [`safety::Safety`]: emergency stop and hold, for drivers of hardware that moves; [`safety::SafetyClient`] asks for them.
//!
//! # Asking others
//! - [`client::Channels`] keeps one channel per endpoint; [`client::ActionClient`], [`client::ResourceClient`], [`client::WorldClient`],
//!   [`client::ProcessClient`] use the types of the cores; [`client::CallError`] distinguishes a refusal from a crash;
//!   [`client::wait_until_serving`] asks gRPC health.
//! - [`session::Session`] keeps a session with the resource manager alive and reports when it was lost; [`provider::Provider`] offers
//!   resources in that session, and offers them again after the manager restarted. Both measure with [`boot_clock::BootClock`] for how long
//!   they may trust the manager; it goes on while the machine is suspended.
//!
//! The SDK deliberately decides nothing: it does not retry goals and does not choose resources.

pub mod access;
pub mod action;
pub mod adoption;
pub mod arguments;
pub mod audit;
pub mod boot_clock;
pub mod client;
pub mod connections;
pub mod endpoint;
pub mod gate;
mod leader;
pub mod lease_watch;
pub mod multiplex;
mod otlp;
pub mod panic;
pub mod pooled;
pub mod prelude;
pub mod protocol;
pub mod provider;
pub mod robot_clock;
pub mod runtime_directory;
pub mod safety;
pub mod server;
pub mod session;
pub mod shutdown;
pub mod testing;
pub mod tls;
pub mod token_bucket;
pub mod trace;
mod under_way;
pub mod unix_socket;
mod unix_stream;
pub mod vitals;
pub mod worker;
