//! Queries about a world: `at(?box) = ?pose, class(?box, SLC), not in_gripper(?box), weight(?box) < 2`.
//!
//! The language is that of task files ([`ratn_model::expression::query`] defines the conditions). A [`Query`] is parsed once,
//! prepared once (planned, and checked against an ontology if there is one), and run as often as needed, each time with values
//! for its arguments `$name`. Answers have no duplicates and are sorted by the values of the variables, in the order of the text;
//! so they do not depend on the plan. The size of the text, its depth, the conditions, the visited facts and the answers are
//! bounded.

use crate::world::World;
use ratn_model::expression::parse::{NameError, Names, ParseError, parse_query};
use ratn_model::expression::query::{Flow, Plan, PlanError, RunError, plan, run};
use ratn_model::expression::scope::NothingKnown;
use ratn_model::expression::{EvaluateError, Expr, Lookup, Scope};
use ratn_model::fact::{FactKey, FactPattern};
use ratn_model::id::StateId;
use ratn_model::ontology::{Ontology, Violation};
use ratn_model::value::Value;
use std::borrow::Cow;
use std::cmp::Ordering;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

/// Limit of answers that are collected before they are sorted and cut to the requested number.
pub const MAX_ANSWERS: usize = 100_000;

/// A query as written.
#[derive(Debug, Clone, PartialEq)]
pub struct Query {
    conditions: Vec<Expr>,
}

/// A prepared query.
#[derive(Debug, Clone, PartialEq)]
pub struct Prepared {
    plan: Plan,
    arguments: BTreeSet<String>,
}

/// The answers to a query.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Rows {
    /// The variables, without `?`, in the order of the text.
    pub variables: Vec<String>,
    /// The answers, sorted, each a list of values. A query without variables has one empty answer, or none.
    pub rows: Vec<Vec<Value>>,
    /// Whether there are more answers than requested.
    pub more: bool,
}

/// Error: the query could not be answered.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum QueryError {
    /// The text is no query.
    #[error("at character {}: {message}{}{help}", .offset + 1, if .help.is_empty() { "" } else { "; " })]
    Syntax {
        /// The place, in characters from the start.
        offset: usize,
        /// What is wrong.
        message: String,
        /// What to do; empty if the message already tells.
        help: String,
    },
    /// The query cannot be planned.
    #[error(transparent)]
    Plan(#[from] PlanError),
    /// The ontology does not allow its facts.
    #[error(transparent)]
    Ontology(#[from] Violation),
    /// An argument is missing.
    #[error("the query needs a value for `${name}`")]
    MissingArgument {
        /// Its name without `$`.
        name: String,
    },
    /// An argument is unknown.
    #[error("the query has no `${name}`")]
    UnknownArgument {
        /// Its name without `$`.
        name: String,
    },
    /// A condition cannot be computed.
    #[error("{0}")]
    Evaluate(EvaluateError),
    /// It visits too many facts, or has too many answers.
    #[error("{0}")]
    TooLarge(String),
}

impl Query {
    /// Parses a query.
    ///
    /// # Errors
    /// [`QueryError::Syntax`] with the place.
    pub fn parse(text: &str) -> Result<Query, QueryError> {
        Ok(Query { conditions: parse_query(text, &mut Arguments)? })
    }

    /// The names of its arguments, without `$`, in order.
    pub fn arguments(&self) -> BTreeSet<String> {
        let all = self.conditions.iter().flat_map(Expr::variables);
        all.map(str::to_owned).collect()
    }

    /// The predicates of its facts.
    pub fn predicates(&self) -> BTreeSet<&str> {
        self.conditions.iter().flat_map(Expr::fact_expressions).map(|fact| fact.predicate.as_str()).collect()
    }

    /// Plans the query, and checks it against an ontology.
    ///
    /// # Errors
    /// [`QueryError::Plan`], [`QueryError::Ontology`].
    pub fn prepare(&self, ontology: Option<&Ontology>) -> Result<Prepared, QueryError> {
        if let Some(ontology) = ontology {
            for fact in self.conditions.iter().flat_map(Expr::fact_expressions) {
                ontology.check_pattern(&fact.pattern(&NothingKnown))?;
            }
        }
        Ok(Prepared { plan: plan(&self.conditions, &|_| false)?, arguments: self.arguments() })
    }
}

impl fmt::Display for Query {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (i, condition) in self.conditions.iter().enumerate() {
            write!(f, "{}{condition}", if i == 0 { "" } else { ", " })?;
        }
        Ok(())
    }
}

