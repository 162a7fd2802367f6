//! The cell as a pure machine: events in, commands out, time as an argument.

pub mod arms;
pub mod braking;
pub mod cell;
pub mod contacts;
pub mod demands;
pub mod environment;
mod errors;
pub mod faults;
pub mod grasping;
pub mod objects;
pub mod picture;
pub mod placement;
pub mod protocol;
pub mod recording;
pub mod snapshot;
pub mod tableware;

mod activity;
mod apart;
mod battery;
mod clearance;
mod deviations;
mod holding;
mod levers;
mod motion;
mod parting;
mod passing;
mod starting;
mod trajectory;
