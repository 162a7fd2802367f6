//! Reads the fields of a mapping: expressions with their locations, plain numbers and flags; reports unknown keys.

use super::names::{NamesFrom, Task, View, suggestion};
use super::yaml::{Content, Entry, Node};
use crate::diagnostic::Findings;
use crate::expression::parse::{Names, ParseError, parse_effect, parse_expression, parse_fact};
use crate::expression::{EffectExpr, Expr, FactExpr};
use crate::guard::Guard;
use crate::id::StateId;
use crate::name::{KIND_RULE, is_kind};
use crate::program::Location;
use crate::resource::Quantity;
use crate::value::Value;
use std::collections::BTreeMap;

/// Locations of the parts of states: `(state, "in.goal")`, `(state, "requires.0")`.
#[derive(Debug, Default)]
pub(crate) struct Places {
    places: BTreeMap<(StateId, String), Location>,
}

impl Places {
    pub(crate) fn note(&mut self, state: StateId, part: impl Into<String>, at: Location) {
        self.places.insert((state, part.into()), at);
    }

    /// States were replaced by new ones, some by several: locations of transitions move to the outermost new state, all others to the innermost.
    pub(crate) fn move_to(&mut self, copies: &[BTreeMap<StateId, Vec<StateId>>]) {
        for ((id, part), at) in std::mem::take(&mut self.places) {
            let is_outside = part.starts_with("transitions") || part == "exceptional" || part.starts_with("shared");
            for layers in copies.iter().filter_map(|places| places.get(&id)) {
                let now = if is_outside { layers.first() } else { layers.last() };
                self.places.insert((now.copied().unwrap_or(id), part.clone()), at);
            }
        }
    }

    /// The location of a part; that of the state if the part's is unknown.
    pub(crate) fn of(&self, state: StateId, part: &str, fallback: Location) -> Location {
        self.places.get(&(state, part.to_owned())).copied().unwrap_or(fallback)
    }
}

/// The results that loading collects.
#[derive(Debug, Default)]
pub(crate) struct Output {
    pub(crate) findings: Findings,
    pub(crate) places: Places,
    /// Whether the task declares its initial world.
    pub(crate) declares_world: bool,
    /// The paths of the states that use a library.
    pub(crate) libraries: Vec<String>,
    /// The functions of the file: name, usage, number of arguments.
    pub(crate) functions: Vec<(String, String, usize)>,
    pub(crate) guards: BTreeMap<StateId, Guard>,
}

/// Reads fields on behalf of one state.
pub(crate) struct Fields<'t, 'a> {
    pub(crate) task: &'t Task<'a>,
    pub(crate) view: View,
    pub(crate) path: String,
    pub(crate) out: &'t mut Output,
}

impl<'t, 'a> Fields<'t, 'a> {
    pub(crate) fn error(&mut self, rule: &str, at: Location, message: impl Into<String>, help: impl Into<String>) {
        self.out.findings.error(rule, at, &self.path, message, help);
    }

    /// Reports unknown keys.
    pub(crate) fn keys(&mut self, node: &Node, known: &[&str]) {
        // A key without value, followed by an unknown key: probably its value is not indented.
        let mut empty: Option<&str> = None;
        for entry in node.entries() {
            let key = entry.key.as_str();
            if known.contains(&key) {
                empty = (entry.value.content == Content::Null).then_some(key);
                continue;
            }
            let help = match empty {
                Some(above) => format!("if it belongs to `{above}`, indent it by two more blanks"),
                None => suggestion(key, known.iter().copied(), "", "leave it out"),
            };
            self.error("unknown-key", entry.at, format!("there is no key `{key}` here"), help);
        }
    }

    /// Stores the location of a part of the state.
    pub(crate) fn note(&mut self, part: impl Into<String>, at: Location) {
        if let Some(state) = self.view.state {
            self.out.places.note(state, part, at);
        }
    }

    /// A YAML value as an expression: a text is parsed, other values are constants.
    pub(crate) fn expression(&mut self, node: &Node) -> Option<Expr> {
        match &node.content {
            Content::Null => Some(Expr::Literal(Value::Null)),
            Content::Bool(b) => Some(Expr::Literal(Value::Bool(*b))),
            Content::Int(i) => Some(Expr::Literal(Value::Int(*i))),
            Content::Float(x) => Some(Expr::Literal(Value::Float(*x))),
            Content::Text(text) => self.parsed(node, text, 0, parse_expression),
            Content::List(items) => {
                let parsed: Vec<Option<Expr>> = items.iter().map(|item| self.expression(item)).collect();
                Some(Expr::List(parsed.into_iter().collect::<Option<_>>()?))
            }
            Content::Map(entries) => {
                let parsed: Vec<_> =
                    entries.iter().map(|e| Some((e.key.clone(), self.expression(&e.value)?))).collect();
                Some(Expr::Map(parsed.into_iter().collect::<Option<_>>()?))
            }
        }
    }

