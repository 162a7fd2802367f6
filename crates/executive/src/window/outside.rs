//! Changes of the world from outside the run: a fact has expired, or another client has written one.
//!
//! Retired results stay, and what is under way at its place goes on, as in HSM mode. Everything else that depends on a changed fact is made
//! again, settled or not. A decision that would now be different is made again in place, and what was expanded behind it is
//! discarded. Nothing behind it has begun that could not be discarded, because no PIA begins before its decisions have retired. Such
//! changes are rare, so examining the whole window is acceptable.

use super::Window;
use super::decide::names_of;
use super::graph::instance::{Instance, Role};
use super::memory::{Looked, facts_of};
use crate::context::Context;
use ratn_model::expression::Expr;
use ratn_model::fact::{FactKey, FactPattern, Footprint};
use ratn_model::id::InstanceId;
use ratn_model::list::List;
use ratn_model::program::{Program, StateKind};
use ratn_model::value::Value;
use ratn_world::world::World;

/// The output of a loop with its list, if the list depends on facts.
const ELEMENTS: &str = "elements";

impl Window {
    /// Compares changes from outside with the root, before they are applied to it.
    pub(crate) fn compare_outside(&mut self, program: &Program, root: &World, facts: &[(FactKey, Option<Value>)]) {
        let base = self.tolerance;
        self.memory.compare_outside(root, facts, |key| program.tolerances.of(&key.predicate, base));
    }

    /// These facts of the root have changed from outside.
    pub(super) fn world_changed<'a>(&mut self, context: &mut Context<'_>, facts: impl Iterator<Item = &'a FactKey>) {
        let changed: Vec<FactPattern> = facts.map(FactPattern::of).collect();
        self.memory.root_changed(context.root, changed.iter().cloned());
        self.overwrites(context, &changed);
        let changed = Footprint::Patterns(changed);
        let news = self.memory.take_news_from_outside();
        let all: Vec<InstanceId> = self.graph.iter().map(|instance| instance.id).collect();
        self.graph.unsettle_all();
        for id in &all {
            // Its effects may depend on these facts.
            self.memory.mark(*id);
            let Some(instance) = self.graph.get(*id) else { continue };
            let exact = self.exact(context, instance);
            let is_exact = |pattern: &&FactPattern| Looked::at(&exact).overlaps(pattern);
            let otherwise = self.has_seen(context, *id, news.otherwise.iter());
            let seen = otherwise.map(|pattern| (pattern, false));
            let tolerated = || Some((self.has_seen(context, *id, news.changed.iter().filter(is_exact))?, true));
            if let Some((pattern, is_tolerated)) = seen.or_else(tolerated)
                && !self.goes_on(context, *id)
            {
                self.came_otherwise(context, *id, is_tolerated, format!("{pattern} was changed from outside"));
            }
        }
        self.revise(context);
        self.decide_again(context, all, &changed);
    }

    /// Decides again, among these instances, all decisions that the changed facts may have made wrong.
    pub(super) fn decide_again(&mut self, context: &mut Context<'_>, all: Vec<InstanceId>, changed: &Footprint) {
        for id in &all {
            if self.may_decide_otherwise(context, *id) || self.decides_otherwise(context, *id, changed) {
                self.reopen(context, *id);
            }
        }
        // Instances that waited for the world to change may go on now, and others have to wait.
        all.into_iter().for_each(|id| self.waits.enqueue(&mut self.graph, id));
    }

    /// The first of some facts of the root that an instance has read and that no writer in between hides.
    fn has_seen<'p>(
        &self,
        context: &Context<'_>,
        id: InstanceId,
        patterns: impl Iterator<Item = &'p FactPattern>,
    ) -> Option<&'p FactPattern> {
        let seen = self.graph.get(id)?.seen()?;
        let mut looked_at = patterns.filter(|pattern| seen.overlaps(pattern));
        looked_at.find(|pattern| {
            let pattern = std::slice::from_ref(*pattern);
            self.look(context, id, None, |_, view| view.is_visible(InstanceId(0), pattern)).unwrap_or(false)
        })
    }

    /// Whether a decision is no longer settled, because an older instance may now write other facts.
    fn may_decide_otherwise(&mut self, context: &Context<'_>, id: InstanceId) -> bool {
        let Some(instance) = self.graph.get(id).filter(|instance| instance.ended().is_some()) else { return false };
        let expressions = decides_from(context.program, instance);
        !expressions.is_empty() && self.undecidable(context, id, &expressions).is_some()
    }

    /// Whether a decision would now be different.
    fn decides_otherwise(&self, context: &Context<'_>, id: InstanceId, changed: &Footprint) -> bool {
        let Some(instance) = self.graph.get(id) else { return false };
        let Some(ended) = instance.ended() else { return false };
        let expressions = decides_from(context.program, instance);
        if expressions.is_empty() {
            return false;
        }
        let decides = self.look(context, id, None, |instance, view| {
            let is_open = |id: InstanceId| self.graph.get(id).is_some_and(|producer| producer.ended().is_none());
            let made_again = |id: InstanceId| is_open(id) || self.assigned_again.contains(&id);
            if view.sight.producers_of(view.instance).any(made_again) {
                return true;
            }
            if !facts_of(expressions.iter().copied(), view).overlaps(changed) {
                return false;
            }
            match (instance.role(), expressions.as_slice()) {
                (Some(Role::Condition | Role::Test), [predicate]) => {
                    let names = names_of(instance);
                    predicate.holds(view).map_or(true, |holds| names[usize::from(!holds)] != &*ended.outcome)
                }
                (Some(Role::Loop), [collection]) => {
                    let before = ended.outputs.get(ELEMENTS);
                    collection.evaluate(view).map_or(true, |now| before != Some(&now))
                }
                _ => true,
            }
        });
        decides.unwrap_or(false)
    }

    /// Decides again: what is behind is discarded and expanded again.
    fn reopen(&mut self, context: &mut Context<'_>, id: InstanceId) {
        self.cut_behind(context, id);
        self.graph.reopen(id);
        self.growth.reopen(&mut self.graph, context, id);
        self.waits.wake(&mut self.graph, id);
        self.waits.enqueue(&mut self.graph, id);
    }
}

/// The expressions by which a condition, a test, a loop or a decider decides.
pub(super) fn decides_from<'p>(program: &'p Program, instance: &Instance) -> Vec<&'p Expr> {
    match (&program.state(instance.state).kind, instance.role()) {
        (StateKind::Condition { predicate, .. }, Some(Role::Condition)) => vec![predicate],
        (StateKind::While { predicate, .. }, Some(Role::Test)) => vec![predicate],
        (StateKind::ForEach { collection, .. }, Some(Role::Loop)) => vec![collection],
        (StateKind::Concurrency { decide, .. }, Some(Role::Join)) => decide.iter().map(|(_, holds)| holds).collect(),
        _ => Vec::new(),
    }
}

/// The list of a loop, kept for later comparison.
pub(super) fn remembered(elements: List) -> (String, Value) {
    (ELEMENTS.to_owned(), Value::List(elements))
}
