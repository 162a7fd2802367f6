//! Forecasts: the changes of the world by one instance, predicted before it has ended and exact afterwards, effect by effect.
//!
//! A forecast is made for its first reader and kept. Its inputs are registered, so that it is made again when they change, and
//! its readers are told the difference. An `increase` is turned into a `set` of the resulting value: then it hides older
//! writers, and a chain of counters costs one step per writer.

use super::difference::Difference;
use super::overlay::Overlay;
use super::view::{Blocked, View};
use super::walk::Looked;
use super::{Purpose, Sight, Source, User};
use crate::plan::{Effects, Outcome};
use crate::window::graph::instance::{Body, Changed, Ended, Instance, Role};
use crate::window::growth::environment::Link;
use ratn_model::expression::{EffectExpr, EvaluateError, Lookup, Scope};
use ratn_model::fact::{Change, FactKey, FactPattern, Footprint};
use ratn_model::id::InstanceId;
use ratn_model::tolerance::Tolerance;
use ratn_model::value::Value;
use ratn_world::world::increased;
use serde::{Deserialize, Serialize};
use smallvec::SmallVec;
use std::sync::Arc;

/// Limit of nested forecasts; beyond it, the innermost one is made first, separately.
const MAX_DEPTH: u32 = 24;

/// Limit of remembered versions that differ within the tolerance; beyond it, every difference counts as beyond the tolerance.
const MAX_VERSIONS: usize = 4;

/// The changes by one effect.
pub(super) type Chunk = Arc<[Change]>;

/// The changes by one instance along one of its arms.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Forecast {
    /// The outcome that the arm assumes.
    outcome: Outcome,
    is_vague: bool,
    /// By effect, in order; measured facts that are not declared come last.
    parts: SmallVec<[Part; 2]>,
    /// Earlier versions that readers may have seen; they differ within the tolerance.
    versions: Vec<Vec<Change>>,
}

/// One effect.
#[derive(Debug, Clone, Serialize, Deserialize)]
enum Part {
    /// No reader has asked yet.
    Open,
    Known(Chunk),
    /// Not known until an older instance has gone on; these are the facts that the effect may write.
    Blocked(Footprint),
}

/// The result of making an instance's forecasts again.
#[derive(Debug, Default)]
pub(crate) struct Refreshed {
    pub(crate) difference: Difference,
    /// Whether something is known that was not known before.
    pub(crate) is_known_now: bool,
}

impl<'a> Sight<'a> {
    /// The changes by a writer along a link, for the facts that are looked at, except those that `hidden` covers (written by
    /// younger writers).
    pub(super) fn effects(
        self,
        writer: &'a Instance,
        link: Link,
        looked: Looked<'_>,
        hidden: &[FactPattern],
    ) -> Result<SmallVec<[Chunk; 2]>, Blocked> {
        let mut chunks = SmallVec::new();
        let count = self.prepare(writer, link.outcome, link.vague);
        for place in 0..count {
            match self.part(writer, link, place) {
                Part::Known(chunk) => {
                    if chunk.iter().any(|change| looked.overlaps(&change.pattern())) {
                        chunks.push(chunk);
                    }
                }
                Part::Blocked(footprint) if is_shown(&footprint, looked, hidden) => return Err(Blocked(writer.id)),
                Part::Blocked(_) | Part::Open => {}
            }
        }
        Ok(chunks)
    }

    /// Makes all parts of a forecast, unless it depends on a deep chain that must be made first.
    pub(super) fn complete(self, writer: &'a Instance, outcome: Outcome, vague: bool) {
        let link = Link { writer: writer.id, outcome, vague };
        for place in 0..self.prepare(writer, outcome, vague) {
            self.part(writer, link, place);
            if self.is_suspended() {
                return;
            }
        }
    }

