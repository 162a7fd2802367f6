//! Preconditions that nothing establishes: neither an older state's effects nor the initial world.
//!
//! Without a declared `world` the initial facts are unknown, so it is only a warning then.

use super::{Subject, branches, functions, named};
use crate::diagnostic::Findings;
use crate::expression::scope::NothingKnown;
use crate::expression::{BinaryOperator, EffectExpr, Expr, FactExpr, UnaryOperator};
use crate::fact::{FactPattern, Footprint};
use crate::id::StateId;
use crate::program::{Program, State, StateKind, Target};
use crate::value::Value;
use std::collections::BTreeSet;

pub(super) fn check(subject: &Subject<'_>, findings: &mut Findings) {
    let mut established = Established::default();
    established.add(writes(&subject.program.initial));
    walk(subject, Program::ROOT, &mut established, findings);
}

/// The facts that may hold so far.
#[derive(Default)]
struct Established {
    everything: bool,
    patterns: Vec<FactPattern>,
    known: BTreeSet<FactPattern>,
}

impl Established {
    fn add(&mut self, patterns: Vec<FactPattern>) {
        for pattern in patterns {
            if self.known.insert(pattern.clone()) {
                self.patterns.push(pattern);
            }
        }
    }

    fn may_hold(&self, fact: &FactExpr) -> bool {
        let pattern = fact.pattern(&NothingKnown);
        self.everything || self.patterns.iter().any(|other| other.overlaps(&pattern))
    }
}

/// Walks in program order; everything counts that any branch or visit may have written.
fn walk(subject: &Subject<'_>, id: StateId, established: &mut Established, findings: &mut Findings) {
    let state = subject.program.state(id);
    let repeats = matches!(state.kind, StateKind::ForEach { .. } | StateKind::While { .. });
    for list in state.lists() {
        if repeats || leads_back(subject.program, list) {
            // A later visit of the list sees what an earlier one has written.
            list.iter().for_each(|child| establish_all(subject, *child, established));
        }
    }
    for (i, required) in state.annotations.requires.iter().enumerate() {
        if let Some(missing) = missing(required, established) {
            let at = subject.place(state, &format!("requires.{i}"));
            let required = named(subject.program, required);
            let message = format!("`{required}` is required, and nothing before establishes `{missing}`");
            let rule = "unestablished-precondition";
            let meant = functions::meant_predicate(subject, &missing.predicate);
            let help = |otherwise: &str| match meant {
                Some(meant) => format!("did you mean `{meant}`? Else {otherwise}"),
                None => otherwise.to_owned(),
            };
            if subject.declares_world {
                let help = help("add it to the `world` of the task, or to the effects of an older state");
                findings.error(rule, at, &state.path, message, help);
            } else {
                let help = help("say in the task's `world` what holds at the start");
                findings.warning(rule, at, &state.path, message, help);
            }
        }
    }
    branches(state).into_iter().flatten().for_each(|child| walk(subject, *child, established, findings));
    establish(state, established);
}

/// Whether a transition leads from a state of a list to itself or to an earlier one.
fn leads_back(program: &Program, list: &[StateId]) -> bool {
    let position = |id: &StateId| list.iter().position(|other| other == id);
    list.iter().any(|from| {
        let mut targets = program.state(*from).transitions.values();
        targets.any(|target| matches!(target, Target::State(to) if position(to) <= position(from)))
    })
}

fn establish_all(subject: &Subject<'_>, id: StateId, established: &mut Established) {
    let state = subject.program.state(id);
    branches(state).into_iter().flatten().for_each(|child| establish_all(subject, *child, established));
    establish(state, established);
}

fn establish(state: &State, established: &mut Established) {
    match state.annotations.effects.get(crate::program::SUCCESS) {
        None => established.everything = true,
        Some(_) => state.annotations.effects.values().for_each(|effects| established.add(writes(effects))),
    }
}

/// The facts that effects may make true; deletions establish nothing.
fn writes(effects: &[EffectExpr]) -> Vec<FactPattern> {
    let mut patterns = Vec::new();
    for effect in effects {
        match effect {
            EffectExpr::Delete(_) => {}
            EffectExpr::Set(_, Expr::Literal(Value::Null)) => {}
            EffectExpr::ForEach { effects, .. } => patterns.extend(writes(effects)),
            one => {
                if let Footprint::Patterns(some) = EffectExpr::footprint(std::slice::from_ref(one), &NothingKnown) {
                    patterns.extend(some);
                }
            }
        }
    }
    patterns
}

fn finds(required: &Expr) -> bool {
    let mut found = false;
    required.visit(&mut |part| found |= matches!(part, Expr::Find(..)));
    found
}

/// A fact that must hold for the expression to be true, and that nothing establishes.
fn missing<'e>(required: &'e Expr, established: &Established) -> Option<&'e FactExpr> {
    match required {
        Expr::Unary(UnaryOperator::Not, _) => None,
        Expr::Query(conditions) => conditions.iter().find_map(|condition| missing(condition, established)),
        Expr::Binary(BinaryOperator::And, a, b) => missing(a, established).or_else(|| missing(b, established)),
        Expr::Binary(BinaryOperator::Or, a, b) => missing(a, established).and_then(|_| missing(b, established)),
        // The query may be meant to find nothing.
        other if finds(other) => None,
        // The expression may be true because a fact is absent.
        Expr::Binary(BinaryOperator::NotEqual, ..) => None,
        Expr::Binary(_, a, b) if [a, b].into_iter().any(|e| **e == Expr::Literal(Value::Null)) => None,
        other => other.fact_expressions().into_iter().find(|fact| !established.may_hold(fact)),
    }
}
