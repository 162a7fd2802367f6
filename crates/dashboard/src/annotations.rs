//! The editor of annotations: one task file, shown with what is in force for its states, checked with a change in it, and changed.
//!
//! It owns the file only while it writes: what a page has seen is known by a digest, and a text of another digest is not changed. What changes
//! in the text, `ratn_model::load::edit` decides; how a text is checked and simulated, whoever starts the dashboard says.

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

/// What a page sends has at most this many bytes …
pub(crate) const MAX_BODY: usize = 64 * 1024;
/// … and this many items of all keys.
const MAX_ITEMS: usize = 1_000;
/// A simulation that takes longer is ended.
const SIMULATION: Duration = Duration::from_secs(2);
/// Of longer changes the first lines are shown.
const MAX_SHOWN_LINES: usize = 60;
/// So many words of a kind are offered for completion.
const MAX_WORDS: usize = 500;
/// So many words are offered for single places of predicates.
const MAX_PLACED: usize = 5_000;
/// Keys of one value; all others have a list.
const SINGLE: [&str; 7] = ["computes", "pia", "duration", "attempts", "deterministic", "routine", "exceptions"];

type Kinds = dyn Fn() -> Vec<String> + Send + Sync;
type Check = dyn Fn(&str) -> Result<Loaded, Vec<Diagnostic>> + Send + Sync;
type Makespan = dyn Fn(&Program, &dyn Fn() -> bool) -> Result<f64, String> + Send + Sync;

/// A task file whose annotations may be changed, and how its text is checked.
#[derive(Clone)]
pub struct Editing(Arc<Inner>);

struct Inner {
    file: PathBuf,
    kinds: Box<Kinds>,
    check: Box<Check>,
    makespan: Box<Makespan>,
    writing: Mutex<()>,
    /// One at a time.
    simulating: Arc<Semaphore>,
    /// How many were asked for: an older one makes room for the newest.
    asked: AtomicU64,
}

impl std::fmt::Debug for Editing {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Editing({})", self.0.file.display())
    }
}

impl Editing {
    /// Of this file. `kinds` says which kinds of resources are offered; `check` loads and checks a text as the file's; `makespan` says how many seconds a program
    /// takes as a dataflow network, or why that cannot be said; it asks often whether it shall go on, and ends soon after it shall not.
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

    /// The file, for people.
    pub(crate) fn name(&self) -> String {
        self.0.file.display().to_string()
    }
}

/// What a page wants to have changed.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Proposal {
    /// Of the text that it has seen.
    digest: String,
    /// The path of the state.
    state: String,
    /// The keys that change.
    changes: Vec<Setting>,
}

/// What a state shall say under a key.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Setting {
    key: String,
    /// Nothing: the key is not there any more.
    items: Option<Vec<String>>,
}

/// Why something is not done.
#[derive(Debug, thiserror::Error)]
pub(crate) enum Problem {
    /// The question cannot be understood.
    #[error("{0}")]
    Question(String),
    /// The file is not as the page has seen it.
    #[error(
        "{file} has changed on the disk since it was read: read it again, then make the change anew; nothing was written"
    )]
    Changed {
        /// Which.
        file: String,
    },
    /// The file cannot be read or written.
    #[error(transparent)]
    File(#[from] FileError),
    /// The text cannot be changed so.
    #[error(transparent)]
    Edit(#[from] EditError),
    /// A value that is none.
    #[error("`{item}` of `{key}` is no value: {why}")]
    Value {
        /// Of which key.
        key: String,
        /// Which.
        item: String,
        /// What is wrong.
        why: String,
    },
    /// The file would be refused.
    #[error("with this change `ratn check` would refuse the file, and nothing was written: {first}")]
    Refused {
        /// The first error.
        first: String,
    },
}

impl Problem {
    /// The key that it is of.
    fn key(&self) -> String {
        match self {
            Problem::Edit(EditError::Unsafe { key, .. } | EditError::NoKey { key, .. })
            | Problem::Value { key, .. } => key.clone(),
            _ => String::new(),
        }
    }
}

impl Proposal {
    /// Reads what a page has sent.
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

/// What changes would lead to. May read files; writes none.
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

/// What changes would gain: two simulations, each of which is ended after [`SIMULATION`], when somebody asks for another one, and when this is
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
        // As long as it goes on no other one begins.
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

/// Writes the changes into the file. May read and write files.
pub(crate) fn saved(editing: &Editing, proposal: &Proposal) -> Result<wire::Told, Problem> {
    let inner = &editing.0;
    // What a panic left is whole: the file is replaced at once.
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

/// What items say, as the file has it.
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

/// What somebody has typed: in brackets or quotes, a number or a boolean as YAML has it, else a text as it stands there.
fn item(text: &str) -> Result<Document, String> {
    let text = text.trim();
    // A few bytes of them are millions of values.
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
        // In YAML a comment would begin at `#`, which nobody types here.
        Ok(read @ (Document::Bool(_) | Document::Int(_) | Document::Float(_) | Document::Null))
            if !text.is_empty() && !text.contains('#') =>
        {
            Ok(read)
        }
        _ if text.is_empty() => Err("it is empty: write something, or leave the line out".to_owned()),
        _ => Ok(Document::Text(text.to_owned())),
    }
}

/// As somebody would type it.
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

/// What is in force for the states of the file itself. Where one is tried again it has another path in the program, and it is known by its place.
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

/// What paths of states of libraries begin with.
fn libraries(all: &[Written]) -> Vec<String> {
    all.iter().filter(|one| one.form.starts_with("library")).map(|one| format!("{}/", one.path)).collect()
}

/// Puts the states of libraries behind those that use them.
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

/// What can be completed to.
#[derive(Debug, Default)]
struct Words {
    /// Of the ontology, and those that the file uses, as `at(?)`.
    predicates: Vec<String>,
    /// Of the ontology, and those that the file uses.
    entities: Vec<String>,
    /// Of predicates for whose places something else than all individuals can stand.
    places: Vec<wire::Places>,
}

/// A place of a predicate.
#[derive(Debug, Default)]
struct Place<'p> {
    /// What may stand there: nothing is known without an ontology.
    domain: Option<&'p Domain>,
    /// The variables that the file has there: `$box.id`.
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
        // Of a predicate that is left out, all individuals are offered.
        let Some(rest) = left.checked_sub(offered.iter().map(Vec::len).sum()) else { continue };
        left = rest;
        places.push(wire::Places { predicate: with_places(name, *arity), offered });
    }
    let predicates = predicates.keys().take(MAX_WORDS).map(|(name, arity)| with_places(name, *arity)).collect();
    Words { predicates, entities, places }
}

impl Place<'_> {
    /// The variables first: they are what the file has there.
    fn offered(&self, program: &Program, entities: &[String]) -> Vec<String> {
        let fits = |one: &&String| match (self.domain, &program.ontology) {
            (Some(Domain::Class(class)), Some(ontology)) => ontology.is_a(one, class),
            (Some(Domain::Integer), _) => false,
            _ => true,
        };
        self.variables.iter().chain(entities.iter().filter(fits)).take(MAX_WORDS).cloned().collect()
    }
}

/// As pages know a predicate: `on(?, ?)`.
fn with_places(name: &str, arity: usize) -> String {
    format!("{name}({})", vec!["?"; arity].join(", "))
}

/// A variable or a field of one, as `$box.id`.
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

/// An argument that is a name, as `cup`.
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

/// The lines that differ, with the number of the first one.
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
