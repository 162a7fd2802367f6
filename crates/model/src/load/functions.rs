//! `functions: { near($a, $b): … }`: pure expressions with parameters, local to one file.
//!
//! When the file is read, a call is replaced by the function's expression, with the arguments in place of the parameters. So a program contains no
//! functions, and the facts that a state reads through one are visible to all checks. An argument that is not used is not evaluated, and recursion
//! is impossible. Variables of comprehensions and queries inside get names that cannot be written in a file, so that they never capture variables
//! of an argument.

use super::names::suggestion;
use super::yaml::{Content, Entry, Node};
use crate::diagnostic::Findings;
use crate::expression::display::is_word;
use crate::expression::parse::{NameError, Names, ParseError, parse_expression};
use crate::expression::{Comprehension, Expr, Function};
use crate::value::Value;
use std::collections::BTreeMap;

/// Limit of functions in a file.
const MAX_FUNCTIONS: usize = 200;
/// How to write a function.
const EXAMPLE: &str = "write `near($a, $b): distance($a, $b) < 0.1` below `functions`";
/// Limit of the parts of an expression after replacing a call.
pub(super) const MAX_PARTS: usize = 2_000;

/// The functions of a file, with the calls in their bodies already replaced.
#[derive(Debug, Default)]
pub(crate) struct Functions {
    all: BTreeMap<String, Defined>,
}

#[derive(Debug, Clone)]
struct Defined {
    parameters: Vec<String>,
    /// `None` if it was refused.
    body: Option<Expr>,
}

impl Functions {
    /// Whether a function of this name exists.
    pub(crate) fn has(&self, name: &str) -> bool {
        self.all.contains_key(name)
    }

    /// Name, usage and number of arguments of each function.
    pub(crate) fn usages(&self) -> Vec<(String, String, usize)> {
        let usage =
            |(name, defined): (&String, &Defined)| (name.clone(), defined.usage(name), defined.parameters.len());
        self.all.iter().map(usage).collect()
    }

    /// The expression that replaces a call.
    pub(crate) fn call(&self, name: &str, arguments: &[Expr]) -> Result<Expr, NameError> {
        match self.all.get(name) {
            Some(defined) => defined.call(name, arguments),
            None => Err(wrong("unknown-function", format!("there is no function `{name}`"), "")),
        }
    }
}

impl Defined {
    fn usage(&self, name: &str) -> String {
        let parameters: Vec<String> = self.parameters.iter().map(|parameter| format!("${parameter}")).collect();
        format!("{name}({})", parameters.join(", "))
    }

    fn call(&self, name: &str, arguments: &[Expr]) -> Result<Expr, NameError> {
        if arguments.len() != self.parameters.len() {
            let (given, wanted) = (arguments.len(), self.parameters.len());
            let plural = if wanted == 1 { "" } else { "s" };
            let message = format!("`{name}` takes {wanted} argument{plural}, and is given {given}");
            return Err(wrong("invalid-expression", message, &format!("write `{}`", self.usage(name))));
        }
        // Already reported at its definition; any expression will do.
        let Some(mut body) = self.body.clone() else { return Ok(Expr::Literal(Value::Null)) };
        body.rewrite(&mut |part| {
            if let Expr::Variable(parameter) = part
                && let Some(place) = self.parameters.iter().position(|own| own == parameter)
            {
                *part = arguments[place].clone();
            }
        });
        let mut parts = 0;
        body.visit(&mut |_| parts += 1);
        if parts > MAX_PARTS {
            let message = format!("with what `{name}` stands for, this expression has more than {MAX_PARTS} parts");
            return Err(wrong("invalid-expression", message, "bind a part of it to a variable"));
        }
        Ok(body)
    }
}

fn wrong(rule: &'static str, message: String, help: &str) -> NameError {
    NameError { rule, message, help: help.to_owned() }
}

/// Renames the variables of comprehensions and queries inside to names that cannot be written in a file. So they differ from all variables in an
/// inserted expression and around it.
pub(super) fn rename_inner(expression: &mut Expr, of: &str) {
    let own = |inner: &mut String| *inner = format!("{inner} of {of}");
    expression.rewrite(&mut |part| match part {
        Expr::Each { element, .. } => own(element),
        Expr::Element(inner) | Expr::Unknown(inner) => own(inner),
        Expr::Find(wanted, _) => wanted.iter_mut().for_each(own),
        _ => {}
    });
}

/// Reads the functions of a file.
pub(crate) fn functions(source: &str, root: &Node, findings: &mut Findings) -> Functions {
    let Some(node) = root.get("functions") else { return Functions::default() };
    if !matches!(node.content, Content::Map(_) | Content::Null) {
        let message = format!("`functions` is a mapping, found {}", node.described());
        findings.error("invalid-state", node.at, "", message, EXAMPLE);
    }
    if node.entries().len() > MAX_FUNCTIONS {
        findings.error("invalid-state", node.at, "", format!("a file has at most {MAX_FUNCTIONS} functions"), "");
        return Functions::default();
    }
    let mut written = BTreeMap::new();
    for entry in node.entries() {
        let Some((name, parameters)) = header(&entry.key) else {
            let message = format!("`{}` is no function with its parameters", entry.key);
            findings.error("invalid-state", entry.at, "", message, EXAMPLE);
            continue;
        };
        if Function::named(&name).is_some() || Comprehension::named(&name).is_some() {
            let help = "give it another name";
            findings.error("invalid-name", entry.at, "", format!("the function `{name}` is built in"), help);
            continue;
        }
        if let Some(twice) = parameters.iter().enumerate().find(|(n, name)| parameters[..*n].contains(name)) {
            let message = format!("`{name}` has two parameters `${}`", twice.1);
            findings.error("duplicate-name", entry.at, "", message, "rename one of them");
        }
        if written.insert(name.clone(), Written { parameters, entry }).is_some() {
            let message = format!("there are two functions `{name}`");
            findings.error("duplicate-name", entry.at, "", message, "rename one of them");
        }
    }
    let mut reading = Reading { source, written, done: BTreeMap::new(), under_way: Vec::new(), findings };
    let names: Vec<String> = reading.written.keys().cloned().collect();
    names.iter().for_each(|name| reading.read(name));
    Functions { all: reading.done }
}

