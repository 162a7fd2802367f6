//! What live projections have read, and which of them a commit contradicts.
//!
//! A projection shows a base with predicted effects, and what reads it depends on what it showed: on single facts, on the facts
//! that match a pattern (that none did, too), or on everything. When the root changes, a projection is contradicted where it
//! would show something else now. What it would show now is the new root with those of its effects that are still to come: the
//! effects of the writer that commits have come true, and what was predicted of them is compared with what they came to.
//!
//! ```text
//! shown   =  base     + effect of a, effect of b        (when it was made)
//! now     =  new root              + effect of b        (after a's commit)
//! ```
//!
//! [`Live`] finds the projections that read what a commit touches by the patterns that can match a fact, of which a fact of n
//! arguments has 2ⁿ; so a commit costs what it touches and who reads that, not the number of projections or facts. What a projection
//! has read is not copied: it is the projection, which shares its store with the root.

use crate::store::hash_of;
use crate::world::{World, increased, written};
use ratn_model::fact::{Change, FactKey, FactPattern, Footprint};
use ratn_model::id::Revision;
use ratn_model::tolerance::Tolerance;
use ratn_model::value::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// Of a fact with more arguments, every pattern of its predicate is tried instead of those that can match it.
const MAX_ENUMERATED: usize = 6;

/// Projections that something depends on, by an id of the caller.
#[derive(Debug, Clone)]
pub struct Live<Id> {
    projections: BTreeMap<Id, Projection>,
    /// Who has read by a pattern.
    by_pattern: BTreeMap<FactPattern, BTreeSet<Id>>,
    everything: BTreeSet<Id>,
    /// Who waits for a writer's effects.
    by_writer: BTreeMap<Arc<str>, BTreeSet<Id>>,
}

#[derive(Debug, Clone)]
struct Projection {
    base: Revision,
    shown: World,
    effects: Vec<Effect>,
    /// Hashes of the keys that its effects ever wrote, in order: all others it shows as its base does.
    written: Vec<u64>,
    /// Whole patterns that its effects ever deleted.
    deleted: Vec<FactPattern>,
    reads: Footprint,
}

/// A predicted change, and who will make it.
#[derive(Debug, Clone, PartialEq)]
pub struct Effect {
    /// The node, by the path of its instance; `None` where nobody will.
    pub writer: Option<Arc<str>>,
    /// What it will change.
    pub change: Change,
}

/// A projection that a commit contradicts.
#[derive(Debug, Clone, PartialEq)]
pub struct Contradiction<Id> {
    /// Which.
    pub projection: Id,
    /// The first fact, in the order of keys, that it showed and that is otherwise.
    pub fact: FactKey,
    /// What it showed; `None`: that there is no such fact.
    pub was: Option<Value>,
    /// What it would show now.
    pub is: Option<Value>,
}

impl<Id> Default for Live<Id> {
    fn default() -> Live<Id> {
        let (projections, by_pattern, everything, by_writer) = Default::default();
        Live { projections, by_pattern, everything, by_writer }
    }
}

impl<Id: Ord + Copy> Live<Id> {
    /// How many there are.
    pub fn len(&self) -> usize {
        self.projections.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.projections.is_empty()
    }

    /// Adds what was read of `shown`, which is `base` with the effects; one of the same id ends. All bases are revisions of one
    /// history.
    pub fn insert(&mut self, id: Id, base: Revision, shown: World, effects: Vec<Effect>, reads: Footprint) {
        self.remove(id);
        match &reads {
            Footprint::Everything => drop(self.everything.insert(id)),
            Footprint::Patterns(patterns) => {
                for pattern in patterns {
                    self.by_pattern.entry(pattern.clone()).or_default().insert(id);
                }
            }
        }
        for writer in effects.iter().filter_map(|effect| effect.writer.as_ref()) {
            self.by_writer.entry(Arc::clone(writer)).or_default().insert(id);
        }
        let (mut written, mut deleted) = (Vec::new(), Vec::new());
        for effect in &effects {
            match &effect.change {
                Change::Set { fact, .. } | Change::Increase { fact, .. } => written.push(hash_of(fact)),
                Change::Delete { pattern } => deleted.push(pattern.clone()),
            }
        }
        written.sort_unstable();
        self.projections.insert(id, Projection { base, shown, effects, written, deleted, reads });
    }

