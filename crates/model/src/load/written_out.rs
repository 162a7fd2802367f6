//! `switch`, `fallback` and similar regions: short forms, which are expanded into other forms before anything else is read.
//!
//! ```text
//! switch: look.kind              condition: (look.kind) = cup
//! cases:                         then: […]
//!   cup: […]              →      else:
//!   bowl: […]                      - else: { condition: (look.kind) = bowl, then: […], else: […] }
//! default: […]
//!
//! fallback:                      states:
//!   - pick: {…}           →        - pick: {…, transitions: {success: success, aborted: ask}}
//!   - ask: {…}                     - ask: {…, transitions: {success: success}}
//!
//! regions:                       regions:
//!   for: arm in [left, right]  →   - left: {states: […with left for $arm…]}
//!   do: […]                        - right: {states: […with right for $arm…]}
//! ```

use super::yaml::{Content, Entry, Node};
use crate::diagnostic::Findings;
use crate::expression::Comprehension;
use crate::expression::display::is_word;
use crate::parameters::constant;
use crate::program::{ABORTED, SUCCESS};
use crate::value::Value;

/// Limit of the cases of a switch; each is a condition nested in the one before.
const MAX_CASES: usize = 24;

/// Limit of the regions made by `for`.
const MAX_REGIONS: usize = 64;

/// Keys with lists of states below.
const LISTS: [&str; 9] = ["states", "do", "then", "else", "regions", "default", "fallback", "before", "finally"];

/// Forms whose `index` is a variable.
const LOOPS: [&str; 4] = ["for", "while", "do_while", "until"];

/// Expands a list of states, and all lists inside.
pub(crate) fn write_out(list: &mut Node, findings: &mut Findings) {
    let Content::List(items) = &mut list.content else { return };
    for item in items {
        state(item, "", findings);
    }
}

/// Expands a state: a mapping with its keys, or with its name and such a mapping.
fn state(node: &mut Node, name: &str, findings: &mut Findings) {
    if node.get("switch").is_some() && (node.get("cases").is_some() || node.entries().len() == 1) {
        switch(node, name, findings);
    } else if node.get("fallback").is_some() {
        fallback(node, name, findings);
    } else if node.get("concurrency").is_some()
        && let Content::Map(entries) = &mut node.content
        && let Some(regions) = entries.iter_mut().find(|entry| entry.key == "regions")
        && matches!(regions.value.content, Content::Map(_))
    {
        alike(&mut regions.value, name, findings);
    }
    let Content::Map(entries) = &mut node.content else { return };
    let is_alone = entries.len() == 1;
    for Entry { key, value, .. } in entries {
        match (&value.content, key.as_str()) {
            (Content::List(_), list) if LISTS.contains(&list) => write_out(value, findings),
            (Content::Map(_), "retry") => state(value, name, findings),
            (Content::Map(_), _) if is_alone => state(value, &key.clone(), findings),
            _ => {}
        }
    }
}

/// Expands a switch: nested conditions, one per case.
fn switch(node: &mut Node, name: &str, findings: &mut Findings) {
    let at = node.at;
    let Some(entries) = taken(node) else { return };
    let (mut on, mut cases, mut default) = (None, None, None);
    let mut rest = Vec::new();
    for entry in entries {
        match entry.key.as_str() {
            "switch" => on = Some(entry.value),
            "cases" => cases = Some(entry),
            "default" => default = Some(entry.value),
            "condition" | "then" | "else" => {
                let message = format!("there is no key `{}` of a `switch`", entry.key);
                findings.error("unknown-key", entry.at, name, message, "it has `cases` and `default`");
            }
            _ => rest.push(entry),
        }
    }
    let mut refuse = |message: String, help: &str| findings.error("invalid-state", at, name, message, help);
    let (text, cases) = match (on.as_ref().map(|node| &node.content), cases.map(|entry| entry.value.content)) {
        (Some(Content::Text(text)), Some(Content::Map(cases))) if (1..=MAX_CASES).contains(&cases.len()) => {
            (text.clone(), cases)
        }
        (Some(Content::Text(_)), _) => {
            refuse(
                format!("a `switch` has 1 to {MAX_CASES} cases, each a value with a list of states"),
                "write `cases: { cup: […], bowl: […] }`, and `default: […]` for any other value",
            );
            return empty(node, rest);
        }
        _ => {
            refuse("a `switch` looks at an expression".to_owned(), "write `switch: look.kind`");
            return empty(node, rest);
        }
    };
    let outcomes = rest.iter().find(|entry| entry.key == "outcomes").cloned();
    let mut otherwise = default.unwrap_or(Node { at, offset: None, content: Content::List(Vec::new()) });
    for (number, case) in cases.into_iter().enumerate().rev() {
        let Some(value) = value(&case.key) else {
            let message = format!("`{}` is no value that a case can be for", case.key);
            findings.error(
                "invalid-state",
                case.at,
                name,
                message,
                "a case is a word, a number, or a text without quotes in it",
            );
            continue;
        };
        // The location is that of the case, in the file.
        let condition = Node { at: case.at, offset: None, content: Content::Text(format!("({text}) = {value}")) };
        let entry = |key: &str, value: Node| Entry { key: key.to_owned(), at: case.at, value };
        let mut condition = vec![entry("condition", condition), entry("then", case.value), entry("else", otherwise)];
        if number == 0 {
            condition.append(&mut rest);
            node.content = Content::Map(condition);
            return;
        }
        condition.extend(outcomes.clone());
        let inner = Node { at: case.at, offset: None, content: Content::Map(condition) };
        let named = Content::Map(vec![entry("else", inner)]);
        let item = Node { at: case.at, offset: None, content: named };
        otherwise = Node { at: case.at, offset: None, content: Content::List(vec![item]) };
    }
    empty(node, rest);
}

