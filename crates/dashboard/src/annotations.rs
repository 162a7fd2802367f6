//! The editor of annotations: shows a task file with the annotations in force for its states, checks a proposed change, and writes it.
//!
//! The file is locked only during a write: a page identifies the text that it has seen by a digest, and a text with another digest is not
//! changed. `ratn_model::load::edit` makes the change in the text; whoever starts the dashboard supplies the functions that check and
//! simulate a text.

mod attributes;
mod file;

use crate::wire;
use file::FileError;
use ratn_model::diagnostic::{Diagnostic, Severity};
use ratn_model::expression::{EffectExpr, Expr, FactExpr};
use ratn_model::fact::SCENE_PREDICATES;
use ratn_model::in_force::{InForce, in_force};
use ratn_model::load::Loaded;
use ratn_model::load::edit::{self, EditError, Written};
use ratn_model::load::{Document, MAX_SOURCE};
use ratn_model::ontology::Domain;
use ratn_model::program::{Location, Nature, Origin, Program};
use ratn_model::value::Value;
use serde::Deserialize;
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};
use tokio::sync::Semaphore;

/// Maximum size in bytes of a request from a page …
pub(crate) const MAX_BODY: usize = 64 * 1024;
/// … and maximum number of items in it, all keys together.
const MAX_ITEMS: usize = 1_000;
/// Time limit of a simulation.
const SIMULATION: Duration = Duration::from_secs(2);
/// Maximum number of lines shown of a change.
const MAX_SHOWN_LINES: usize = 60;
/// Maximum number of words of a kind offered for completion.
const MAX_WORDS: usize = 500;
/// Maximum number of words offered for single places of predicates.
const MAX_PLACED: usize = 5_000;
/// Keys with a single value; all others have a list.
const SINGLE: [&str; 7] = ["computes", "pia", "duration", "attempts", "deterministic", "routine", "exceptions"];

type Kinds = dyn Fn() -> Vec<String> + Send + Sync;
type Check = dyn Fn(&str) -> Result<Loaded, Vec<Diagnostic>> + Send + Sync;
type Makespan = dyn Fn(&Program, &dyn Fn() -> bool) -> Result<f64, String> + Send + Sync;

/// A task file whose annotations may be changed, and the functions that check its text.
#[derive(Clone)]
pub struct Editing(Arc<Inner>);

struct Inner {
    file: PathBuf,
    kinds: Box<Kinds>,
    check: Box<Check>,
    makespan: Box<Makespan>,
    writing: Mutex<()>,
    /// Allows one simulation at a time.
    simulating: Arc<Semaphore>,
    /// Number of simulations asked for: the newest one supersedes older ones.
    asked: AtomicU64,
}

impl std::fmt::Debug for Editing {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Editing({})", self.0.file.display())
    }
}

impl Editing {
    /// An editor for this file. `kinds` returns the kinds of resources offered; `check` loads and checks a text as that of the file;
    /// `makespan` returns the duration in seconds of a program as a dataflow network, or why it is unknown. It polls its second argument,
    /// whether to go on, and ends soon after that returns false.
    pub fn of(
        file: PathBuf,
        kinds: impl Fn() -> Vec<String> + Send + Sync + 'static,
        check: impl Fn(&str) -> Result<Loaded, Vec<Diagnostic>> + Send + Sync + 'static,
        makespan: impl Fn(&Program, &dyn Fn() -> bool) -> Result<f64, String> + Send + Sync + 'static,
    ) -> Editing {
        let simulating = Arc::new(Semaphore::new(1));
        let (kinds, check, makespan, writing) = (Box::new(kinds), Box::new(check), Box::new(makespan), Mutex::new(()));
        Editing(Arc::new(Inner { file, kinds, check, makespan, writing, simulating, asked: AtomicU64::new(0) }))
    }

    /// The file's path, for people.
    pub(crate) fn name(&self) -> String {
        self.0.file.display().to_string()
    }
}

/// A change that a page proposes.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Proposal {
    /// The digest of the text that the page has seen.
    digest: String,
    /// The path of the state.
    state: String,
    /// The keys that change.
    changes: Vec<Setting>,
}

