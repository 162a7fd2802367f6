//! Evaluates the arguments of facts, effects and resources, and finds the facts that an effect may write while some
//! arguments are not known yet.

use super::evaluate::{EvaluateError, described};
use super::scope::{Scope, WithVariable};
use super::{EffectExpr, Expr, FactExpr};
use crate::fact::{Change, FactKey, FactPattern, Footprint, Term};
use crate::list::List;
use crate::program::ResourceExpr;
use crate::resource::Requirement;
use crate::value::Value;
use std::borrow::Cow;

impl FactExpr {
    /// The pattern with every argument evaluated.
    ///
    /// # Errors
    /// As [`Expr::evaluate`]; also for an argument that is neither an individual nor an int.
    pub fn bind(&self, scope: &dyn Scope) -> Result<FactPattern, EvaluateError> {
        let arguments = self.arguments.iter().map(|argument| argument.as_ref().map(|a| term(a, scope)).transpose());
        Ok(FactPattern { predicate: self.predicate.clone(), arguments: arguments.collect::<Result<_, _>>()? })
    }

    /// The pattern as far as it is known: an argument that cannot be evaluated becomes `?`.
    pub fn pattern(&self, scope: &dyn Scope) -> FactPattern {
        let arguments = self.arguments.iter().map(|argument| argument.as_ref().and_then(|a| term(a, scope).ok()));
        FactPattern { predicate: self.predicate.clone(), arguments: arguments.collect() }
    }

    /// The patterns of several facts, as far as they are known.
    pub fn footprint(facts: &[FactExpr], scope: &dyn Scope) -> Footprint {
        let mut patterns = Vec::new();
        facts.iter().for_each(|fact| add(&mut patterns, fact.pattern(scope)));
        Footprint::Patterns(patterns)
    }

    fn key(&self, scope: &dyn Scope) -> Result<FactKey, EvaluateError> {
        let arguments = self.bind(scope)?.arguments.into_iter().collect::<Option<Vec<Term>>>();
        let arguments = arguments.ok_or_else(|| EvaluateError::Wrong {
            expression: self.to_string(),
            problem: "a fact that is written needs all its arguments; `?` is not one".to_owned(),
        })?;
        Ok(FactKey { predicate: self.predicate.clone(), arguments })
    }
}

impl EffectExpr {
    /// The changes of the effects, in order. All effects are evaluated in the same scope: none sees another's change.
    ///
    /// # Errors
    /// As [`Expr::evaluate`].
    pub fn bind(effects: &[EffectExpr], scope: &dyn Scope) -> Result<Vec<Change>, EvaluateError> {
        let mut changes = Vec::new();
        bind_into(effects, scope, &mut changes)?;
        Ok(changes)
    }

    /// The facts that the effects may write, as far as they are known: what cannot be evaluated becomes `?`, and so does
    /// the variable of an unknown list.
    pub fn footprint(effects: &[EffectExpr], scope: &dyn Scope) -> Footprint {
        let mut patterns = Vec::new();
        footprint_into(effects, scope, &mut patterns);
        Footprint::Patterns(patterns)
    }
}

impl ResourceExpr {
    /// The requirement with every attribute evaluated.
    ///
    /// # Errors
    /// As [`Expr::evaluate`].
    pub fn bind(&self, scope: &dyn Scope) -> Result<Requirement, EvaluateError> {
        let attributes = self.attributes.iter().map(|(name, value)| Ok((name.clone(), value.evaluate(scope)?)));
        let conditions = self.conditions.iter().map(|condition| condition.bind(scope));
        Ok(Requirement {
            operation: self.operation,
            kind: self.kind.clone(),
            class: self.class,
            attributes: attributes.collect::<Result<_, EvaluateError>>()?,
            conditions: conditions.collect::<Result<_, EvaluateError>>()?,
            count: self.count,
            divisible: self.divisible,
        })
    }
}

pub(super) fn term(argument: &Expr, scope: &dyn Scope) -> Result<Term, EvaluateError> {
    match argument.value(scope)?.as_ref() {
        Value::String(name) => Ok(Term::Name(name.clone())),
        Value::Int(i) => Ok(Term::Int(*i)),
        other => {
            let problem = format!("an argument of a fact is an individual or an int, found {}", described(other));
            Err(argument.wrong(problem))
        }
    }
}

fn list(collection: &Expr, scope: &dyn Scope) -> Result<List, EvaluateError> {
    match collection.value(scope)? {
        Cow::Borrowed(Value::List(items)) => Ok(items.clone()),
        Cow::Owned(Value::List(items)) => Ok(items),
        other => Err(collection.wrong(format!("expected a list, found {}", described(&other)))),
    }
}

