//! The facts that live projections have read, and the projections that a commit contradicts.
//!
//! A projection shows a base with predicted effects. Its readers depend on what it showed: on single facts, on the facts that match a
//! pattern (or on their absence), or on everything. When the root changes, a projection is contradicted if it would now show something else.
//! What it would show now is the new root plus those of its effects that are still expected. The predicted effects of the committing writer
//! are no longer expected; they are compared with what the writer has really changed.
//!
//! ```text
//! shown   =  base     + effect of a, effect of b        (when it was made)
//! now     =  new root              + effect of b        (after a's commit)
//! ```
//!
//! [`Live`] finds the readers of a changed fact by the patterns that can match it; a fact of n arguments has 2ⁿ. Readers by the same pattern
//! whose effects do not touch the fact are compared together: all whose bases have the same version of the fact show the same value. A
//! projection is compared alone for the facts that its effects write or delete by pattern, and once when it is contradicted. So a commit
//! costs its changes plus their readers, not the product of the two. What a projection has read is not copied: the projection is kept, and
//! shares its store with the root.

use crate::table::hash_of;
use crate::world::{Fact as WrittenFact, World, increased, written};
use ratn_model::fact::{Change, FactKey, FactPattern, Footprint};
use ratn_model::id::Revision;
use ratn_model::tolerance::Tolerance;
use ratn_model::value::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Bound;
use std::sync::Arc;

/// For a fact with more arguments, all patterns of its predicate are tried instead of enumerating those that can match.
const MAX_ENUMERATED: usize = 6;

/// Live projections, by an id of the caller.
#[derive(Debug, Clone)]
pub struct Live<Id> {
    places: BTreeMap<Id, Place>,
    /// By place; places of removed projections are reused.
    projections: Vec<Option<(Id, Projection)>>,
    free: Vec<Place>,
    /// Readers by pattern.
    by_pattern: BTreeMap<FactPattern, Readers>,
    everything: Readers,
    /// By writer, the projections that expect its effects, in order.
    by_writer: BTreeMap<Arc<str>, Vec<Place>>,
    /// By hash of a fact, the projections whose effects write it, in order.
    by_hash: BTreeMap<u64, Vec<Place>>,
    /// Projections whose effects delete patterns, in order.
    deleting: Vec<Place>,
}

/// The index of a projection.
type Place = usize;

/// The readers by one pattern: by their bases, in order.
type Readers = BTreeMap<Revision, Vec<Place>>;

#[derive(Debug, Clone)]
struct Projection {
    base: Revision,
    shown: World,
    effects: Vec<Predicted>,
    /// The writers of its effects, and whether each has committed.
    writers: Vec<(Arc<str>, bool)>,
    /// The facts that its effects write, sorted by hash; it shows all other facts as its base does.
    written: Vec<Written>,
    /// The patterns that its effects delete.
    deleted: Vec<FactPattern>,
    reads: Footprint,
}

/// The keys with one hash that the effects of a projection write.
#[derive(Debug, Clone, Copy)]
struct Written {
    hash: u64,
    /// The index of an effect that writes one.
    effect: usize,
    /// No other effect does, and none deletes anything.
    alone: bool,
}

/// An effect of a projection.
#[derive(Debug, Clone)]
struct Predicted {
    /// Hash of the key that it writes; 0 if it deletes a pattern.
    hash: u64,
    /// Index among the projection's writers.
    writer: Option<usize>,
    change: Change,
}

/// A predicted change and its writer.
#[derive(Debug, Clone, PartialEq)]
pub struct Effect {
    /// The writing node, by the path of its instance; `None` if no node will make the change.
    pub writer: Option<Arc<str>>,
    /// What it will change.
    pub change: Change,
}

/// A projection that a commit contradicts.
#[derive(Debug, Clone, PartialEq)]
pub struct Contradiction<Id> {
    /// Its id.
    pub projection: Id,
    /// The first differing fact, in the order of keys.
    pub fact: FactKey,
    /// The value that it showed; `None`: it showed no such fact.
    pub was: Option<Value>,
    /// The value that it would show now.
    pub is: Option<Value>,
}

