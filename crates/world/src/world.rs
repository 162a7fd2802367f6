//! Worlds: facts, and the application of changes.
//!
//! A [`World`] is a shared store of facts and an overlay: the changes of this world only. [`World::project`] writes into the
//! overlay, so a projection costs only its effects; [`World::apply`] writes into the store, so a projection of a root begins with
//! an empty overlay. An overlay that grows beyond [`OVERLAY_LIMIT`] is moved into the store, too.

use crate::store::{Store, begins_as, first_of};
use ratn_model::fact::{Change, FactKey, FactPattern};
use ratn_model::id::Revision;
use ratn_model::measurement::Measurement;
use ratn_model::value::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::iter::Peekable;
use std::ops::Bound;
use std::sync::Arc;

/// Limit of an overlay; a projection with more changes gets its own store.
pub const OVERLAY_LIMIT: usize = 1024;

/// A fact's value, with its writer and revision.
#[derive(Debug, Clone, PartialEq)]
pub struct Fact {
    /// The value.
    pub value: Value,
    /// The revision of the world that wrote it.
    pub revision: Revision,
    /// The node that wrote it, by the path of its instance; `None` if unknown.
    pub writer: Option<Arc<str>>,
    /// The measurement, with its certainty; `None` if it was not measured.
    pub measured: Option<Arc<Measurement>>,
}

/// A world model: the root, or a projection. Cloning shares the store and copies the overlay; a root has no overlay.
#[derive(Debug, Clone, Default)]
pub struct World {
    store: Store,
    /// `None`: the fact does not hold, even if it is in the store.
    overlay: Written,
    revision: Revision,
}

/// The result of a list of changes: facts as they are written; `None` is a deleted fact.
pub type Written = BTreeMap<Arc<FactKey>, Option<Arc<Fact>>>;

/// Error: a change cannot be applied. The world is then unchanged by the whole list of changes.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ChangeError {
    /// `increase` of a fact whose value is no number.
    #[error("{fact} is {value}, not a number: it cannot be increased")]
    NotANumber {
        /// The fact.
        fact: FactKey,
        /// Its value.
        value: Value,
    },
    /// The result of `increase` is out of range.
    #[error(
        "{fact} is {value}: increased by {by} it is beyond the range of its numbers (whole numbers from {} to {}, others of finite size); set \
         it to a number with a decimal point, or count from 0 again",
        i64::MIN,
        i64::MAX
    )]
    OutOfRange {
        /// The fact.
        fact: FactKey,
        /// Its value; null if it is absent.
        value: Value,
        /// The increment.
        by: f64,
    },
}

impl World {
    /// A world with these facts, at a revision; of two facts with the same key the later one counts.
    pub fn from_facts(facts: impl IntoIterator<Item = (FactKey, Value)>, revision: Revision) -> World {
        let mut store = Store::default();
        for (key, value) in facts {
            store.insert(&Arc::new(key), &Arc::new(Fact { value, revision, writer: None, measured: None }));
        }
        World { store, overlay: BTreeMap::new(), revision }
    }

    /// A world of existing facts, with their writers and revisions.
    pub fn of(facts: impl IntoIterator<Item = (Arc<FactKey>, Arc<Fact>)>, revision: Revision) -> World {
        let mut store = Store::default();
        for (key, fact) in facts {
            store.insert(&key, &fact);
        }
        World { store, overlay: BTreeMap::new(), revision }
    }

    /// Number of commits so far.
    pub fn revision(&self) -> Revision {
        self.revision
    }

    /// The same facts, at another revision.
    #[must_use]
    pub fn numbered(self, revision: Revision) -> World {
        World { revision, ..self }
    }

    /// Number of facts that hold; costs the overlay.
    pub fn len(&self) -> usize {
        let mut len = self.store.len();
        for (key, fact) in &self.overlay {
            match (self.store.get(key).is_some(), fact.is_some()) {
                (false, true) => len += 1,
                (true, false) => len -= 1,
                _ => {}
            }
        }
        len
    }

    /// Whether no fact holds.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The value of one fact.
    pub fn get(&self, key: &FactKey) -> Option<&Value> {
        self.fact(key).map(|fact| &fact.value)
    }

    /// One fact, with its writer and revision.
    pub fn fact(&self, key: &FactKey) -> Option<&Fact> {
        // Most lookups are in roots, whose overlay is empty and costs nothing to probe.
        match self.overlay.get(key) {
            Some(fact) => fact.as_deref(),
            None => self.store.get(key),
        }
    }

    /// Every fact, in the order of keys.
    pub fn iter(&self) -> impl Iterator<Item = (&FactKey, &Fact)> {
        let overlay = self.overlay.iter().map(|(key, fact)| (key.as_ref(), fact.as_deref()));
        Merged { below: self.store.iter().peekable(), above: overlay.peekable() }
    }

