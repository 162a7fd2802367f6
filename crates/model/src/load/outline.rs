//! The tree of steps of a task file: kinds, names and order of the states, before any expression is read. So an expression may refer to a
//! state further down, and the rules can report that.

use super::yaml::{Content, Entry, Node};
use crate::diagnostic::Findings;
use crate::expression::Function;
use crate::expression::display::is_word;
use crate::id::StateId;
use crate::program::Location;

/// Limit of the states of a task.
const MAX_STATES: usize = 10_000;
/// Limit of nested states.
const MAX_DEPTH: usize = 32;

/// Keys that give the form of a step.
const FORMS: [&str; 11] =
    ["action", "for", "condition", "states", "while", "do_while", "until", "concurrency", "library", "wait", "ask"];
/// Forms that have been expanded before ([`super::written_out`]).
const SHORT_FORMS: [&str; 2] = ["switch", "fallback"];
/// Forms whose names people also use for states.
const NAMES: [&str; 2] = ["wait", "ask"];

/// Keys of other languages for the form of a step, and how to write it here.
const FOREIGN_FORMS: [(&str, &str); 10] = [
    ("selector", "write `- name:`, with `fallback: […]`"),
    ("if", CONDITION),
    ("when", CONDITION),
    ("repeat", COUNTED),
    ("loop", COUNTED),
    ("foreach", "write `- for: x in list`, with `do: […]`"),
    ("sequence", "write `- name:`, with `states: […]`"),
    (
        "parallel",
        "write `- name:`, with `concurrency: barrier` and `regions: […]`, or `regions: { for: 'arm in [left, right]', do: […] }`",
    ),
    ("sleep", "write `- wait: { seconds: 1 }`"),
    ("call", "write `- name:`, with `action: provider/action` and `in: {…}`"),
];
const CONDITION: &str = "write `- condition: …`, with `then: […]` and `else: […]`";
const COUNTED: &str = "write `- for: i in range(n)`, with `do: […]`";

/// Whether a key of a list item gives the form of the state. `wait: { action: … }` is a state named `wait`.
fn is_form(entry: &Entry) -> bool {
    let is_state = |entry: &Entry| entry.value.entries().iter().any(|inner| FORMS.contains(&inner.key.as_str()));
    FORMS.contains(&entry.key.as_str()) && !(NAMES.contains(&entry.key.as_str()) && is_named(entry, is_state))
}

/// Whether the value of `wait` or `ask` is a state. With `for`, `until` or `signal` it is a wait.
fn is_named(entry: &Entry, is_state: impl Fn(&Entry) -> bool) -> bool {
    let has = |key: &str| entry.value.get(key).is_some();
    is_state(entry) && (entry.key == "ask" || !(has("for") || has("until")) || has("do"))
}

/// The key of a form of another language, and how to write it here.
fn foreign_form(entries: &[Entry]) -> Option<(&Entry, &'static str)> {
    let here = |entry: &Entry| FOREIGN_FORMS.iter().find(|(other, _)| *other == entry.key).map(|(_, here)| *here);
    entries.iter().find_map(|entry| Some((entry, here(entry)?)))
}

/// Every step, by [`StateId`]; the root is the task.
#[derive(Debug)]
pub(crate) struct Outline<'a> {
    pub(crate) steps: Vec<Step<'a>>,
}

/// A step of the file, which becomes a state.
#[derive(Debug)]
pub(crate) struct Step<'a> {
    pub(crate) name: String,
    pub(crate) path: String,
    pub(crate) parent: Option<StateId>,
    /// The list of the parent; siblings have the same parent and branch.
    pub(crate) branch: Branch,
    pub(crate) form: Form<'a>,
    /// `retry: {before: …}`.
    pub(crate) before: Vec<StateId>,
    /// `finally: […]`.
    pub(crate) finally: Vec<StateId>,
    /// Its mapping.
    pub(crate) body: &'a Node,
    pub(crate) at: Location,
}

