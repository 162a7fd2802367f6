//! Changes one annotation of a state in the text of a task file, and keeps comments and layout. Pure.
//!
//! A YAML writer would write the whole file anew. Instead, the lines of one key of one state are located at the places that the loader
//! knows, and only these lines change. The result is parsed again. The change is refused unless the result is exactly the old tree with this
//! change, with all its comments. So a YAML form that this code does not understand leads to a refusal, never to a damaged file.
//!
//! Not supported: states without their own text (made by `regions: {for: …}` or through an alias), and states of libraries.

mod scan;

use super::document::Document;
use super::outline::{Form, outline};
use super::yaml::{self, Content, Entry, Node};
use super::{state, written_out};
use crate::diagnostic::Findings;
use crate::program::Location;
use scan::{Lines, comments, flow_end, has_hidden_comment};
pub use scan::{has_anchor, has_tag};
use std::collections::BTreeMap;

/// The annotations that can be changed.
pub const KEYS: [&str; 14] = [
    "computes",
    "senses",
    "pia",
    "reads",
    "requires",
    "effects",
    "resources",
    "duration",
    "attempts",
    "deterministic",
    "routine",
    "exceptional",
    "exceptions",
    "shared",
];
/// Longer lines are split into several.
const LINE_WIDTH: usize = 120;
/// Keys with lists of states below; a new key is inserted before them.
const LISTS: [&str; 8] = ["states", "do", "then", "else", "regions", "cases", "default", "fallback"];

/// A state as written in the file.
#[derive(Debug, Clone, PartialEq)]
pub struct Written {
    /// Its path.
    pub path: String,
    /// Number of states around it.
    pub depth: usize,
    /// Its form: `action: gripper/grasp`, `for: box in look.boxes`.
    pub form: String,
    /// Its location.
    pub location: Location,
    /// The annotations that it may have, with its own values.
    pub keys: Vec<(&'static str, Option<Document>)>,
    /// The locations of all its keys.
    pub places: Vec<(Location, String)>,
    /// Why it cannot be changed here, if so.
    pub fixed: Option<EditError>,
}

/// Error: a text was not changed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum EditError {
    /// The states of the text cannot be found.
    #[error("line {}: {message}: the file cannot be read as a task; correct it in an editor first", at.line)]
    Unreadable {
        /// The location.
        at: Location,
        /// What is wrong.
        message: String,
    },
    /// The file has no such state.
    #[error(
        "there is no state `{path}` in this file: read the file again; a state of a library is changed in the library's file"
    )]
    NoState {
        /// The path.
        path: String,
    },
    /// The form of the state does not allow this key.
    #[error("`{path}` cannot have `{key}`: a state with `{form}` may say {may}")]
    NoKey {
        /// The state.
        path: String,
        /// The key.
        key: String,
        /// The state's form.
        form: String,
        /// The keys that it may have.
        may: String,
    },
    /// The state has no text of its own.
    #[error("`{path}` (line {}) has no text of its own: {why}; change it in an editor", at.line)]
    Shared {
        /// The state.
        path: String,
        /// Its location.
        at: Location,
        /// Where its text comes from.
        why: &'static str,
    },
    /// The change would affect more than this key.
    #[error("`{key}` of `{path}` (line {}) is not changed: {why}; change it in an editor", at.line)]
    Unsafe {
        /// The state.
        path: String,
        /// The key.
        key: String,
        /// The location.
        at: Location,
        /// The obstacle.
        why: &'static str,
    },
}

impl Written {
    /// The key at a location, or above it, so that findings can be shown at their key.
    pub fn key_at(&self, at: Location) -> Option<&str> {
        let before = self.places.iter().filter(|(place, _)| *place <= at);
        before.max_by_key(|(place, _)| *place).map(|(_, key)| key.as_str())
    }
}

/// A state with its place in the tree.
struct Found<'n> {
    written: Written,
    /// Its mapping, if it has a text of its own.
    body: Option<&'n Node>,
}

/// The states of a task file as written, in file order.
///
/// # Errors
/// [`EditError::Unreadable`].
pub fn written(text: &str) -> Result<Vec<Written>, EditError> {
    let root = read(text)?;
    Ok(states(&root).into_iter().map(|found| found.written).collect())
}

