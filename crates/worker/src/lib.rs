//! The worker SDK: what a process links that takes part in a ratn system. Light: no planner, no store, no clap.
//!
//! # Serving
//! - [`endpoint::Endpoint`]: `http://host:port`, `https://…`, `host:port` or `unix:/path`; parse, print, [`endpoint::connect`].
//! - [`runtime_directory::RuntimeDirectory`]: `create`, `publish(role, &endpoint) -> Published` (a guard), `find(role)`,
//!   `wait_for(role, deadline)`.
//! - [`server`]: `bind(&endpoint) -> Bound` (port 0 and Unix sockets too), `Services::new().with(service)`,
//!   `bound.serve(services, shutdown_token)`: adds gRPC health and reflection, drains with a hard deadline.
//! - [`gate::Gate`] sees every call with the [`gate::Identity`] of its caller; [`access::RoleGate`] is the one of every server unless it
//!   brings its own: who may what is [`access`]. [`tls`] says what is shown and trusted; [`trace`] carries
//!   a W3C trace context from call to call; [`multiplex`] carries many calls over one stream.
//! - [`shutdown`]: `on_signals(&token)`, `exit_with_parent(&token)`.
//!
//! # Performing actions
//! - [`action::Action`]: the trait; [`action::GoalContext`]: inputs by type (`goal.input_joints("start")?`), `seed`, `lease`,
//!   `cancelled`, `progress("…")`, `world(&patterns)`, `call("Camera", "capture", inputs)`.
//! - [`action::ActionServer`]: fencing, idempotent goals, one at a time where asked, cancel, bounded results.
//! - [`lease_watch::LeaseWatch`]: who holds this provider's resources, by the resource manager's word; goals end with their lease.
//! - [`worker::Worker`]: all of it in one builder; [`worker::Worker::from_args`] for a process of its own. [`prelude`] has what it needs,
//!   [`testing::perform`] performs a goal in a test.
//! - [`action::Signature`]: what an action says of its ports, outcomes and annotations.
//! - [`safety::Safety`]: emergency stop and hold, for drivers of what moves; [`safety::SafetyClient`] asks for them.
//!
//! # Asking others
//! - [`client::Channels`] keeps one channel per endpoint; [`client::ActionClient`], [`client::ResourceClient`],
//!   [`client::WorldClient`], [`client::ProcessClient`] speak the cores' types; [`client::CallError`] tells a refusal from a
//!   crash; [`client::wait_until_serving`] asks gRPC health.
//! - [`session::Session`] keeps a session with the resource manager alive and tells when it was lost;
//!   [`provider::Provider`] offers resources under it, again after the manager came back. What is believed of either ends by
//!   [`boot_clock::BootClock`], also while the machine is suspended.
//!
//! What it deliberately does not do: decide anything. No retries of goals, no choice of resources.

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
pub mod vitals;
pub mod worker;