/// The value of a case as an expression.
fn value(key: &str) -> Option<String> {
    let is_number = key.parse::<f64>().is_ok_and(f64::is_finite);
    if is_word(key) || is_number {
        return Some(key.to_owned());
    }
    (!key.contains(['"', '\\', '\n'])).then(|| format!("\"{key}\""))
}

/// Expands a fallback: each state leads to the next if it fails, and out by success.
fn fallback(node: &mut Node, name: &str, findings: &mut Findings) {
    let at = node.at;
    let Content::Map(entries) = &mut node.content else { return };
    let Some(list) = entries.iter_mut().find(|entry| entry.key == "fallback") else { return };
    list.key = "states".to_owned();
    let Content::List(ways) = &mut list.value.content else { return };
    let names: Vec<Option<String>> = ways.iter().map(|way| named(way).map(str::to_owned)).collect();
    if ways.is_empty() {
        findings.error(
            "invalid-state",
            at,
            name,
            "there is nothing to try",
            "list states: the first that succeeds is the last",
        );
    }
    for (number, way) in ways.iter_mut().enumerate() {
        if names[number].is_none() {
            let help = "write `- name: {…}`: the state before it leads there by its name";
            findings.error("invalid-state", way.at, name, "each state of a `fallback` has a name", help);
            continue;
        }
        if let Some(outcome) = names[number].as_deref().filter(|name| [SUCCESS, ABORTED].contains(name)) {
            let message = format!(
                "a state of a `fallback` is not called `{outcome}`: success leads out, and what fails to the next one"
            );
            findings.error("invalid-state", way.at, name, message, "give it another name");
            continue;
        }
        let next = names.get(number + 1).cloned().flatten();
        let Content::Map(way) = &mut way.content else { continue };
        let Some(body) = way.first_mut().map(|entry| &mut entry.value) else { continue };
        let at = body.at;
        let Content::Map(keys) = &mut body.content else { continue };
        if !keys.iter().any(|entry| entry.key == "transitions") {
            let value = Node { at, offset: None, content: Content::Map(Vec::new()) };
            keys.push(Entry { key: "transitions".to_owned(), at, value });
        }
        let Some(transitions) = keys.iter_mut().find(|entry| entry.key == "transitions") else { continue };
        let Content::Map(leads) = &mut transitions.value.content else { continue };
        if let Some(entry) = leads.iter().find(|entry| [SUCCESS, ABORTED].contains(&entry.key.as_str())) {
            let help = "leave it out, or write the states as `states`, with transitions of your own";
            let message = format!("where `{}` leads the `fallback` says", entry.key);
            findings.error("invalid-state", entry.at, name, message, help);
            continue;
        }
        let mut lead = |outcome: &str, to: &str| {
            let value = Node { at, offset: None, content: Content::Text(to.to_owned()) };
            leads.push(Entry { key: outcome.to_owned(), at, value });
        };
        lead(SUCCESS, SUCCESS);
        if let Some(next) = next {
            lead(ABORTED, &next);
        }
    }
}

/// Expands similar regions, which differ in the value of a variable.
fn alike(node: &mut Node, name: &str, findings: &mut Findings) {
    let at = node.at;
    let Some(entries) = taken(node) else { return };
    node.content = Content::List(Vec::new());
    let (mut over, mut body, mut rest) = (None, None, Vec::new());
    for entry in entries {
        match entry.key.as_str() {
            "for" => over = Some(entry.value),
            "do" => body = Some(entry.value),
            "variables" | "states" => {
                let message = format!("there is no key `{}` of regions that are alike", entry.key);
                findings.error("unknown-key", entry.at, name, message, "they have `for` and `do`");
            }
            _ => rest.push(entry),
        }
    }
    let help = "write `regions: { for: 'arm in [left, right]', do: […] }`, or a list of states";
    let listed = |node: &Node| {
        let Content::Text(text) = &node.content else { return None };
        let (variable, list) = text.split_once(" in ")?;
        let Ok(Value::List(values)) = constant(list.trim()) else { return None };
        is_word(variable.trim()).then(|| (variable.trim().to_owned(), values))
    };
    let (Some((variable, values)), Some(body)) = (over.as_ref().and_then(listed), body) else {
        let message = "regions are a list of states, or `for` a variable and a list of values what each of them does";
        return findings.error("invalid-state", at, name, message, help);
    };
    if !(1..=MAX_REGIONS).contains(&values.len()) {
        let message = format!("there are 1 to {MAX_REGIONS} regions that are alike, and not {}", values.len());
        return findings.error("invalid-state", at, name, message, help);
    }
    if binds(&body, &variable) || rest.iter().any(|one| binds(&one.value, &variable)) {
        let message = format!("another variable inside is called `{variable}`, too");
        return findings.error("invalid-state", at, name, message, "give one of them another name");
    }
    let region = |(number, value): (usize, &Value)| {
        let (text, name) = match value {
            Value::String(word) if is_word(word) => (word.clone(), word.clone()),
            number_or_other => (constant_text(number_or_other), format!("{variable}_{}", number + 1)),
        };
        let entry = |key: String, at, value| Entry { key, at, value };
        let mut keys = vec![entry("states".to_owned(), body.at, with(&body, &variable, &text))];
        keys.extend(rest.iter().map(|one| entry(one.key.clone(), one.at, with(&one.value, &variable, &text))));
        let keys = Node { at, offset: None, content: Content::Map(keys) };
        Node { at, offset: None, content: Content::Map(vec![entry(name, at, keys)]) }
    };
    node.content = Content::List(values.iter().enumerate().map(region).collect());
}

