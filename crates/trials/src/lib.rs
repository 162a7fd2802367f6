//! Random task programs and a random but fixed world for them: the *oracle* of the safety theorem.
//!
//! Programs contain what the task model has ([`Features`]; exceptions: `generator`), with annotations that are true but often
//! incomplete. The behaviour of a node is a hash of what it is entitled to see: its path with visit numbers and its try, its inputs,
//! and the facts that it declares to read, sense or require. So any read from a wrong world changes the result, and everything after
//! it.
//!
//! What is compared, by what happens in a run:
//!
//! | | |
//! |---|---|
//! | nothing, failures, crashes, lost leases, late messages, pauses and steps, refused resources, emergency stops, a resume | everything: [`trial`] |
//! | the world changes from outside at the start of a PIA | everything: [`trial_from_outside`] |
//! | it changes at any time; the user ends the run; a deadline | everything if that is at one place of the program, else that a part of the undisturbed run is done: [`trial_interrupted`] |
//! | motions with imprecise exceptions, shared facts | that PIAs are decided and final; without failures, the world |
//! | the same if nothing reads the world ([`Features::IMPRECISE`]) | the outcome, every result of HSM mode, and that all its PIAs start |
//!
//! Every run is replayed from its log, and the executive's invariants are checked after each event. The CDTN run is repeated, and after
//! each moment everything that waits is examined again: no instance may have been forgotten that could go on.
//!
//! | | |
//! |---|---|
//! | programs | `generator`, `features`, `listing`; as task files with a part of the annotations in a catalogue: `inherited` |
//! | their world | `oracle`, `awaited`, `anytime`, `dice` |
//! | both modes compared | `trial`, `outside`, `interrupt`, `story`, `weak`, `blind` |
//! | both modes compared with a plain evaluation of the program | `reference` |
//! | every run repeated from its log | `replay` |
//! | smaller programs with the same failure | `shrink`, `rewrite` |

mod anytime;
mod awaited;
mod blind;
mod features;
mod finds;
mod generator;
mod inherited;
mod interrupt;
mod listing;
mod lists;
mod oracle;
mod outside;
mod reference;
mod replay;
mod rewrite;
mod shrink;
mod story;
mod trial;
mod weak;

pub use features::Features;
pub use generator::program;
pub use inherited::{Inherited, inherited};
pub use interrupt::trial_interrupted;
pub use listing::listing;
pub use oracle::HashOracle;
pub use outside::trial_from_outside;
pub use ratn_simulation::dice::Dice;
pub(crate) use ratn_simulation::dice::Hash;
pub use shrink::{Shrunk, shrink, shrink_by};
pub use trial::{Conditions, Verdict, execute, no_verdict, trial};

use ratn_model::catalogue::ResourceOffer;
use ratn_model::expression::{Expr, Function};
use ratn_model::fact::Change;
use ratn_model::program::{Program, State, StateKind, WORLD_MODEL};
use ratn_model::resource::{Quantity, ResourceClass};
use ratn_model::value::Value;
use std::collections::BTreeMap;

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

/// Three tools with attributes; divisible power; a battery that is never recharged.
const TOOL: &str = "Tool";
const POWER: &str = "Power";
const BATTERY: &str = "Battery";
/// No program except chains has so many states.
const MANY_STATES: usize = 90;

/// All resources for random programs.
pub fn offers() -> Vec<(String, ResourceOffer)> {
    let plain = RESOURCES.iter().map(|(kind, class, units)| ((*kind).to_owned(), ResourceOffer::new(*class, *units)));
    let part = |thousandths| Quantity::from_thousandths(thousandths);
    let power = ResourceOffer { divisible: true, ..ResourceOffer::new(ResourceClass::System, part(1_500)) };
    let battery = ResourceOffer {
        divisible: true,
        renewable: false,
        ..ResourceOffer::new(ResourceClass::System, part(10_000_000))
    };
    let more = [
        (TOOL.to_owned(), ResourceOffer::new(ResourceClass::Process, 3)),
        (POWER.to_owned(), power),
        (BATTERY.to_owned(), battery),
    ];
    plain.chain(more).collect()
}

/// The attributes of the units of each kind, in order.
fn attributes() -> BTreeMap<String, Vec<BTreeMap<String, Value>>> {
    let tool = |level: i64, cuts: bool| {
        let mut attributes = BTreeMap::from([("level".to_owned(), Value::Int(level))]);
        if cuts {
            attributes.insert("cuts".to_owned(), Value::Bool(true));
        }
        attributes
    };
    BTreeMap::from([(TOOL.to_owned(), vec![tool(1, false), tool(2, true), tool(3, false)])])
}

/// Whether a program is long, so that it may need many events.
fn is_long(program: &Program) -> bool {
    let many = |state: &State| match &state.kind {
        StateKind::ForEach { collection: Expr::Call(Function::Range, to), .. } => {
            matches!(to.as_slice(), [Expr::Literal(Value::Int(many))] if *many >= 100)
        }
        _ => false,
    };
    program.states.len() > MANY_STATES || program.states.iter().any(many)
}

/// The task resource of random programs.
const PART: &str = "Part";
/// The number of parts at the start; no program uses them up.
const PARTS: u32 = 400;
/// Predicates of random worlds: `p0(n)` … `p5(n)`.
const PREDICATES: u64 = 6;
/// Upper limit (exclusive) of arguments.
const ARGUMENTS: u64 = 3;
/// The outcome that may lead back; it never occurs after the second visit.
const AGAIN: &str = "again";
/// The other custom outcomes lead on.
const FOUND: &str = "found";
const EMPTY: &str = "empty";

/// The state at a path with visits.
fn state_of<'a>(program: &'a Program, path: &str) -> Option<&'a State> {
    let plain = plain(path);
    program.states.iter().find(|state| state.path == plain)
}

/// A path without visit numbers.
fn plain(path: &str) -> String {
    let parts = path.split('/').map(|part| part.split(['[', '#']).next().unwrap_or(part));
    parts.collect::<Vec<_>>().join("/")
}

/// The state and the states around it, from inside out.
fn around<'a>(program: &'a Program, state: &'a State) -> impl Iterator<Item = &'a State> {
    std::iter::successors(Some(state), |s| s.parent.map(|id| program.state(id)))
}

/// Whether the state is, or is inside of, a state that the window executes as one node.
fn is_in_routine(program: &Program, state: &State) -> bool {
    around(program, state).any(State::is_routine)
}

/// Changes with the same name are compared in order. The name is the fact if there are regions, because these are not ordered and may
/// change different facts of one predicate; else the predicate.
fn compared_as(program: &Program, change: &Change) -> String {
    let pattern = change.pattern();
    let has_regions = program.states.iter().any(|state| matches!(state.kind, StateKind::Concurrency { .. }));
    if has_regions { pattern.to_string() } else { pattern.predicate }
}

fn is_preemptive(state: &State) -> bool {
    matches!(state.kind, StateKind::Concurrency { preemptive: true, .. })
}
