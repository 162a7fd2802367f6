//! The world changes from outside: a fact expired, or somebody else wrote one.
//!
//! What is real stands, and so does a motion under way, as it would in HSM mode. Of the rest, whatever was made of a fact that is
//! otherwise now is made again, settled or not; and a decision that would be another one now is made again where it stands: what
//! was expanded behind it is discarded. Nothing behind has begun that could not be discarded, for no PIA begins before its decisions
//! have retired. Rare, so it may look at the whole window.

use super::Window;
use super::cursor::{Cursor, Todo};
use super::instance::{Arm, Instance, Role, Status};
use super::ready::facts_of;
use crate::context::Context;
use ratn_model::expression::{EffectExpr, Expr};
use ratn_model::fact::{FactKey, FactPattern, Footprint};
use ratn_model::id::InstanceId;
use ratn_model::program::{Program, StateKind};
use ratn_model::value::Value;
use smallvec::smallvec;
use std::slice::from_ref;

/// In the outputs of a loop that has looked into the world: its list.
pub(super) const ELEMENTS: &str = "elements";

impl Window {
    /// These facts are otherwise in the root than they were.
    pub(super) fn world_changed<'a>(&mut self, context: &mut Context<'_>, facts: impl Iterator<Item = &'a FactKey>) {
        let changed = Footprint::Patterns(facts.map(FactPattern::of).collect());
        let all: Vec<InstanceId> = self.instances.iter().map(|instance| instance.id).collect();
        self.instances.iter().for_each(|instance| instance.settled.set(false));
        // What is read may have been predicted by effects that are made of other facts.
        let anything = effects_look_up(context.program);
        for id in &all {
            let Some(seen) = self.instances.get(*id).and_then(|instance| instance.seen.as_deref()) else { continue };
            if anything || seen.read.iter().any(|read| read.overlaps(&changed)) {
                self.revalidate(context, *id);
            }
        }
        for id in &all {
            if self.decides_otherwise(context, *id, &changed) {
                self.reopen(context, *id);
            }
        }
        // What waited for an older instance to make the world as it has to be may have got it so, and the other way round.
        all.into_iter().for_each(|id| self.enqueue(id));
    }

    /// Whether an instance has decided and might not do so again.
    fn decides_otherwise(&self, context: &Context<'_>, id: InstanceId, changed: &Footprint) -> bool {
        let Some(instance) = self.instances.get(id) else { return false };
        let Some(ended) = &instance.ended else { return false };
        let state = context.program.state(instance.state);
        let made_again = |id: InstanceId| self.instances.get(id).is_some_and(|producer| producer.ended.is_none());
        let expressions: Vec<&Expr> = match (&state.kind, instance.role) {
            (StateKind::Condition { predicate, .. }, Role::Condition) => vec![predicate],
            (StateKind::While { predicate, .. }, Role::Test) => vec![predicate],
            (StateKind::ForEach { collection, .. }, Role::Loop) => vec![collection],
            (StateKind::Concurrency { decide, .. }, Role::Join) => decide.iter().map(|(_, holds)| holds).collect(),
            _ => return false,
        };
        if self.producers_of(instance).any(made_again) {
            return true;
        }
        let view = self.sight(context).view(instance, None);
        if !expressions.iter().any(|expression| facts_of(from_ref(*expression), &view).overlaps(changed)) {
            return false;
        }
        let names = if instance.role == Role::Test { ["again", "done"] } else { ["then", "else"] };
        match (instance.role, expressions.as_slice()) {
            (Role::Condition | Role::Test, [predicate]) => {
                predicate.holds(&view).map_or(true, |holds| names[usize::from(!holds)] != &*ended.outcome)
            }
            (Role::Loop, [collection]) => {
                let before = ended.outputs.get(ELEMENTS);
                collection.evaluate(&view).map_or(true, |now| before != Some(&now))
            }
            _ => true,
        }
    }

    /// It decides again; what is behind it is discarded and expanded anew.
    fn reopen(&mut self, context: &mut Context<'_>, id: InstanceId) {
        self.squash_behind(context, id);
        let Some(instance) = self.instances.get_mut(id) else { return };
        (instance.status, instance.ended) = (Status::Expanded, None);
        let Instance { state, role, visit, iteration, line, segment, position, .. } = *instance;
        let mut environment = instance.environment.clone();
        environment.test = None;
        if role == Role::Join {
            instance.arms = smallvec![Arm { outcomes: u64::MAX, outcome: 0, next: None, segment }];
        }
        let because = instance.left_because.clone();
        self.next_order += 1;
        self.cursors.push(Cursor {
            environment,
            tail: Some((id, 0)),
            line,
            segment,
            position: position + 1,
            todo: Todo::Await(id),
            probability: self.probability(segment),
            because,
            idle: 0,
            order: self.next_order,
        });
        let index = self.cursors.len() - 1;
        match role {
            Role::Condition => self.branch_on_condition(context, index, id, visit),
            Role::Test => self.branch_on_test(context, index, id, visit, iteration.unwrap_or(0)),
            Role::Loop => self.single_arm(index, id),
            _ => {}
        }
        self.wake_waiters(id);
        self.enqueue(id);
        debug_assert!(context.program.state(state).parent.is_some(), "the task itself decides nothing");
    }
}

/// Whether an effect of some state is made of facts.
fn effects_look_up(program: &Program) -> bool {
    let effects = program.states.iter().flat_map(|state| state.annotations.effects.values());
    effects.into_iter().any(|effects| !EffectExpr::fact_expressions(effects).is_empty())
}

/// The list of a loop, for comparison.
pub(super) fn remembered(elements: &[Value]) -> (String, Value) {
    (ELEMENTS.to_owned(), Value::List(elements.to_vec()))
}