impl<Id> Default for Live<Id> {
    fn default() -> Live<Id> {
        let (places, projections, free, by_pattern, everything, by_writer, by_hash, deleting) = Default::default();
        Live { places, projections, free, by_pattern, everything, by_writer, by_hash, deleting }
    }
}

impl<Id: Ord + Copy> Live<Id> {
    /// Number of live projections.
    pub fn len(&self) -> usize {
        self.places.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.places.is_empty()
    }

    /// Adds the reads of the projection `shown`, which is `base` with the effects; replaces one with the same id. All bases are revisions of
    /// one history.
    pub fn insert(&mut self, id: Id, base: Revision, shown: World, effects: Vec<Effect>, reads: Footprint) {
        self.remove(id);
        let place = self.free.pop().unwrap_or(self.projections.len());
        match &reads {
            Footprint::Everything => put_in(&mut self.everything, &base, place),
            Footprint::Patterns(patterns) => {
                for pattern in patterns {
                    put_in(self.by_pattern.entry(pattern.clone()).or_default(), &base, place);
                }
            }
        }
        let mut projection = Projection {
            base,
            shown,
            effects: Vec::with_capacity(effects.len()),
            writers: Vec::new(),
            written: Vec::new(),
            deleted: Vec::new(),
            reads,
        };
        effects.into_iter().for_each(|effect| projection.predict(effect));
        projection.index();
        projection.writers.iter().for_each(|(writer, _)| put_in(&mut self.by_writer, writer, place));
        projection.written.iter().for_each(|written| put_in(&mut self.by_hash, &written.hash, place));
        if !projection.deleted.is_empty() {
            put(&mut self.deleting, place);
        }
        if place == self.projections.len() {
            self.projections.push(None);
        }
        self.projections[place] = Some((id, projection));
        self.places.insert(id, place);
    }

    /// Removes a projection.
    pub fn remove(&mut self, id: Id) {
        let Some(place) = self.places.remove(&id) else { return };
        let Some((_, projection)) = self.projections[place].take() else { return };
        self.free.push(place);
        match &projection.reads {
            Footprint::Everything => take_from(&mut self.everything, &projection.base, place),
            Footprint::Patterns(patterns) => {
                for pattern in patterns {
                    if let Some(readers) = self.by_pattern.get_mut(pattern) {
                        take_from(readers, &projection.base, place);
                        if readers.is_empty() {
                            self.by_pattern.remove(pattern);
                        }
                    }
                }
            }
        }
        projection.writers.iter().for_each(|(writer, _)| take_from(&mut self.by_writer, writer, place));
        projection.written.iter().for_each(|written| take_from(&mut self.by_hash, &written.hash, place));
        take(&mut self.deleting, place);
    }

    /// The projections that a commit contradicts, in the order of ids. `before` and `after` are the root; `writer` is the committer, whose
    /// effects are no longer expected. A difference within the predicate's tolerance does not count. Each commit is judged separately: the
    /// caller removes a projection that it has been told of.
    pub fn contradicted(
        &mut self,
        before: &World,
        after: &World,
        writer: Option<&str>,
        changes: &[Change],
        tolerance: &dyn Fn(&str) -> Tolerance,
    ) -> Vec<Contradiction<Id>> {
        let mut touched = written(before, changes);
        // A fact that the commit both wrote and deleted has changed for nobody; projections that predicted it are compared alone.
        touched.retain(|key| before.fact(key).is_some() || after.fact(key).is_some());
        let mut hashes: Vec<u64> = touched.iter().map(hash_of).collect();
        hashes.sort_unstable();
        // A predicted change that the writer did not make is a difference, too.
        let alone = self.come_true(writer, before, &hashes);
        let mut found = Found::default();
        for (place, key) in &alone {
            self.compare(*place, &Fact::of(key, before, after), tolerance, &mut found);
        }
        for key in &touched {
            let fact = Fact::of(key, before, after);
            let by_themselves = self.by_themselves(&fact);
            for place in &by_themselves {
                if self.compare(*place, &fact, tolerance, &mut found) {
                    found.over.insert(*place);
                }
            }
            self.compare_together(None, &self.everything, &fact, &by_themselves, tolerance, &mut found);
            self.readers(key, &mut |pattern, readers| {
                self.compare_together(Some(pattern), readers, &fact, &by_themselves, tolerance, &mut found);
            });
        }
        found.first.into_values().collect()
    }