    /// Every fact with a greater key, in the order of keys.
    pub fn iter_behind<'a>(&'a self, key: &'a FactKey) -> impl Iterator<Item = (&'a FactKey, &'a Fact)> {
        let behind = (Bound::Excluded(key), Bound::Unbounded);
        let overlay = self.overlay.range::<FactKey, _>(behind).map(|(key, fact)| (key.as_ref(), fact.as_deref()));
        Merged { below: self.store.iter_behind(key).peekable(), above: overlay.peekable() }
    }

    /// The facts that match, in the order of keys. Costs only the matches if the pattern gives the whole key, its leading
    /// arguments (the subject) or one later argument (the object).
    pub fn matching<'a>(&'a self, pattern: &'a FactPattern) -> impl Iterator<Item = (&'a FactKey, &'a Fact)> {
        self.merged(pattern).filter(|(key, _)| pattern.matches(key))
    }

    /// The facts that match, together with others that the index cannot separate, in the order of keys.
    pub(crate) fn merged<'a>(&'a self, pattern: &'a FactPattern) -> impl Iterator<Item = (&'a FactKey, &'a Fact)> {
        let first = first_of(pattern);
        let bound = first.arguments.len();
        let overlay = self
            .overlay
            .range::<FactKey, _>(first..)
            .take_while(move |(key, _)| begins_as(key, pattern, bound))
            .filter(|(key, _)| pattern.matches(key))
            .map(|(key, fact)| (key.as_ref(), fact.as_deref()));
        Merged { below: self.store.candidates(pattern).peekable(), above: overlay.peekable() }
    }

    /// Visits the facts that match, together with others that the index cannot separate, in the order of keys, until `visit`
    /// returns false; what is visited is the cost.
    pub fn each_fact(&self, pattern: &FactPattern, visit: &mut dyn FnMut(&FactKey, &Value) -> bool) {
        if self.overlay.is_empty() {
            self.store.candidates(pattern).all(|(key, fact)| visit(key, &fact.value));
        } else {
            self.merged(pattern).all(|(key, fact)| visit(key, &fact.value));
        }
    }

    /// Applies all changes as one new revision, or none of them.
    ///
    /// # Errors
    /// [`ChangeError`] names the first change that does not apply.
    pub fn apply(&mut self, changes: &[Change]) -> Result<Revision, ChangeError> {
        self.apply_as(None, changes)
    }

    /// As [`World::apply`]; `writer`, a node's path, is stored as the writer of each fact.
    ///
    /// # Errors
    /// As [`World::apply`].
    pub fn apply_as(&mut self, writer: Option<&str>, changes: &[Change]) -> Result<Revision, ChangeError> {
        let writer = writer.map(Arc::<str>::from);
        // The store is written last: if a clone of the world exists, writing copies the store, so errors must come before.
        let World { overlay, revision, .. } = self.changed(|_| writer.as_ref(), changes)?;
        self.overlay = overlay;
        self.revision = revision;
        self.store_overlay();
        Ok(revision)
    }

    /// What [`World::apply_as`] would write to a root, for callers that examine it first; [`World::write`] then applies it.
    ///
    /// # Errors
    /// As [`World::apply`].
    pub fn written_by(&self, writer: Option<&str>, changes: &[Change]) -> Result<Written, ChangeError> {
        debug_assert!(self.overlay.is_empty(), "a root has no overlay");
        let writer = writer.map(Arc::<str>::from);
        Ok(self.changed(|_| writer.as_ref(), changes)?.overlay)
    }

    /// Writes these facts, in a new revision.
    pub fn write(&mut self, written: &Written) -> Revision {
        self.overlay.extend(written.iter().map(|(key, fact)| (Arc::clone(key), fact.clone())));
        self.store_overlay();
        self.revision = Revision(self.revision.0 + 1);
        self.revision
    }

    /// Sets or removes these facts, in a new revision.
    pub fn overwrite(&mut self, facts: impl IntoIterator<Item = (FactKey, Option<Value>)>) -> Revision {
        let revision = Revision(self.revision.0 + 1);
        let of = |value| Arc::new(Fact { value, revision, writer: None, measured: None });
        let written: Written = facts.into_iter().map(|(key, value)| (Arc::new(key), value.map(of))).collect();
        self.write(&written)
    }

    /// The world after the changes; costs the changes, not the facts.
    ///
    /// # Errors
    /// As [`World::apply`].
    pub fn project(&self, changes: &[Change]) -> Result<World, ChangeError> {
        self.project_as(&[], changes)
    }

    /// As [`World::project`]; the writer of each fact, a node's path, is taken from the index of its change. Empty or missing:
    /// unknown.
    ///
    /// # Errors
    /// As [`World::apply`].
    pub fn project_as(&self, writers: &[Arc<str>], changes: &[Change]) -> Result<World, ChangeError> {
        self.project_looking(writers, changes, |_| {})
    }

    /// As [`World::project_as`]; `look` gets what the changes write.
    ///
    /// # Errors
    /// As [`World::apply`].
    pub fn project_looking(
        &self,
        writers: &[Arc<str>],
        changes: &[Change],
        look: impl FnOnce(&Written),
    ) -> Result<World, ChangeError> {
        let writer = |place: usize| writers.get(place).filter(|writer| !writer.is_empty());
        let mut world = self.changed(writer, changes)?;
        look(&world.overlay);
        if world.overlay.len() > OVERLAY_LIMIT {
            world.store_overlay();
        }
        Ok(world)
    }

    /// A copy with the changes in its overlay.
    fn changed<'a>(
        &self,
        writer: impl Fn(usize) -> Option<&'a Arc<str>>,
        changes: &[Change],
    ) -> Result<World, ChangeError> {
        let mut world = self.clone();
        world.revision = Revision(self.revision.0 + 1);
        let revision = world.revision;
        for (place, change) in changes.iter().enumerate() {
            let written = |value: Value| {
                let writer = writer(place).cloned();
                Some(Arc::new(Fact { value, revision, writer, measured: None }))
            };
            match change {
                Change::Set { fact, value } => {
                    world.overlay.insert(Arc::new(fact.clone()), written(value.clone()));
                }
                Change::Delete { pattern } => {
                    let doomed: Vec<FactKey> = world.matching(pattern).map(|(key, _)| key.clone()).collect();
                    world.overlay.extend(doomed.into_iter().map(|key| (Arc::new(key), None)));
                }
                Change::Increase { fact, by } => {
                    let value = increased(fact, world.get(fact), *by)?;
                    world.overlay.insert(Arc::new(fact.clone()), written(value));
                }
            }
        }
        Ok(world)
    }

    fn store_overlay(&mut self) {
        for (key, fact) in std::mem::take(&mut self.overlay) {
            match fact {
                Some(fact) => self.store.insert(&key, &fact),
                None => self.store.remove(&key),
            }
        }
    }
}

