//! Annotations that a state takes from its action in the catalogue, with the state's inputs in place of the action's ports.
//!
//! The rule: a state's own annotation replaces the action's annotation under the same key. `computes`, `senses` and `pia` count as one key. Only `effects` are
//! combined: a state's effects replace only the action's effects on the same predicate. (Else a state that declares one fact of its own would silently declare
//! that the arm did not move.)
//!
//! Facts whose predicate the task's ontology does not have are left out ([`super::allowed`]). An annotation that needs an input which the state does not give
//! is not in force, and a warning says so. That is safe, because without it the state may read and change more.

use super::allowed::OfAction;
use super::fields::Fields;
use super::functions::{MAX_PARTS, rename_inner};
use super::outline::{Form, Step};
use super::state::action_name;
use super::yaml::{Content, Node};
use crate::catalogue::{ActionSignature, Annotations, unknown_input};
use crate::expression::parse::NameError;
use crate::expression::{EffectExpr, Expr, FactExpr};
use crate::program::{ABORTED, Location, Nature, Origin, PREEMPTED, SUCCESS, StateKind, VIOLATED};
use crate::value::Value;
use std::cell::{Cell, RefCell};
use std::collections::{BTreeMap, BTreeSet};
use std::rc::Rc;

/// The ports of an action, as its annotations see them for one state.
#[derive(Debug)]
pub(crate) struct Ports {
    /// `provider/action`
    name: String,
    signature: ActionSignature,
    /// The state's expressions for the inputs; inputs that are `null` are left out.
    inputs: BTreeMap<String, Expr>,
    /// The outputs in the state's `out`.
    written: BTreeSet<String>,
    /// An input or output that was needed and is missing.
    missing: RefCell<Option<String>>,
    /// Number of expression parts inserted into the present text by inputs.
    parts: Cell<usize>,
}

impl Ports {
    /// Called before each of the action's texts is parsed.
    pub(crate) fn begins_text(&self) {
        self.parts.set(0);
    }

    /// The expression for `$name`; a placeholder if the state does not give this input.
    pub(crate) fn input(&self, name: &str) -> Result<Expr, NameError> {
        if let Some(error) = unknown_input(&self.signature, name) {
            return Err(error);
        }
        let Some(given) = self.inputs.get(name) else {
            self.missing.replace(Some(format!("the input `{name}`")));
            return Ok(Expr::Literal(Value::Null));
        };
        let mut parts = self.parts.get();
        given.visit(&mut |_| parts += 1);
        self.parts.set(parts);
        if parts > MAX_PARTS {
            return Err(NameError {
                rule: "invalid-expression",
                message: format!("with what the state gives its inputs, this has more than {MAX_PARTS} parts"),
                help: "bind a part of what the state gives to a variable".to_owned(),
            });
        }
        Ok(given.clone())
    }

    /// The output for a bare word in effects, if the action has it.
    pub(crate) fn output(&self, word: &str) -> Option<Expr> {
        self.signature.outputs.contains_key(word).then(|| {
            if !self.written.contains(word) {
                self.missing.replace(Some(format!("the output `{word}`")));
            }
            Expr::Output(word.to_owned())
        })
    }

    /// An error in one of the action's texts, reported for the state that uses the action.
    pub(crate) fn told(&self, text: &str, message: &str) -> String {
        format!("the catalogue says `{text}` of `{}`: {message}", self.name)
    }
}

/// The keys for a state's nature; one replaces all.
const NATURES: [&str; 3] = ["computes", "senses", "pia"];

/// The sources of one state's annotations: first the state, then its action.
pub(crate) struct Sources<'b> {
    body: &'b Node,
    action: Option<(Annotations, Rc<Ports>, Location)>,
    /// The origin of each annotation in force, by key.
    pub(crate) origin: BTreeMap<String, Origin>,
}