/// The text with another value for a key of a state; `None` removes the key.
///
/// # Errors
/// [`EditError`]: the state or key does not exist, or cannot be changed separately.
pub fn edited(text: &str, path: &str, key: &str, value: Option<&Document>) -> Result<String, EditError> {
    let root = read(text)?;
    let found = states(&root).into_iter().find(|found| found.written.path == path);
    let Found { written, body } = found.ok_or_else(|| EditError::NoState { path: path.to_owned() })?;
    let Some((_, old)) = written.keys.iter().find(|(own, _)| *own == key) else {
        let may = written.keys.iter().map(|(key, _)| *key).collect::<Vec<_>>().join(", ");
        return Err(EditError::NoKey { path: path.to_owned(), key: key.to_owned(), form: written.form, may });
    };
    if old.as_ref() == value {
        return Ok(text.to_owned());
    }
    let Some(body) = body else {
        return Err(written.fixed.unwrap_or(EditError::NoState { path: path.to_owned() }));
    };
    let refused = |why| EditError::Unsafe { path: path.to_owned(), key: key.to_owned(), at: written.location, why };
    let change = Change { lines: Lines::of(text), body, key, value };
    let (new, index) = change.made().map_err(refused)?;
    let expected = changed(&root, body, key, value, index);
    match yaml::read(&new) {
        Ok(root) if Document::of(root.clone()) == expected => {}
        _ => return Err(refused("the file would not read as exactly this change")),
    }
    let (mut before, mut after) = (comments(text), comments(&new));
    before.sort_unstable();
    after.sort_unstable();
    if before != after {
        return Err(refused("a comment would be lost"));
    }
    Ok(new)
}

/// A value on one line, in YAML flow style.
pub fn flow(value: &Document) -> String {
    match value {
        Document::Null => "null".to_owned(),
        Document::Bool(truth) => truth.to_string(),
        Document::Int(number) => number.to_string(),
        Document::Float(number) => format!("{number:?}"),
        Document::Text(text) => scan::scalar(text),
        Document::List(items) => format!("[{}]", items.iter().map(flow).collect::<Vec<_>>().join(", ")),
        Document::Map(entries) if entries.is_empty() => "{}".to_owned(),
        Document::Map(entries) => {
            let entry = |(key, value): &(String, Document)| format!("{}: {}", scan::scalar(key), flow(value));
            format!("{{ {} }}", entries.iter().map(entry).collect::<Vec<_>>().join(", "))
        }
    }
}

fn read(text: &str) -> Result<Node, EditError> {
    yaml::read(text).map_err(|error| EditError::Unreadable { at: error.at, message: error.message })
}

/// All states with their places. The tree is expanded as in the loader, so that paths agree.
fn states(root: &Node) -> Vec<Found<'_>> {
    let mut whole = root.clone();
    let mut findings = Findings::default();
    if let Content::Map(entries) = &mut whole.content
        && let Some(states) = entries.iter_mut().find(|entry| entry.key == "states")
    {
        written_out::write_out(&mut states.value, &mut findings);
    }
    let outline = outline("", &whole, &mut findings);
    let mut places = BTreeMap::new();
    mappings(root, false, &mut places);
    let mut found = Vec::new();
    for step in outline.steps.iter().skip(1) {
        let own = state::known_keys(&step.form);
        let keys = KEYS.into_iter().filter(|key| own.contains(key));
        let keys = keys.map(|key| (key, step.body.get(key).cloned().map(Document::of))).collect();
        let places = places.get(&step.body.at).map_or(&[][..], Vec::as_slice);
        let shared = |why| Some(EditError::Shared { path: step.path.clone(), at: step.at, why });
        let (body, fixed) = match places {
            [] => (None, shared("it is written out from a shorter form")),
            [(_, true)] => (None, shared("it is made by `regions: { for: … }`")),
            [(body, false)] => (Some(*body), None),
            _ => (None, shared("it stands in several places, through an alias")),
        };
        let written = Written {
            path: step.path.clone(),
            depth: step.path.matches('/').count(),
            form: form(&step.form, step.body),
            location: step.at,
            keys,
            places: step.body.entries().iter().map(|entry| (entry.at, entry.key.clone())).collect(),
            fixed,
        };
        found.push(Found { written, body });
    }
    found
}

fn form(form: &Form<'_>, body: &Node) -> String {
    let key = match form {
        Form::Action { .. } => "action",
        Form::Sequence { .. } => "states",
        Form::ForEach { .. } => "for",
        Form::Condition { .. } => "condition",
        Form::While { .. } => {
            ["while", "do_while", "until"].into_iter().find(|key| body.get(key).is_some()).unwrap_or("while")
        }
        Form::Concurrency { .. } => "concurrency",
        Form::Library { .. } => "library",
        Form::Wait { asks: true, .. } => "ask",
        Form::Wait { .. } => "wait",
    };
    match body.get(key).map(|node| &node.content) {
        Some(Content::Text(text)) => format!("{key}: {text}"),
        _ => key.to_owned(),
    }
}

