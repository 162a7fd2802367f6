//! The ontology of a task: the classes, individuals and predicates of its facts, declared in Turtle ([`turtle`]).
//!
//! An ontology is used only for checks. Nothing is inferred from it except subclasses. Violations are refused with the name of
//! the rule: by `ratn check` as far as the arguments are constants, else by the executive when an effect is bound.
//!
//! | rule | refuses |
//! |---|---|
//! | `unknown-predicate` | a predicate that is not declared |
//! | `outside-domain` | a wrong number of arguments; an individual of no class, or of another class |
//! | `outside-range` | a value of another type, or the name of an individual of another class |
//! | `other-uncertainty` | a measurement with another kind of certainty than the predicate declares, or a covariance of another size |
//! | `not-functional` | a second fact of a functional predicate for one subject |

pub mod turtle;

use crate::expression::{EffectExpr, Expr, FactExpr};
use crate::fact::{Change, FactKey, FactPattern, Term};
use crate::load::suggestion;
use crate::measurement::{Certainty, Measurement};
use crate::tolerance::{Deviation, Tolerances};
use crate::value::{Type, Value};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

/// What facts may exist.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Ontology {
    /// Every class with all its superclasses, including itself.
    classes: BTreeMap<String, BTreeSet<String>>,
    /// By prefix of a name: the class of individuals whose names begin with it.
    named: BTreeMap<String, String>,
    /// Individuals with their declared classes.
    individuals: BTreeMap<String, BTreeSet<String>>,
    predicates: BTreeMap<String, Predicate>,
}

/// A declared predicate.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Predicate {
    /// The domain of each argument; their number is the predicate's arity.
    pub domain: Vec<Domain>,
    /// The range of the value.
    pub range: Range,
    /// Among the facts that differ in the last argument only, at most one holds (`on(box, ?)`: a box is on one thing).
    pub functional: bool,
    /// Tolerance within which a measured value counts as the predicted one; parts that are `None` come from the task.
    pub tolerance: Deviation,
    /// Whether the scene is derived from its facts: `reads: [scene]` includes them.
    pub geometric: bool,
    /// Time to live in seconds: a measured fact is stale after it, unless measured again; `None`: it holds until it is changed.
    pub ttl_s: Option<f64>,
    /// The certainty that its measured facts have.
    pub uncertainty: Option<Uncertainty>,
    /// The unit of its numbers, `kg`.
    pub unit: Option<String>,
}

/// The kind of certainty of a measured fact.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Uncertainty {
    /// A number between 0 and 1.
    Confidence,
    /// The covariance matrix of the value's numbers.
    Covariance,
}

/// The domain of an argument.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Domain {
    /// Any individual, declared or not, or a whole number.
    Anything,
    /// A whole number.
    Integer,
    /// An individual of this class or of a subclass.
    Class(String),
}

/// The range of a fact's value. Null is always allowed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Range {
    /// A value of this type.
    Type(Type),
    /// The name of an individual of this class or of a subclass.
    Class(String),
}

/// A fact that does not conform to the ontology.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("[{rule}] {message}{}{help}", if .help.is_empty() { "" } else { "; " })]
pub struct Violation {
    /// The rule's name, `outside-domain`.
    pub rule: &'static str,
    /// What is wrong.
    pub message: String,
    /// What to do; empty if the message already tells.
    pub help: String,
}

impl Ontology {
    /// A predicate by its name.
    pub fn predicate(&self, name: &str) -> Option<&Predicate> {
        self.predicates.get(name)
    }

    /// The declared individuals.
    pub fn individuals(&self) -> impl Iterator<Item = &str> {
        self.individuals.keys().map(String::as_str)
    }

    /// Every predicate by its name, in order.
    pub fn predicates(&self) -> impl Iterator<Item = (&str, &Predicate)> {
        self.predicates.iter().map(|(name, predicate)| (name.as_str(), predicate))
    }

    /// The predicates from which the scene is derived, with their arity.
    pub fn scene(&self) -> Vec<(&str, usize)> {
        let geometric = self.predicates().filter(|(_, predicate)| predicate.geometric);
        geometric.map(|(name, predicate)| (name, predicate.domain.len())).collect()
    }

    /// The tolerances of a task, completed by those of the predicates here.
    #[must_use]
    pub fn tolerances(&self, mut of_task: Tolerances) -> Tolerances {
        for (name, Predicate { tolerance, .. }) in self.predicates() {
            if !tolerance.is_empty() {
                let own = of_task.predicates.entry(name.to_owned()).or_default();
                *own = own.or(*tolerance);
            }
        }
        of_task
    }

