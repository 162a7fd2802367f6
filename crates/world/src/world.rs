//! Facts, and how changes apply to them.

use imbl::OrdMap;
use ratn_model::fact::{Change, FactKey, FactPattern};
use ratn_model::id::Revision;
use ratn_model::value::Value;

/// A fact's value and the revision that wrote it.
#[derive(Debug, Clone, PartialEq)]
pub struct Fact {
    /// What the fact says.
    pub value: Value,
    /// The revision of the world in which it was written.
    pub revision: Revision,
}

/// A world model: the root, or a projection. Cloning takes constant time and shares everything.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct World {
    facts: OrdMap<FactKey, Fact>,
    revision: Revision,
}

/// A change that does not apply; the world is as it was before the whole list of changes.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ChangeError {
    /// `increase` of a fact that holds something else than a number.
    #[error("{fact} is {value}, not a number: it cannot be increased")]
    NotANumber {
        /// Which fact.
        fact: FactKey,
        /// What it holds.
        value: Value,
    },
}

impl World {
    /// The world in which these facts hold, at a revision.
    pub fn from_facts(facts: impl IntoIterator<Item = (FactKey, Value)>, revision: Revision) -> World {
        let facts = facts.into_iter().map(|(key, value)| (key, Fact { value, revision })).collect();
        World { facts, revision }
    }

    /// The number of commits so far.
    pub fn revision(&self) -> Revision {
        self.revision
    }

    /// How many facts hold.
    pub fn len(&self) -> usize {
        self.facts.len()
    }

    /// Whether no fact holds.
    pub fn is_empty(&self) -> bool {
        self.facts.is_empty()
    }

    /// The value of one fact.
    pub fn get(&self, key: &FactKey) -> Option<&Value> {
        self.facts.get(key).map(|fact| &fact.value)
    }

    /// Every fact, in the order of keys.
    pub fn iter(&self) -> impl Iterator<Item = (&FactKey, &Fact)> {
        self.facts.iter()
    }

    /// The facts that match, in the order of keys.
    pub fn matching<'a>(&'a self, pattern: &'a FactPattern) -> impl Iterator<Item = (&'a FactKey, &'a Fact)> {
        // Bound leading arguments narrow the range; the rest is filtered.
        let first = FactKey {
            predicate: pattern.predicate.clone(),
            arguments: pattern.arguments.iter().map_while(Clone::clone).collect(),
        };
        let bound = first.arguments.len();
        let prefix = first.clone();
        self.facts
            .range(first..)
            .take_while(move |(key, _)| {
                key.predicate == prefix.predicate
                    && key.arguments.len() >= bound
                    && key.arguments[..bound] == prefix.arguments
            })
            .filter(move |(key, _)| pattern.matches(key))
    }

    /// Applies all changes as one new revision, or none of them.
    ///
    /// # Errors
    /// [`ChangeError`] names the first change that does not apply.
    pub fn apply(&mut self, changes: &[Change]) -> Result<Revision, ChangeError> {
        let revision = Revision(self.revision.0 + 1);
        let mut facts = self.facts.clone();
        for change in changes {
            match change {
                Change::Set { fact, value } => {
                    facts.insert(fact.clone(), Fact { value: value.clone(), revision });
                }
                Change::Delete { pattern } => {
                    let doomed: Vec<FactKey> = World { facts: facts.clone(), revision }
                        .matching(pattern)
                        .map(|(key, _)| key.clone())
                        .collect();
                    for key in doomed {
                        facts.remove(&key);
                    }
                }
                Change::Increase { fact, by } => {
                    let value = increased(fact, facts.get(fact).map(|f| &f.value), *by)?;
                    facts.insert(fact.clone(), Fact { value, revision });
                }
            }
        }
        self.facts = facts;
        self.revision = revision;
        Ok(revision)
    }

    /// A copy with the changes applied: what the world will be.
    ///
    /// # Errors
    /// As [`World::apply`].
    pub fn project(&self, changes: &[Change]) -> Result<World, ChangeError> {
        let mut world = self.clone();
        world.apply(changes)?;
        Ok(world)
    }
}

/// What `increase` makes of a value; an absent one counts as 0.
///
/// # Errors
/// [`ChangeError`] for what is no number.
pub fn increased(fact: &FactKey, old: Option<&Value>, by: f64) -> Result<Value, ChangeError> {
    match old {
        None | Some(Value::Null) if by.fract() == 0.0 => Ok(Value::Int(by as i64)),
        None | Some(Value::Null) => Ok(Value::Float(by)),
        Some(Value::Int(i)) if by.fract() == 0.0 => Ok(Value::Int(i.saturating_add(by as i64))),
        Some(value) => match value.as_number() {
            Some(x) => Ok(Value::Float(x + by)),
            None => Err(ChangeError::NotANumber { fact: fact.clone(), value: value.clone() }),
        },
    }
}