/// The new value of a key of a state.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Setting {
    key: String,
    /// `None`: the key is removed.
    items: Option<Vec<String>>,
}

/// Why a request is not carried out.
#[derive(Debug, thiserror::Error)]
pub(crate) enum Problem {
    /// The request is malformed.
    #[error("{0}")]
    Question(String),
    /// The file has changed since the page read it.
    #[error(
        "{file} has changed on the disk since it was read: read it again, then make the change anew; nothing was written"
    )]
    Changed {
        /// The file.
        file: String,
    },
    /// The file cannot be read or written.
    #[error(transparent)]
    File(#[from] FileError),
    /// The text cannot be changed in this way.
    #[error(transparent)]
    Edit(#[from] EditError),
    /// A value is invalid.
    #[error("`{item}` of `{key}` is no value: {why}")]
    Value {
        /// Its key.
        key: String,
        /// The item.
        item: String,
        /// The reason.
        why: String,
    },
    /// The changed file would be refused.
    #[error("with this change `ratn check` would refuse the file, and nothing was written: {first}")]
    Refused {
        /// The first error.
        first: String,
    },
}

impl Problem {
    /// The key that the problem is about; empty for none.
    fn key(&self) -> String {
        match self {
            Problem::Edit(EditError::Unsafe { key, .. } | EditError::NoKey { key, .. })
            | Problem::Value { key, .. } => key.clone(),
            _ => String::new(),
        }
    }
}

impl Proposal {
    /// Parses the request of a page.
    pub(crate) fn read(body: &[u8]) -> Result<Proposal, Problem> {
        let read: Proposal = serde_json::from_slice(body)
            .map_err(|error| Problem::Question(format!("this is no change of annotations: {error}")))?;
        let items: usize = read.changes.iter().map(|one| one.items.as_ref().map_or(0, Vec::len)).sum();
        if read.changes.len() > edit::KEYS.len() || items > MAX_ITEMS {
            let problem = format!("at most {} keys with {MAX_ITEMS} items are changed at once", edit::KEYS.len());
            return Err(Problem::Question(problem));
        }
        Ok(read)
    }
}

/// The file with its states. May read files.
pub(crate) fn told(editing: &Editing) -> Result<wire::Annotations, Problem> {
    let inner = &editing.0;
    let text = file::read(&inner.file, MAX_SOURCE)?;
    let digest = file::digest(&text);
    let (findings, program) = match (inner.check)(&text) {
        Ok(loaded) => (loaded.warnings, Some(loaded.program)),
        Err(findings) => (findings, None),
    };
    let (written, problem) = match edit::written(&text) {
        Ok(written) => (written, String::new()),
        Err(error) => (Vec::new(), error.to_string()),
    };
    let Words { predicates, entities, places } = words(program.as_ref());
    let mut by_place = by_place(program.as_ref(), &written);
    let own = |one: &Written| state(one, by_place.remove(&one.location).unwrap_or_default());
    let mut states: Vec<wire::AnnotatedState> = written.iter().map(own).collect();
    if let Some(program) = &program {
        of_libraries(program, &written, &mut states);
    }
    Ok(wire::Annotations {
        file: editing.name(),
        digest,
        problem,
        kinds: (inner.kinds)(),
        findings: findings.iter().map(|one| finding(&written, one)).collect(),
        states,
        predicates,
        entities,
        places,
    })
}

/// The effect of a change. May read files; writes none.
pub(crate) fn proposed(editing: &Editing, proposal: &Proposal) -> Result<wire::Proposed, Problem> {
    let inner = &editing.0;
    let text = as_seen(editing, proposal)?;
    let new = match changed(&text, proposal) {
        Ok(new) => new,
        Err(problem) => {
            return Ok(wire::Proposed {
                problem: problem.to_string(),
                key: problem.key(),
                ..wire::Proposed::default()
            });
        }
    };
    let (findings, program) = match (inner.check)(&new) {
        Ok(loaded) => (loaded.warnings, Some(loaded.program)),
        Err(findings) => (findings, None),
    };
    let written = edit::written(&new)?;
    let own = written.iter().find(|one| one.path == proposal.state);
    let (line, before, after) = difference(&text, &new);
    Ok(wire::Proposed {
        refused: program.is_none(),
        findings: findings.iter().map(|one| finding(&written, one)).collect(),
        in_force: own.and_then(|one| by_place(program.as_ref(), &written).remove(&one.location)).unwrap_or_default(),
        before,
        after,
        line,
        ..wire::Proposed::default()
    })
}

/// The gain of a change: two simulations. Each is ended after [`SIMULATION`], when another gain is asked for, or when this future is
/// dropped.
pub(crate) async fn gained(editing: &Editing, proposal: Proposal) -> Result<wire::Gained, Problem> {
    let without = |obstacle: &str| Ok(wire::Gained { obstacle: obstacle.to_owned(), ..wire::Gained::default() });
    let own = editing.0.asked.fetch_add(1, Ordering::Relaxed) + 1;
    let Ok(place) = editing.0.simulating.clone().acquire_owned().await else {
        return without("the dashboard ends");
    };
    let editing = editing.clone();
    let asker = Arc::new(());
    let waits = Arc::downgrade(&asker);
    let simulated = tokio::task::spawn_blocking(move || {
        // Held to the end, so that no other simulation begins meanwhile.
        let _place = place;
        let text = as_seen(&editing, &proposal)?;
        let new = changed(&text, &proposal)?;
        let inner = &editing.0;
        let is_wanted = || inner.asked.load(Ordering::Relaxed) == own && waits.strong_count() > 0;
        let makespan_s = |text: &str, which: &str| {
            let program = (inner.check)(text).map_err(|_| format!("`ratn check` refuses the file {which}"))?.program;
            let began = Instant::now();
            let is_in_time = || began.elapsed() < SIMULATION;
            let makespan_s = (inner.makespan)(&program, &|| is_wanted() && is_in_time());
            match makespan_s {
                Err(_) if !is_wanted() => Err("something else was asked meanwhile".to_owned()),
                Err(_) if !is_in_time() => {
                    Err(format!("the simulation of the file {which} takes longer than {} s", SIMULATION.as_secs()))
                }
                said => said,
            }
        };
        let before = makespan_s(&text, "as it is");
        let after = makespan_s(&new, "with the change");
        let obstacle = after.as_ref().err().or(before.as_ref().err()).cloned().unwrap_or_default();
        Ok(wire::Gained { before_s: before.ok(), after_s: after.ok(), obstacle })
    });
    let gained = simulated.await.unwrap_or_else(|_| without("the simulation ended with a panic"));
    drop(asker);
    gained
}

/// Writes a change into the file. May read and write files.
pub(crate) fn saved(editing: &Editing, proposal: &Proposal) -> Result<wire::Told, Problem> {
    let inner = &editing.0;
    // A panic leaves the file intact: it is replaced atomically.
    let _writing = inner.writing.lock().unwrap_or_else(PoisonError::into_inner);
    let text = as_seen(editing, proposal)?;
    let new = changed(&text, proposal)?;
    if new == text {
        return Ok(wire::Told { said: "The file says that already.".to_owned() });
    }
    if new.len() > MAX_SOURCE {
        return Err(Problem::Question(format!("a task file has at most {MAX_SOURCE} bytes")));
    }
    if let Err(findings) = (inner.check)(&new)
        && (inner.check)(&text).is_ok()
    {
        let first = findings.iter().find(|one| one.severity == Severity::Error).map(Diagnostic::to_string);
        return Err(Problem::Refused { first: first.unwrap_or_default() });
    }
    match file::replace(&inner.file, &text, &new, MAX_SOURCE) {
        Ok(()) => Ok(wire::Told { said: format!("`{}` is changed in {}.", proposal.state, editing.name()) }),
        Err(FileError::Changed) => Err(Problem::Changed { file: editing.name() }),
        Err(error) => Err(error.into()),
    }
}

/// The text of the file, if it is the one that the page has seen.
fn as_seen(editing: &Editing, proposal: &Proposal) -> Result<String, Problem> {
    let text = file::read(&editing.0.file, MAX_SOURCE)?;
    if file::digest(&text) == proposal.digest { Ok(text) } else { Err(Problem::Changed { file: editing.name() }) }
}

fn changed(text: &str, proposal: &Proposal) -> Result<String, Problem> {
    let mut new = text.to_owned();
    for Setting { key, items } in &proposal.changes {
        let value = items.as_ref().map(|items| value(key, items)).transpose()?;
        new = edit::edited(&new, &proposal.state, key, value.as_ref())?;
    }
    Ok(new)
}

/// The value for the file from the items of a page.
fn value(key: &str, items: &[String]) -> Result<Document, Problem> {
    let read =
        |text: &String| item(text).map_err(|why| Problem::Value { key: key.to_owned(), item: text.clone(), why });
    let mut read: Vec<Document> = items.iter().map(read).collect::<Result<_, _>>()?;
    let is_by_outcome = |one: &Document| match one {
        Document::Map(entries) => key == "effects" && !entries.iter().any(|(name, _)| name == "for"),
        _ => false,
    };
    match read.as_slice() {
        [one] if SINGLE.contains(&key) || is_by_outcome(one) => Ok(read.swap_remove(0)),
        _ if SINGLE.contains(&key) => {
            let why = "it has one value".to_owned();
            Err(Problem::Value { key: key.to_owned(), item: items.join(", "), why })
        }
        _ => Ok(Document::List(read)),
    }
}

/// Parses an item that a user has typed: in brackets or quotes, a number or a boolean as YAML; anything else as plain text.
fn item(text: &str) -> Result<Document, String> {
    let text = text.trim();
    // A few bytes of anchors could expand to millions of values.
    if edit::has_anchor(text) {
        return Err("an anchor or an alias (`&`, `*`) stands in it: write out what it stands for".to_owned());
    }
    if edit::has_tag(text) {
        return Err("a tag (`!`) stands in it: leave it out, or put a text with it in quotes".to_owned());
    }
    let as_yaml = || Document::read(text, "").map_err(|finding| finding.message.clone());
    if text.starts_with(['{', '[', '"', '\'']) {
        return as_yaml();
    }
    match as_yaml() {
        // In YAML a comment begins at `#`; here it is part of the text.
        Ok(read @ (Document::Bool(_) | Document::Int(_) | Document::Float(_) | Document::Null))
            if !text.is_empty() && !text.contains('#') =>
        {
            Ok(read)
        }
        _ if text.is_empty() => Err("it is empty: write something, or leave the line out".to_owned()),
        _ => Ok(Document::Text(text.to_owned())),
    }
}

/// An item in the form in which a user would type it.
fn typed(item: &Document) -> String {
    match item {
        Document::Text(text) if self::item(text).as_ref() == Ok(item) => text.clone(),
        _ => edit::flow(item),
    }
}

fn state(one: &Written, in_force: Vec<wire::InForceLine>) -> wire::AnnotatedState {
    let key = |(key, said): &(&'static str, Option<Document>)| wire::AnnotationKey {
        key: (*key).to_owned(),
        said: said.is_some(),
        items: match said {
            None | Some(Document::Null) => Vec::new(),
            Some(Document::List(items)) => items.iter().map(typed).collect(),
            Some(other) => vec![typed(other)],
        },
        listed: !SINGLE.contains(key),
    };
    wire::AnnotatedState {
        path: one.path.clone(),
        depth: one.depth,
        form: one.form.clone(),
        line: one.location.line,
        fixed: one.fixed.as_ref().map(ToString::to_string).unwrap_or_default(),
        keys: one.keys.iter().map(key).collect(),
        in_force,
    }
}

/// The annotations in force for the states of the file itself. A state with `retry` has another path in the program, so states are
/// identified by their location.
fn by_place(program: Option<&Program>, all: &[Written]) -> BTreeMap<Location, Vec<wire::InForceLine>> {
    let Some(program) = program else { return BTreeMap::new() };
    let libraries = libraries(all);
    let is_own = |path: &str| !libraries.iter().any(|library| path.starts_with(library.as_str()));
    let told: BTreeMap<String, InForce> = in_force(program).into_iter().map(|one| (one.state.clone(), one)).collect();
    let own = program.states.iter().filter(|state| is_own(&state.path));
    own.filter_map(|state| Some((state.location, said(told.get(&state.path)?)))).collect()
}

fn said(told: &InForce) -> Vec<wire::InForceLine> {
    let from = |origin: Option<Origin>| match origin {
        Some(Origin::State) => "this state".to_owned(),
        Some(Origin::Action) => format!("the catalogue, of {}", told.action),
        Some(Origin::Both) => format!("this state and the catalogue, of {}", told.action),
        Some(Origin::Reads) => "for what it reads".to_owned(),
        None => "default: nobody says otherwise".to_owned(),
    };
    let line = |line: &ratn_model::in_force::Line| wire::InForceLine {
        key: line.key.to_owned(),
        text: line.text.clone(),
        from: from(line.from),
    };
    told.lines.iter().map(line).collect()
}

/// The path prefixes of states of libraries.
fn libraries(all: &[Written]) -> Vec<String> {
    all.iter().filter(|one| one.form.starts_with("library")).map(|one| format!("{}/", one.path)).collect()
}

/// Inserts the states of libraries after those that use them.
fn of_libraries(program: &Program, written: &[Written], states: &mut Vec<wire::AnnotatedState>) {
    let told: BTreeMap<String, InForce> = in_force(program).into_iter().map(|one| (one.state.clone(), one)).collect();
    for library in libraries(written) {
        let inside = program.states.iter().filter(|state| !state.is_pause() && state.path.starts_with(&library));
        let inside = inside.map(|state| wire::AnnotatedState {
            path: state.path.clone(),
            depth: state.path.matches('/').count(),
            form: told.get(&state.path).map(|one| format!("action: {}", one.action)).unwrap_or_default(),
            line: state.location.line,
            fixed: "It is a state of a library: change it in the library's file.".to_owned(),
            keys: Vec::new(),
            in_force: told.get(&state.path).map(said).unwrap_or_default(),
        });
        let inside: Vec<_> = inside.collect();
        let Some(place) = states.iter().position(|one| format!("{}/", one.path) == library) else { continue };
        states.splice(place + 1..place + 1, inside);
    }
}

/// Words offered for completion.
#[derive(Debug, Default)]
struct Words {
    /// Predicates of the ontology, and those that the file uses, as `at(?)`.
    predicates: Vec<String>,
    /// Individuals of the ontology, and those that the file uses.
    entities: Vec<String>,
    /// Predicates with places where something else than any individual is offered.
    places: Vec<wire::Places>,
}

/// A place of a predicate.
#[derive(Debug, Default)]
struct Place<'p> {
    /// The domain that the ontology gives it; `None` without an ontology.
    domain: Option<&'p Domain>,
    /// The variables that the file uses there: `$box.id`.
    variables: BTreeSet<String>,
}