    /// The facts that must not hold together with this one: other facts of a functional predicate for the same subject.
    pub fn rivals(&self, fact: &FactKey) -> Option<FactPattern> {
        self.predicate(&fact.predicate).filter(|predicate| predicate.functional)?;
        let mut rivals = FactPattern::of(fact);
        *rivals.arguments.last_mut()? = None;
        Some(rivals)
    }

    /// The facts that must not hold together with those that an effect sets (see [`Ontology::rivals`]), before the effect is bound.
    pub fn rivals_of(&self, effect: &EffectExpr) -> Vec<FactExpr> {
        match effect {
            EffectExpr::Set(_, Expr::Literal(Value::Null | Value::Bool(false))) => Vec::new(),
            EffectExpr::Set(fact, _) if self.predicate(&fact.predicate).is_some_and(|own| own.functional) => {
                let mut rivals = fact.clone();
                rivals.arguments.last_mut().into_iter().for_each(|last| *last = None);
                vec![rivals]
            }
            EffectExpr::Set(..) | EffectExpr::Delete(_) | EffectExpr::Increase(..) => Vec::new(),
            EffectExpr::ForEach { effects, .. } => effects.iter().flat_map(|inner| self.rivals_of(inner)).collect(),
        }
    }

    /// Whether an individual is of a class: as declared or by its name, directly or through subclasses.
    pub fn is_a(&self, individual: &str, class: &str) -> bool {
        self.classes_of(individual).any(|of| self.classes.get(of).is_some_and(|above| above.contains(class)))
    }

    /// Checks a pattern of facts.
    ///
    /// # Errors
    /// The violated rule.
    pub fn check_pattern(&self, pattern: &FactPattern) -> Result<(), Violation> {
        let name = &pattern.predicate;
        let Some(predicate) = self.predicates.get(name) else {
            let help = suggestion(name, self.predicates.keys().map(String::as_str), "", "declare it in the ontology");
            let message = format!("the ontology has no predicate `{name}`");
            return Err(Violation { rule: "unknown-predicate", message, help });
        };
        let outside = |message, help| Err(Violation { rule: "outside-domain", message, help });
        let (takes, has) = (predicate.domain.len(), pattern.arguments.len());
        if takes != has {
            let plural = if takes == 1 { "argument" } else { "arguments" };
            return outside(format!("`{name}` has {takes} {plural}, and `{pattern}` has {has}"), String::new());
        }
        for (domain, argument) in predicate.domain.iter().zip(&pattern.arguments) {
            match (domain, argument) {
                (Domain::Anything, _) | (_, None) | (Domain::Integer, Some(Term::Int(_))) => {}
                (Domain::Class(class), Some(Term::Name(individual))) => {
                    if let Some(why) = self.is_not(individual, class) {
                        return outside(format!("in `{pattern}`, {why}"), self.near(individual));
                    }
                }
                (domain, Some(term)) => {
                    return outside(format!("in `{pattern}`, `{term}` is not {domain}"), String::new());
                }
            }
        }
        Ok(())
    }

    /// Checks a fact with its value.
    ///
    /// # Errors
    /// The violated rule; those for the fact come first.
    pub fn check_fact(&self, fact: &FactKey, value: &Value) -> Result<(), Violation> {
        let pattern = FactPattern::of(fact);
        self.check_pattern(&pattern)?;
        self.check_value(&pattern, value)
    }

    /// Checks a value for facts that match the pattern; for an undeclared predicate every value is allowed.
    ///
    /// # Errors
    /// `outside-range`.
    pub fn check_value(&self, pattern: &FactPattern, value: &Value) -> Result<(), Violation> {
        let Some(predicate) = self.predicates.get(&pattern.predicate) else { return Ok(()) };
        let outside = |message, help| Err(Violation { rule: "outside-range", message, help });
        match (&predicate.range, value) {
            (_, Value::Null) => Ok(()),
            (Range::Type(ty), value) if ty.accepts(value) => Ok(()),
            (Range::Type(ty), value) => {
                let unit = predicate.unit.as_ref().map(|unit| format!(" in {unit}")).unwrap_or_default();
                outside(format!("`{pattern}` is {ty}{unit}, and {value} is {}", value.type_name()), String::new())
            }
            (Range::Class(class), Value::String(individual)) => match self.is_not(individual, class) {
                None => Ok(()),
                Some(why) => outside(format!("as the value of `{pattern}`, {why}"), self.near(individual)),
            },
            (Range::Class(class), value) => {
                let message = format!("`{pattern}` is the name of a {class}, and {value} is {}", value.type_name());
                outside(message, String::new())
            }
        }
    }

