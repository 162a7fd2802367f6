//! The view of an instance: its variables, the ports of older instances, and the world at its place in the program.
//!
//! Where a value is not known yet, the view names the instance to wait for.

use super::forecast::Chunk;
use super::overlay::Overlay;
use super::walk::Looked;
use super::{Sight, Source};
use crate::binding::{Names, Outputs};
use crate::plan::Predicate;
use crate::window::graph::instance::Instance;
use crate::window::growth::environment::{Binding, Producer, assigned};
use ratn_model::expression::{Expr, FactExpr, Given, Lookup, Scope};
use ratn_model::fact::{Change, FactKey, FactPattern, Footprint};
use ratn_model::id::{InstanceId, StateId};
use ratn_model::value::Value;
use smallvec::SmallVec;
use std::borrow::Cow;
use std::cell::{Cell, RefCell};

/// The changes by one writer, effect by effect.
pub(super) type ByWriter = (InstanceId, SmallVec<[Chunk; 2]>);

pub(crate) struct View<'a> {
    pub(crate) sight: Sight<'a>,
    pub(crate) instance: &'a Instance,
    /// Its own outputs, once it has ended.
    outputs: Option<&'a Outputs>,
    /// Whether only settled results count as known.
    only_settled: bool,
    /// The instance to wait for, if a value was not known.
    blocker: Cell<Option<InstanceId>>,
    /// The instances whose outputs were used or whose effects were looked at.
    used: RefCell<SmallVec<[(InstanceId, Source); 4]>>,
}

/// Not known until this instance has gone on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Blocked(pub(crate) InstanceId);

