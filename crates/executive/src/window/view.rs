//! What an instance sees: its variables, the ports of older instances, and the world at its place in the program, which is the
//! root with the effects of the older instances that have not retired.
//!
//! Nothing is copied: a lookup walks the chain of older writers of the predicate (youngest first) as far as it must. Where an
//! effect is not known yet, the view names the instance to wait for.

use super::environment::{Binding, Link, Producer, assigned};
use super::instance::{Changed, Instance, Role};
use super::instances::Instances;
use crate::binding::Outputs;
use crate::plan::{EVERYTHING, Effects, Plan, Predicate};
use ratn_model::expression::{EffectExpr, EvaluateError, Lookup, Scope};
use ratn_model::fact::{Change, FactKey, FactPattern, Footprint};
use ratn_model::id::{InstanceId, StateId};
use ratn_model::program::{Program, StateKind};
use ratn_model::value::Value;
use ratn_world::world::World;
use std::borrow::Cow;
use std::cell::{Cell, RefCell};
use std::collections::{BTreeMap, BTreeSet, BinaryHeap};

/// Effects made of effects of effects are followed this far; beyond, the view waits for the instance to end.
const MAX_DEPTH: u32 = 48;

/// Where everything that a view needs stands.
#[derive(Clone, Copy)]
pub(crate) struct Sight<'a> {
    pub(crate) program: &'a Program,
    pub(crate) plan: &'a Plan,
    pub(crate) root: &'a World,
    pub(crate) instances: &'a Instances,
    /// Imprecise PIAs that still run although younger instances have retired.
    pub(crate) detached: &'a BTreeSet<InstanceId>,
    /// Joins whose regions wrote the same predicate: all their links.
    pub(crate) joins: &'a BTreeMap<InstanceId, Vec<(Predicate, Link)>>,
}

/// One instance's view.
pub(crate) struct View<'a> {
    pub(crate) sight: Sight<'a>,
    pub(crate) instance: &'a Instance,
    /// Its own outputs, once it has ended.
    pub(crate) outputs: Option<&'a Outputs>,
    depth: u32,
    /// Whom to wait for, where something was not known.
    blocker: Cell<Option<InstanceId>>,
    /// Older instances whose effects were used.
    used: RefCell<Vec<InstanceId>>,
}

/// Not known before this instance has gone on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Blocked(pub(crate) InstanceId);

