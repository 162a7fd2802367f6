//! The environment's physics: rigid bodies, friction, a fixed step.
//!
//! rapier3d moves everything that can be moved. Floor and furniture are fixed, and the robot's links follow its joints, whatever is in their way.
//! `grip` computes what the fingers can hold, `riding` which objects move with a driving base, `touch` all contacts, planned or not, and `overlap`
//! their depth. Nothing here reads a clock: the step is fixed, time is the number of steps, and the same steps with the same joints give the same
//! world to the last bit on one machine ([`Environment::digest`]).

mod convex;
mod grip;
mod object;
mod overlap;
mod polygon;
mod riding;
mod shell;
mod touch;
mod vector;
mod world;

pub use grip::{Grip, Hold, Load, Slip};
pub use object::{Kind, Model};
pub use touch::{NEAR_M, Thing, Touch};
pub use world::{Environment, FLOOR, Furniture, GRAVITY, ObjectState, STEP, Saved, Support};
