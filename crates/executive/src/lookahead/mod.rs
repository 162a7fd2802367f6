//! Look-ahead: a better order in which the ready instances of a window are served.
//!
//! Plain dispatch serves the ready instance with the longest remaining path first, and never waits. Here the rest of the window is
//! scheduled over and over, and the best schedule is handed back as how long before the end each instance should begin and who is held
//! back for others ([`Advice`]): the executive serves larger ones first, which comes to that schedule, as a simulation of that
//! very dispatch has confirmed. It never advises anything worse than the longest remaining path.
//!
//! | file | |
//! |---|---|
//! | `problem`, `network`, `project` | what is to be done; as numbers; of that what has not begun |
//! | `rollout` | the executive's dispatch, simulated |
//! | `packed`, `profile`, `schedule` | schedules from lists, for several units of several resources; double justification |
//! | `variation`, `population` | new lists; two populations of them, where resources have several units |
//! | `disjunctive`, `tabu` | orders of machines and moves in critical blocks, where they have one |
//! | `annealing` | other orders for the dispatch, where something is speculative |
//! | `search`, `lookout` | the search and its advice; when to look ahead anew |
//!
//! Pure and anytime: a shell runs [`Search::step`] in a thread while the robot moves, a simulation with a fixed number of
//! steps; [`Lookout`] says when it is worth it. It owns a copy of what it plans ([`Problem`], from
//! [`crate::executive::Executive::outlook`]) and knows nothing of the executive's state.

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
