//! The world model: a set of facts `predicate(argument, …) = value`, its root and its projections, and the geometric scene
//! derived from facts.
//!
//! A [`world::World`] is an overlay of changes over a shared, indexed store: a projection is a clone (constant time) plus its
//! effects, whatever the number of facts. Which effects are applied when is the executive's business.

pub mod scene;
mod store;
pub mod tolerance;
pub mod world;
