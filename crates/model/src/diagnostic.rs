//! What is wrong with a task program: which rule, where, and what to do.

use crate::program::Location;
use serde::{Deserialize, Serialize};
use std::fmt;

/// Limit of collected findings; then loading stops.
pub const MAX_DIAGNOSTICS: usize = 100;

/// A finding of `check`.
///
/// Printed as `file:line:column: error[rule] in state/path: message. help: what to do`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Diagnostic {
    /// The rule's name, `unknown-port`.
    pub rule: String,
    /// Whether the task is refused.
    pub severity: Severity,
    /// The task file.
    pub file: String,
    /// Where in it.
    pub location: Location,
    /// The path of the state; empty for the task as a whole.
    pub path: String,
    /// What is wrong.
    pub message: String,
    /// What to do; empty if the message already tells.
    pub help: String,
}

/// How bad a finding is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Severity {
    /// The task is refused.
    Error,
    /// The task may run.
    Warning,
}

impl fmt::Display for Severity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Severity::Error => "error",
            Severity::Warning => "warning",
        })
    }
}

impl fmt::Display for Diagnostic {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Diagnostic { rule, severity, file, location, path, message, help } = self;
        write!(f, "{file}:{}:{}: {severity}[{rule}]", location.line, location.column)?;
        if !path.is_empty() {
            write!(f, " in {path}")?;
        }
        write!(f, ": {message}")?;
        if !help.is_empty() {
            write!(f, ". help: {help}")?;
        }
        Ok(())
    }
}

/// Findings in the order in which they are found.
#[derive(Debug, Default)]
pub(crate) struct Findings {
    list: Vec<Diagnostic>,
}

impl Findings {
    pub(crate) fn error(
        &mut self,
        rule: &str,
        location: Location,
        path: &str,
        message: impl Into<String>,
        help: impl Into<String>,
    ) {
        self.add(Severity::Error, rule, location, path, message.into(), help.into());
    }

    pub(crate) fn warning(
        &mut self,
        rule: &str,
        location: Location,
        path: &str,
        message: impl Into<String>,
        help: impl Into<String>,
    ) {
        self.add(Severity::Warning, rule, location, path, message.into(), help.into());
    }

    fn add(&mut self, severity: Severity, rule: &str, location: Location, path: &str, message: String, help: String) {
        // One line of the file may stand for several states of the program; a finding in it is reported once.
        let is_known = |d: &Diagnostic| {
            (d.location, d.severity, d.rule.as_str(), d.message.as_str()) == (location, severity, rule, &message)
        };
        if self.list.len() < MAX_DIAGNOSTICS && !self.list.iter().any(is_known) {
            let (rule, path, file) = (rule.to_owned(), path.to_owned(), String::new());
            self.list.push(Diagnostic { rule, severity, file, location, path, message, help });
        }
    }

    /// Whether a rule has found something in a place.
    pub(crate) fn has(&self, rule: &str, location: Location) -> bool {
        self.list.iter().any(|d| d.rule == rule && d.location == location)
    }

    pub(crate) fn has_errors(&self) -> bool {
        self.list.iter().any(|d| d.severity == Severity::Error)
    }

    /// All of them in the order of the file.
    pub(crate) fn in_file(mut self, file: &str) -> Vec<Diagnostic> {
        self.list.iter_mut().for_each(|d| file.clone_into(&mut d.file));
        self.list.sort_by_key(|d| (d.location, d.severity));
        self.list
    }
}
