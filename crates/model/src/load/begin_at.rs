//! A run that begins at another state than the first (`ratn run --from`).
//!
//! In each list on the path to that state, a state is inserted in front that leads to the next state on the path:
//!
//! ```text
//!                                states:
//! states:                          - begin: {states: [], transitions: {success: cups}}
//!   - look: {…}                    - look: {…}
//!   - cups:               →        - cups:
//!       states:                        states:
//!         - find: {…}                    - begin: {states: [], transitions: {success: pick}}
//!         - pick: {…}                    - find: {…}
//!                                        - pick: {…}
//! ```

use super::suggestion;
use super::written_out::named;
use super::yaml::{Content, Entry, Node};
use crate::diagnostic::Findings;
use crate::program::SUCCESS;
use std::collections::BTreeSet;

/// Makes the states of a list begin at `from`: the name of one of them, or a path into them, as `cups/pick`. Every state on the path must be entered
/// exactly once and in one way, so that it is clear what begins there.
pub(super) fn begin_at(list: &mut Node, from: &str, findings: &mut Findings) {
    let mut names = BTreeSet::new();
    keys(list, &mut names);
    let new = |n: u32| if n == 1 { "begin".to_owned() } else { format!("begin_{n}") };
    let name = (1..).map(new).find(|name| !names.contains(name)).unwrap_or_default();
    step(list, "", from, &name, findings);
}

/// The same for a list inside of the state with the path `around`.
fn step(list: &mut Node, around: &str, from: &str, name: &str, findings: &mut Findings) {
    let at = list.at;
    let Content::List(states) = &mut list.content else { return };
    let (first, rest) = from.split_once('/').map_or((from, None), |(first, rest)| (first, Some(rest)));
    let known: Vec<&str> = states.iter().filter_map(named).collect();
    let Some(place) = states.iter().position(|state| named(state) == Some(first)) else {
        let owner = if around.is_empty() { "the task".to_owned() } else { format!("`{around}`") };
        let message = format!("{owner} has no state `{first}` in its own list, at which it could begin");
        let help = suggestion(first, known.into_iter(), "", "its states have no names");
        return findings.error("invalid-state", at, around, message, help);
    };
    if let Some(rest) = rest {
        let path = if around.is_empty() { first.to_owned() } else { format!("{around}/{first}") };
        let earlier: Vec<&str> = states[..=place].iter().filter_map(named).collect();
        let comes_back = states[place..].iter().any(|state| leads_to_one_of(state, &earlier));
        let Content::Map(state) = &mut states[place].content else { return };
        let Some(keys) = state.first_mut().map(|entry| &mut entry.value) else { return };
        let at = keys.at;
        if let Some(why) = why_not(keys, comes_back) {
            let message = format!("a run cannot begin inside of `{path}`: {why}");
            return findings.error("invalid-state", at, &path, message, format!("begin at `{path}`, or before it"));
        }
        let Content::Map(keys) = &mut keys.content else { return };
        let Some(list) = keys.iter_mut().find(|entry| entry.key == "states") else { return };
        step(&mut list.value, &path, rest, name, findings);
    }
    let node = |content: Content| Node { at, offset: None, content };
    let entry = |key: &str, content: Content| Entry { key: key.to_owned(), at, value: node(content) };
    let leads = vec![entry(SUCCESS, Content::Text(first.to_owned()))];
    let keys = vec![entry("states", Content::List(Vec::new())), entry("transitions", Content::Map(leads))];
    states.insert(0, node(Content::Map(vec![entry(name, Content::Map(keys))])));
}

/// The reason why a run cannot begin inside of a state, if there is one.
fn why_not(state: &Node, comes_back: bool) -> Option<&'static str> {
    let has = |key: &str| state.get(key).is_some();
    if has("do") {
        return Some("it is a loop, and which pass is meant is not said");
    }
    if has("condition") {
        return Some("only its condition says which way it goes");
    }
    if has("regions") {
        return Some("its regions begin all at once");
    }
    if has("library") {
        return Some("what it does stands in another file");
    }
    if !has("states") {
        return Some("there are no states in it");
    }
    if has("retry") {
        return Some("it is retried from its own beginning");
    }
    comes_back.then_some("a transition leads back to it or before it, and it begins at its own beginning then")
}

fn leads_to_one_of(state: &Node, names: &[&str]) -> bool {
    let [entry] = state.entries() else { return false };
    let transitions = entry.value.get("transitions").map(Node::entries).unwrap_or_default();
    transitions.iter().any(|lead| matches!(&lead.value.content, Content::Text(to) if names.contains(&to.as_str())))
}

/// Collects all keys of mappings, which include the names of states.
fn keys(node: &Node, names: &mut BTreeSet<String>) {
    for entry in node.entries() {
        names.insert(entry.key.clone());
        keys(&entry.value, names);
    }
    if let Content::List(items) = &node.content {
        items.iter().for_each(|item| keys(item, names));
    }
}
