//! YAML text → a tree of nodes with their locations. The only module that uses the YAML library.
//!
//! Booleans are `true` and `false` only, because a state may be named `no`. Duplicate keys, several documents and files
//! larger than [`MAX_SOURCE`] are refused; the library limits depth and aliases.

use crate::program::Location;
use serde::de::{Deserialize, Deserializer, MapAccess, SeqAccess, Visitor};
use serde_saphyr::Spanned;
use std::fmt;

/// Limit of a task file, in bytes.
pub const MAX_SOURCE: usize = 1 << 20;

/// A YAML node.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Node {
    pub(crate) at: Location,
    /// Byte offset of its beginning in the source.
    pub(crate) offset: Option<usize>,
    pub(crate) content: Content,
}

/// The content of a node.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Content {
    Null,
    Bool(bool),
    Int(i64),
    Float(f64),
    Text(String),
    List(Vec<Node>),
    Map(Vec<Entry>),
}

/// A key and its value.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Entry {
    pub(crate) key: String,
    pub(crate) at: Location,
    pub(crate) value: Node,
}

/// Error: the text is no YAML.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct InvalidYaml {
    pub(crate) at: Location,
    pub(crate) message: String,
}

/// Reads a document.
pub(crate) fn read(source: &str) -> Result<Node, InvalidYaml> {
    let start = Location { line: 1, column: 1 };
    if source.len() > MAX_SOURCE {
        return Err(InvalidYaml { at: start, message: format!("a task file has at most {MAX_SOURCE} bytes") });
    }
    let mut options = serde_saphyr::Options::default();
    options.strict_booleans = true;
    // `!hand_empty(gripper)` without quotes would be a YAML tag without a value, and so a condition that never holds.
    options.reject_unsupported_tags = true;
    options.with_snippet = false;
    match serde_saphyr::from_str_with_options::<Spanned<Content>>(source, options) {
        Ok(spanned) => {
            let root = node(spanned);
            match negated(&root, source) {
                Some(at) => Err(InvalidYaml { at, message: "unsupported tag `!`".to_owned() }),
                None => Ok(root),
            }
        }
        Err(error) => {
            let at = error.location().map_or(start, location);
            let text = error.without_snippet().to_string();
            Err(InvalidYaml { at: if at.line == 0 { start } else { at }, message: message(&text) })
        }
    }
}

/// The location of a single `!` before a value: YAML ignores it, but the author means a negation.
fn negated(node: &Node, source: &str) -> Option<Location> {
    let before = node.offset.and_then(|offset| source.get(..offset)).unwrap_or_default();
    let own = node.offset.and_then(|offset| source.get(offset..)).unwrap_or_default();
    if before.trim_end_matches(' ').ends_with('!') || own.starts_with("! ") {
        return Some(node.at);
    }
    match &node.content {
        Content::List(items) => items.iter().find_map(|item| negated(item, source)),
        Content::Map(entries) => entries.iter().find_map(|entry| negated(&entry.value, source)),
        _ => None,
    }
}

/// The library's message without the location, which is reported separately, and without advice for programmers.
fn message(text: &str) -> String {
    let line = text.lines().next().unwrap_or("unreadable");
    if line.contains("recursion limit exceeded") || line.contains("budget breached: Depth") {
        return "lists and mappings are nested deeper here than a task file may nest them".to_owned();
    }
    if line.contains("budget breached") {
        return "it has more values than a task file may have, each counted wherever an alias repeats it".to_owned();
    }
    let line = line.rsplit_once(" at line ").map_or(line, |(message, _)| message);
    line.split_once(", set DuplicateKeyPolicy").map_or(line, |(message, _)| message).to_owned()
}

impl Node {
    /// The kind of node, for messages.
    pub(crate) fn described(&self) -> &'static str {
        match self.content {
            Content::Null => "nothing",
            Content::Bool(_) => "a boolean",
            Content::Int(_) | Content::Float(_) => "a number",
            Content::Text(_) => "text",
            Content::List(_) => "a list",
            Content::Map(_) => "a mapping",
        }
    }

    /// The value of a key of a mapping.
    pub(crate) fn get(&self, key: &str) -> Option<&Node> {
        self.entries().iter().find(|entry| entry.key == key).map(|entry| &entry.value)
    }

    /// The entries of a mapping; empty for anything else.
    pub(crate) fn entries(&self) -> &[Entry] {
        match &self.content {
            Content::Map(entries) => entries,
            _ => &[],
        }
    }

    /// The items of a list; a single value counts as a list of one, a missing value as the empty list.
    pub(crate) fn items(&self) -> Vec<&Node> {
        match &self.content {
            Content::List(items) => items.iter().collect(),
            Content::Null => Vec::new(),
            _ => vec![self],
        }
    }

    /// The location in the file of the character `offset` of a text: exact if the file contains the text as it is (plain,
    /// or quoted without escapes, on one line), else the beginning of the node.
    pub(crate) fn place_in_text(&self, source: &str, offset: usize) -> Location {
        let (Content::Text(text), Some(begin)) = (&self.content, self.offset) else { return self.at };
        let Some(raw) = source.get(begin..) else { return self.at };
        let quotes = usize::from(raw.starts_with(['"', '\'']));
        let as_written = raw.get(quotes..).is_some_and(|raw| raw.starts_with(text.as_str()));
        if !as_written || text.contains('\n') {
            return self.at;
        }
        let shift = u32::try_from(quotes + offset.min(text.chars().count())).unwrap_or(0);
        Location { line: self.at.line, column: self.at.column + shift }
    }
}