impl<'b> Sources<'b> {
    /// The sources for a step whose inputs have been read.
    pub(crate) fn of(fields: &Fields<'_, '_>, step: &Step<'b>, kind: &StateKind) -> Sources<'b> {
        let says = || {
            let (Form::Action { action: node }, StateKind::Action { inputs, outputs, .. }) = (&step.form, kind) else {
                return None;
            };
            let (provider, action) = action_name(node)?;
            let signature = fields.task.catalogue.action(&provider, &action)?;
            if signature.annotations.is_empty() {
                return None;
            }
            let ports = Ports {
                name: format!("{provider}/{action}"),
                signature: signature.clone(),
                inputs: inputs.iter().filter(|(_, given)| *given != Expr::Literal(Value::Null)).map(as_input).collect(),
                written: outputs.keys().cloned().collect(),
                missing: RefCell::default(),
                parts: Cell::default(),
            };
            let said = signature.annotations.of_inputs(|input| ports.inputs.contains_key(input));
            Some((said, Rc::new(ports), node.at))
        };
        Sources { body: step.body, action: says(), origin: BTreeMap::new() }
    }

    /// The annotation under a key, parsed.
    pub(crate) fn read<T: OfAction>(
        &mut self,
        fields: &mut Fields<'_, '_>,
        key: &'static str,
        read: impl Fn(&mut Fields<'_, '_>, &Node) -> T,
    ) -> Option<T> {
        if let Some(node) = self.body.get(key) {
            self.origin.insert(key.to_owned(), Origin::State);
            return Some(read(fields, node));
        }
        self.of_action(fields, key, read)
    }

    /// The effects of a state: its own, and its action's on other predicates. For outcomes other than success, facts that success would set are deleted if the
    /// action leaves them unknown after a failure and the state declares no effect on that predicate.
    pub(crate) fn effects(
        &mut self,
        fields: &mut Fields<'_, '_>,
        read: impl Fn(&mut Fields<'_, '_>, &Node) -> BTreeMap<String, Vec<EffectExpr>>,
    ) -> BTreeMap<String, Vec<EffectExpr>> {
        let mut changed = self.declared_effects(fields, read);
        let Some((said, ports, _)) = &self.action else { return changed };
        let is_unknown = |predicate: &str| said.unknown_after_failure.iter().any(|known| known == predicate);
        let set: Vec<FactExpr> = changed.get(SUCCESS).into_iter().flatten().filter_map(named_before).cloned().collect();
        let lost: Vec<FactExpr> = set.into_iter().filter(|fact| is_unknown(&fact.predicate)).collect();
        if lost.is_empty() {
            return changed;
        }
        let cut_short = self.body.get("while").map(|_| VIOLATED);
        let own = ports.signature.outcomes.iter().map(String::as_str);
        for outcome in [ABORTED, PREEMPTED].into_iter().chain(cut_short).chain(own) {
            let effects = changed.entry(outcome.to_owned()).or_default();
            let said: BTreeSet<String> = effects.iter().filter_map(predicate).map(str::to_owned).collect();
            let deleted = lost.iter().filter(|fact| !said.contains(&fact.predicate));
            effects.extend(deleted.cloned().map(EffectExpr::Delete));
        }
        let from = self.origin.entry("effects".to_owned()).or_insert(Origin::Action);
        if *from == Origin::State {
            *from = Origin::Both;
        }
        changed
    }

    fn declared_effects(
        &mut self,
        fields: &mut Fields<'_, '_>,
        read: impl Fn(&mut Fields<'_, '_>, &Node) -> BTreeMap<String, Vec<EffectExpr>>,
    ) -> BTreeMap<String, Vec<EffectExpr>> {
        let Some(node) = self.body.get("effects") else {
            return self.of_action(fields, "effects", read).unwrap_or_default();
        };
        let mut changed = read(fields, node);
        let own: BTreeSet<String> =
            changed.get(SUCCESS).into_iter().flatten().filter_map(predicate).map(str::to_owned).collect();
        let replaced = |effect: &EffectExpr| predicate(effect).is_some_and(|predicate| own.contains(predicate));
        let mut more = Vec::new();
        for (one, missing) in self.each_of_action(fields, "effects", read) {
            let mut one: Vec<EffectExpr> = one.into_values().flatten().collect();
            one.retain(|effect| !replaced(effect));
            match missing {
                None => more.extend(one),
                Some(missing) if !one.is_empty() => self.not_in_force(fields, "effects", &missing),
                Some(_) => {}
            }
        }
        // An empty list is an annotation, too: that success changes nothing stays true if the state mentions only other outcomes.
        if self.action.as_ref().is_some_and(|(said, ..)| said.effects.as_ref().is_some_and(Vec::is_empty)) {
            changed.entry(SUCCESS.to_owned()).or_default();
        }
        let from = if more.is_empty() { Origin::State } else { Origin::Both };
        self.origin.insert("effects".to_owned(), from);
        if !more.is_empty() {
            let own = changed.entry(SUCCESS.to_owned()).or_default();
            own.splice(..0, more);
        }
        changed
    }

    fn of_action<T: OfAction>(
        &mut self,
        fields: &mut Fields<'_, '_>,
        key: &'static str,
        read: impl Fn(&mut Fields<'_, '_>, &Node) -> T,
    ) -> Option<T> {
        let (said, ports, at) = self.action.as_ref()?;
        let node = node(said, key, *at)?;
        let (value, missing) = in_its_terms(fields, ports, &node, &read);
        if let Some(missing) = missing {
            self.not_in_force(fields, key, &missing);
            return None;
        }
        self.origin.insert(key.to_owned(), Origin::Action);
        Some(value)
    }

    /// As [`Sources::read`], for a key with independent items: an item that is not in force does not affect the others.
    pub(crate) fn read_each<T>(
        &mut self,
        fields: &mut Fields<'_, '_>,
        key: &'static str,
        read: impl Fn(&mut Fields<'_, '_>, &Node) -> Vec<T>,
    ) -> Vec<T>
    where
        Vec<T>: OfAction,
    {
        if self.body.get(key).is_some() {
            return self.read(fields, key, read).unwrap_or_default();
        }
        let mut all = Vec::new();
        for (items, missing) in self.each_of_action(fields, key, read) {
            match missing {
                None => all.extend(items),
                Some(missing) => self.not_in_force(fields, key, &missing),
            }
        }
        if !all.is_empty() {
            self.origin.insert(key.to_owned(), Origin::Action);
        }
        all
    }

    /// The items of the action's annotation under a key, each with the port that it needs and the state does not have, if any.
    fn each_of_action<T: OfAction>(
        &self,
        fields: &mut Fields<'_, '_>,
        key: &'static str,
        read: impl Fn(&mut Fields<'_, '_>, &Node) -> T,
    ) -> Vec<(T, Option<String>)> {
        let Some((said, ports, at)) = &self.action else { return Vec::new() };
        let node = node(said, key, *at);
        let items = node.as_ref().map(Node::items).unwrap_or_default();
        items.into_iter().map(|item| in_its_terms(fields, ports, item, &read)).collect()
    }

    fn not_in_force(&self, fields: &mut Fields<'_, '_>, key: &str, missing: &str) {
        let Some((_, ports, at)) = &self.action else { return };
        // A missing required input is reported as an error elsewhere.
        if ports.signature.inputs.keys().any(|input| !ports.inputs.contains_key(input)) {
            return;
        }
        let action = &ports.name;
        let message = format!(
            "what `{action}` says under `{key}` needs {missing}, which this state does not have: it is not in force"
        );
        let path = fields.path.clone();
        fields.out.findings.warning("annotation-not-in-force", *at, &path, message, format!("say `{key}` here"));
    }

    /// Whether its action is anytime; only if the state computes or senses.
    pub(crate) fn is_anytime(&mut self, nature: &Nature) -> bool {
        let is = *nature != Nature::Irreversible && self.action.as_ref().is_some_and(|(said, ..)| said.anytime);
        if is {
            self.origin.insert("anytime".to_owned(), Origin::Action);
        }
        is
    }

    /// The nature of the state: its own annotation, or else the action's.
    pub(crate) fn nature(
        &mut self,
        fields: &mut Fields<'_, '_>,
        own: impl FnOnce(&mut Fields<'_, '_>) -> Nature,
    ) -> Nature {
        let said: Vec<&str> = NATURES.into_iter().filter(|key| self.body.get(key).is_some()).collect();
        if !said.is_empty() {
            self.origin.extend(said.into_iter().map(|key| (key.to_owned(), Origin::State)));
            return own(fields);
        }
        if self.action.as_ref().is_some_and(|(said, ..)| said.computes) {
            self.origin.insert(NATURES[0].to_owned(), Origin::Action);
            return Nature::Computes;
        }
        let senses = |fields: &mut Fields<'_, '_>, node: &Node| -> Vec<FactExpr> {
            node.items().into_iter().filter_map(|fact| fields.fact(fact)).collect()
        };
        let said = self.action.as_ref().map_or(0, |(said, ..)| said.senses.len());
        match self.of_action(fields, "senses", senses) {
            Some(senses) if senses.len() == said => Nature::Senses(senses),
            // The ontology has no predicate for something that it senses: the state then waits for its place in the program.
            _ => {
                self.origin.remove("senses");
                Nature::default()
            }
        }
    }
}

/// A state's expression for an input, for use in the action's expressions.
fn as_input((name, given): &(String, Expr)) -> (String, Expr) {
    let mut given = given.clone();
    rename_inner(&mut given, name);
    (name.clone(), given)
}

/// Reads a node of the action with its ports as names; also returns a port that it needs and the state does not have.
fn in_its_terms<T: OfAction>(
    fields: &mut Fields<'_, '_>,
    ports: &Rc<Ports>,
    node: &Node,
    read: impl Fn(&mut Fields<'_, '_>, &Node) -> T,
) -> (T, Option<String>) {
    fields.view.action = Some(Rc::clone(ports));
    let mut value = read(fields, node);
    fields.view.action = None;
    if let Some(ontology) = &fields.task.ontology {
        value.leave_out(ontology);
    }
    (value, ports.missing.take())
}

/// The fact that an effect sets, if its key uses no output of the state itself: a state that fails has no outputs.
fn named_before(effect: &EffectExpr) -> Option<&FactExpr> {
    let EffectExpr::Set(fact, _) = effect else { return None };
    let mut has_outputs = false;
    let mut look = |part: &Expr| has_outputs |= matches!(part, Expr::Output(_));
    fact.arguments.iter().flatten().for_each(|argument| argument.visit(&mut look));
    (!has_outputs).then_some(fact)
}

/// The predicate of an effect on a single fact.
fn predicate(effect: &EffectExpr) -> Option<&str> {
    match effect {
        EffectExpr::Set(fact, _) | EffectExpr::Delete(fact) | EffectExpr::Increase(fact, _) => Some(&fact.predicate),
        EffectExpr::ForEach { .. } => None,
    }
}

/// The action's annotation under a key, as a node at the place where the state names the action.
fn node(said: &Annotations, key: &str, at: Location) -> Option<Node> {
    let place = |content| Node { at, offset: None, content };
    let list = |texts: &[String]| {
        let text = |text: &String| place(Content::Text(text.clone()));
        place(Content::List(texts.iter().map(text).collect()))
    };
    let some = |texts: &[String]| (!texts.is_empty()).then(|| list(texts));
    match key {
        "reads" => said.reads.as_deref().map(list),
        "senses" => some(&said.senses),
        "requires" => some(&said.requires),
        "effects" => said.effects.as_deref().map(list),
        "resources" => some(&said.resources),
        "duration" => said.duration.as_ref().map(|text| place(Content::Text(text.clone()))),
        _ => None,
    }
}