/// All mappings by their location, each with whether regions are made from it.
fn mappings<'n>(node: &'n Node, is_made: bool, found: &mut BTreeMap<Location, Vec<(&'n Node, bool)>>) {
    match &node.content {
        Content::List(items) => items.iter().for_each(|item| mappings(item, is_made, found)),
        Content::Map(entries) => {
            found.entry(node.at).or_default().push((node, is_made));
            for Entry { key, value, .. } in entries {
                let is_made = is_made || (key == "regions" && matches!(value.content, Content::Map(_)));
                mappings(value, is_made, found);
            }
        }
        _ => {}
    }
}

/// The tree with the change; a new key is inserted at `index`.
fn changed(node: &Node, body: &Node, key: &str, value: Option<&Document>, index: usize) -> Document {
    match &node.content {
        Content::List(items) => {
            Document::List(items.iter().map(|item| changed(item, body, key, value, index)).collect())
        }
        Content::Map(entries) if node.at == body.at => {
            let own = entries.iter().map(|entry| (entry.key.clone(), Document::of(entry.value.clone())));
            let mut own: Vec<(String, Document)> = own.collect();
            match (own.iter().position(|(other, _)| other == key), value) {
                (Some(place), Some(value)) => own[place].1 = value.clone(),
                (Some(place), None) => drop(own.remove(place)),
                (None, Some(value)) => own.insert(index.min(own.len()), (key.to_owned(), value.clone())),
                (None, None) => {}
            }
            Document::Map(own)
        }
        Content::Map(entries) => Document::Map(
            entries.iter().map(|entry| (entry.key.clone(), changed(&entry.value, body, key, value, index))).collect(),
        ),
        _ => Document::of(node.clone()),
    }
}

struct Change<'c> {
    lines: Lines<'c>,
    body: &'c Node,
    key: &'c str,
    value: Option<&'c Document>,
}

type Made = Result<(String, usize), &'static str>;

const ODD: &str = "the way in which this state is written is not understood";
const ANCHORED: &str = "an anchor or an alias (`&`, `*`) stands there";

