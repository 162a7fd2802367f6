//! Look-ahead: a better order in which the ready instances of a window are served.
//!
//! Plain dispatch serves the ready instance with the longest remaining path first. Here the rest of the window is simulated under
//! that very dispatch over and over with other orders, and the order of the best simulation is handed back as
//! how long before the end each instance should begin ([`Advice`]): the executive serves larger ones first, which reproduces
//! that simulation. It never advises anything worse than the longest remaining path.
//!
//! Pure and anytime: a shell runs [`Search::step`] in a thread while the robot moves, a simulation with a fixed number of
//! steps; [`Lookout`] says when it is worth it. It owns a copy of what it plans ([`Problem`], from
//! [`crate::executive::Executive::outlook`]) and knows nothing of the executive's state.

mod dice;
mod lookout;
mod network;
mod problem;
mod rollout;
mod search;

pub use lookout::Lookout;
pub use problem::{Problem, ProblemError, Task};
pub use search::{Advice, Search};

#[cfg(test)]
mod tests;