impl Prepared {
    /// The variables of its answers, without `?`, in the order of the text.
    pub fn variables(&self) -> &[String] {
        self.plan.variables()
    }

    /// At most `limit` answers in a world, with values for the arguments (without `$`).
    ///
    /// # Errors
    /// [`QueryError`] if arguments are missing or unknown, if a condition cannot be computed, or if the query visits too many
    /// facts.
    pub fn run(&self, world: &World, arguments: &BTreeMap<String, Value>, limit: usize) -> Result<Rows, QueryError> {
        if let Some(name) = self.arguments.iter().find(|name| !arguments.contains_key(*name)) {
            return Err(QueryError::MissingArgument { name: name.clone() });
        }
        if let Some(name) = arguments.keys().find(|name| !self.arguments.contains(*name)) {
            return Err(QueryError::UnknownArgument { name: name.clone() });
        }
        let mut rows: Vec<Vec<Value>> = Vec::new();
        let mut too_many = false;
        run(&self.plan, &InWorld { world, arguments }, &mut |row| {
            too_many = rows.len() >= MAX_ANSWERS;
            if too_many {
                return Flow::Enough;
            }
            rows.push(row.to_vec());
            // A query without variables has at most one answer.
            if row.is_empty() { Flow::Enough } else { Flow::More }
        })?;
        if too_many {
            let message = format!("the query has more than {MAX_ANSWERS} answers; narrow it by another condition");
            return Err(QueryError::TooLarge(message));
        }
        rows.sort_by(|a, b| order_of_rows(a, b));
        rows.dedup_by(|a, b| order_of_rows(a, b).is_eq());
        let more = rows.len() > limit;
        rows.truncate(limit);
        Ok(Rows { variables: self.variables().to_vec(), rows, more })
    }
}

impl From<ParseError> for QueryError {
    fn from(ParseError { offset, message, help, .. }: ParseError) -> QueryError {
        QueryError::Syntax { offset, message, help }
    }
}

impl From<RunError> for QueryError {
    fn from(error: RunError) -> QueryError {
        match error {
            RunError::Evaluate(error) => QueryError::Evaluate(error),
            RunError::TooManySteps => QueryError::TooLarge(format!("the query is too expensive: {error}")),
        }
    }
}

/// The names in a query: `$name` is an argument; states are unknown.
struct Arguments;

impl Names for Arguments {
    fn variable(&mut self, name: &str) -> Result<Expr, NameError> {
        Ok(Expr::Variable(name.to_owned()))
    }

    fn word(&mut self, _: &str) -> Option<Expr> {
        None
    }

    fn port(&mut self, state: &str, port: &str) -> Result<Expr, NameError> {
        Err(NameError {
            rule: "unknown-state",
            message: format!("`{state}.{port}` is the output of a state, and a query has none"),
            help: format!("write `?{state}.{port}` for a field of a variable, or quote a text that contains a point"),
        })
    }
}

struct InWorld<'a> {
    world: &'a World,
    arguments: &'a BTreeMap<String, Value>,
}

impl Scope for InWorld<'_> {
    fn variable(&self, name: &str) -> Option<Cow<'_, Value>> {
        self.arguments.get(name).map(Cow::Borrowed)
    }

    fn output(&self, _: &str) -> Option<Cow<'_, Value>> {
        None
    }

    fn port(&self, _: StateId, _: &str) -> Option<Cow<'_, Value>> {
        None
    }

    fn fact(&self, pattern: &FactPattern) -> Lookup<'_> {
        match self.world.matching(pattern).next() {
            Some((_, fact)) => Lookup::Holds(Cow::Owned(fact.value.clone())),
            None => Lookup::Absent,
        }
    }

    fn each_fact(&self, pattern: &FactPattern, visit: &mut dyn FnMut(&FactKey, &Value) -> bool) -> bool {
        self.world.each_fact(pattern, visit);
        true
    }
}

fn order_of_rows(a: &[Value], b: &[Value]) -> Ordering {
    a.iter().zip(b).map(|(a, b)| a.total_order(b)).find(|order| order.is_ne()).unwrap_or(a.len().cmp(&b.len()))
}