    /// Adds an empty forecast if there is none; returns its number of parts.
    fn prepare(self, writer: &Instance, outcome: Outcome, is_vague: bool) -> usize {
        let of = |forecast: &Forecast| forecast.outcome == outcome && forecast.is_vague == is_vague;
        let mut forecasts = writer.memory.forecasts.borrow_mut();
        if let Some(forecast) = forecasts.iter().find(|forecast| of(forecast)) {
            return forecast.parts.len();
        }
        let count = self.count_parts(writer, outcome, is_vague);
        let parts = smallvec::smallvec![Part::Open; count];
        forecasts.push(Forecast { outcome, is_vague, parts, versions: Vec::new() });
        count
    }

    fn count_parts(self, writer: &Instance, outcome: Outcome, is_vague: bool) -> usize {
        match self.declared(writer, outcome, is_vague) {
            Declared::Nothing => 0,
            Declared::Effects(effects, measured) => effects.len() + usize::from(!measured.is_empty()),
            Declared::Exactly(_) | Declared::Unknown => 1,
        }
    }

    /// One part of a forecast; makes it if necessary.
    fn part(self, writer: &'a Instance, link: Link, place: usize) -> Part {
        let at = |forecast: &Forecast| forecast.outcome == link.outcome && forecast.is_vague == link.vague;
        {
            let forecasts = writer.memory.forecasts.borrow();
            let known = forecasts.iter().find(|forecast| at(forecast)).and_then(|forecast| forecast.parts.get(place));
            match known {
                Some(Part::Open) => {}
                Some(part) => return part.clone(),
                None => return Part::Open,
            }
        }
        let deep = &self.memory.deep;
        if deep.depth.get() >= MAX_DEPTH {
            deep.suspended.set(Some((writer.id, link.outcome, link.vague)));
        }
        if self.is_suspended() {
            return Part::Blocked(Footprint::Everything);
        }
        deep.depth.set(deep.depth.get() + 1);
        let part = self.make_part(writer, link, place);
        deep.depth.set(deep.depth.get() - 1);
        if !self.is_suspended() {
            let mut forecasts = writer.memory.forecasts.borrow_mut();
            let forecast = forecasts.iter_mut().find(|forecast| at(forecast));
            if let Some(slot) = forecast.and_then(|forecast| forecast.parts.get_mut(place)) {
                slot.clone_from(&part);
            }
        }
        part
    }

    fn is_suspended(self) -> bool {
        let suspended = &self.memory.deep.suspended;
        let first = suspended.take();
        suspended.set(first);
        first.is_some()
    }

    fn make_part(self, writer: &'a Instance, link: Link, place: usize) -> Part {
        match self.declared(writer, link.outcome, link.vague) {
            Declared::Nothing => Part::Known(Arc::new([])),
            Declared::Unknown => {
                let view = self.view(writer, None);
                let footprint = self.may_differ_along(&view, link);
                view.register(Purpose::Effects);
                Part::Blocked(footprint)
            }
            Declared::Exactly(changes) => {
                let view = self.view(writer, None);
                let made = self.worked_out(&view, writer, link, 0, changes.to_vec());
                view.register(Purpose::Effects);
                made.map_or(Part::Blocked(patterns_of(changes)), |made| Part::Known(made.into()))
            }
            Declared::Effects(effects, measured) => match effects.get(place) {
                Some(effect) => self.make_effect(writer, link, place, effect, measured),
                // A measured fact that is not declared makes the instance fail later; until then readers see it.
                None => {
                    let mut written: Vec<FactKey> = Vec::new();
                    for before in 0..place {
                        if let Part::Known(chunk) = self.part(writer, link, before) {
                            written.extend(chunk.iter().filter_map(|change| match change {
                                Change::Set { fact, .. } => Some(fact.clone()),
                                _ => None,
                            }));
                        }
                    }
                    let undeclared = measured.iter().filter(|(key, _)| !written.contains(key));
                    Part::Known(undeclared.map(|(key, value)| set(key, value)).collect())
                }
            },
        }
    }

