//! The simulated cell: a mobile robot at a table with boxes, its sensors and its controllers.
//!
//! [`core`] is the cell itself, a pure machine. It knows the true poses of everything, follows trajectories in the robot's time, and holds an object
//! only if the fingers are really around it. `shell` is the process around it: the action service of the modules (arm, gripper, pan-tilt unit,
//! camera, base), their resources, the battery, the clock, and a service that reports the ground truth to tests and demonstrations. No worker uses
//! that service.

pub mod config;
pub mod core;
mod photo;
mod shell;

pub use photo::photo;
pub use shell::link::MIDDLE;
pub use shell::{ROLE, run, run_as};
