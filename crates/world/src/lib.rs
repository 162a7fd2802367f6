//! The world model: a set of facts `predicate(argument, …) = value`, its root and its projections, and the geometric scene
//! derived from facts ([`scene`]).
//!
//! A [`world::World`] is an overlay of changes over a shared, indexed store: a projection is a clone (constant time) plus its effects, whatever
//! the number of facts. The executive decides which effects are applied when. A [`query::Query`] asks a world. [`reads::Live`] knows what
//! projections have read, and which of them a commit contradicts; [`digest::Digest`] tells whether two have read the same.
//!
//! What it costs (`cargo bench -p ratn-world`, medians of one run on two busy cores, all indexes counted):
//!
//! | | 10⁴ facts | 10⁵ | 10⁶ |
//! |---|---|---|---|
//! | fork and 20 effects | 2.6 µs | 3.8 µs | 2.5 µs |
//! | point lookup, 1,000 keys in turn | 35 ns | 46 ns | 38 ns |
//! | the same in a projection | 67 ns | 69 ns | 74 ns |
//! | point lookup, every key once: from memory | 52 ns | 242 ns | 255 ns |
//! | 10 facts by object | 0.80 µs | 0.75 µs | 0.76 µs |
//! | join of three, 10 answers, prepared | 8.7 µs | 9.4 µs | 9.6 µs |
//! | commit of 20 effects beside a projection | 13 µs | 17 µs | 21 µs |
//! | that commit against 100 live projections that read 20 other facts each | 19 µs | 20 µs | 22 µs |
//! | the same, each having read all 20 facts, too | 101 µs | 99 µs | 98 µs |
//! | consecutive commits of 20 facts anywhere, while the first world is held | 22 µs | 66 µs | 107 µs |
//! | the slowest of those | 0.8 ms | 4.5 ms | 83 ms |
//! | 1,000 projections of 20 effects, beside the facts | | 5.2 MB | |
//! | scene of 1,000 objects: 20 move, and the delta is made | 56 µs | | |
//!
//! Checking a commit against live projections costs about 50 ns per projection that has read a written fact. The shared table of facts is divided
//! into shards of at most 16,384 facts; a shard is copied when an eighth of it has changed beside it. So one write copies at most one shard, but
//! shards that are written equally often reach that point together: a commit of 20 facts anywhere among 10⁶ may copy 20.

pub mod digest;
mod functional;
pub mod query;
pub mod reads;
pub mod scene;
pub mod search;
mod store;
mod table;
pub mod world;