    /// The projections that must be compared alone for a fact, in order, because their effects may concern it.
    fn by_themselves(&self, fact: &Fact<'_>) -> Vec<Place> {
        let writing = self.by_hash.get(&fact.hash).into_iter().flatten();
        let deletes = |place: &&Place| {
            let projection = self.projections[**place].as_ref();
            projection.is_some_and(|(_, projection)| projection.deletes(fact.key))
        };
        let mut all: Vec<Place> = writing.chain(self.deleting.iter().filter(deletes)).copied().collect();
        all.sort_unstable();
        all.dedup();
        all
    }

    /// Compares one projection for a fact; true if it is contradicted.
    fn compare(
        &self,
        place: Place,
        fact: &Fact<'_>,
        tolerance: &dyn Fn(&str) -> Tolerance,
        found: &mut Found<'_, Id>,
    ) -> bool {
        let Some((id, projection)) = &self.projections[place] else { return false };
        if found.over.contains(&place) || !projection.reads.contains(fact.key) {
            return false;
        }
        let difference = projection.difference(fact, tolerance);
        let differs = difference.is_some();
        difference.into_iter().for_each(|difference| add(&mut found.first, *id, fact.key, difference));
        differs
    }

    /// Compares a fact for all readers by one pattern whose effects do not concern it; those with the same version of the fact at once.
    fn compare_together<'a>(
        &'a self,
        pattern: Option<&'a FactPattern>,
        readers: &'a Readers,
        fact: &Fact<'_>,
        by_themselves: &[Place],
        tolerance: &dyn Fn(&str) -> Tolerance,
        found: &mut Found<'a, Id>,
    ) {
        let is_together = |place: &Place| by_themselves.binary_search(place).is_err();
        // Bases older than this one are still to be compared.
        let mut below = Bound::Unbounded;
        let mut version = fact.before;
        loop {
            let left = found.left.get(&pattern).unwrap_or(readers);
            let Some((newest, places)) = left.range((Bound::Unbounded, below)).next_back() else { return };
            let since = match version.take().filter(|version| version.revision <= *newest) {
                // The version in the root before the commit, unless it was written after this base.
                Some(version) => Some(version),
                None => {
                    let Some(place) = places.iter().find(|place| is_together(place)) else {
                        below = Bound::Excluded(*newest);
                        continue;
                    };
                    let shown = self.projections[*place].as_ref().map(|(_, projection)| &projection.shown);
                    shown.and_then(|shown| shown.fact(fact.key))
                }
            };
            let oldest = since.map_or(*newest, |version| version.revision.min(*newest));
            let newest = below;
            below = Bound::Excluded(oldest);
            let Some(difference) = differ(fact, since.map(|version| &version.value), fact.now, tolerance) else {
                continue;
            };
            let Found { first, over, left } = &mut *found;
            let left = left.entry(pattern).or_insert_with(|| readers.clone());
            let bases: Vec<Revision> = left.range((Bound::Included(oldest), newest)).map(|(base, _)| *base).collect();
            for base in bases {
                let Some(places) = left.remove(&base) else { continue };
                let (contradicted, by_themselves): (Vec<Place>, Vec<Place>) = places.into_iter().partition(is_together);
                for place in contradicted {
                    if let Some((id, _)) = &self.projections[place]
                        && over.insert(place)
                    {
                        add(first, *id, fact.key, difference.clone());
                    }
                }
                if !by_themselves.is_empty() {
                    left.insert(base, by_themselves);
                }
            }
        }
    }

    /// The writer's effects are no longer expected. Returns the facts that they were to write and the commit did not.
    fn come_true(&mut self, writer: Option<&str>, before: &World, touched: &[u64]) -> Vec<(Place, FactKey)> {
        let waiting = writer.and_then(|writer| self.by_writer.remove(writer)).unwrap_or_default();
        let mut alone = Vec::new();
        for place in waiting {
            let Some((_, projection)) = &mut self.projections[place] else { continue };
            let Some(own) = projection.writers.iter().position(|(of, _)| Some(of.as_ref()) == writer) else { continue };
            projection.writers[own].1 = true;
            for Predicted { hash, change, .. } in projection.effects.iter().filter(|e| e.writer == Some(own)) {
                match change {
                    Change::Set { fact, .. } | Change::Increase { fact, .. } => {
                        // Hashes may collide; then the fact is only compared once more.
                        if touched.binary_search(hash).is_err() && projection.reads.contains(fact) {
                            alone.push((place, fact.clone()));
                        }
                    }
                    Change::Delete { pattern } => {
                        let hidden = before.matching(pattern).map(|(key, _)| key);
                        let to_come = projection.effects.iter().filter_map(|effect| match &effect.change {
                            Change::Set { fact, .. } | Change::Increase { fact, .. } => Some(fact),
                            Change::Delete { .. } => None,
                        });
                        let to_come = to_come.filter(|fact| pattern.matches(fact));
                        let read = hidden.chain(to_come).filter(|key| projection.reads.contains(key));
                        alone.extend(read.map(|key| (place, key.clone())));
                    }
                }
            }
        }
        alone
    }

    /// Calls `visit` with each pattern by which a fact was read, and its readers.
    fn readers<'a>(&'a self, key: &FactKey, visit: &mut dyn FnMut(&'a FactPattern, &'a Readers)) {
        let arity = key.arguments.len();
        let mut pattern = FactPattern::of(key);
        if arity > MAX_ENUMERATED {
            pattern.arguments.fill(None);
            pattern.arguments.clear();
            let of_predicate = self.by_pattern.range(pattern..).take_while(|(p, _)| p.predicate == key.predicate);
            return of_predicate.filter(|(p, _)| p.matches(key)).for_each(|(pattern, readers)| visit(pattern, readers));
        }
        for hidden in 0_usize..1 << arity {
            for (position, argument) in pattern.arguments.iter_mut().enumerate() {
                let is_hidden = hidden & (1 << position) != 0;
                if is_hidden == argument.is_some() {
                    *argument = (!is_hidden).then(|| key.arguments[position].clone());
                }
            }
            if let Some((pattern, readers)) = self.by_pattern.get_key_value(&pattern) {
                visit(pattern, readers);
            }
        }
    }
}