/// `near($a, $b)`
fn header(key: &str) -> Option<(String, Vec<String>)> {
    let (name, rest) = key.trim().split_once('(')?;
    let inner = rest.strip_suffix(')')?.trim();
    let parameter = |text: &str| text.trim().strip_prefix('$').filter(|name| is_word(name)).map(str::to_owned);
    let parameters = if inner.is_empty() { Some(Vec::new()) } else { inner.split(',').map(parameter).collect() };
    Some((name.trim().to_owned(), parameters?)).filter(|(name, _)| is_word(name))
}

struct Written<'a> {
    parameters: Vec<String>,
    entry: &'a Entry,
}

struct Reading<'a, 'f> {
    source: &'a str,
    written: BTreeMap<String, Written<'a>>,
    done: BTreeMap<String, Defined>,
    /// The functions that are being read, each because the one before calls it.
    under_way: Vec<String>,
    findings: &'f mut Findings,
}

impl Reading<'_, '_> {
    /// Reads a function, and first the functions that it calls.
    fn read(&mut self, name: &str) {
        if self.done.contains_key(name) {
            return;
        }
        let Some(written) = self.written.get(name) else { return };
        let (parameters, node) = (written.parameters.clone(), &written.entry.value);
        self.under_way.push(name.to_owned());
        let mut body = self.expression(node, &parameters);
        self.under_way.pop();
        if let Some(body) = &mut body {
            rename_inner(body, name);
        }
        self.done.insert(name.to_owned(), Defined { parameters, body });
    }

    fn expression(&mut self, node: &Node, parameters: &[String]) -> Option<Expr> {
        match &node.content {
            Content::Null => Some(Expr::Literal(Value::Null)),
            Content::Bool(b) => Some(Expr::Literal(Value::Bool(*b))),
            Content::Int(i) => Some(Expr::Literal(Value::Int(*i))),
            Content::Float(x) => Some(Expr::Literal(Value::Float(*x))),
            Content::Text(text) => {
                let parsed = parse_expression(text, &mut Body { reading: self, parameters });
                let refused = |ParseError { offset, rule, message, help }: ParseError| {
                    let at = node.place_in_text(self.source, offset);
                    self.findings.error(rule, at, "", message, help);
                };
                parsed.map_err(refused).ok()
            }
            Content::List(items) => {
                let items: Vec<Option<Expr>> = items.iter().map(|item| self.expression(item, parameters)).collect();
                Some(Expr::List(items.into_iter().collect::<Option<_>>()?))
            }
            Content::Map(entries) => {
                let fields: Vec<Option<(String, Expr)>> = entries
                    .iter()
                    .map(|entry| Some((entry.key.clone(), self.expression(&entry.value, parameters)?)))
                    .collect();
                Some(Expr::Map(fields.into_iter().collect::<Option<_>>()?))
            }
        }
    }
}

/// The names in a function: its parameters, facts, and other functions.
struct Body<'r, 'a, 'f> {
    reading: &'r mut Reading<'a, 'f>,
    parameters: &'r [String],
}

impl Names for Body<'_, '_, '_> {
    fn variable(&mut self, name: &str) -> Result<Expr, NameError> {
        if self.parameters.iter().any(|parameter| parameter == name) {
            return Ok(Expr::Variable(name.to_owned()));
        }
        let known = self.parameters.iter().map(String::as_str);
        let help = suggestion(name, known, "$", "give it as an argument");
        let message = format!("a function sees its own parameters, and `${name}` is none of them");
        Err(wrong("unknown-variable", message, &help))
    }

    fn word(&mut self, _: &str) -> Option<Expr> {
        None
    }

    fn port(&mut self, state: &str, port: &str) -> Result<Expr, NameError> {
        let message = format!("a function sees no states, and `{state}.{port}` is the output of one");
        Err(wrong("unknown-state", message, "give it as an argument; quote a text that contains a point"))
    }

    fn has_function(&self, name: &str) -> bool {
        self.reading.written.contains_key(name)
    }

    fn call(&mut self, name: &str, arguments: Vec<Expr>) -> Result<Expr, NameError> {
        let around = &self.reading.under_way;
        if let Some(first) = around.iter().position(|other| other == name) {
            let circle: Vec<&str> = around[first..].iter().map(String::as_str).chain([name]).collect();
            let message = format!("the function `{name}` uses itself: {}", circle.join(" → "));
            return Err(wrong(
                "recursive-function",
                message,
                "say what is done over and over as a loop, or with `map`",
            ));
        }
        self.reading.read(name);
        match self.reading.done.get(name) {
            Some(defined) => defined.call(name, &arguments),
            None => Ok(Expr::Literal(Value::Null)),
        }
    }
}