impl<'a> Sight<'a> {
    pub(crate) fn view(self, instance: &'a Instance, outputs: Option<&'a Outputs>) -> View<'a> {
        View { sight: self, instance, outputs, depth: 0, blocker: Cell::new(None), used: RefCell::new(Vec::new()) }
    }

    /// What a producer that has ended assigns to variables: a routine does also where it ends badly.
    pub(crate) fn assigned_by(self, producer: &'a Producer) -> Option<&'a Outputs> {
        let alive = || self.instances.get(producer.instance)?.ended.as_ref().map(|ended| &ended.outputs);
        producer.real.get().or_else(alive)
    }

    /// The outputs of a producer that has ended well.
    pub(crate) fn outputs_of(&self, producer: &'a Producer) -> Option<&'a Outputs> {
        producer.real.get().or_else(|| self.instances.get(producer.instance)?.outputs())
    }
}

impl<'a> View<'a> {
    /// Whom to wait for before what was not known may be.
    pub(crate) fn blocker(&self) -> Option<InstanceId> {
        self.blocker.get()
    }

    /// The older instances whose effects were used since it was asked last.
    pub(crate) fn used(&self) -> Vec<InstanceId> {
        self.used.take()
    }

    fn produced(&self, producer: &'a Producer) -> Option<&'a Outputs> {
        let outputs = self.sight.outputs_of(producer);
        if outputs.is_none()
            && let Some(instance) = self.sight.instances.get(producer.instance)
            && instance.ended.is_none()
        {
            self.blocker.set(Some(instance.id));
        }
        outputs
    }

    /// The facts of a footprint at this place, in the order of keys.
    pub(crate) fn facts(&self, footprint: &Footprint) -> Result<Vec<(FactKey, Value)>, Blocked> {
        let changes = self.changes(footprint)?;
        let mut facts: BTreeMap<FactKey, Value> = BTreeMap::new();
        match footprint {
            Footprint::Everything => {
                facts.extend(self.sight.root.iter().map(|(key, fact)| (key.clone(), fact.value.clone())));
            }
            Footprint::Patterns(patterns) => {
                for pattern in patterns {
                    let matching = self.sight.root.matching(pattern);
                    facts.extend(matching.map(|(key, fact)| (key.clone(), fact.value.clone())));
                }
            }
        }
        for change in &changes {
            apply(change, &mut facts);
        }
        facts.retain(|key, _| footprint.contains(key));
        Ok(facts.into_iter().collect())
    }

    /// The effects of older instances on the facts of a footprint, in program order.
    pub(crate) fn changes(&self, footprint: &Footprint) -> Result<Vec<Change>, Blocked> {
        Ok(self.changes_by_writer(footprint)?.into_iter().flat_map(|(_, changes)| changes).collect())
    }

    /// The same, with whose effects they are.
    pub(crate) fn changes_by_writer(&self, footprint: &Footprint) -> Result<Vec<(InstanceId, Vec<Change>)>, Blocked> {
        let mut by_writer: Vec<(InstanceId, Vec<Change>)> = Vec::new();
        if footprint.is_nothing() {
            return Ok(Vec::new());
        }
        // What a younger writer hides of the older ones is not asked of them.
        let mut open = footprint.clone();
        let mut known: Vec<FactPattern> = Vec::new();
        let mut failed = None;
        self.walk(footprint, |writer, link| {
            match self.effects(writer, link, &open, &known) {
                Ok(changes) if changes.is_empty() => {}
                Ok(changes) => {
                    let hiding = changes.iter().filter(|change| !matches!(change, Change::Increase { .. }));
                    known.extend(hiding.map(Change::pattern));
                    if let Footprint::Patterns(patterns) = &mut open {
                        patterns.retain(|pattern| !known.iter().any(|known| known.covers(pattern)));
                    }
                    self.used.borrow_mut().push(writer.id);
                    by_writer.push((writer.id, changes));
                    if open.is_nothing() {
                        return false;
                    }
                }
                Err(blocked) => {
                    failed = Some(blocked);
                    return false;
                }
            }
            true
        });
        if let Some(blocked) = failed {
            self.blocker.set(Some(blocked.0));
            return Err(blocked);
        }
        by_writer.sort_by_key(|(id, _)| *id);
        self.check_increases(&by_writer)?;
        Ok(by_writer)
    }

    /// An increase of what is no number will fail when it becomes real; until then nobody may build on it.
    fn check_increases(&self, by_writer: &[(InstanceId, Vec<Change>)]) -> Result<(), Blocked> {
        let all = by_writer.iter().flat_map(|(_, changes)| changes);
        let increased = all.filter_map(|change| match change {
            Change::Increase { fact, .. } => Some(fact.clone()),
            _ => None,
        });
        let root = self.sight.root;
        let mut facts: BTreeMap<FactKey, Value> = BTreeMap::new();
        for key in increased {
            if let Some(value) = root.get(&key) {
                facts.insert(key, value.clone());
            }
        }
        for (writer, changes) in by_writer {
            for change in changes {
                if let Change::Increase { fact, by } = change
                    && ratn_world::world::increased(fact, facts.get(fact), *by).is_err()
                {
                    self.blocker.set(Some(*writer));
                    return Err(Blocked(*writer));
                }
                apply(change, &mut facts);
            }
        }
        Ok(())
    }

    /// The youngest older instance that has not retired and may write one of these facts, or was predicted to: who believed that
    /// is compared when it retires.
    pub(crate) fn writer_of(&self, footprint: &Footprint) -> Option<InstanceId> {
        let mut found = None;
        self.walk(footprint, |writer, link| {
            let may = match &writer.ended {
                Some(_) => self.effects(writer, link, footprint, &[]).map_or(true, |changes| !changes.is_empty()),
                None => false,
            };
            let may = may || self.may_write(writer, link).overlaps(footprint);
            if may {
                found = Some(writer.id);
            }
            !may
        });
        found
    }

    /// The youngest older instance that has not retired and operates on one of these kinds of task resources.
    pub(crate) fn operator_of(&self, kinds: &[Predicate]) -> Option<InstanceId> {
        let links = kinds.iter().filter_map(|kind| self.instance.environment.writer(*kind));
        links.map(|link| link.writer).filter(|writer| self.sight.instances.get(*writer).is_some()).max()
    }

    /// Visits the older writers that have not retired of the predicates of a footprint, youngest first, while told to go on.
    fn walk(&self, footprint: &Footprint, mut visit: impl FnMut(&'a Instance, Link) -> bool) {
        let mut open: BinaryHeap<(InstanceId, Predicate, usize, bool)> = BinaryHeap::new();
        let instances = self.sight.instances;
        let push = |open: &mut BinaryHeap<_>, link: Option<Link>, predicate: Predicate| {
            if let Some(link) = link
                && instances.get(link.writer).is_some()
            {
                open.push((link.writer, predicate, link.outcome, link.vague));
            }
        };
        let environment = &self.instance.environment;
        push(&mut open, environment.writer(EVERYTHING), EVERYTHING);
        match footprint {
            Footprint::Everything => {
                for predicate in self.sight.plan.predicates().skip(1) {
                    push(&mut open, environment.writer(predicate), predicate);
                }
            }
            Footprint::Patterns(patterns) => {
                for (i, pattern) in patterns.iter().enumerate() {
                    // Several patterns of one predicate are one chain.
                    if patterns[..i].iter().any(|before| before.predicate == pattern.predicate) {
                        continue;
                    }
                    if let Some(predicate) = self.sight.plan.predicate(&pattern.predicate) {
                        push(&mut open, environment.writer(predicate), predicate);
                    }
                }
            }
        }
        let mut last = None;
        let mut seen_detached = Vec::new();
        while let Some((id, predicate, outcome, vague)) = open.pop() {
            let Some(writer) = instances.get(id) else { continue };
            match self.sight.joins.get(&id) {
                Some(links) if writer.role == Role::Join => {
                    let merged = links.iter().filter(|(of, _)| *of == predicate);
                    merged.for_each(|(_, link)| push(&mut open, Some(*link), predicate));
                    continue;
                }
                _ => push(&mut open, writer.environment.writer(predicate), predicate),
            }
            if last.replace(id) == Some(id) {
                continue;
            }
            if writer.detached {
                seen_detached.push(id);
            }
            if !visit(writer, Link { writer: id, outcome, vague }) {
                return;
            }
        }
        // A younger writer that has retired already hides those that still run beside it.
        for id in self.sight.detached.iter().rev().filter(|id| **id < self.instance.id && !seen_detached.contains(id)) {
            if let Some(writer) = instances.get(*id)
                && !visit(writer, Link { writer: *id, outcome: 0, vague: false })
            {
                return;
            }
        }
    }

    /// What a writer changes of the facts of a footprint, measured or predicted; `known` is what younger ones have hidden.
    fn effects(
        &self,
        writer: &'a Instance,
        link: Link,
        footprint: &Footprint,
        known: &[FactPattern],
    ) -> Result<Vec<Change>, Blocked> {
        let plan = self.sight.plan.state(writer.state);
        let blocked = Blocked(writer.id);
        let touches = |change: &Change| footprint.overlaps(&Footprint::Patterns(vec![change.pattern()]));
        let Some(ended) = &writer.ended else {
            if !matches!(writer.role, Role::Node | Role::Exit) {
                return Ok(Vec::new());
            }
            let Effects::Declared(declared) = &plan.effects[link.outcome] else {
                let shows = seen_of(self.may_write(writer, link), footprint, known);
                return if shows { Err(blocked) } else { Ok(Vec::new()) };
            };
            if link.vague {
                let shows = seen_of(self.may_write(writer, link), footprint, known);
                return if shows { Err(blocked) } else { Ok(Vec::new()) };
            }
            return self.predicted(writer, declared, None, footprint, known);
        };
        match &ended.changes {
            Changed::Exactly(made) => Ok(made.changes.iter().filter(|change| touches(change)).cloned().collect()),
            Changed::Declared(measured, _) => {
                let outcome = plan.outcome(&ended.outcome).unwrap_or(link.outcome);
                let mut changes = match &plan.effects[outcome] {
                    Effects::Unknown => Vec::new(),
                    Effects::Declared(declared) => {
                        self.predicted(writer, declared, Some(&ended.outputs), footprint, known)?
                    }
                };
                let mut undeclared = Vec::new();
                for (key, value) in measured {
                    let mut declared = false;
                    for change in &mut changes {
                        if let Change::Set { fact, value: predicted } = change
                            && fact == key
                        {
                            *predicted = value.clone();
                            declared = true;
                        }
                    }
                    if !declared {
                        undeclared.push(Change::Set { fact: key.clone(), value: value.clone() });
                    }
                }
                changes.extend(undeclared.into_iter().filter(touches));
                Ok(changes)
            }
        }
    }

    /// Declared effects bound at the writer's place, as far as they touch the footprint.
    fn predicted(
        &self,
        writer: &'a Instance,
        declared: &[EffectExpr],
        outputs: Option<&'a Outputs>,
        footprint: &Footprint,
        known: &[FactPattern],
    ) -> Result<Vec<Change>, Blocked> {
        let blocked = Blocked(writer.id);
        let mut changes = Vec::new();
        for effect in declared {
            if self.depth >= MAX_DEPTH {
                return Err(blocked);
            }
            let view = View {
                sight: self.sight,
                instance: writer,
                outputs,
                depth: self.depth + 1,
                blocker: Cell::new(None),
                used: RefCell::new(Vec::new()),
            };
            let one = std::slice::from_ref(effect);
            if !seen_of(EffectExpr::footprint(one, &view), footprint, known) {
                continue;
            }
            view.blocker.set(None);
            match EffectExpr::bind(one, &view) {
                Ok(bound) => changes
                    .extend(bound.into_iter().filter(|c| footprint.overlaps(&Footprint::Patterns(vec![c.pattern()])))),
                Err(EvaluateError::NotYetKnown { .. }) => {
                    return Err(view.blocker().map_or(blocked, Blocked));
                }
                // It will end `aborted`; until then nobody may build on it.
                Err(EvaluateError::Wrong { .. }) => return Err(blocked),
            }
            // What its effects were made of is used, too.
            self.used.borrow_mut().extend(view.used());
        }
        Ok(changes)
    }

    /// The facts that a writer which has not ended may write on the path that a link assumes.
    pub(crate) fn may_write(&self, writer: &'a Instance, link: Link) -> Footprint {
        let view = self.sight.view(writer, None);
        let plan = self.sight.plan.state(writer.state);
        let is_routine = writer.role == Role::Node
            && !matches!(self.sight.program.state(writer.state).kind, StateKind::Action { .. });
        if is_routine {
            return match &self.sight.plan.state(writer.state).may_write {
                Some(effects) => EffectExpr::footprint(effects, &view),
                None => Footprint::Everything,
            };
        }
        if !matches!(writer.role, Role::Node | Role::Exit) {
            return Footprint::NOTHING;
        }
        let outcomes: Vec<usize> = match writer.arms.iter().find(|arm| arm.outcomes & (1 << link.outcome) != 0) {
            Some(arm) if link.vague => (0..plan.effects.len()).filter(|n| arm.outcomes & (1 << n) != 0).collect(),
            _ => vec![link.outcome],
        };
        let of = |outcome: usize| match &plan.effects[outcome] {
            Effects::Unknown => Footprint::Everything,
            Effects::Declared(declared) => EffectExpr::footprint(declared, &view),
        };
        outcomes.into_iter().map(of).fold(Footprint::NOTHING, Footprint::union)
    }
}

impl Scope for View<'_> {
    fn variable(&self, name: &str) -> Option<Cow<'_, Value>> {
        let environment = &self.instance.environment;
        match environment.variables.get(name) {
            Some(Binding::Known(value)) => Some(Cow::Borrowed(value)),
            Some(Binding::Assigned(producer)) => {
                let outputs = self.sight.assigned_by(producer);
                if outputs.is_none() {
                    self.blocker.set(Some(producer.instance));
                }
                outputs?.get(&assigned(name)).map(Cow::Borrowed)
            }
            None => environment.loop_variables(self.sight.program).find(|(n, _)| *n == name).map(|(_, value)| value),
        }
    }

    fn output(&self, name: &str) -> Option<Cow<'_, Value>> {
        if self.outputs.is_none() {
            self.blocker.set(Some(self.instance.id));
        }
        self.outputs?.get(name).map(Cow::Borrowed)
    }

    fn port(&self, state: StateId, port: &str) -> Option<Cow<'_, Value>> {
        let environment = &self.instance.environment;
        let plan = self.sight.plan;
        if port == "outcome" && plan.state(state).is_region {
            let end = environment.producers.get(plan.len() + state.0 as usize)?;
            return self.produced(end)?.get(port).map(Cow::Borrowed);
        }
        match environment.producer(state) {
            Some(producer) => self.produced(producer)?.get(port).map(Cow::Borrowed),
            None => self.sight.program.state(state).defaults.get(port).map(Cow::Borrowed),
        }
    }

    fn fact(&self, pattern: &FactPattern) -> Lookup<'_> {
        let footprint = Footprint::Patterns(vec![pattern.clone()]);
        let Ok(changes) = self.changes(&footprint) else { return Lookup::Unknown };
        if changes.is_empty() {
            return match self.sight.root.matching(pattern).next() {
                Some((_, fact)) => Lookup::Holds(Cow::Owned(fact.value.clone())),
                None => Lookup::Absent,
            };
        }
        match self.facts(&footprint) {
            Err(_) => Lookup::Unknown,
            Ok(facts) => match facts.into_iter().next() {
                Some((_, value)) => Lookup::Holds(Cow::Owned(value)),
                None => Lookup::Absent,
            },
        }
    }

    fn each_fact(&self, pattern: &FactPattern, visit: &mut dyn FnMut(&FactKey, &Value) -> bool) -> bool {
        let footprint = Footprint::Patterns(vec![pattern.clone()]);
        let Ok(changes) = self.changes(&footprint) else { return false };
        if changes.is_empty() {
            self.sight.root.each_fact(pattern, visit);
            return true;
        }
        let Ok(facts) = self.facts(&footprint) else { return false };
        for (key, value) in &facts {
            if !visit(key, value) {
                break;
            }
        }
        true
    }
}

/// Whether some of the facts that are written are looked at and not hidden by what is known of younger writers.
fn seen_of(written: Footprint, read: &Footprint, known: &[FactPattern]) -> bool {
    match written {
        Footprint::Everything => written.overlaps(read),
        Footprint::Patterns(patterns) => {
            let mut shown = patterns.into_iter().filter(|pattern| !known.iter().any(|known| known.covers(pattern)));
            shown.any(|pattern| Footprint::Patterns(vec![pattern]).overlaps(read))
        }
    }
}

/// One change on a part of the world.
fn apply(change: &Change, facts: &mut BTreeMap<FactKey, Value>) {
    match change {
        Change::Set { fact, value } => {
            facts.insert(fact.clone(), value.clone());
        }
        Change::Delete { pattern } => facts.retain(|key, _| !pattern.matches(key)),
        Change::Increase { fact, by } => {
            // A fact that is no number fails when it becomes real; here it stays as it is.
            if let Ok(value) = ratn_world::world::increased(fact, facts.get(fact), *by) {
                facts.insert(fact.clone(), value);
            }
        }
    }
}