/// A fact to compare.
struct Fact<'a> {
    key: &'a FactKey,
    hash: u64,
    /// In the root before the commit: unchanged since the fact's revision.
    before: Option<&'a WrittenFact>,
    now: Option<&'a Value>,
}

/// Earlier and present value.
type Difference = (Option<Value>, Option<Value>);

impl<'a> Fact<'a> {
    fn of(key: &'a FactKey, before: &'a World, after: &'a World) -> Fact<'a> {
        Fact { key, hash: hash_of(key), before: before.fact(key), now: after.get(key) }
    }
}

/// The contradictions of a commit found so far.
struct Found<'a, Id> {
    first: BTreeMap<Id, Contradiction<Id>>,
    /// Projections that need no further comparison, because facts are compared in the order of keys.
    over: BTreeSet<Place>,
    /// The remaining readers by a pattern (`None`: readers of everything), for patterns with finished readers.
    left: BTreeMap<Option<&'a FactPattern>, Readers>,
}

impl<Id> Default for Found<'_, Id> {
    fn default() -> Self {
        Found { first: BTreeMap::new(), over: BTreeSet::new(), left: BTreeMap::new() }
    }
}

fn add<Id: Ord + Copy>(found: &mut BTreeMap<Id, Contradiction<Id>>, id: Id, fact: &FactKey, (was, is): Difference) {
    let contradiction = Contradiction { projection: id, fact: fact.clone(), was, is };
    match found.get_mut(&id) {
        Some(first) if first.fact <= contradiction.fact => {}
        Some(first) => *first = contradiction,
        None => drop(found.insert(id, contradiction)),
    }
}

/// The difference of the values, beyond the tolerance.
fn differ(
    fact: &Fact<'_>,
    was: Option<&Value>,
    is: Option<&Value>,
    tolerance: &dyn Fn(&str) -> Tolerance,
) -> Option<Difference> {
    (!same(was, is, || tolerance(&fact.key.predicate))).then(|| (was.cloned(), is.cloned()))
}