/// Equal if all facts are equal, with their writers and revisions; how they are stored makes no difference.
impl PartialEq for World {
    fn eq(&self, other: &World) -> bool {
        self.revision == other.revision && self.iter().eq(other.iter())
    }
}

/// Merges two ordered sequences; for equal keys `above` wins.
struct Merged<B: Iterator, A: Iterator> {
    below: Peekable<B>,
    above: Peekable<A>,
}

impl<'a, B, A> Iterator for Merged<B, A>
where
    B: Iterator<Item = (&'a FactKey, &'a Fact)>,
    A: Iterator<Item = (&'a FactKey, Option<&'a Fact>)>,
{
    type Item = (&'a FactKey, &'a Fact);

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            let Some((above, _)) = self.above.peek() else { return self.below.next() };
            if let Some(fact) = self.below.next_if(|(below, _)| below < above) {
                return Some(fact);
            }
            let (key, fact) = self.above.next()?;
            self.below.next_if(|(below, _)| *below == key);
            if let Some(fact) = fact {
                return Some((key, fact));
            }
        }
    }
}

/// The facts that changes write in a world.
pub(crate) fn written(before: &World, changes: &[Change]) -> BTreeSet<FactKey> {
    let mut keys = BTreeSet::new();
    for change in changes {
        match change {
            Change::Set { fact, .. } | Change::Increase { fact, .. } => drop(keys.insert(fact.clone())),
            Change::Delete { pattern } => keys.extend(before.matching(pattern).map(|(key, _)| key.clone())),
        }
    }
    keys
}

/// The result of `increase`; an absent value counts as 0. Whole numbers stay whole.
///
/// # Errors
/// [`ChangeError`] if the value is no number, or if the result is out of range.
pub fn increased(fact: &FactKey, old: Option<&Value>, by: f64) -> Result<Value, ChangeError> {
    let beyond = || {
        let value = old.cloned().unwrap_or(Value::Null);
        ChangeError::OutOfRange { fact: fact.clone(), value, by }
    };
    let finite = |x: f64| if x.is_finite() { Ok(Value::Float(x)) } else { Err(beyond()) };
    let whole = by.fract() == 0.0;
    match old {
        None | Some(Value::Null) if whole => as_whole(by).map(Value::Int).ok_or_else(beyond),
        None | Some(Value::Null) => finite(by),
        Some(Value::Int(i)) if whole => {
            as_whole(by).and_then(|by| i.checked_add(by)).map(Value::Int).ok_or_else(beyond)
        }
        Some(value) => match value.as_number() {
            Some(x) => finite(x + by),
            None => Err(ChangeError::NotANumber { fact: fact.clone(), value: value.clone() }),
        },
    }
}

/// A whole number as an int, if it is in range. The limits of the range are powers of two, so they are exact as floats.
fn as_whole(x: f64) -> Option<i64> {
    (x >= i64::MIN as f64 && x < -(i64::MIN as f64)).then_some(x as i64)
}