    /// Nothing depends on it any more.
    pub fn remove(&mut self, id: Id) {
        let Some(projection) = self.projections.remove(&id) else { return };
        self.everything.remove(&id);
        if let Footprint::Patterns(patterns) = &projection.reads {
            patterns.iter().for_each(|pattern| take(&mut self.by_pattern, pattern, id));
        }
        projection.effects.iter().filter_map(|effect| effect.writer.as_ref()).for_each(|writer| {
            take(&mut self.by_writer, writer, id);
        });
    }

    /// What a projection showed.
    pub fn shown(&self, id: Id) -> Option<&World> {
        self.projections.get(&id).map(|projection| &projection.shown)
    }

    /// The projections that a commit contradicts, in the order of ids. `before` and `after` are the root; `writer` is who
    /// committed, whose effects are no longer to come. A difference within the tolerance of the predicate is none.
    pub fn contradicted(
        &mut self,
        before: &World,
        after: &World,
        writer: Option<&str>,
        changes: &[Change],
        tolerance: &dyn Fn(&str) -> Tolerance,
    ) -> Vec<Contradiction<Id>> {
        let touched = written(before, changes);
        let mut found: BTreeMap<Id, Contradiction<Id>> = BTreeMap::new();
        let mut note = |contradiction: Contradiction<Id>| {
            let first = found.entry(contradiction.projection).or_insert_with(|| contradiction.clone());
            if contradiction.fact < first.fact {
                *first = contradiction;
            }
        };
        // What was predicted of the writer and did not come is as much a difference as what came.
        for (id, key) in self.come_true(writer, before) {
            let Some(projection) = self.projections.get(&id) else { continue };
            if !touched.contains(&key) && projection.reads.contains(&key) {
                projection.compare(id, &key, hash_of(&key), &mut Shown::default(), after, tolerance).map(&mut note);
            }
        }
        for key in &touched {
            let hash = hash_of(key);
            let mut shown = Shown::default();
            let mut look = |id: &Id| {
                if let Some(projection) = self.projections.get(id) {
                    projection.compare(*id, key, hash, &mut shown, after, tolerance).map(&mut note);
                }
            };
            self.everything.iter().for_each(&mut look);
            self.readers(key, &mut look);
        }
        found.into_values().collect()
    }

    /// Ends the effects of a writer that were to come; the facts they were to write.
    fn come_true(&mut self, writer: Option<&str>, before: &World) -> Vec<(Id, FactKey)> {
        let waiting = writer.and_then(|writer| self.by_writer.remove(writer)).unwrap_or_default();
        let mut keys = Vec::new();
        for id in waiting {
            let Some(projection) = self.projections.get_mut(&id) else { continue };
            let (come, still): (Vec<Effect>, Vec<Effect>) =
                std::mem::take(&mut projection.effects).into_iter().partition(|e| e.writer.as_deref() == writer);
            projection.effects = still;
            for Effect { change, .. } in come {
                match change {
                    Change::Set { fact, .. } | Change::Increase { fact, .. } => keys.push((id, fact)),
                    Change::Delete { pattern } => {
                        // Those that it hid.
                        keys.extend(before.matching(&pattern).map(|(key, _)| (id, key.clone())));
                        let to_come = projection.effects.iter().filter_map(|effect| match &effect.change {
                            Change::Set { fact, .. } | Change::Increase { fact, .. } => Some(fact),
                            Change::Delete { .. } => None,
                        });
                        keys.extend(to_come.filter(|fact| pattern.matches(fact)).map(|fact| (id, fact.clone())));
                    }
                }
            }
        }
        keys
    }