/// The list of its parent that a step is in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Branch {
    /// The only list, or `then`.
    First,
    /// `else`
    Otherwise,
    /// `retry: {before: …}`: in none of the parent's lists, and not inside of the parent.
    Before,
    /// `finally: […]`: the same.
    Finally,
}

/// The form of a step.
#[derive(Debug)]
pub(crate) enum Form<'a> {
    Action {
        action: &'a Node,
    },
    Sequence {
        children: Vec<StateId>,
    },
    ForEach {
        variable: String,
        collection: Header<'a>,
        index: Option<String>,
        body: Vec<StateId>,
    },
    Condition {
        predicate: &'a Node,
        then: Vec<StateId>,
        otherwise: Vec<StateId>,
    },
    While {
        predicate: &'a Node,
        tests: Tests,
        index: Option<String>,
        body: Vec<StateId>,
    },
    Concurrency {
        kind: &'a Node,
        regions: Vec<StateId>,
    },
    Library {
        file: &'a Node,
    },
    /// The executive itself waits or asks an operator.
    Wait {
        node: &'a Node,
        asks: bool,
    },
}

/// When the predicate of a loop is tested, and which result ends the loop.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Tests {
    /// `while`: before each iteration; false ends it.
    Before,
    /// `do_while`: after each iteration; false ends it.
    After,
    /// `until`: after each iteration; true ends it.
    Until,
}

/// `variable in collection`
#[derive(Debug, Clone)]
pub(crate) struct Header<'a> {
    /// The whole text.
    pub(crate) node: &'a Node,
    /// The part after `in`.
    pub(crate) collection: String,
    /// Where that part begins in the text, in characters.
    pub(crate) offset: usize,
}

impl Outline<'_> {
    pub(crate) fn step(&self, id: StateId) -> &Step<'_> {
        &self.steps[id.0 as usize]
    }

    /// The siblings of a step, itself included, in program order.
    pub(crate) fn siblings(&self, id: StateId) -> &[StateId] {
        let step = self.step(id);
        let parent = step.parent.map(|parent| self.step(parent));
        match (parent.map(|parent| &parent.form), step.branch) {
            (Some(Form::Condition { otherwise, .. }), Branch::Otherwise) => otherwise,
            (Some(_), Branch::Before) => parent.map_or(&[], |parent| &parent.before),
            (Some(_), Branch::Finally) => parent.map_or(&[], |parent| &parent.finally),
            (Some(form), _) => form.first_branch(),
            (None, _) => &[],
        }
    }

    /// Whether a step is a region of a concurrency.
    pub(crate) fn is_region(&self, id: StateId) -> bool {
        let is_concurrency = |parent| matches!(self.step(parent).form, Form::Concurrency { .. });
        self.step(id).branch == Branch::First && self.step(id).parent.is_some_and(is_concurrency)
    }

    /// The step and the steps around it, innermost first.
    pub(crate) fn around(&self, id: StateId) -> impl Iterator<Item = StateId> + '_ {
        std::iter::successors(Some(id), |id| self.step(*id).parent)
    }
}

impl Outline<'_> {
    /// The states that contain a step, innermost first. The steps of `retry: {before: …}` and `finally` are not inside of their state.
    pub(crate) fn containers(&self, id: StateId) -> impl Iterator<Item = StateId> + '_ {
        std::iter::successors(self.container(id), |id| self.container(*id))
    }

    fn container(&self, id: StateId) -> Option<StateId> {
        let step = self.step(id);
        match step.branch {
            Branch::First | Branch::Otherwise => step.parent,
            Branch::Before | Branch::Finally => step.parent.and_then(|parent| self.container(parent)),
        }
    }
}

impl<'a> Step<'a> {
    /// Whether this is how a further case of a `switch` is expanded: the only state of the branch, a condition named `else`.
    pub(crate) fn is_next_case(&self, branch: &[StateId]) -> bool {
        branch.len() == 1 && self.name == "else" && matches!(self.form, Form::Condition { .. })
    }

    /// The `while` conditions beside another form.
    pub(crate) fn holds(&self) -> Option<&'a Node> {
        match self.form {
            Form::While { tests: Tests::Before, .. } => None,
            _ => self.body.get("while"),
        }
    }
}

