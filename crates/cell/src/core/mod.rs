//! The cell as a pure machine: events in, commands out, time as an argument.

pub mod boxes;
pub mod cell;
pub mod environment;
pub mod grasping;
pub mod picture;
pub mod placement;
pub mod protocol;
pub mod settling;

mod activity;
mod battery;
mod holding;
mod leases;
mod starting;
mod trajectory;
