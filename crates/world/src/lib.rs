//! The world model: a set of facts `predicate(argument, …) = value`, its root and its projections, and the geometric scene
//! derived from facts ([`scene`]).
//!
//! A [`world::World`] is an overlay of changes over a shared, indexed store: a projection is a clone (constant time) plus its
//! effects, whatever the number of facts. Which effects are applied when is the executive's business. A [`query::Query`] asks it. [`reads::Live`]
//! knows what projections have read, and which of them a commit contradicts; [`digest::Digest`] says when two have read the same.
//!
//! What it costs (`cargo bench -p ratn-world`, medians of one run on two busy cores, all indexes counted):
//!
//! | | 10⁴ facts | 10⁵ | 10⁶ |
//! |---|---|---|---|
//! | fork and 20 effects | 2.5 µs | 2.5 µs | 2.4 µs |
//! | point lookup, 1,000 scattered keys | 0.22 µs | 0.79 µs | 1.0 µs |
//! | the same in a projection | 0.16 µs | 0.59 µs | 1.3 µs |
//! | 10 facts by object | 0.87 µs | 0.91 µs | 1.0 µs |
//! | commit of 20 effects beside a projection | 33 µs | 25 µs | 41 µs |
//! | 1,000 projections of 20 effects, beside the facts | | 5.0 MB | |
//!
//! Scattered lookups are above the 0.1 µs aimed at; where their time goes has not been measured.

pub mod digest;
mod functional;
pub mod query;
pub mod reads;
pub mod scene;
mod store;
pub mod world;