    /// Checks a change of the world.
    ///
    /// # Errors
    /// The first violated rule.
    pub fn check_change(&self, change: &Change) -> Result<(), Violation> {
        match change {
            Change::Set { fact, value } => self.check_fact(fact, value),
            Change::Delete { pattern } => self.check_pattern(pattern),
            Change::Increase { fact, by } => {
                let pattern = FactPattern::of(fact);
                self.check_pattern(&pattern)?;
                self.check_increase(&pattern, *by)
            }
        }
    }

    /// Checks an increase of facts that match the pattern.
    ///
    /// # Errors
    /// `outside-range`.
    pub fn check_increase(&self, pattern: &FactPattern, by: f64) -> Result<(), Violation> {
        let whole = by.fract() == 0.0 && by.abs() < i64::MAX as f64;
        // An int plus a whole number stays an int.
        let step = if whole { Value::Int(by as i64) } else { Value::Float(by) };
        self.check_value(pattern, &step)
    }

    /// Checks whether a fact with this value may have this measurement. A measurement may always omit its certainty.
    ///
    /// # Errors
    /// `other-uncertainty`.
    pub fn check_measurement(&self, fact: &FactKey, value: &Value, measured: &Measurement) -> Result<(), Violation> {
        let Some(certainty) = &measured.certainty else { return Ok(()) };
        let declared = self.predicate(&fact.predicate).and_then(|predicate| predicate.uncertainty);
        let message = match (declared, certainty) {
            (Some(Uncertainty::Confidence), Certainty::Confidence(_)) => return Ok(()),
            (Some(Uncertainty::Covariance), Certainty::Covariance(entries)) => {
                let rows = match value {
                    Value::Pose(_) => 6,
                    Value::Joints(joints) => joints.len(),
                    _ => 1,
                };
                if entries.len() == rows * rows {
                    return Ok(());
                }
                let found = entries.len();
                format!("the covariance of `{fact}` has {rows} times {rows} entries, and {found} were measured")
            }
            (Some(declared), found) => {
                format!("`{fact}` is measured with a {declared}, and this has a {}", found.name())
            }
            (None, found) => {
                format!("`{}` declares no uncertainty, and {fact} was measured with a {}", fact.predicate, found.name())
            }
        };
        let help = match declared {
            None => format!("declare it (`ratn:uncertainty \"{}\"`)", certainty.name()),
            Some(_) => String::new(),
        };
        Err(Violation { rule: "other-uncertainty", message, help })
    }

    /// Checks several changes; see [`Ontology::check_change`].
    ///
    /// # Errors
    /// The first violated rule.
    pub fn check_changes(&self, changes: &[Change]) -> Result<(), Violation> {
        changes.iter().try_for_each(|change| self.check_change(change))
    }

    fn classes_of(&self, individual: &str) -> impl Iterator<Item = &str> {
        let declared = self.individuals.get(individual).into_iter().flatten();
        let named = self.named.iter().filter(move |(prefix, _)| individual.starts_with(prefix.as_str()));
        declared.chain(named.map(|(_, class)| class)).map(String::as_str)
    }

    /// Reason why an individual is not of a class; empty if it is.
    fn is_not(&self, individual: &str, class: &str) -> Option<String> {
        if self.is_a(individual, class) {
            return None;
        }
        let classes: Vec<&str> = self.classes_of(individual).collect();
        Some(match classes.as_slice() {
            [] => format!("`{individual}` is no individual of the ontology; a {class} is expected"),
            of => format!("`{individual}` is a {}, not a {class}", of.join(" and a ")),
        })
    }

    /// Advice about an individual that does not conform.
    fn near(&self, individual: &str) -> String {
        if self.classes_of(individual).next().is_some() {
            return String::new();
        }
        let known = self.individuals.keys().map(String::as_str);
        suggestion(individual, known, "", "declare it, or say how such individuals are named (`ratn:named`)")
    }
}

impl Violation {
    /// The violation by two facts of a functional predicate for one subject.
    pub fn not_functional(fact: &FactKey, beside: &FactKey) -> Violation {
        Violation {
            rule: "not-functional",
            message: format!(
                "`{fact}` beside `{beside}`: `{}` is functional, of one subject it says one thing",
                fact.predicate
            ),
            help: format!("add the effect \"delete {beside}\", or one with `?` in the place of the last argument"),
        }
    }
}

impl fmt::Display for Uncertainty {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Uncertainty::Confidence => "confidence",
            Uncertainty::Covariance => "covariance",
        })
    }
}

impl fmt::Display for Domain {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Domain::Anything => f.write_str("an individual"),
            Domain::Integer => f.write_str("a whole number"),
            Domain::Class(class) => write!(f, "a {class}"),
        }
    }
}
