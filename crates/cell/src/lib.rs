//! The simulated cell: a mobile robot at a table with boxes, its sensors and its controllers.
//!
//! [`core`] is the cell itself, a pure machine: it knows where everything really is, follows trajectories in the robot's
//! time, refuses those that collide, holds a box only when the fingers are really around it. `shell` is the process around
//! it: the action service of the four modules, their resources, the battery, the clock, and a service that tells tests and
//! demonstrations the ground truth, which no worker ever asks.

pub mod config;
pub mod core;
mod photo;
mod shell;

pub use photo::photo;
pub use shell::{ROLE, run, run_as};