    /// Parses `text`, which begins in `node` at character `offset`.
    pub(crate) fn parsed<T>(
        &mut self,
        node: &Node,
        text: &str,
        offset: usize,
        parse: impl FnOnce(&str, &mut dyn Names) -> Result<T, ParseError>,
    ) -> Option<T> {
        self.view.action.iter().for_each(|action| action.begins_text());
        let parsed = parse(text, &mut NamesFrom { task: self.task, view: &self.view });
        match parsed {
            Ok(parsed) => Some(parsed),
            Err(error) => {
                if let Some(action) = &self.view.action {
                    let message = action.told(text, &error.message);
                    self.error(error.rule, node.at, message, error.help);
                    return None;
                }
                let at = node.place_in_text(self.task.source, offset + error.offset);
                let help = if is_cut_off(text) { QUOTE.to_owned() } else { error.help };
                self.error(error.rule, at, error.message, help);
                None
            }
        }
    }

    fn text<'n>(&mut self, node: &'n Node, what: &str, example: &str) -> Option<&'n str> {
        if let Content::Text(text) = &node.content {
            return Some(text);
        }
        let message = format!("expected {what}, found {}", node.described());
        self.error("invalid-expression", node.at, message, format!("write it as text, {example}"));
        None
    }

    pub(crate) fn fact(&mut self, node: &Node) -> Option<FactExpr> {
        let text = self.text(node, "a fact", "\"at(box, ?)\" (quoted, because of the comma)")?;
        self.parsed(node, text, 0, parse_fact)
    }

    pub(crate) fn effect(&mut self, node: &Node) -> Option<EffectExpr> {
        let text = self.text(node, "an effect", "\"set at(box) = x\"")?;
        self.parsed(node, text, 0, parse_effect)
    }

    /// The entries of a key whose value must be a mapping or missing.
    pub(crate) fn mapping<'n>(&mut self, body: &'n Node, key: &str, example: &str) -> &'n [Entry] {
        let Some(node) = body.get(key) else { return &[] };
        if !matches!(node.content, Content::Map(_) | Content::Null) {
            let message = format!("`{key}` is a mapping, found {}", node.described());
            self.error("invalid-state", node.at, message, format!("write `{key}: {example}`"));
        }
        node.entries()
    }

    pub(crate) fn flag(&mut self, node: &Node) -> bool {
        match node.content {
            Content::Bool(b) => b,
            _ => {
                let help = match &node.content {
                    Content::Text(text) => crate::check::types::truth(text).unwrap_or_default(),
                    _ => "",
                };
                let message = format!("expected true or false, found {}", node.described());
                self.error("type-mismatch", node.at, message, help);
                false
            }
        }
    }

    /// A whole number of at least `least`.
    pub(crate) fn count(&mut self, node: &Node, what: &str, least: u32) -> Option<u32> {
        let count = match node.content {
            Content::Int(i) => u32::try_from(i).ok().filter(|n| *n >= least),
            _ => None,
        };
        if count.is_none() {
            let message = format!("`{what}` is a whole number of at least {least}");
            self.error("type-mismatch", node.at, message, "");
        }
        count
    }

    /// An amount of a resource, greater than 0.
    pub(crate) fn quantity(&mut self, node: &Node, what: &str) -> Option<Quantity> {
        let number = match node.content {
            Content::Int(i) => i as f64,
            Content::Float(number) => number,
            _ => {
                let message = format!("`{what}` is a number, found {}", node.described());
                self.error("type-mismatch", node.at, message, "write an amount such as 2 or 0.5");
                return None;
            }
        };
        let wrong = match Quantity::try_from(number) {
            Ok(Quantity::ZERO) => "is 0: that asks for nothing".to_owned(),
            Ok(quantity) => return Some(quantity),
            Err(error) => error.to_string(),
        };
        self.error("invalid-amount", node.at, format!("`{what}` {wrong}"), "write an amount such as 2 or 0.5");
        None
    }

    pub(crate) fn word<'n>(&mut self, node: &'n Node, what: &str) -> Option<&'n str> {
        match &node.content {
            Content::Text(text) if crate::expression::display::is_word(text) => Some(text),
            _ => {
                self.error("invalid-name", node.at, format!("expected {what}, a name, found {}", node.described()), "");
                None
            }
        }
    }

    pub(crate) fn resource_kind<'n>(&mut self, node: &'n Node) -> Option<&'n str> {
        match &node.content {
            Content::Text(text) if is_kind(text) => Some(text),
            _ => {
                let message = format!("expected a kind of resource, {KIND_RULE}, found {}", node.described());
                self.error("invalid-name", node.at, message, "");
                None
            }
        }
    }
}

/// Advice for unquoted text within `{ }` or `[ ]`.
const QUOTE: &str = "quote it: within { } and [ ] a comma ends a text, so write \"pose(1, 2, 3)\"";

/// Whether a parenthesis is not closed at the end of a text.
fn is_cut_off(text: &str) -> bool {
    text.matches('(').count() > text.matches(')').count()
}