fn words(program: Option<&Program>) -> Words {
    let Some(program) = program else { return Words::default() };
    let mut predicates: BTreeMap<(&str, usize), Vec<Place<'_>>> = BTreeMap::new();
    let mut entities = BTreeSet::new();
    match &program.ontology {
        Some(ontology) => {
            for (name, one) in ontology.predicates() {
                let places = one.domain.iter().map(|domain| Place { domain: Some(domain), ..Place::default() });
                predicates.insert((name, one.domain.len()), places.collect());
            }
            entities.extend(ontology.individuals().map(str::to_owned));
        }
        None => {
            let scene = SCENE_PREDICATES.iter().map(|(name, arity)| ((*name, *arity), Vec::new()));
            predicates.extend(scene);
        }
    }
    let mut used = Vec::new();
    changed_facts(&program.initial, &mut used);
    for state in &program.states {
        let said = &state.annotations;
        used.extend(said.reads.iter().flatten());
        used.extend(said.requires.iter().flat_map(|one| one.fact_expressions()));
        if let Nature::Senses(sensed) = &said.nature {
            used.extend(sensed);
        }
        said.effects.values().for_each(|effects| changed_facts(effects, &mut used));
    }
    for fact in used {
        let arity = fact.arguments.len();
        let places = predicates.entry((&fact.predicate, arity)).or_default();
        places.resize_with(arity, Place::default);
        for (place, argument) in places.iter_mut().zip(&fact.arguments) {
            let Some(argument) = argument else { continue };
            entities.extend(individual(argument).map(str::to_owned));
            place.variables.extend(is_variable(argument).then(|| argument.to_string()));
        }
    }
    let entities: Vec<String> = entities.into_iter().take(MAX_WORDS).collect();
    let mut left = MAX_PLACED;
    let mut places = Vec::new();
    for ((name, arity), known) in predicates.iter().take(MAX_WORDS) {
        if known.iter().all(|place| place.domain.is_none() && place.variables.is_empty()) {
            continue;
        }
        let offered: Vec<Vec<String>> = known.iter().map(|place| place.offered(program, &entities)).collect();
        // If the limit leaves a predicate out, all individuals are offered for it.
        let Some(rest) = left.checked_sub(offered.iter().map(Vec::len).sum()) else { continue };
        left = rest;
        places.push(wire::Places { predicate: with_places(name, *arity), offered });
    }
    let predicates = predicates.keys().take(MAX_WORDS).map(|(name, arity)| with_places(name, *arity)).collect();
    Words { predicates, entities, places }
}