fn bind_into(effects: &[EffectExpr], scope: &dyn Scope, changes: &mut Vec<Change>) -> Result<(), EvaluateError> {
    for effect in effects {
        match effect {
            EffectExpr::Set(fact, value) => {
                changes.push(Change::Set { fact: fact.key(scope)?, value: value.evaluate(scope)? });
            }
            EffectExpr::Delete(fact) => changes.push(Change::Delete { pattern: fact.bind(scope)? }),
            EffectExpr::Increase(fact, by) => {
                let amount = by.value(scope)?;
                let Some(amount) = amount.as_number() else {
                    return Err(by.wrong(format!("expected a number, found {}", described(&amount))));
                };
                changes.push(Change::Increase { fact: fact.key(scope)?, by: amount });
            }
            EffectExpr::ForEach { variable, collection, effects } => {
                for value in &list(collection, scope)? {
                    let inner = WithVariable { outer: scope, name: variable, value: Some(value) };
                    bind_into(effects, &inner, changes)?;
                }
            }
        }
    }
    Ok(())
}

fn footprint_into(effects: &[EffectExpr], scope: &dyn Scope, patterns: &mut Vec<FactPattern>) {
    for effect in effects {
        match effect {
            EffectExpr::Set(fact, _) | EffectExpr::Delete(fact) | EffectExpr::Increase(fact, _) => {
                add(patterns, fact.pattern(scope));
            }
            EffectExpr::ForEach { variable, collection, effects } => {
                let hidden = WithVariable { outer: scope, name: variable, value: None };
                match list(collection, scope) {
                    Ok(values) => values.iter().for_each(|value| {
                        footprint_into(effects, &WithVariable { value: Some(value), ..hidden }, patterns);
                    }),
                    Err(_) => footprint_into(effects, &hidden, patterns),
                }
            }
        }
    }
}

fn add(patterns: &mut Vec<FactPattern>, pattern: FactPattern) {
    if !patterns.contains(&pattern) {
        patterns.push(pattern);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]

    use super::super::scope::NothingKnown;
    use super::*;
    use std::collections::BTreeMap;

    fn at_each_box() -> Vec<EffectExpr> {
        let at = FactExpr { predicate: "at".into(), arguments: vec![Some(Expr::Variable("b".into()))] };
        vec![EffectExpr::ForEach {
            variable: "b".into(),
            collection: Expr::Variable("boxes".into()),
            effects: vec![EffectExpr::Set(at, Expr::Literal(Value::Bool(true)))],
        }]
    }

    fn printed(footprint: Footprint) -> Vec<String> {
        match footprint {
            Footprint::Everything => vec!["everything".into()],
            Footprint::Patterns(patterns) => patterns.iter().map(ToString::to_string).collect(),
        }
    }

    #[test]
    fn an_effect_on_a_list_that_is_not_known_may_write_any_of_its_predicate() {
        assert_eq!(printed(EffectExpr::footprint(&at_each_box(), &NothingKnown)), ["at(?)"]);
        let boxes = Value::List(vec![Value::String("a".into()), Value::String("b".into())].into());
        let scope = BTreeMap::from([("boxes".to_owned(), boxes), ("b".to_owned(), Value::String("other".into()))]);
        assert_eq!(printed(EffectExpr::footprint(&at_each_box(), &scope)), ["at(a)", "at(b)"]);
        let changes = EffectExpr::bind(&at_each_box(), &scope).unwrap();
        assert_eq!(
            changes.iter().map(ToString::to_string).collect::<Vec<_>>(),
            ["set at(a) = true", "set at(b) = true"]
        );
        // The quantifier's variable hides an outer one, even if its value is unknown.
        let outside = BTreeMap::from([("b".to_owned(), Value::String("other".into()))]);
        assert_eq!(printed(EffectExpr::footprint(&at_each_box(), &outside)), ["at(?)"]);
    }

    #[test]
    fn a_written_fact_needs_all_its_arguments() {
        let any = FactExpr { predicate: "at".into(), arguments: vec![None] };
        let set = [EffectExpr::Set(any.clone(), Expr::Literal(Value::Bool(true)))];
        assert!(matches!(EffectExpr::bind(&set, &NothingKnown), Err(EvaluateError::Wrong { .. })));
        assert!(EffectExpr::bind(&[EffectExpr::Delete(any)], &NothingKnown).is_ok());
        assert!(EffectExpr::bind(&at_each_box(), &NothingKnown).unwrap_err().is_not_yet_known());
    }
}