impl Change<'_> {
    /// The new text, and the index of a new key among the state's keys.
    fn made(&self) -> Made {
        let entries = self.body.entries();
        let begin = self.lines.offset(self.body.at).ok_or(ODD)?;
        // Keys merged into the mapping (`<<`) stand elsewhere.
        let keys: Vec<usize> =
            entries.iter().map(|entry| self.lines.offset(entry.at)).collect::<Option<_>>().ok_or(ODD)?;
        let is_own = |(entry, at): (&Entry, &usize)| {
            self.lines.text[*at..].trim_start_matches(['"', '\'']).starts_with(&entry.key)
        };
        let in_order = keys.first().is_some_and(|first| *first >= begin) && keys.windows(2).all(|two| two[0] < two[1]);
        if !in_order || !entries.iter().zip(&keys).all(is_own) {
            return Err(ODD);
        }
        let place = entries.iter().position(|entry| entry.key == self.key);
        if self.lines.text[begin..].starts_with('{') {
            self.in_flow(&keys, place)
        } else if entries.iter().all(|entry| entry.at.column == entries[0].at.column) && keys[0] == begin {
            self.in_block(&keys, place)
        } else {
            Err(ODD)
        }
    }

    fn splice(&self, from: usize, to: usize, with: &str) -> String {
        let text = self.lines.text;
        [&text[..from], with, &text[to..]].concat()
    }

    fn in_flow(&self, keys: &[usize], place: Option<usize>) -> Made {
        let text = self.lines.text;
        // From a key to the last character of its value, and the comma or bracket behind it.
        let span = |key: usize| {
            let end = flow_end(text, key).ok_or(ODD)?;
            let last = key + text[key..end].trim_end().len();
            if !comments(&text[key..last]).is_empty() {
                return Err("a comment stands inside of its value");
            }
            Ok((last, end))
        };
        let written = self.value.map(|value| format!("{}: {}", self.key, flow(value)));
        let Some(place) = place else {
            let Some(written) = written else { return Ok((text.to_owned(), 0)) };
            let last_key = *keys.last().ok_or(ODD)?;
            let end = flow_end(text, last_key).ok_or(ODD)?;
            // A comment may follow the last value.
            let last = scan::without_comments_end(text, last_key, end);
            let line = self.lines.line_of(last);
            let width = self.lines.content(line).chars().count() + written.chars().count() + 2;
            let (first, indent) = (keys[0], self.lines.column(keys[0]));
            let is_short = width <= LINE_WIDTH || (line == self.lines.line_of(first) && written.len() > LINE_WIDTH);
            let between = match is_short {
                true => ", ".to_owned(),
                false => format!(",{}{}", self.lines.newline(), " ".repeat(indent)),
            };
            return Ok((self.splice(last, last, &(between + &written)), keys.len()));
        };
        let key = keys[place];
        let (last, end) = span(key)?;
        if has_anchor(&text[key..last]) {
            return Err(ANCHORED);
        }
        if let Some(written) = written {
            return Ok((self.splice(key, last, &written), place));
        }
        let blanks = |from: usize| from + text[from..].len() - text[from..].trim_start_matches([' ', '\t']).len();
        let before = text[..key].trim_end().len();
        if text[end..].starts_with(',') {
            let behind = blanks(end + 1);
            let starts_line = self.lines.starts_line(key);
            let ends_line = text[behind..].starts_with(['\n', '\r']);
            let (from, to) = match (starts_line, ends_line) {
                (true, true) => {
                    let line = self.lines.line_of(key);
                    (self.lines.start(line), self.lines.start(self.lines.line_of(end) + 1))
                }
                (false, true) => (key - (text[..key].len() - text[..key].trim_end_matches([' ', '\t']).len()), end + 1),
                (_, false) => (key, behind),
            };
            return Ok((self.splice(from, to, ""), place));
        }
        if text[..before].ends_with(',') {
            return Ok((self.splice(before - 1, last, ""), place));
        }
        // A comment precedes it, so the comma stays.
        Ok((self.splice(key, last, ""), place))
    }

    fn in_block(&self, keys: &[usize], place: Option<usize>) -> Made {
        let text = self.lines.text;
        let (indent, newline) = (self.lines.column(keys[0]), self.lines.newline());
        let margin = " ".repeat(indent);
        // From a key to the end of the last line of its value.
        let end = |place: usize| {
            let bound = keys.get(place + 1).map(|next| self.lines.line_of(*next));
            self.lines.block_end(self.lines.line_of(keys[place]), indent, bound)
        };
        let Some(place) = place else {
            let Some(value) = self.value else { return Ok((text.to_owned(), 0)) };
            let written = self.block(value, indent, false, "");
            let is_list = |entry: &Entry| LISTS.contains(&entry.key.as_str());
            let list = self.body.entries().iter().position(is_list);
            return match list {
                Some(0) if self.lines.starts_line(keys[0]) => {
                    let start = self.lines.start(self.lines.line_of(keys[0]));
                    Ok((self.splice(start, start, &format!("{margin}{written}{newline}")), 0))
                }
                Some(list) if list > 0 => {
                    let after = end(list - 1);
                    Ok((self.splice(after, after, &format!("{newline}{margin}{written}")), list))
                }
                _ => {
                    let after = end(keys.len() - 1);
                    Ok((self.splice(after, after, &format!("{newline}{margin}{written}")), keys.len()))
                }
            };
        };
        let (key, end) = (keys[place], end(place));
        if has_anchor(&text[key..end]) {
            return Err(ANCHORED);
        }
        if has_hidden_comment(&text[key..end]) {
            return Err("what looks like a comment stands behind a text over several lines (`|`, `>`)");
        }
        // Comments in the old value are kept: a comment on the key's line stays behind the key, others get their own lines.
        let first_line_end = end.min(self.lines.end(self.lines.line_of(key)));
        let behind = comments(&text[key..first_line_end]).first().map(|comment| {
            let at = first_line_end - comment.len();
            let gap = text[key..at].len() - text[key..at].trim_end_matches([' ', '\t']).len();
            text[at - gap..first_line_end].to_owned()
        });
        let rest: Vec<&str> = comments(&text[key..end]).into_iter().skip(usize::from(behind.is_some())).collect();
        if let (Some(Document::List(new)), Content::List(old)) = (self.value, &self.body.entries()[place].value.content)
            && let Some(new) = self.list_kept(key, end, old, new)
        {
            return Ok((self.splice(key, end, &new), place));
        }
        let starts_line = self.lines.starts_line(key);
        match self.value {
            Some(value) => {
                let is_block = text[key..end].contains('\n')
                    && matches!(&self.body.entries()[place].value.content, Content::List(_))
                    && self.lines.content(self.lines.line_of(key) + 1).trim_start().starts_with(['-', '#']);
                let written = self.block(value, indent, is_block, behind.as_deref().unwrap_or_default());
                let kept = |comment: &&str| format!("{comment}{newline}{margin}");
                let new = match starts_line {
                    true => rest.iter().map(kept).collect::<String>() + &written,
                    false => {
                        written + &rest.iter().map(|comment| format!("{newline}{margin}{comment}")).collect::<String>()
                    }
                };
                Ok((self.splice(key, end, &new), place))
            }
            None if starts_line => {
                let kept: Vec<String> = behind
                    .iter()
                    .map(|comment| comment.trim())
                    .chain(rest)
                    .map(|comment| format!("{margin}{comment}{newline}"))
                    .collect();
                let start = self.lines.start(self.lines.line_of(key));
                let next = self.lines.start(self.lines.line_of(end) + 1);
                let mut new = kept.concat();
                let mut start = start;
                if next == end {
                    // The file's last line has no line end, so the new last line gets none.
                    new = new.trim_end_matches(['\n', '\r']).to_owned();
                    if new.is_empty() {
                        start = text[..start].trim_end_matches(['\n', '\r']).len();
                    }
                }
                Ok((self.splice(start, next, &new), place))
            }
            // The first key of a list item: the next key takes its place.
            None => match keys.get(place + 1) {
                Some(next) if comments(&text[key..*next]).is_empty() => Ok((self.splice(key, *next, ""), place)),
                _ => Err("it is the first key of its list item, and a comment stands behind it"),
            },
        }
    }

    /// A list with one item per line: items that are kept keep their text. `None` if no item is kept.
    fn list_kept(&self, key: usize, end: usize, old: &[Node], new: &[Document]) -> Option<String> {
        let (text, lines, newline) = (self.lines.text, &self.lines, self.lines.newline());
        let (first, last) = (lines.line_of(key), lines.line_of(end));
        let head = &text[key..lines.end(first).min(end)];
        let value_begins = scan::without_comments_end(head, 0, head.len());
        if !head[..value_begins].ends_with(':') {
            return None;
        }
        // For each item: the line of its dash, and the first line of the comments above it.
        let mut items: Vec<(usize, usize)> = Vec::new();
        let (mut depth, mut above) = (None, first + 1);
        for line in first + 1..=last {
            let content = lines.content(line);
            let own = content.trim_start_matches(' ');
            let is_dash = own == "-" || own.starts_with("- ");
            if is_dash && *depth.get_or_insert(content.len() - own.len()) == content.len() - own.len() {
                items.push((above, line));
            }
            if !(own.trim().is_empty() || own.starts_with('#')) {
                above = line + 1;
            }
        }
        if items.len() != old.len() {
            return None;
        }
        let margin = " ".repeat(depth?);
        let until = |item: usize| items.get(item + 1).map_or(last + 1, |next| next.0);
        let span = |item: usize| &text[lines.start(items[item].0)..lines.end(until(item) - 1)];
        let mut made = head.to_owned();
        let drop_items = |made: &mut String, from: usize, to: usize| {
            for comment in (from..to).flat_map(|item| comments(span(item))) {
                made.extend([newline, &margin, comment]);
            }
        };
        let mut next = 0;
        for item in new {
            match (next..old.len()).find(|place| Document::of(old[*place].clone()) == *item) {
                Some(place) => {
                    drop_items(&mut made, next, place);
                    made.extend([newline, span(place)]);
                    next = place + 1;
                }
                None => made.extend([newline, &margin, "- ", &flow(item)]),
            }
        }
        drop_items(&mut made, next, old.len());
        (next > 0).then_some(made)
    }

    /// `key: value`, followed by `behind`; on one line if it was so before or is short.
    fn block(&self, value: &Document, indent: usize, is_block: bool, behind: &str) -> String {
        let (key, newline) = (self.key, self.lines.newline());
        let line = format!("{key}: {}{behind}", flow(value));
        let below = " ".repeat(indent + 2);
        let is_long = line.chars().count() + indent > LINE_WIDTH;
        match value {
            Document::List(items) if !items.is_empty() && (is_block || is_long) => {
                let items = items.iter().map(|item| format!("{newline}{below}- {}", flow(item)));
                items.fold(format!("{key}:{behind}"), |text, item| text + &item)
            }
            Document::Map(entries) if !entries.is_empty() && is_long => {
                let entries = entries
                    .iter()
                    .map(|(key, value)| format!("{newline}{below}{}: {}", scan::scalar(key), flow(value)));
                entries.fold(format!("{key}:{behind}"), |text, entry| text + &entry)
            }
            _ => line,
        }
    }
}

#[cfg(test)]
mod tests;