impl Projection {
    fn predict(&mut self, Effect { writer, change }: Effect) {
        let writer = writer.map(|writer| {
            self.writers.iter().position(|(known, _)| *known == writer).unwrap_or_else(|| {
                self.writers.push((writer, false));
                self.writers.len() - 1
            })
        });
        let hash = match &change {
            Change::Set { fact, .. } | Change::Increase { fact, .. } => hash_of(fact),
            Change::Delete { pattern } => {
                self.deleted.push(pattern.clone());
                0
            }
        };
        self.effects.push(Predicted { hash, writer, change });
    }

    fn index(&mut self) {
        let writes =
            self.effects.iter().enumerate().filter(|(_, effect)| !matches!(effect.change, Change::Delete { .. }));
        let alone = self.deleted.is_empty();
        self.written = writes.map(|(at, effect)| Written { hash: effect.hash, effect: at, alone }).collect();
        self.written.sort_unstable_by_key(|written| written.hash);
        self.written.dedup_by(|later, first| {
            let same = later.hash == first.hash;
            first.alone &= !same;
            same
        });
    }

    /// Whether one of its effects may delete this fact.
    fn deletes(&self, key: &FactKey) -> bool {
        self.deleted.iter().any(|pattern| pattern.matches(key))
    }

    /// The difference between what the projection would show of a fact now and what it showed.
    fn difference(&self, fact: &Fact<'_>, tolerance: &dyn Fn(&str) -> Tolerance) -> Option<Difference> {
        let differ = |was: Option<&Value>, is: Option<&Value>| differ(fact, was, is, tolerance);
        let written = self.written.binary_search_by_key(&fact.hash, |written| written.hash);
        let is_to_come = |effect: &Predicted| effect.writer.is_none_or(|writer| !self.writers[writer].1);
        if let Ok(at) = written
            && let Written { effect, alone: true, .. } = self.written[at]
            && let effect @ Predicted { change: Change::Set { fact: set, value }, .. } = &self.effects[effect]
            && set == fact.key
        {
            // An effect that is still expected hides the present value.
            return if is_to_come(effect) { None } else { differ(Some(value), fact.now) };
        }
        let mut own = self.effects.iter().filter(|effect| effect.hash == fact.hash || effect.hash == 0);
        let was = match own.clone().next_back().map(|effect| &effect.change) {
            Some(Change::Set { fact: set, value }) if set == fact.key => Some(value),
            _ => self.shown.get(fact.key),
        };
        if !own.clone().any(is_to_come) {
            return differ(was, fact.now);
        }
        let mut is = fact.now.cloned();
        for effect in own.by_ref().filter(|effect| is_to_come(effect)) {
            match &effect.change {
                Change::Set { fact: set, value } if set == fact.key => is = Some(value.clone()),
                // An increase that cannot be applied will fail later; until then the value stays.
                Change::Increase { fact: grown, by } if grown == fact.key => {
                    is = increased(grown, is.as_ref(), *by).ok().or(is);
                }
                Change::Delete { pattern } if pattern.matches(fact.key) => is = None,
                _ => {}
            }
        }
        differ(was, is.as_ref())
    }
}

fn same(was: Option<&Value>, is: Option<&Value>, tolerance: impl Fn() -> Tolerance) -> bool {
    match (was, is) {
        (Some(was), Some(is)) => was == is || tolerance().equal(was, is),
        (was, is) => was.is_none() && is.is_none(),
    }
}

fn put(places: &mut Vec<Place>, place: Place) {
    if let Err(at) = places.binary_search(&place) {
        places.insert(at, place);
    }
}

fn take(places: &mut Vec<Place>, place: Place) {
    if let Ok(at) = places.binary_search(&place) {
        places.remove(at);
    }
}

fn put_in<K: Ord + Clone>(index: &mut BTreeMap<K, Vec<Place>>, key: &K, place: Place) {
    match index.get_mut(key) {
        Some(places) => put(places, place),
        None => drop(index.insert(key.clone(), vec![place])),
    }
}

fn take_from<K: Ord>(index: &mut BTreeMap<K, Vec<Place>>, key: &K, place: Place) {
    if let Some(places) = index.get_mut(key) {
        take(places, place);
        if places.is_empty() {
            index.remove(key);
        }
    }
}
