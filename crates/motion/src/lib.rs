//! Robot kinematics, collision, path planning and time parameterisation.
//!
//! A pure library: no clock, no threads, no ambient randomness. The caller says through a callback when time is up, and
//! hands in the seed.

pub mod aimm;
pub mod collision;
pub mod connect;
pub mod exact;
mod frame;
pub mod geometry;
mod halton;
mod improve;
pub mod inverse;
pub mod line;
pub mod mechanism;
pub mod pace;
pub mod plan;
pub mod problems;
mod request;
pub mod robot;
mod search;
pub mod shorten;
mod simd;
pub mod simplify;
pub mod space;
pub mod spheres;
pub mod timing;
pub mod trajectory;
mod tree;
pub mod trial;
mod urdf;
pub mod validate;