impl Form<'_> {
    /// The children, or those of `then`.
    pub(crate) fn first_branch(&self) -> &[StateId] {
        match self {
            Form::Action { .. } | Form::Library { .. } | Form::Wait { .. } => &[],
            Form::Sequence { children } => children,
            Form::ForEach { body, .. } | Form::While { body, .. } => body,
            Form::Concurrency { regions, .. } => regions,
            Form::Condition { then, .. } => then,
        }
    }
}

/// Splits `variable in collection`.
pub(crate) fn header<'a>(node: &'a Node, path: &str, findings: &mut Findings) -> Option<(String, Header<'a>)> {
    let expected = "write `for: variable in collection`";
    let Content::Text(text) = &node.content else {
        let message = format!("expected `variable in collection`, found {}", node.described());
        findings.error("invalid-state", node.at, path, message, expected);
        return None;
    };
    let split = text.find(" in ").map(|at| (text[..at].trim(), at + " in ".len()));
    let Some((variable, begin)) = split.filter(|(variable, _)| is_word(variable)) else {
        findings.error("invalid-state", node.at, path, format!("`{text}` is not `variable in collection`"), expected);
        return None;
    };
    let offset = text[..begin].chars().count();
    Some((variable.to_owned(), Header { node, collection: text[begin..].to_owned(), offset }))
}

/// Reads the outline of a whole file.
pub(crate) fn outline<'a>(name: &str, root: &'a Node, findings: &mut Findings) -> Outline<'a> {
    let mut builder = Builder { steps: Vec::new(), findings };
    builder.steps.push(Step {
        name: name.to_owned(),
        path: String::new(),
        parent: None,
        branch: Branch::First,
        form: Form::Sequence { children: Vec::new() },
        before: Vec::new(),
        finally: Vec::new(),
        body: root,
        at: root.at,
    });
    let children = match root.get("states") {
        Some(list) => builder.list(list, StateId(0), Branch::First, 0),
        None => {
            builder.findings.error("invalid-state", root.at, "", "the task has no `states`", "list its states there");
            Vec::new()
        }
    };
    builder.steps[0].form = Form::Sequence { children };
    Outline { steps: builder.steps }
}

struct Builder<'a, 'f> {
    steps: Vec<Step<'a>>,
    findings: &'f mut Findings,
}