impl Place<'_> {
    /// Variables first, because the file uses them there.
    fn offered(&self, program: &Program, entities: &[String]) -> Vec<String> {
        let fits = |one: &&String| match (self.domain, &program.ontology) {
            (Some(Domain::Class(class)), Some(ontology)) => ontology.is_a(one, class),
            (Some(Domain::Integer), _) => false,
            _ => true,
        };
        self.variables.iter().chain(entities.iter().filter(fits)).take(MAX_WORDS).cloned().collect()
    }
}

/// A predicate in the notation of the pages: `on(?, ?)`.
fn with_places(name: &str, arity: usize) -> String {
    format!("{name}({})", vec!["?"; arity].join(", "))
}

/// A variable or a field of one: `$box.id`.
fn is_variable(argument: &Expr) -> bool {
    match argument {
        Expr::Variable(_) => true,
        Expr::Field(of, _) => is_variable(of),
        _ => false,
    }
}

/// The facts that effects change.
fn changed_facts<'e>(effects: &'e [EffectExpr], found: &mut Vec<&'e FactExpr>) {
    for effect in effects {
        match effect {
            EffectExpr::Set(fact, _) | EffectExpr::Delete(fact) | EffectExpr::Increase(fact, _) => found.push(fact),
            EffectExpr::ForEach { effects, .. } => changed_facts(effects, found),
        }
    }
}