    fn make_effect(
        self,
        writer: &'a Instance,
        link: Link,
        place: usize,
        effect: &EffectExpr,
        measured: &[(FactKey, Value)],
    ) -> Part {
        let outputs = writer.ended().map(|ended| &ended.outputs);
        let view = self.view(writer, outputs);
        let one = std::slice::from_ref(effect);
        let mut bound = EffectExpr::bind(one, &view);
        if let Ok(changes) = &mut bound {
            for change in changes {
                if let Change::Set { fact, value } = change
                    && let Some((_, actual)) = measured.iter().rev().find(|(key, _)| key == fact)
                {
                    value.clone_from(actual);
                }
            }
        }
        let made = match bound {
            Ok(changes) => self.worked_out(&view, writer, link, place, changes),
            // A wrong effect ends the instance `aborted`; until then nothing may depend on it.
            Err(EvaluateError::NotYetKnown { .. } | EvaluateError::Wrong { .. }) => Err(Blocked(writer.id)),
        };
        let part = match made {
            Ok(changes) => Part::Known(changes.into()),
            Err(_) => Part::Blocked(EffectExpr::footprint(one, &view)),
        };
        view.register(Purpose::Effects);
        part
    }

    /// Replaces every increase by a `set` of the resulting value.
    fn worked_out(
        self,
        view: &View<'a>,
        writer: &'a Instance,
        link: Link,
        place: usize,
        mut changes: Vec<Change>,
    ) -> Result<Vec<Change>, Blocked> {
        for at in 0..changes.len() {
            let Change::Increase { fact, by } = &changes[at] else { continue };
            let own = Overlay::value_after(&changes[..at], fact);
            let before = match own {
                Some(value) => value,
                None => self.value_before(view, writer, link, place, fact)?,
            };
            let value = increased(fact, before.as_ref(), *by).map_err(|_| Blocked(writer.id))?;
            changes[at] = Change::Set { fact: fact.clone(), value };
        }
        Ok(changes)
    }

    /// The value of a fact before an effect: after the earlier effects of the same list, or else at the instance's place.
    fn value_before(
        self,
        view: &View<'a>,
        writer: &'a Instance,
        link: Link,
        place: usize,
        fact: &FactKey,
    ) -> Result<Option<Value>, Blocked> {
        let pattern = FactPattern::of(fact);
        for before in (0..place).rev() {
            match self.part(writer, link, before) {
                Part::Known(chunk) => {
                    if let Some(value) = Overlay::value_after(&chunk, fact) {
                        return Ok(value);
                    }
                }
                Part::Blocked(footprint) if Looked::at(&footprint).overlaps(&pattern) => {
                    return Err(Blocked(writer.id));
                }
                Part::Blocked(_) | Part::Open => {}
            }
        }
        match view.fact(&pattern) {
            Lookup::Unknown => Err(Blocked(writer.id)),
            Lookup::Absent => Ok(None),
            Lookup::Holds(value) => Ok(Some(value.into_owned())),
        }
    }

