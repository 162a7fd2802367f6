//! The world model: a set of facts `predicate(argument, …) = value`, its root and its projections, and the geometric scene
//! derived from facts.
//!
//! A [`world::World`] is a persistent ordered map: a projection is a clone (constant time) plus the effects applied to it
//! (logarithmic each), whatever the number of facts. Which effects are applied when is the executive's business.

pub mod scene;
pub mod tolerance;
pub mod world;
