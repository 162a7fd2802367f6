//! Facts that violate the task's ontology: checked wherever a fact is named, as far as its arguments are constants. The rest is
//! checked when the fact is bound.

use super::{Subject, expressions};
use crate::diagnostic::Findings;
use crate::expression::scope::NothingKnown;
use crate::expression::{EffectExpr, Expr, FactExpr};
use crate::fact::{FactKey, FactPattern};
use crate::ontology::{Ontology, Violation};
use crate::program::{Location, Program, State};
use crate::value::Value;

pub(super) fn check(subject: &Subject<'_>, findings: &mut Findings) {
    let program = subject.program;
    let Some(ontology) = &program.ontology else { return };
    let root = program.state(Program::ROOT);
    let mut together = Together { ontology, facts: Vec::new() };
    for (i, effect) in program.initial.iter().enumerate() {
        let mut said = Said { ontology, at: subject.place(root, &format!("world.{i}")), path: "", findings };
        said.effect(effect);
        said.note(together.takes(effect));
    }
    for state in &program.states {
        of_state(subject, ontology, state, findings);
    }
}

fn of_state(subject: &Subject<'_>, ontology: &Ontology, state: &State, findings: &mut Findings) {
    let annotations = &state.annotations;
    let at = |part: &str| subject.place(state, part);
    for (slot, expr) in expressions(subject.program, state) {
        let mut said = Said { ontology, at: subject.place_of(state, slot), path: &state.path, findings };
        expr.fact_expressions().into_iter().for_each(|fact| said.fact(fact));
    }
    for (part, facts) in [("reads", annotations.reads.as_deref().unwrap_or_default()), ("senses", annotations.senses())]
    {
        let mut said = Said { ontology, at: at(part), path: &state.path, findings };
        facts.iter().for_each(|fact| said.fact(fact));
    }
    for (outcome, effects) in &annotations.effects {
        let mut said = Said { ontology, at: at(&format!("effects.{outcome}")), path: &state.path, findings };
        let mut together = Together { ontology, facts: Vec::new() };
        for effect in effects {
            said.effect(effect);
            said.note(together.takes(effect));
        }
    }
}

/// The constant facts that hold together after a list of effects.
struct Together<'a> {
    ontology: &'a Ontology,
    facts: Vec<FactKey>,
}

impl Together<'_> {
    fn takes(&mut self, effect: &EffectExpr) -> Result<(), Violation> {
        match effect {
            EffectExpr::Delete(fact) => {
                // An argument that is not known yet may match any of them.
                let gone = fact.pattern(&NothingKnown);
                self.facts.retain(|fact| !gone.matches(fact));
            }
            EffectExpr::Set(fact, value) => {
                let Some(fact) = key(fact.pattern(&NothingKnown)) else { return Ok(()) };
                let Some(rivals) = self.ontology.rivals(&fact) else { return Ok(()) };
                self.facts.retain(|other| *other != fact);
                if matches!(constant(value), Some(Value::Null | Value::Bool(false)) | None) {
                    return Ok(());
                }
                let rival = self.facts.iter().find(|other| rivals.matches(other));
                let found = rival.map_or(Ok(()), |rival| Err(Violation::not_functional(&fact, rival)));
                self.facts.push(fact);
                return found;
            }
            EffectExpr::Increase(..) | EffectExpr::ForEach { .. } => {}
        }
        Ok(())
    }
}

fn key(pattern: FactPattern) -> Option<FactKey> {
    Some(FactKey { predicate: pattern.predicate, arguments: pattern.arguments.into_iter().collect::<Option<_>>()? })
}

/// The context of one checked place.
struct Said<'a> {
    ontology: &'a Ontology,
    at: Location,
    path: &'a str,
    findings: &'a mut Findings,
}

impl Said<'_> {
    fn fact(&mut self, fact: &FactExpr) {
        self.note(self.ontology.check_pattern(&fact.pattern(&NothingKnown)));
    }

    fn effect(&mut self, effect: &EffectExpr) {
        match effect {
            EffectExpr::Delete(fact) => self.fact(fact),
            EffectExpr::Set(fact, value) => {
                self.fact(fact);
                if let Some(value) = constant(value) {
                    self.note(self.ontology.check_value(&fact.pattern(&NothingKnown), &value));
                }
            }
            EffectExpr::Increase(fact, by) => {
                self.fact(fact);
                if let Some(by) = constant(by).and_then(|by| by.as_number()) {
                    self.note(self.ontology.check_increase(&fact.pattern(&NothingKnown), by));
                }
            }
            EffectExpr::ForEach { effects, .. } => effects.iter().for_each(|inner| self.effect(inner)),
        }
    }

    fn note(&mut self, checked: Result<(), Violation>) {
        if let Err(Violation { rule, message, help }) = checked {
            self.findings.error(rule, self.at, self.path, message, help);
        }
    }
}

fn constant(expr: &Expr) -> Option<Value> {
    expr.evaluate(&NothingKnown).ok()
}
