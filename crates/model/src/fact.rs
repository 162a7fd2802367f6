//! Names of facts: keys, patterns over keys, and bound changes. The facts themselves are stored in `ratn-world`.

use crate::value::Value;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::fmt;

/// An argument of a fact: an individual by name, or a whole number.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Term {
    /// A whole number.
    Int(i64),
    /// An individual.
    Name(String),
}

/// `predicate(argument, …)`: the key of a fact.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct FactKey {
    /// Its predicate.
    pub predicate: String,
    /// Its arguments, in order; may be none.
    pub arguments: Vec<Term>,
}

/// `predicate(argument or ?, …)`: the keys of one predicate and arity whose arguments match.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct FactPattern {
    /// The predicate.
    pub predicate: String,
    /// `None` (written `?`) matches every term.
    pub arguments: Vec<Option<Term>>,
}

/// A set of facts, by patterns.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Footprint {
    /// Every fact: the footprint of a state without the annotation.
    Everything,
    /// The union of these; empty means none.
    Patterns(Vec<FactPattern>),
}

/// One change of the world, with every argument bound.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Change {
    /// The fact has this value from now on.
    Set {
        /// The fact.
        fact: FactKey,
        /// Its value.
        value: Value,
    },
    /// Every matching fact is removed.
    Delete {
        /// The facts.
        pattern: FactPattern,
    },
    /// A numeric fact increases by this amount; an absent fact counts as 0.
    Increase {
        /// The fact.
        fact: FactKey,
        /// The amount; a negative one decreases.
        by: f64,
    },
}

/// The predicates that the geometric scene is derived from; `reads: [scene]` stands for them.
pub const SCENE_PREDICATES: [(&str, usize); 5] =
    [("at", 1), ("shape", 1), ("in_gripper", 1), ("in_gripper", 2), ("on", 2)];

/// Text form, as people write it, without a tag for the kind of term.
#[derive(Serialize, Deserialize)]
#[serde(remote = "Term", untagged)]
enum WrittenTerm {
    Int(i64),
    Name(String),
}

/// Binary form, with a tag, because bytes do not show the kind of term.
#[derive(Serialize, Deserialize)]
#[serde(remote = "Term")]
enum TaggedTerm {
    Int(i64),
    Name(String),
}

impl Serialize for Term {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match serializer.is_human_readable() {
            true => WrittenTerm::serialize(self, serializer),
            false => TaggedTerm::serialize(self, serializer),
        }
    }
}

impl<'de> Deserialize<'de> for Term {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Term, D::Error> {
        match deserializer.is_human_readable() {
            true => WrittenTerm::deserialize(deserializer),
            false => TaggedTerm::deserialize(deserializer),
        }
    }
}

impl FactPattern {
    /// The pattern that matches only `key`.
    pub fn of(key: &FactKey) -> FactPattern {
        FactPattern { predicate: key.predicate.clone(), arguments: key.arguments.iter().cloned().map(Some).collect() }
    }

    /// Whether `key` matches.
    pub fn matches(&self, key: &FactKey) -> bool {
        self.predicate == key.predicate
            && self.arguments.len() == key.arguments.len()
            && self.arguments.iter().zip(&key.arguments).all(|(want, have)| want.as_ref().is_none_or(|w| w == have))
    }

    /// Whether every key that matches `other` matches this pattern.
    pub fn covers(&self, other: &FactPattern) -> bool {
        self.predicate == other.predicate
            && self.arguments.len() == other.arguments.len()
            && self.arguments.iter().zip(&other.arguments).all(|(mine, its)| mine.is_none() || mine == its)
    }

    /// Whether some key matches both.
    pub fn overlaps(&self, other: &FactPattern) -> bool {
        self.predicate == other.predicate
            && self.arguments.len() == other.arguments.len()
            && self.arguments.iter().zip(&other.arguments).all(|pair| match pair {
                (Some(a), Some(b)) => a == b,
                _ => true,
            })
    }
}

impl Footprint {
    /// No fact.
    pub const NOTHING: Footprint = Footprint::Patterns(Vec::new());

    /// Whether it contains no fact.
    pub fn is_nothing(&self) -> bool {
        matches!(self, Footprint::Patterns(patterns) if patterns.is_empty())
    }

    /// Whether it contains `key`.
    pub fn contains(&self, key: &FactKey) -> bool {
        match self {
            Footprint::Everything => true,
            Footprint::Patterns(patterns) => patterns.iter().any(|p| p.matches(key)),
        }
    }

    /// Whether both may contain a common fact.
    pub fn overlaps(&self, other: &Footprint) -> bool {
        match (self, other) {
            (Footprint::Everything, o) | (o, Footprint::Everything) => !o.is_nothing(),
            (Footprint::Patterns(a), Footprint::Patterns(b)) => a.iter().any(|p| b.iter().any(|q| p.overlaps(q))),
        }
    }

    /// The union of both.
    pub fn union(self, other: Footprint) -> Footprint {
        match (self, other) {
            (Footprint::Patterns(mut a), Footprint::Patterns(b)) => {
                a.extend(b);
                Footprint::Patterns(a)
            }
            _ => Footprint::Everything,
        }
    }
}

impl Change {
    /// The facts that the change writes.
    pub fn pattern(&self) -> FactPattern {
        match self {
            Change::Set { fact, .. } | Change::Increase { fact, .. } => FactPattern::of(fact),
            Change::Delete { pattern } => pattern.clone(),
        }
    }
}

impl fmt::Display for Term {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Term::Int(i) => write!(f, "{i}"),
            Term::Name(name) => f.write_str(name),
        }
    }
}

impl fmt::Display for FactKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", FactPattern::of(self))
    }
}

impl fmt::Display for FactPattern {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}(", self.predicate)?;
        for (i, argument) in self.arguments.iter().enumerate() {
            f.write_str(if i == 0 { "" } else { ", " })?;
            match argument {
                Some(term) => write!(f, "{term}")?,
                None => f.write_str("?")?,
            }
        }
        f.write_str(")")
    }
}

impl fmt::Display for Change {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Change::Set { fact, value } => write!(f, "set {fact} = {value}"),
            Change::Delete { pattern } => write!(f, "delete {pattern}"),
            Change::Increase { fact, by } => write!(f, "increase {fact} by {by}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pattern(predicate: &str, arguments: &[Option<&str>]) -> FactPattern {
        FactPattern {
            predicate: predicate.into(),
            arguments: arguments.iter().map(|a| a.map(|name| Term::Name(name.into()))).collect(),
        }
    }

    #[test]
    fn an_unbound_argument_overlaps_everything_of_its_predicate() {
        assert!(pattern("at", &[None]).overlaps(&pattern("at", &[Some("box")])));
        assert!(!pattern("at", &[Some("cup")]).overlaps(&pattern("at", &[Some("box")])));
        assert!(!pattern("at", &[None]).overlaps(&pattern("on", &[None])));
        assert!(!pattern("at", &[None]).overlaps(&pattern("at", &[None, None])));
    }

    #[test]
    fn everything_overlaps_all_but_nothing() {
        assert!(Footprint::Everything.overlaps(&Footprint::Everything));
        assert!(!Footprint::Everything.overlaps(&Footprint::NOTHING));
    }
}