/// An argument that is a plain name: `cup`.
fn individual(argument: &Expr) -> Option<&str> {
    let Expr::Literal(Value::String(name)) = argument else { return None };
    let is_word = |name: &str| name.chars().all(|c| c.is_ascii_alphanumeric() || c == '_');
    Some(&**name).filter(|name| is_word(name) && name.starts_with(|c: char| c.is_ascii_alphabetic()))
}

fn finding(written: &[Written], one: &Diagnostic) -> wire::Finding {
    let state = written.iter().find(|state| state.path == one.path);
    wire::Finding {
        severity: one.severity.to_string(),
        rule: one.rule.clone(),
        path: one.path.clone(),
        key: state.and_then(|state| state.key_at(one.location)).unwrap_or_default().to_owned(),
        line: one.location.line,
        message: one.message.clone(),
        help: one.help.clone(),
    }
}

/// The lines that differ, and the number of the first one.
fn difference(old: &str, new: &str) -> (u32, Vec<String>, Vec<String>) {
    let (old, new): (Vec<&str>, Vec<&str>) = (old.lines().collect(), new.lines().collect());
    let most = old.len().min(new.len());
    let head = old.iter().zip(&new).take_while(|(a, b)| a == b).count();
    let tail = old.iter().rev().zip(new.iter().rev()).take(most - head).take_while(|(a, b)| a == b).count();
    let shown = |lines: &[&str]| -> Vec<String> {
        lines[head..lines.len() - tail].iter().take(MAX_SHOWN_LINES).map(|line| (*line).to_owned()).collect()
    };
    (u32::try_from(head + 1).unwrap_or(u32::MAX), shown(&old), shown(&new))
}

#[cfg(test)]
mod tests;