/// A constant as text that can replace a variable anywhere.
fn constant_text(value: &Value) -> String {
    let is_plain = value.as_number().is_some_and(|number| number >= 0.0);
    if is_plain { value.to_string() } else { format!("({value})") }
}

/// Whether a text contains `map($name in …` or another comprehension with this element.
fn is_element(text: &str, variable: &str) -> bool {
    let name = format!("${variable}");
    text.match_indices(&name).any(|(at, _)| {
        let behind = text[at + name.len()..].strip_prefix(char::is_whitespace);
        let is_list_behind = behind.is_some_and(|rest| rest.trim_start().starts_with("in "));
        let called = text[..at].trim_end().strip_suffix('(').map(str::trim_end);
        let called = called.and_then(|called| called.rsplit(|c: char| !(c.is_alphanumeric() || c == '_')).next());
        is_list_behind && called.is_some_and(|called| Comprehension::named(called).is_some())
    })
}

/// Whether a loop, variables or a comprehension inside bind this name.
fn binds(node: &Node, variable: &str) -> bool {
    let is_loop = node.entries().iter().any(|entry| LOOPS.contains(&entry.key.as_str()));
    let by_entry = |Entry { key, value, .. }: &Entry| {
        let is_bound = match (&value.content, key.as_str()) {
            (Content::Text(name), "index") => is_loop && name.trim() == variable,
            (Content::Text(text), "for") => {
                text.split_once(" in ").is_some_and(|(names, _)| names.split(',').any(|one| one.trim() == variable))
            }
            (Content::Map(_), "variables") => value.get(variable).is_some(),
            _ => false,
        };
        is_bound || binds(value, variable)
    };
    match &node.content {
        Content::Text(text) => is_element(text, variable),
        Content::List(items) => items.iter().any(|item| binds(item, variable)),
        Content::Map(entries) => entries.iter().any(by_entry),
        _ => false,
    }
}

/// The node with a text in place of a variable, in keys and values.
fn with(node: &Node, variable: &str, text: &str) -> Node {
    let entry = |one: &Entry| {
        let (key, value) = (replaced(&one.key, variable, text), with(&one.value, variable, text));
        Entry { key, at: one.at, value }
    };
    let content = match &node.content {
        Content::Text(old) => Content::Text(replaced(old, variable, text)),
        Content::List(items) => Content::List(items.iter().map(|item| with(item, variable, text)).collect()),
        Content::Map(entries) => Content::Map(entries.iter().map(entry).collect()),
        other => other.clone(),
    };
    Node { at: node.at, offset: node.offset.filter(|_| content == node.content), content }
}

fn replaced(old: &str, variable: &str, text: &str) -> String {
    let (mut new, mut rest) = (String::new(), old);
    while let Some(place) = rest.find('$') {
        let (before, name) = (&rest[..place], &rest[place + 1..]);
        let end = name.find(|c: char| !(c.is_alphanumeric() || c == '_')).unwrap_or(name.len());
        new.push_str(before);
        match &name[..end] {
            name if name == variable => new.push_str(text),
            other => new.extend(["$", other]),
        }
        rest = &name[end..];
    }
    new + rest
}

/// The name of a state in a list, if it has one.
pub(super) fn named(item: &Node) -> Option<&str> {
    match item.entries() {
        [entry] if matches!(entry.value.content, Content::Map(_)) => Some(&entry.key),
        _ => None,
    }
}

fn taken(node: &mut Node) -> Option<Vec<Entry>> {
    match &mut node.content {
        Content::Map(entries) => Some(std::mem::take(entries)),
        _ => None,
    }
}

/// Replaces a refused state by one without children.
fn empty(node: &mut Node, mut rest: Vec<Entry>) {
    let value = Node { at: node.at, offset: None, content: Content::List(Vec::new()) };
    rest.push(Entry { key: "states".to_owned(), at: node.at, value });
    node.content = Content::Map(rest);
}
