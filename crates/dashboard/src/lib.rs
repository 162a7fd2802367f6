//! The dashboard: runs and a system as pages in a browser on this machine.
//!
//! It owns an HTTP server on loopback, the folds of the logs that pages look at, and the pages themselves, which are built from `web/`
//! and travel in the program. It decides nothing of a run: what it shows is the event log's (`ratn-report`) and the daemons' word, and
//! what it tells a run goes over the run's control socket, if its user allowed that.
//!
//! Pages ask, a few times a second while somebody looks at them, for what has changed; nothing is pushed, so nothing queues up.

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
