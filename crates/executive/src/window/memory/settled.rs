//! Settled results: they can no longer change, although they may not have retired. Conditions and loops decide by settled results
//! only.
//!
//! A result is settled when its path is decided, its inputs are settled, and no older instance that has not retired may write a
//! fact that it has read. What such an instance may write is judged by settled results, too: a key that comes from a result that
//! may still change counts as any key.

use super::view::{View, facts_of};
use super::walk::Looked;
use super::{Memory, Sight};
use crate::context::Context;
use crate::window::graph::Graph;
use crate::window::graph::instance::Instance;
use crate::window::growth::environment::Link;
use crate::window::waits::Wait;
use ratn_model::expression::Expr;
use ratn_model::id::InstanceId;
use std::collections::BTreeMap;

/// The result of examining one instance.
enum Step {
    Settled,
    /// Not settled until this instance has gone on.
    Blocked(InstanceId),
    /// Depends on whether this instance is settled.
    After(InstanceId),
}

/// The instance to wait for until a result is settled; `None` if it is settled. Without recursion, because chains of results may be
/// long.
pub(crate) fn unsettled(
    graph: &mut Graph,
    memory: &Memory,
    context: &Context<'_>,
    id: InstanceId,
) -> Option<InstanceId> {
    let mut blocked: BTreeMap<InstanceId, InstanceId> = BTreeMap::new();
    unsettled_after(graph, memory, context, id, &mut blocked)
}

fn unsettled_after(
    graph: &mut Graph,
    memory: &Memory,
    context: &Context<'_>,
    id: InstanceId,
    blocked: &mut BTreeMap<InstanceId, InstanceId>,
) -> Option<InstanceId> {
    let mut open = vec![id];
    while let Some(last) = open.last().copied() {
        let sight = memory.sight(context.program, context.plan, context.root, graph);
        match sight.with(|sight| sight.step(last, blocked)) {
            Step::Settled => {
                graph.settle(last);
                open.pop();
            }
            Step::Blocked(on) => {
                blocked.insert(last, on);
                open.pop();
            }
            Step::After(older) => open.push(older),
        }
    }
    blocked.get(&id).copied()
}

/// What a decision by these expressions has to wait for; `None`: it can be made.
pub(crate) fn undecidable(
    graph: &mut Graph,
    memory: &Memory,
    context: &Context<'_>,
    id: InstanceId,
    from: &[&Expr],
) -> Option<Wait> {
    let instance = graph.get(id)?;
    if let Some(decision) = graph.undecided(instance) {
        return Some(Wait::Decision(decision));
    }
    let sight = memory.sight(context.program, context.plan, context.root, graph);
    let flows = from.iter().flat_map(|expression| expression.flows());
    let variables: Vec<&str> = from.iter().flat_map(|expression| expression.variables()).collect();
    if let Some(producer) = sight.missing(instance, flows, variables.iter().copied()) {
        return Some(Wait::Data(producer));
    }
    let mut blocked = BTreeMap::new();
    let producers: Vec<InstanceId> = sight.producers_of(instance).collect();
    for producer in producers {
        if let Some(blocker) = unsettled_after(graph, memory, context, producer, &mut blocked) {
            return Some(Wait::Settling(blocker));
        }
    }
    loop {
        let sight = memory.sight(context.program, context.plan, context.root, graph);
        let instance = graph.get(id)?;
        let found = sight.with(|sight| {
            let view = sight.view(instance, None);
            let facts = facts_of(from.iter().copied(), &view);
            view.writer_of(Looked::at(&facts), &blocked)
        });
        match found {
            None => return None,
            Some(Step::After(older)) => drop(unsettled_after(graph, memory, context, older, &mut blocked)),
            Some(Step::Blocked(writer)) => return Some(Wait::World(writer)),
            Some(Step::Settled) => return None,
        }
    }
}

impl<'a> Sight<'a> {
    fn step(self, id: InstanceId, blocked: &BTreeMap<InstanceId, InstanceId>) -> Step {
        let Some(instance) = self.graph.get(id).filter(|instance| !instance.is_settled) else { return Step::Settled };
        if instance.ended().is_none() {
            return Step::Blocked(id);
        }
        if let Some(decision) = self.graph.undecided(instance) {
            return Step::Blocked(decision);
        }
        for producer in self.producers_of(instance) {
            if self.graph.get(producer).is_some_and(|producer| producer.is_settled) {
                continue;
            }
            return match blocked.get(&producer) {
                Some(on) => Step::Blocked(*on),
                None => Step::After(producer),
            };
        }
        let view = self.view(instance, None);
        let reads = instance.seen().into_iter().flat_map(|seen| &seen.read);
        reads.into_iter().find_map(|read| view.writer_of(Looked::at(read), blocked)).unwrap_or(Step::Settled)
    }

    /// The youngest older instance that has not retired and may write one of these facts; for messages and waits.
    pub(crate) fn writer_of(self, instance: &'a Instance, looked: Looked<'_>) -> Option<InstanceId> {
        let view = self.view(instance, None);
        let mut found = None;
        view.walk(looked, |writer, link| {
            let may = self.may_still_write(writer, link, looked).0;
            found = may.then_some(writer.id);
            !may
        });
        found
    }

    /// Whether an instance that has not retired may write one of these facts, or was predicted to; and the instance whose result
    /// must be settled before more is known, if there is one.
    fn may_still_write(self, writer: &'a Instance, link: Link, looked: Looked<'_>) -> (bool, Option<InstanceId>) {
        let predicted = writer.ended().is_some()
            && self.effects(writer, link, looked, &[]).map_or(true, |chunks| !chunks.is_empty());
        if predicted {
            return (true, None);
        }
        let view = self.settled_view(writer);
        let may = looked.overlaps_any(&self.may_differ_along(&view, link));
        (may, view.blocker().filter(|_| may))
    }
}

impl View<'_> {
    /// As [`Sight::writer_of`], as a step: it may depend on whether the result that gives a key is settled.
    fn writer_of(&self, looked: Looked<'_>, blocked: &BTreeMap<InstanceId, InstanceId>) -> Option<Step> {
        let mut found = None;
        self.walk(looked, |writer, link| {
            let (may, after) = self.sight.may_still_write(writer, link, looked);
            if may {
                // A key is known before its writer has retired, so wait first for the instance that the key comes from.
                found = Some(match after.filter(|id| *id != writer.id) {
                    None => Step::Blocked(writer.id),
                    Some(older) => match blocked.get(&older) {
                        Some(on) => Step::Blocked(*on),
                        None if self.sight.graph.get(older).is_some_and(|older| older.ended().is_none()) => {
                            Step::Blocked(older)
                        }
                        None => Step::After(older),
                    },
                });
            }
            !may
        });
        found
    }
}
