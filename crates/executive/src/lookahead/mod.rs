//! Look-ahead: searches for a better order in which to serve the ready instances of a window.
//!
//! Plain dispatch serves the ready instance with the longest remaining path first, and never waits. Here the rest of the window is
//! scheduled again and again. The best schedule is returned as [`Advice`]: how long before the end each instance should begin, and
//! which instances are held back for others. The executive serves larger values first; a simulation of its own dispatch has confirmed
//! that this leads to the schedule. The advice is never worse than the longest remaining path.
//!
//! | file | |
//! |---|---|
//! | `problem`, `network`, `project` | the remaining work; the same as numbers; the part of it that has not begun |
//! | `rollout` | the executive's dispatch, simulated |
//! | `packed`, `profile`, `schedule` | schedules from lists, for resources with several units; double justification |
//! | `variation`, `population` | new lists; two populations of lists, used when resources have several units |
//! | `disjunctive`, `tabu` | machine orders and moves in critical blocks, used when resources have one unit |
//! | `annealing` | orders for the dispatch, used when tasks are speculative |
//! | `search`, `lookout` | the search and its advice; when to look ahead again |
//!
//! Pure and anytime: a shell runs [`Search::step`] in a thread while the robot moves, a simulation with a fixed number of steps;
//! [`Lookout`] tells when it is worthwhile. It works on its own copy of the remaining work ([`Problem`], from
//! [`crate::executive::Executive::outlook`]) and does not access the executive's state.

mod annealing;
mod dice;
mod disjunctive;
mod lookout;
mod network;
mod packed;
mod population;
mod problem;
mod profile;
mod project;
mod rollout;
mod schedule;
mod search;
mod tabu;
mod variation;

pub use lookout::Lookout;
pub use problem::{Problem, ProblemError, Task};
pub use search::{Advice, Held, Memory, Search};

#[cfg(test)]
mod tests;