impl<'a> Builder<'a, '_> {
    fn list(&mut self, list: &'a Node, parent: StateId, branch: Branch, depth: usize) -> Vec<StateId> {
        let path = self.steps[parent.0 as usize].path.clone();
        let Content::List(items) = &list.content else {
            let message = format!("expected a list of states, found {}", list.described());
            let first = list.entries().first().map_or("name", |entry| entry.key.as_str());
            let help = format!("write each state as `- {first}: {{…}}`, or with its keys in lines of their own below");
            self.findings.error("invalid-state", list.at, &path, message, help);
            return Vec::new();
        };
        if depth >= MAX_DEPTH || self.steps.len() + items.len() > MAX_STATES {
            let message = format!("a task has at most {MAX_STATES} states, nested at most {MAX_DEPTH} deep");
            self.findings.error("invalid-state", list.at, &path, message, "");
            return Vec::new();
        }
        let mut ids: Vec<StateId> = Vec::new();
        for item in items {
            let Some((name, at, body)) = self.named(item, &path) else { continue };
            let siblings = || ids.iter().map(|id| self.steps[id.0 as usize].name.as_str());
            let name = match name {
                Some(name) => name,
                None => unused(&default_name(body), siblings()),
            };
            let path = if path.is_empty() { name.clone() } else { format!("{path}/{name}") };
            if siblings().any(|other| other == name) {
                let message = format!("there are two states `{name}` side by side");
                self.findings.error("duplicate-name", at, &path, message, "rename one of them");
            }
            if let Some(id) = self.step(name, path, at, body, parent, branch, depth) {
                ids.push(id);
            }
        }
        ids
    }

    /// The name of a step, if it has one, and its mapping.
    fn named(&mut self, item: &'a Node, path: &str) -> Option<(Option<String>, Location, &'a Node)> {
        let entries = item.entries();
        // `- tuck:` with its keys in the same column: the name is a key without a value.
        if let [name, rest @ ..] = entries
            && rest.iter().any(is_form)
            && !is_form(name)
            && is_word(&name.key)
            && name.value.content == Content::Null
        {
            let message = format!("`{}` stands beside `{}` instead of in it", rest[0].key, name.key);
            let help = format!("indent what belongs to `{}` by two more blanks", name.key);
            self.findings.error("invalid-state", name.at, path, message, help);
            return None;
        }
        if let Some(form) = entries.iter().find(|entry| is_form(entry)) {
            if matches!(form.key.as_str(), "action" | "library" | "concurrency") {
                let message = "this state has no name";
                let help = format!("write `- name: {{ {}: … }}`", form.key);
                self.findings.error("invalid-state", item.at, path, message, help);
                return None;
            }
            return Some((None, item.at, item));
        }
        let [entry] = entries else {
            let (at, message, help) = match entries {
                _ if let Some((form, here)) = foreign_form(entries) => {
                    (form.at, format!("there is no form `{}`", form.key), here.to_owned())
                }
                [name, other, ..] if matches!(name.value.content, Content::Map(_)) => (
                    other.at,
                    format!("`{}` stands beside the state `{}`", other.key, name.key),
                    format!(
                        "indent it as the keys of `{}` if it belongs to it; a state of its own begins with `- `",
                        name.key
                    ),
                ),
                _ => (
                    item.at,
                    format!("expected `name: {{…}}`, found {}", item.described()),
                    "each state is one list item `- name: {…}`; mind the indentation of what belongs to it".to_owned(),
                ),
            };
            self.findings.error("invalid-state", at, path, message, help);
            return None;
        };
        if !is_word(&entry.key) || Function::named(&entry.key).is_some() {
            let message = format!("`{}` cannot be a state's name", entry.key);
            let help = "use letters, digits and _, beginning with a letter, and no word that is built in";
            self.findings.error("invalid-name", entry.at, path, message, help);
            return None;
        }
        if !matches!(entry.value.content, Content::Map(_)) {
            let message = format!("expected a mapping, found {}", entry.value.described());
            self.findings.error(
                "invalid-state",
                entry.at,
                path,
                message,
                "write `- name: { action: provider/action }`",
            );
            return None;
        }
        Some((Some(entry.key.clone()), entry.at, &entry.value))
    }

    #[expect(clippy::too_many_arguments, reason = "all of it is the place of one step")]
    fn step(
        &mut self,
        name: String,
        path: String,
        at: Location,
        body: &'a Node,
        parent: StateId,
        branch: Branch,
        depth: usize,
    ) -> Option<StateId> {
        let mut forms: Vec<&Entry> = body.entries().iter().filter(|e| FORMS.contains(&e.key.as_str())).collect();
        if forms.len() > 1 {
            // Beside another form, `while` gives conditions that must hold meanwhile.
            forms.retain(|form| form.key != "while");
        }
        let [form] = forms.as_slice() else {
            let message = match forms.as_slice() {
                [] => match foreign_form(body.entries()) {
                    Some((form, _)) => format!("there is no form `{}`", form.key),
                    None => "this is no kind of state".to_owned(),
                },
                [a, b, ..] => format!("a state is `{}` or `{}`, not both", a.key, b.key),
                [_] => String::new(),
            };
            let is_glued = |e: &&Entry| e.key.split_once(':').is_some_and(|(form, _)| FORMS.contains(&form));
            let help = match body.entries().iter().find(is_glued).and_then(|e| e.key.split_once(':')) {
                Some((form, value)) => format!("put a blank behind the colon: `{form}: {value}`"),
                None => match foreign_form(body.entries()) {
                    Some((_, here)) => here.to_owned(),
                    None => format!("give it one of {}", [&FORMS[..], &SHORT_FORMS[..]].concat().join(", ")),
                },
            };
            self.findings.error("invalid-state", at, &path, message, help);
            return None;
        };
        let (variable, collection) = match form.key.as_str() {
            "for" => header(&form.value, &path, self.findings)?,
            _ => (String::new(), Header { node: body, collection: String::new(), offset: 0 }),
        };
        let id = StateId(self.steps.len() as u64);
        let placeholder = Form::Sequence { children: Vec::new() };
        let (before, finally) = (Vec::new(), Vec::new());
        let parent = Some(parent);
        let step = Step { name, path: path.clone(), parent, branch, form: placeholder, before, finally, body, at };
        self.steps.push(step);
        let form = match form.key.as_str() {
            "action" => Form::Action { action: &form.value },
            "states" => Form::Sequence { children: self.list(&form.value, id, Branch::First, depth + 1) },
            "library" => Form::Library { file: &form.value },
            key @ ("wait" | "ask") => Form::Wait { node: &form.value, asks: key == "ask" },
            "concurrency" => {
                let regions = self.branch(body, "regions", id, Branch::First, depth, at);
                Form::Concurrency { kind: &form.value, regions }
            }
            "while" | "do_while" | "until" => {
                let tests = match form.key.as_str() {
                    "while" => Tests::Before,
                    "do_while" => Tests::After,
                    _ => Tests::Until,
                };
                let index = body.get("index").and_then(|node| self.index(node, &path));
                let list = self.branch(body, "do", id, Branch::First, depth, at);
                Form::While { predicate: &form.value, tests, index, body: list }
            }
            "for" => {
                let index = body.get("index").and_then(|node| self.index(node, &path));
                let body = self.branch(body, "do", id, Branch::First, depth, at);
                Form::ForEach { variable, collection, index, body }
            }
            _ => {
                let then = self.branch(body, "then", id, Branch::First, depth, at);
                let otherwise = match body.get("else") {
                    Some(list) => self.list(list, id, Branch::Otherwise, depth + 1),
                    None => Vec::new(),
                };
                Form::Condition { predicate: &form.value, then, otherwise }
            }
        };
        self.steps[id.0 as usize].form = form;
        if let Some(list) = body.get("retry").and_then(|retry| retry.get("before")) {
            self.steps[id.0 as usize].before = self.list(list, id, Branch::Before, depth + 1);
        }
        if let Some(list) = body.get("finally") {
            self.steps[id.0 as usize].finally = self.list(list, id, Branch::Finally, depth + 1);
        }
        Some(id)
    }

    fn branch(
        &mut self,
        body: &'a Node,
        key: &str,
        id: StateId,
        branch: Branch,
        depth: usize,
        at: Location,
    ) -> Vec<StateId> {
        if let Some(list) = body.get(key) {
            return self.list(list, id, branch, depth + 1);
        }
        let path = self.steps[id.0 as usize].path.clone();
        self.findings.error("invalid-state", at, &path, format!("there is no `{key}`"), "list its states there");
        Vec::new()
    }

    fn index(&mut self, node: &Node, path: &str) -> Option<String> {
        match &node.content {
            Content::Text(name) if is_word(name) => Some(name.clone()),
            _ => {
                self.findings.error("invalid-state", node.at, path, "`index` is the name of a variable", "index: i");
                None
            }
        }
    }
}

/// The name of a loop or a condition without a given name.
fn default_name(body: &Node) -> String {
    match body.get("for").map(|node| &node.content) {
        Some(Content::Text(text)) => format!("for_{}", text.split_whitespace().next().unwrap_or("each")),
        _ => {
            let form = body.entries().iter().map(|e| e.key.as_str()).find(|key| FORMS.contains(key));
            form.unwrap_or("state").to_owned()
        }
    }
}

fn unused<'s>(name: &str, taken: impl Iterator<Item = &'s str>) -> String {
    let taken: Vec<&str> = taken.collect();
    let numbered = (2..).map(|n| format!("{name}_{n}"));
    std::iter::once(name.to_owned()).chain(numbered).find(|n| !taken.contains(&n.as_str())).unwrap_or_default()
}
