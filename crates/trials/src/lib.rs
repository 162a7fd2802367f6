//! Random task programs and a random but fixed world for them: the *oracle* of the safety theorem.
//!
//! A program is made of what the task model has ([`Features`]; what is never made, `generator` says), annotated truly but often
//! only in part. What a node
//! does is a hash of what it is entitled to see: its path with visit numbers and its try, its inputs, and the facts that it
//! declares to read, sense or require. Any read from a wrong world changes the result, and with it everything after.
//!
//! What is compared, by what happens to a run:
//!
//! | | |
//! |---|---|
//! | nothing, failures, crashes, lost leases, late messages, pauses and steps, refused resources, emergency stops, a resume | everything: [`trial`] |
//! | the world changes from outside at the start of a PIA | everything: [`trial_from_outside`] |
//! | it changes at any time; the user ends the run; a deadline | everything where one place of the program is meant, else what is done is a part of what is done undisturbed: [`trial_interrupted`] |
//! | motions with imprecise exceptions, shared facts | that what acts is decided and final; without failures, the world |
//! | the same where nothing looks at the world ([`Features::IMPRECISE`]) | the outcome, every result of HSM mode, and that all its PIAs start |
//!
//! Every run is replayed from its log, and the executive's invariants hold after each of its events. CDTN mode's is made once more, and
//! after each moment everything that waits is looked at again: no instance could have gone on that was not woken.
//!
//! | | |
//! |---|---|
//! | programs | `generator`, `features`, `listing`; as task files with a catalogue that says a part of them: `inherited` |
//! | their world | `oracle`, `awaited`, `anytime`, `dice` |
//! | both modes beside each other | `trial`, `outside`, `interrupt`, `story`, `weak`, `blind` |
//! | both modes beside a plain evaluation of the program | `reference` |
//! | every run once more from its log | `replay` |
//! | smaller programs that fail alike | `shrink`, `rewrite` |

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

/// A tool with attributes, one of three; power of which a part can be had, and a battery that nobody fills again.
const TOOL: &str = "Tool";
const POWER: &str = "Power";
const BATTERY: &str = "Battery";
/// More states than any program has that is no chain.
const MANY_STATES: usize = 90;

/// Everything there is for random programs.
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

/// What the units of the kinds of resources are like, one after the other.
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

/// Whether the program is a long one: it may take many events.
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

/// Changes of what goes by the same name are compared in their order: of one fact where there are regions, which have no order and may
/// change different facts of one predicate, else of one predicate.
fn compared_as(program: &Program, change: &Change) -> String {
    let pattern = change.pattern();
    let has_regions = program.states.iter().any(|state| matches!(state.kind, StateKind::Concurrency { .. }));
    if has_regions { pattern.to_string() } else { pattern.predicate }
}

fn is_preemptive(state: &State) -> bool {
    matches!(state.kind, StateKind::Concurrency { preemptive: true, .. })
}