    /// The changes that an instance declares along an arm.
    fn declared<'w>(self, writer: &'w Instance, outcome: Outcome, is_vague: bool) -> Declared<'w>
    where
        'a: 'w,
    {
        let own = self.plan.state(writer.state);
        let Some(ended) = writer.ended() else {
            return match &writer.body {
                Body::Marker(marker) if marker.role != Role::Exit => Declared::Nothing,
                _ => match &own.effects[outcome] {
                    Effects::Declared(effects) if !is_vague => Declared::Effects(effects, &[]),
                    _ => Declared::Unknown,
                },
            };
        };
        match &ended.changes {
            Changed::Exactly(made) => Declared::Exactly(&made.changes),
            Changed::Foreseen(changes) => Declared::Exactly(changes),
            Changed::Declared(measured, _) => match &own.effects[self.outcome_of(writer, ended, outcome)] {
                Effects::Unknown => Declared::Effects(&[], measured),
                Effects::Declared(effects) => Declared::Effects(effects, measured),
            },
        }
    }

    fn outcome_of(self, writer: &Instance, ended: &Ended, assumed: Outcome) -> Outcome {
        self.plan.state(writer.state).outcome(&ended.outcome).unwrap_or(assumed)
    }

    /// Makes the forecasts of an instance again that have readers; returns what came out otherwise. Forecasts without readers
    /// are dropped.
    pub(crate) fn refresh(self, id: InstanceId, tolerance: impl Fn(&FactKey) -> Tolerance) -> Refreshed {
        let mut refreshed = Refreshed::default();
        let Some(writer) = self.graph.get(id) else { return refreshed };
        if !writer.memory.has_readers() {
            refreshed.is_known_now = !writer.memory.forecasts.borrow().is_empty();
            writer.memory.forecasts.borrow_mut().clear();
            return refreshed;
        }
        let arms: SmallVec<[(Outcome, bool); 1]> =
            writer.memory.forecasts.borrow().iter().map(|forecast| (forecast.outcome, forecast.is_vague)).collect();
        for (outcome, vague) in arms {
            self.refresh_arm(writer, outcome, vague, &tolerance, &mut refreshed);
        }
        refreshed
    }

    fn refresh_arm(
        self,
        writer: &'a Instance,
        outcome: Outcome,
        vague: bool,
        tolerance: &impl Fn(&FactKey) -> Tolerance,
        refreshed: &mut Refreshed,
    ) {
        let at = |forecast: &&mut Forecast| forecast.outcome == outcome && forecast.is_vague == vague;
        let count = self.count_parts(writer, outcome, vague);
        let mut before: SmallVec<[Part; 2]> = SmallVec::new();
        if let Some(forecast) = writer.memory.forecasts.borrow_mut().iter_mut().find(at) {
            before = std::mem::replace(&mut forecast.parts, smallvec::smallvec![Part::Open; count]);
        }
        self.with(|sight| sight.complete(writer, outcome, vague));
        let mut forecasts = writer.memory.forecasts.borrow_mut();
        let Some(forecast) = forecasts.iter_mut().find(at) else { return };
        let was_blocked = before.iter().any(|part| matches!(part, Part::Blocked(_)));
        let is_blocked = |part: &&Part| matches!(part, Part::Blocked(_));
        refreshed.is_known_now |= was_blocked || before.len() != count;
        let unknown = forecast.parts.iter().filter(is_blocked).filter_map(|part| match part {
            Part::Blocked(Footprint::Patterns(patterns)) => Some(patterns.clone()),
            _ => None,
        });
        let all_unknown = forecast.parts.iter().any(|part| matches!(part, Part::Blocked(Footprint::Everything)));
        let (was, is) = (flat(&before), flat(&forecast.parts));
        if forecast.parts.iter().any(|part| is_blocked(&part)) && before.iter().any(|part| !is_blocked(&part)) {
            // Readers of values that are no longer known have to wait.
            refreshed.difference.add_unknown(unknown.flatten());
            if all_unknown {
                refreshed.difference.add_unknown(was.iter().map(Change::pattern));
            }
        }
        if was == is {
            return;
        }
        forecast.versions.push(was);
        let is_full = forecast.versions.len() > MAX_VERSIONS;
        for version in std::mem::take(&mut forecast.versions) {
            let mut difference = Difference::default();
            difference.add(&version, &is, tolerance, |_| None);
            if is_full || !difference.is_of_single_facts() {
                difference.add(&version, &is, |_| Tolerance::EXACT, |_| None);
            } else {
                // Readers of the differing facts are told; for the others this version still holds.
                let told = difference.keep_otherwise(&version, &is);
                if told != is && !forecast.versions.contains(&told) {
                    forecast.versions.push(told);
                }
            }
            refreshed.difference.deviations.extend(difference.deviations);
        }
    }

    /// Compares the changes that readers expected from an instance with those that it has made. `before` gives the earlier value
    /// of a fact in the root.
    pub(crate) fn compare_with_actual(
        self,
        writer: &Instance,
        actual: &[Change],
        tolerance: impl Fn(&FactKey) -> Tolerance,
        before: impl Fn(&FactKey) -> Option<Value>,
    ) -> Difference {
        let mut difference = Difference::default();
        let worked_out: Vec<Change> = actual
            .iter()
            .map(|change| match change {
                Change::Increase { fact, .. } => match self.root.get(fact) {
                    Some(value) => set(fact, value),
                    None => change.clone(),
                },
                other => other.clone(),
            })
            .collect();
        for forecast in writer.memory.forecasts.borrow().iter() {
            for version in forecast.versions.iter().chain(std::iter::once(&flat(&forecast.parts))) {
                difference.add(version, &worked_out, &tolerance, |key| Some(before(key)));
            }
            let blocked = forecast.parts.iter().filter_map(|part| match part {
                Part::Blocked(Footprint::Patterns(patterns)) => Some(patterns.clone()),
                _ => None,
            });
            difference.add_unknown(blocked.flatten());
        }
        difference
    }

    /// The facts that may differ behind a writer: those it may write, and those that others may write while it waits.
    pub(crate) fn may_differ_along(self, view: &View<'a>, link: Link) -> Footprint {
        let own = self.may_write_along(view, link);
        match &self.plan.state(view.instance.state).awaited {
            _ if view.instance.node().is_none() => own,
            Effects::Unknown => Footprint::Everything,
            Effects::Declared(awaited) => own.union(EffectExpr::footprint(awaited, view)),
        }
    }

    /// The facts that a writer may write along a link, as far as the view knows.
    pub(crate) fn may_write_along(self, view: &View<'a>, link: Link) -> Footprint {
        let writer = view.instance;
        let own = self.plan.state(writer.state);
        if own.is_routine && writer.node().is_some() {
            return match &own.may_write {
                Some(effects) => EffectExpr::footprint(effects, view),
                None => Footprint::Everything,
            };
        }
        if !matches!(writer.role(), None | Some(Role::Exit)) {
            return Footprint::NOTHING;
        }
        let outcomes: SmallVec<[Outcome; 2]> = match writer.arm_of(link.outcome) {
            Some(arm) if link.vague => {
                (0..own.effects.len().min(64)).filter(|n| writer.arms[arm].outcomes & (1 << n) != 0).collect()
            }
            None if link.vague => (0..own.effects.len()).collect(),
            _ => smallvec::smallvec![link.outcome],
        };
        let of = |outcome: usize| match &own.effects[outcome] {
            Effects::Unknown => Footprint::Everything,
            Effects::Declared(declared) => EffectExpr::footprint(declared, view),
        };
        outcomes.into_iter().map(of).fold(Footprint::NOTHING, Footprint::union)
    }
}