fn location(at: serde_saphyr::Location) -> Location {
    let clipped = |n: u64| u32::try_from(n).unwrap_or(u32::MAX);
    Location { line: clipped(at.line()), column: clipped(at.column()) }
}

fn node(spanned: Spanned<Content>) -> Node {
    let offset = spanned.defined.span().byte_offset().and_then(|offset| usize::try_from(offset).ok());
    Node { at: location(spanned.defined), offset, content: spanned.value }
}

impl<'de> Deserialize<'de> for Content {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Content, D::Error> {
        deserializer.deserialize_any(ContentVisitor)
    }
}

struct ContentVisitor;

impl<'de> Visitor<'de> for ContentVisitor {
    type Value = Content;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a value, a list or a mapping")
    }

    fn visit_bool<E>(self, value: bool) -> Result<Content, E> {
        Ok(Content::Bool(value))
    }

    fn visit_i64<E>(self, value: i64) -> Result<Content, E> {
        Ok(Content::Int(value))
    }

    fn visit_u64<E: serde::de::Error>(self, value: u64) -> Result<Content, E> {
        i64::try_from(value).map(Content::Int).map_err(|_| E::custom(format!("{value} is too large for an int")))
    }

    fn visit_f64<E>(self, value: f64) -> Result<Content, E> {
        Ok(Content::Float(value))
    }

    fn visit_str<E>(self, value: &str) -> Result<Content, E> {
        Ok(Content::Text(value.to_owned()))
    }

    fn visit_unit<E>(self) -> Result<Content, E> {
        Ok(Content::Null)
    }

    fn visit_none<E>(self) -> Result<Content, E> {
        Ok(Content::Null)
    }

    fn visit_some<D: Deserializer<'de>>(self, deserializer: D) -> Result<Content, D::Error> {
        Content::deserialize(deserializer)
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut access: A) -> Result<Content, A::Error> {
        let mut items = Vec::new();
        while let Some(item) = access.next_element::<Spanned<Content>>()? {
            items.push(node(item));
        }
        Ok(Content::List(items))
    }

    fn visit_map<A: MapAccess<'de>>(self, mut access: A) -> Result<Content, A::Error> {
        let mut entries = Vec::new();
        while let Some(key) = access.next_key::<Spanned<String>>()? {
            let value = node(access.next_value::<Spanned<Content>>()?);
            entries.push(Entry { at: location(key.defined), key: key.value, value });
        }
        Ok(Content::Map(entries))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]

    use super::*;

    #[test]
    fn every_node_knows_where_it_stands() {
        let root = read("task: demo\nstates:\n  - plan: { in: {goal: \"at(§x)\"}, no: yes }\n").unwrap();
        let Content::List(steps) = &root.get("states").unwrap().content else { panic!("a list") };
        let entry = &steps[0].entries()[0];
        assert_eq!((entry.key.as_str(), entry.at), ("plan", Location { line: 3, column: 5 }));
        let goal = entry.value.get("in").unwrap().get("goal").unwrap();
        assert_eq!(goal.at, Location { line: 3, column: 24 });
        assert_eq!(goal.place_in_text("", 3), goal.at);
        let source = "task: demo\nstates:\n  - plan: { in: {goal: \"at(§x)\"}, no: yes }\n";
        assert_eq!(goal.place_in_text(source, 4), Location { line: 3, column: 29 });
        assert_eq!(entry.value.get("no").unwrap().content, Content::Text("yes".into()));
    }

    #[test]
    fn what_is_no_yaml_is_refused_with_its_place() {
        for source in ["task: [1, 2", "a: 1\na: 2\n", "a: b: c\n", "a: 1\n---\nb: 2\n", "x: *nothing"] {
            let error = read(source).unwrap_err();
            assert!(error.at.line >= 1 && !error.message.is_empty(), "{source}: {error:?}");
        }
        assert!(read(&"[".repeat(5_000)).is_err());
        // The library's limits are reported in the words of a task file.
        for limit in ["recursion limit exceeded", "budget breached: Depth { depth: 65 } at line 1, column 3"] {
            assert!(message(limit).contains("nested deeper"), "{limit}");
        }
        assert!(message("budget breached: Nodes { nodes: 250001 } at line 9").contains("more values"));
    }
}