impl<'a> Sight<'a> {
    /// The view of an instance; with its own outputs, if it has ended.
    pub(crate) fn view(self, instance: &'a Instance, outputs: Option<&'a Outputs>) -> View<'a> {
        let (blocker, used) = (Cell::new(None), RefCell::default());
        View { sight: self, instance, outputs, only_settled: false, blocker, used }
    }

    /// The view in which only settled results count as known.
    pub(super) fn settled_view(self, instance: &'a Instance) -> View<'a> {
        View { only_settled: true, ..self.view(instance, None) }
    }

    /// The values that an ended producer assigns to variables; a routine assigns also when it fails.
    pub(crate) fn assigned_by(self, producer: &'a Producer) -> Option<&'a Outputs> {
        let alive = || self.graph.get(producer.instance)?.ended().map(|ended| &ended.outputs);
        producer.outputs().or_else(alive)
    }

    /// The outputs of a producer that has ended well.
    pub(crate) fn outputs_of(self, producer: &'a Producer) -> Option<&'a Outputs> {
        producer.outputs().or_else(|| self.graph.get(producer.instance)?.outputs())
    }

    /// The instances in the window that produce the outputs and variables which an instance reads.
    pub(crate) fn producers_of(self, instance: &'a Instance) -> impl Iterator<Item = InstanceId> + 'a {
        let plan = self.plan;
        let own = plan.state(instance.state);
        let environment = &instance.environment;
        let is_join = instance.role() == Some(crate::window::graph::instance::Role::Join);
        let flows = own.flows.iter().filter_map(move |state| {
            let region = is_join.then(|| environment.producers.get(plan.len() + state.0 as usize)).flatten();
            region.or_else(|| environment.producer(*state))
        });
        let variables = own.variables.iter().filter_map(move |name| match environment.variables.get(name)? {
            Binding::Assigned(producer) => Some(producer),
            Binding::Known(_) => None,
        });
        flows
            .chain(variables)
            .filter(|producer| producer.real.get().is_none())
            .map(|producer| producer.instance)
            .filter(move |id| *id != instance.id && self.graph.contains(*id))
    }

    /// The first older instance whose output or assignment is needed and does not exist yet.
    pub(crate) fn missing(
        self,
        instance: &'a Instance,
        flows: impl IntoIterator<Item = StateId>,
        variables: impl IntoIterator<Item = &'a str>,
    ) -> Option<InstanceId> {
        let environment = &instance.environment;
        let is_missing = |producer: &Producer| {
            producer.real.get().is_none()
                && self.graph.get(producer.instance).is_some_and(|other| other.ended().is_none())
        };
        let produced = flows.into_iter().filter_map(|state| environment.producer(state));
        let found = produced.filter(|producer| is_missing(producer)).map(|producer| producer.instance).next();
        found.or_else(|| {
            let assigned = variables.into_iter().filter_map(|name| match environment.variables.get(name)? {
                Binding::Assigned(producer) => Some(producer),
                Binding::Known(_) => None,
            });
            assigned.filter(|producer| is_missing(producer)).map(|producer| producer.instance).next()
        })
    }
}

impl<'a> View<'a> {
    /// The instance to wait for, if a value was not known.
    pub(crate) fn blocker(&self) -> Option<InstanceId> {
        self.blocker.get()
    }

    pub(super) fn note_used(&self, id: InstanceId, of: Source) {
        let mut used = self.used.borrow_mut();
        if used.last() != Some(&(id, of)) {
            used.push((id, of));
        }
    }

    /// Takes what was used since the last call.
    pub(crate) fn take_used(&self) -> SmallVec<[(InstanceId, Source); 4]> {
        let mut used = self.used.take();
        used.sort_unstable();
        used.dedup();
        used
    }

    /// Whether a producer's outputs count as known.
    fn counts(&self, producer: &Producer) -> bool {
        let is_settled = || self.sight.graph.get(producer.instance).is_none_or(|instance| instance.is_settled);
        !self.only_settled || producer.real.get().is_some() || is_settled()
    }

    fn produced(&self, producer: &'a Producer) -> Option<&'a Outputs> {
        self.note_used(producer.instance, Source::Outputs);
        let outputs = self.sight.outputs_of(producer).filter(|_| self.counts(producer));
        if outputs.is_none() && self.is_awaited(producer) {
            self.blocker.set(Some(producer.instance));
        }
        outputs
    }

    /// Whether a producer may still give outputs.
    fn is_awaited(&self, producer: &Producer) -> bool {
        let instance = self.sight.graph.get(producer.instance);
        instance.is_some_and(|instance| instance.ended().is_none() || !self.counts(producer))
    }

    /// The effects of older instances on some facts, in program order, grouped by writer.
    pub(crate) fn changes(&self, looked: Looked<'_>) -> Result<Vec<ByWriter>, Blocked> {
        let mut by_writer: Vec<ByWriter> = Vec::new();
        if looked.is_nothing() {
            return Ok(by_writer);
        }
        // Older writers are not asked for facts that a younger writer hides.
        let mut hidden: Vec<FactPattern> = Vec::new();
        let mut failed = None;
        self.walk(looked, |writer, link| {
            self.note_used(writer.id, Source::World);
            match self.sight.effects(writer, link, looked, &hidden) {
                Ok(chunks) if chunks.is_empty() => true,
                Ok(chunks) => {
                    hidden.extend(chunks.iter().flat_map(|chunk| chunk.iter()).map(Change::pattern));
                    by_writer.push((writer.id, chunks));
                    match looked {
                        Looked::Everything => true,
                        Looked::Patterns(patterns) => {
                            patterns.iter().any(|looked| !hidden.iter().any(|hidden| hidden.covers(looked)))
                        }
                    }
                }
                Err(blocked) => {
                    failed = Some(blocked);
                    false
                }
            }
        });
        if let Some(blocked) = failed {
            self.blocker.set(Some(blocked.0));
            return Err(blocked);
        }
        by_writer.sort_by_key(|(id, _)| *id);
        Ok(by_writer)
    }

    /// The same as lists of changes, restricted to the facts that are looked at.
    pub(crate) fn changes_by_writer(&self, footprint: &Footprint) -> Result<Vec<(InstanceId, Vec<Change>)>, Blocked> {
        let looked = Looked::at(footprint);
        let by_writer = self.changes(looked)?.into_iter();
        let shown = |chunks: SmallVec<[Chunk; 2]>| -> Vec<Change> {
            let all = chunks.iter().flat_map(|chunk| chunk.iter());
            all.filter(|change| looked.overlaps(&change.pattern())).cloned().collect()
        };
        Ok(by_writer.map(|(writer, chunks)| (writer, shown(chunks))).collect())
    }

    /// The youngest older instance that has not retired and operates on one of these kinds of task resources.
    pub(crate) fn operator_of(&self, kinds: &[Predicate]) -> Option<InstanceId> {
        let links = kinds.iter().filter_map(|kind| self.instance.environment.writer(*kind));
        links.map(|link| link.writer).filter(|writer| self.sight.graph.contains(*writer)).max()
    }

    /// Whether changes by a writer of some facts are visible from here: no younger writer hides all of them.
    pub(crate) fn is_visible(&self, writer: InstanceId, patterns: &[FactPattern]) -> bool {
        let looked = Looked::Patterns(patterns);
        let mut hidden: Vec<FactPattern> = Vec::new();
        let mut is_visible = true;
        self.walk(looked, |younger, link| {
            if younger.id <= writer {
                return false;
            }
            if let Ok(chunks) = self.sight.effects(younger, link, looked, &hidden) {
                hidden.extend(chunks.iter().flat_map(|chunk| chunk.iter()).map(Change::pattern));
            }
            is_visible = patterns.iter().any(|pattern| !hidden.iter().any(|hidden| hidden.covers(pattern)));
            is_visible
        });
        is_visible
    }

    /// The fact of a pattern without `?`: from the youngest writer, or else from the root.
    fn single_fact(&self, pattern: &FactPattern) -> Lookup<'_> {
        let looked = Looked::Patterns(std::slice::from_ref(pattern));
        let mut found = None;
        self.walk(looked, |writer, link| {
            self.note_used(writer.id, Source::World);
            match self.sight.effects(writer, link, looked, &[]) {
                Ok(chunks) => {
                    let all = chunks.iter().flat_map(|chunk| chunk.iter());
                    let last = all.rev().find(|change| looked.overlaps(&change.pattern()));
                    found = last.map(|change| match change {
                        Change::Set { value, .. } => Lookup::Holds(Cow::Owned(value.clone())),
                        Change::Delete { .. } | Change::Increase { .. } => Lookup::Absent,
                    });
                }
                Err(Blocked(writer)) => {
                    self.blocker.set(Some(writer));
                    found = Some(Lookup::Unknown);
                }
            }
            found.is_none()
        });
        found.unwrap_or_else(|| {
            let arguments = pattern.arguments.iter().flatten().cloned().collect();
            let key = FactKey { predicate: pattern.predicate.clone(), arguments };
            self.sight.root.get(&key).map_or(Lookup::Absent, |value| Lookup::Holds(Cow::Borrowed(value)))
        })
    }

    /// Whether there is a writer in the window between here and the root for these facts.
    fn is_changed(&self, pattern: &FactPattern) -> bool {
        let mut is_changed = false;
        self.walk(Looked::Patterns(std::slice::from_ref(pattern)), |_, _| {
            is_changed = true;
            false
        });
        is_changed
    }
}

impl Scope for View<'_> {
    fn variable(&self, name: &str) -> Option<Cow<'_, Value>> {
        let environment = &self.instance.environment;
        match environment.variables.get(name) {
            Some(Binding::Known(value)) => Some(Cow::Borrowed(value)),
            Some(Binding::Assigned(producer)) => {
                self.note_used(producer.instance, Source::Outputs);
                let outputs = self.sight.assigned_by(producer).filter(|_| self.counts(producer));
                if outputs.is_none() {
                    self.blocker.set(Some(producer.instance));
                }
                outputs?.get(&assigned(name)).map(Cow::Borrowed)
            }
            None => environment.loop_variables(self.sight.program).find(|(n, _)| *n == name).map(|(_, value)| value),
        }
    }

    fn output(&self, name: &str) -> Option<Cow<'_, Value>> {
        if name.starts_with(crate::window::growth::environment::ASSIGNED) {
            return None;
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
        let written = match environment.producer(state) {
            Some(producer) => self.produced(producer)?.get(port),
            None => None,
        };
        written.or_else(|| self.sight.program.state(state).defaults.get(port)).map(Cow::Borrowed)
    }

    /// Which producer writes an output is known as soon as the path to here is. Whether it wrote the output is known when it has ended,
    /// because an outcome of the state's own may leave it out.
    fn given(&self, state: StateId, port: &str) -> Given {
        let environment = &self.instance.environment;
        let plan = self.sight.plan;
        let end = match port == "outcome" && plan.state(state).is_region {
            true => environment.producers.get(plan.len() + state.0 as usize),
            false => environment.producer(state),
        };
        match end.map(|producer| (producer, self.produced(producer))) {
            Some((_, Some(outputs))) if outputs.contains_key(port) => Given::Written,
            Some((producer, None)) if self.is_awaited(producer) => Given::NotYetKnown,
            _ if self.sight.program.state(state).defaults.contains_key(port) => Given::Default,
            _ => Given::Missing,
        }
    }

    fn fact(&self, pattern: &FactPattern) -> Lookup<'_> {
        if self.only_settled && self.is_changed(pattern) {
            return Lookup::Unknown;
        }
        if pattern.arguments.iter().all(Option::is_some) {
            return self.single_fact(pattern);
        }
        let mut first = None;
        let known = self.each_fact(pattern, &mut |key, value| {
            if pattern.matches(key) {
                first = Some(value.clone());
            }
            first.is_none()
        });
        match (known, first) {
            (false, _) => Lookup::Unknown,
            (true, Some(value)) => Lookup::Holds(Cow::Owned(value)),
            (true, None) => Lookup::Absent,
        }
    }

    fn each_fact(&self, pattern: &FactPattern, visit: &mut dyn FnMut(&FactKey, &Value) -> bool) -> bool {
        if self.only_settled && self.is_changed(pattern) {
            return false;
        }
        let Ok(changes) = self.changes(Looked::Patterns(std::slice::from_ref(pattern))) else { return false };
        if changes.is_empty() {
            self.sight.root.each_fact(pattern, visit);
        } else {
            let all = changes.iter().flat_map(|(_, chunks)| chunks.iter()).flat_map(|chunk| chunk.iter());
            Overlay::of(all).each_fact(self.sight.root, pattern, visit);
        }
        true
    }
}

impl Names for View<'_> {
    fn variable(&self, name: &str) -> Option<Cow<'_, Value>> {
        Scope::variable(self, name)
    }

    fn port(&self, state: StateId, port: &str) -> Option<Cow<'_, Value>> {
        Scope::port(self, state, port)
    }

    fn given(&self, state: StateId, port: &str) -> Given {
        Scope::given(self, state, port)
    }
}

/// The facts that expressions look up.
pub(crate) fn facts_of<'e>(expressions: impl IntoIterator<Item = &'e Expr>, view: &View<'_>) -> Footprint {
    let facts = expressions.into_iter().flat_map(Expr::fact_expressions);
    let mut patterns: Vec<FactPattern> = Vec::new();
    for fact in facts {
        let pattern = FactExpr::pattern(fact, view);
        if !patterns.contains(&pattern) {
            patterns.push(pattern);
        }
    }
    Footprint::Patterns(patterns)
}