/// The changes that an instance declares.
enum Declared<'w> {
    Nothing,
    /// These effects, with the measured values.
    Effects(&'w [EffectExpr], &'w [(FactKey, Value)]),
    Exactly(&'w [Change]),
    Unknown,
}

impl View<'_> {
    /// Registers the view's instance as a user of what it has used.
    pub(crate) fn register(&self, purpose: Purpose) {
        for (id, of) in self.take_used() {
            if let Some(used) = self.sight.graph.get(id).filter(|used| used.id != self.instance.id) {
                used.memory.add_user(User { id: self.instance.id, of, purpose });
            }
        }
    }

    /// Notes outputs that the view uses.
    pub(crate) fn use_outputs(&self, of: impl IntoIterator<Item = InstanceId>) {
        of.into_iter().for_each(|id| self.note_used(id, Source::Outputs));
    }
}

fn set(fact: &FactKey, value: &Value) -> Change {
    Change::Set { fact: fact.clone(), value: value.clone() }
}

fn flat(parts: &[Part]) -> Vec<Change> {
    let known = parts.iter().filter_map(|part| match part {
        Part::Known(chunk) => Some(chunk.iter().cloned()),
        Part::Open | Part::Blocked(_) => None,
    });
    known.flatten().collect()
}

fn patterns_of(changes: &[Change]) -> Footprint {
    Footprint::Patterns(changes.iter().map(Change::pattern).collect())
}

/// Whether some of the facts that may be written are looked at and not hidden by younger writers.
fn is_shown(footprint: &Footprint, looked: Looked<'_>, hidden: &[FactPattern]) -> bool {
    match footprint {
        Footprint::Everything => !looked.is_nothing(),
        Footprint::Patterns(patterns) => {
            let mut open = patterns.iter().filter(|pattern| !hidden.iter().any(|hidden| hidden.covers(pattern)));
            open.any(|pattern| looked.overlaps(pattern))
        }
    }
}
