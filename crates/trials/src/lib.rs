//! Random task programs and a random but fixed world for them: the *oracle* of the safety theorem.
//!
//! A program is made of everything that the task model has ([`Features`]), annotated truly but often only in part. What a node
//! does is a hash of what it is entitled to see: its path with visit numbers and its try, its inputs, and the facts that it
//! declares to read, sense or require. Any read from a wrong world changes the result, and with it everything after.
//!
//! | | |
//! |---|---|
//! | programs | `generator`, `annotations`, `features`, `listing` |
//! | their world | `oracle`, `dice` |
//! | both modes beside each other | `trial`, `outside`, `story`, `weak`, `blind` |
//! | both modes beside a plain evaluation of the program | `reference` |
//! | every run once more from its log | `replay` |
//! | smaller programs that fail alike | `shrink`, `rewrite` |

mod annotations;
mod blind;
mod features;
mod generator;
mod listing;
mod oracle;
mod outside;
mod reference;
mod replay;
mod rewrite;
mod shrink;
mod story;
mod trial;
mod weak;

pub use blind::trial_blind;
pub use features::Features;
pub use generator::program;
pub use listing::listing;
pub use oracle::HashOracle;
pub use outside::trial_from_outside;
pub use ratn_simulation::dice::Dice;
pub(crate) use ratn_simulation::dice::Hash;
pub use shrink::{Shrunk, shrink};
pub use trial::{Conditions, Verdict, execute, trial};

use ratn_model::program::{Program, State, StateKind, WORLD_MODEL};
use ratn_model::resource::ResourceClass;

/// The kinds of resources that random programs use, with class and units.
pub const RESOURCES: [(&str, ResourceClass, u32); 7] = [
    ("Planner", ResourceClass::Process, 2),
    ("Eye", ResourceClass::Process, 1),
    ("Arm", ResourceClass::Module, 1),
    ("Head", ResourceClass::Module, 1),
    ("Base", ResourceClass::Module, 1),
    (PART, ResourceClass::Task, PARTS),
    (WORLD_MODEL, ResourceClass::World, 3),
];

/// The task resource of random programs.
const PART: &str = "Part";
/// So many are there at the start: no program uses them up.
const PARTS: u32 = 400;
/// Predicates of random worlds: `p0(n)` … `p5(n)`.
const PREDICATES: u64 = 6;
/// Arguments are below this.
const ARGUMENTS: u64 = 3;
/// The outcome that may lead back; no visit after the second ends by it.
const AGAIN: &str = "again";
/// The other custom outcomes lead on.
const FOUND: &str = "found";
const EMPTY: &str = "empty";

/// The state of a path with visits.
fn state_of<'a>(program: &'a Program, path: &str) -> Option<&'a State> {
    let plain = plain(path);
    program.states.iter().find(|state| state.path == plain)
}

/// A path without visit numbers.
fn plain(path: &str) -> String {
    let parts = path.split('/').map(|part| part.split(['[', '#']).next().unwrap_or(part));
    parts.collect::<Vec<_>>().join("/")
}

/// The state and all around it, from the inside out.
fn around<'a>(program: &'a Program, state: &'a State) -> impl Iterator<Item = &'a State> {
    std::iter::successors(Some(state), |s| s.parent.map(|id| program.state(id)))
}

/// Whether the state is, or is inside of, something that the window executes as one node.
fn is_in_routine(program: &Program, state: &State) -> bool {
    around(program, state).any(State::is_routine)
}

fn is_preemptive(state: &State) -> bool {
    matches!(state.kind, StateKind::Concurrency { preemptive: true, .. })
}