    /// Calls `visit` for whoever has read a fact by a pattern.
    fn readers(&self, key: &FactKey, visit: &mut dyn FnMut(&Id)) {
        let arity = key.arguments.len();
        let mut pattern = FactPattern::of(key);
        if arity > MAX_ENUMERATED {
            pattern.arguments.fill(None);
            pattern.arguments.clear();
            let of_predicate = self.by_pattern.range(pattern..).take_while(|(p, _)| p.predicate == key.predicate);
            return of_predicate.filter(|(p, _)| p.matches(key)).for_each(|(_, ids)| ids.iter().for_each(&mut *visit));
        }
        for hidden in 0_usize..1 << arity {
            for (position, argument) in pattern.arguments.iter_mut().enumerate() {
                let is_hidden = hidden & (1 << position) != 0;
                if is_hidden == argument.is_some() {
                    *argument = (!is_hidden).then(|| key.arguments[position].clone());
                }
            }
            if let Some(ids) = self.by_pattern.get(&pattern) {
                ids.iter().for_each(&mut *visit);
            }
        }
    }
}

/// What bases say of one fact: projections of one base say the same of what their effects leave alone.
#[derive(Default)]
struct Shown(Vec<(Revision, Option<Value>, bool)>);

impl Projection {
    /// The contradiction in a fact that it has read, if there is one.
    fn compare<Id>(
        &self,
        id: Id,
        key: &FactKey,
        hash: u64,
        of_bases: &mut Shown,
        after: &World,
        tolerance: &dyn Fn(&str) -> Tolerance,
    ) -> Option<Contradiction<Id>> {
        let touches = self.written.binary_search(&hash).is_ok() || self.deleted.iter().any(|p| p.matches(key));
        if !touches {
            if let Some((_, was, same)) = of_bases.0.iter().find(|(base, ..)| *base == self.base) {
                let differs = || Contradiction {
                    projection: id,
                    fact: key.clone(),
                    was: was.clone(),
                    is: after.get(key).cloned(),
                };
                return (!same).then(differs);
            }
            let (was, is) = (self.shown.get(key), after.get(key));
            let same = same(was, is, || tolerance(&key.predicate));
            of_bases.0.push((self.base, was.cloned(), same));
            return (!same).then(|| Contradiction {
                projection: id,
                fact: key.clone(),
                was: was.cloned(),
                is: is.cloned(),
            });
        }
        let was = self.shown.get(key);
        let mut is = after.get(key).cloned();
        for Effect { change, .. } in &self.effects {
            match change {
                Change::Set { fact, value } if fact == key => is = Some(value.clone()),
                // What cannot be increased fails when it comes true; until then it is as it is.
                Change::Increase { fact, by } if fact == key => is = increased(fact, is.as_ref(), *by).ok().or(is),
                Change::Delete { pattern } if pattern.matches(key) => is = None,
                _ => {}
            }
        }
        (!same(was, is.as_ref(), || tolerance(&key.predicate))).then(|| Contradiction {
            projection: id,
            fact: key.clone(),
            was: was.cloned(),
            is,
        })
    }
}

fn same(was: Option<&Value>, is: Option<&Value>, tolerance: impl Fn() -> Tolerance) -> bool {
    match (was, is) {
        (Some(was), Some(is)) => was == is || tolerance().equal(was, is),
        (was, is) => was.is_none() && is.is_none(),
    }
}

fn take<K: Ord + Clone, Id: Ord>(index: &mut BTreeMap<K, BTreeSet<Id>>, key: &K, id: Id) {
    if let Some(ids) = index.get_mut(key) {
        ids.remove(&id);
        if ids.is_empty() {
            index.remove(key);
        }
    }
}
