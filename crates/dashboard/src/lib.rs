//! The dashboard: runs and a system as pages in a browser on this machine.
//!
//! The crate owns an HTTP server on loopback, the folds of the logs that pages show, and the pages themselves, which are built from `web/`
//! and embedded in the program. It decides nothing in a run: it shows the event log (`ratn-report`) and the daemons' answers, and its
//! commands to a run go over the run's control socket, if its user allowed that.
//!
//! Pages poll for changes, a few times per second while they are visible; nothing is pushed, so nothing queues up.

mod annotations;
mod film;
mod fold;
mod gate;
mod logs;
mod looks;
mod patience;
mod robot;
mod server;
mod system;
mod task;
mod tell;
pub mod wire;
mod world;

pub use annotations::Editing;
pub use logs::MAX_LOGS;
pub use robot::{Known, Robots};
pub use server::{Dashboard, DashboardError, Options, Tasks};
