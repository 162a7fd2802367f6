//! Robot kinematics, collision, path planning and time parameterisation.
//!
//! A pure library: no clock, no threads, no ambient randomness. The caller says through a callback when time is up, and
//! hands in the seed.

pub mod aimm;
pub mod collision;
mod frame;
mod geometry;
mod improve;
pub mod inverse;
pub mod line;
pub mod pace;
pub mod plan;
mod request;
pub mod robot;
mod search;
pub mod shorten;
pub mod timing;
pub mod trajectory;
mod urdf;
pub mod validate;
