//! Facts that live projections have read, and which projections a commit contradicts.
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
//! arguments has 2ⁿ, and looks at those of one pattern together: where their effects leave a fact alone, all whose bases have the same
//! version of it show the same. A projection is looked at by itself for the facts that its effects write, for those of which they delete the
//! pattern, and once when it is contradicted. So a commit costs what it touches and who reads that, not the product of the two. What a
//! projection has read is not copied: it is the projection, which shares its store with the root.

use crate::table::hash_of;
use crate::world::{Fact as WrittenFact, World, increased, written};
use ratn_model::fact::{Change, FactKey, FactPattern, Footprint};
use ratn_model::id::Revision;
use ratn_model::tolerance::Tolerance;
use ratn_model::value::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Bound;
use std::sync::Arc;

/// Of a fact with more arguments, every pattern of its predicate is tried instead of those that can match it.
const MAX_ENUMERATED: usize = 6;

/// Projections that something depends on, by an id of the caller.
#[derive(Debug, Clone)]
pub struct Live<Id> {
    places: BTreeMap<Id, Place>,
    /// By place; places of ended ones are taken again.
    projections: Vec<Option<(Id, Projection)>>,
    free: Vec<Place>,
    /// Who has read by a pattern.
    by_pattern: BTreeMap<FactPattern, Readers>,
    everything: Readers,
    /// Who waits for a writer's effects, in order.
    by_writer: BTreeMap<Arc<str>, Vec<Place>>,
    /// Whose effects write a fact, by its hash, in order.
    by_hash: BTreeMap<u64, Vec<Place>>,
    /// Whose effects delete patterns, in order.
    deleting: Vec<Place>,
}

/// Where a projection is among the others.
type Place = usize;

/// Who has read by the same pattern: by their bases, in order.
type Readers = BTreeMap<Revision, Vec<Place>>;

#[derive(Debug, Clone)]
struct Projection {
    base: Revision,
    shown: World,
    effects: Vec<Predicted>,
    /// The writers of its effects, and whether theirs have come true.
    writers: Vec<(Arc<str>, bool)>,
    /// What its effects write, in the order of hashes: all other facts it shows as its base does.
    written: Vec<Written>,
    /// Whole patterns that its effects delete.
    deleted: Vec<FactPattern>,
    reads: Footprint,
}

/// Keys of one hash that the effects of a projection write.
#[derive(Debug, Clone, Copy)]
struct Written {
    hash: u64,
    /// Which effect does.
    effect: usize,
    /// No other does, and none deletes anything.
    alone: bool,
}

/// An effect of a projection.
#[derive(Debug, Clone)]
struct Predicted {
    /// Of the key that it writes; 0 for a pattern that it deletes.
    hash: u64,
    /// Among the projection's writers.
    writer: Option<usize>,
    change: Change,
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
        let (places, projections, free, by_pattern, everything, by_writer, by_hash, deleting) = Default::default();
        Live { places, projections, free, by_pattern, everything, by_writer, by_hash, deleting }
    }
}

impl<Id: Ord + Copy> Live<Id> {
    /// How many there are.
    pub fn len(&self) -> usize {
        self.places.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.places.is_empty()
    }

    /// Adds what was read of `shown`, which is `base` with the effects; one of the same id ends. All bases are revisions of one
    /// history.
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

    /// Nothing depends on it any more.
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

    /// The projections that a commit contradicts, in the order of ids. `before` and `after` are the root; `writer` is who
    /// committed, whose effects are no longer to come. A difference within the tolerance of the predicate is none. Every commit is
    /// judged by itself: who is told that a projection is contradicted removes it.
    pub fn contradicted(
        &mut self,
        before: &World,
        after: &World,
        writer: Option<&str>,
        changes: &[Change],
        tolerance: &dyn Fn(&str) -> Tolerance,
    ) -> Vec<Contradiction<Id>> {
        let mut touched = written(before, changes);
        // What was written and deleted at once has not changed for anybody; who predicted it is among those who are compared alone.
        touched.retain(|key| before.fact(key).is_some() || after.fact(key).is_some());
        let mut hashes: Vec<u64> = touched.iter().map(hash_of).collect();
        hashes.sort_unstable();
        // What was predicted of the writer and did not come is as much a difference as what came.
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

    /// Who has to be looked at alone for a fact, in order: its effects may have to do with it.
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

    /// Whether a projection that may have read a fact is contradicted in it.
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

    /// Compares a fact for those who have read it by one pattern and whose effects leave it alone, all of one version of it at once.
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
        // The bases below this one are still to be looked at.
        let mut below = Bound::Unbounded;
        let mut version = fact.before;
        loop {
            let left = found.left.get(&pattern).unwrap_or(readers);
            let Some((newest, places)) = left.range((Bound::Unbounded, below)).next_back() else { return };
            let since = match version.take().filter(|version| version.revision <= *newest) {
                // Of the root before, unless it was written behind this base.
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

    /// Ends the effects of a writer that were to come; the facts they were to write and a commit of these keys did not.
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
                        // One of the same hash may be another: then it is compared once more.
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

    /// Calls `visit` with each pattern by which a fact was read, and who did.
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

/// A fact that is compared.
struct Fact<'a> {
    key: &'a FactKey,
    hash: u64,
    /// In the root before: it has been so since its revision.
    before: Option<&'a WrittenFact>,
    now: Option<&'a Value>,
}

/// Was, is.
type Difference = (Option<Value>, Option<Value>);

impl<'a> Fact<'a> {
    fn of(key: &'a FactKey, before: &'a World, after: &'a World) -> Fact<'a> {
        Fact { key, hash: hash_of(key), before: before.fact(key), now: after.get(key) }
    }
}

/// What a commit has been found to contradict so far.
struct Found<'a, Id> {
    first: BTreeMap<Id, Contradiction<Id>>,
    /// Whom no later fact has to be compared for: facts are looked at in the order of keys.
    over: BTreeSet<Place>,
    /// Who is left of the readers of a pattern (`None`: of everything) of which some are over.
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

/// What a fact was where it is otherwise now.
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

    /// Whether one of its effects deletes a fact, if there is one.
    fn deletes(&self, key: &FactKey) -> bool {
        self.deleted.iter().any(|pattern| pattern.matches(key))
    }

    /// How what it would show of a fact now differs from what it showed.
    fn difference(&self, fact: &Fact<'_>, tolerance: &dyn Fn(&str) -> Tolerance) -> Option<Difference> {
        let differ = |was: Option<&Value>, is: Option<&Value>| differ(fact, was, is, tolerance);
        let written = self.written.binary_search_by_key(&fact.hash, |written| written.hash);
        let is_to_come = |effect: &Predicted| effect.writer.is_none_or(|writer| !self.writers[writer].1);
        if let Ok(at) = written
            && let Written { effect, alone: true, .. } = self.written[at]
            && let effect @ Predicted { change: Change::Set { fact: set, value }, .. } = &self.effects[effect]
            && set == fact.key
        {
            // What is still to come hides whatever there is now.
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
                // What cannot be increased fails when it comes true; until then it is as it is.
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
