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
//! | fork and 20 effects | 2.5 µs | 2.6 µs | 2.5 µs |
//! | point lookup, 1,000 keys in turn | 30 ns | 30 ns | 39 ns |
//! | the same in a projection | 62 ns | 63 ns | 63 ns |
//! | point lookup, every key once: from memory | 33 ns | 214 ns | 394 ns |
//! | 10 facts by object | 0.61 µs | 0.62 µs | 0.63 µs |
//! | join of three, 10 answers, prepared | 8.5 µs | 8.9 µs | 9.2 µs |
//! | commit of 20 effects beside a projection | 12 µs | 16 µs | 19 µs |
//! | that commit against 100 live projections that read 20 other facts each | 19 µs | 22 µs | 19 µs |
//! | the same, each having read all 20 facts, too | 100 µs | 99 µs | 102 µs |
//! | 1,000 projections of 20 effects, beside the facts | | 5.2 MB | |
//! | scene of 1,000 objects: 20 move, and the delta is made | 53 µs | | |
//!
//! A check against live projections costs about 50 ns for each that has read a fact that is written. Of the table of facts that worlds
//! share, a shard of at most 16,384 is copied when an eighth of it has changed beside it: no commit waits for more than what it writes
//! and a shard.

pub mod digest;
mod functional;
pub mod query;
pub mod reads;
pub mod scene;
mod store;
mod table;
pub mod world;
