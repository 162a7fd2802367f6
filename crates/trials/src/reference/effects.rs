//! Evaluates the effects of a state and applies them to facts.
//!
//! Values and arguments are evaluated before anything changes. If two effects of one list concern the same fact, the documents do
//! not say which one counts; both modes apply them in the order of the list, and so does this.

use super::Fail;
use super::evaluate::{Place, Read};
use super::facts::{Facts, fitting};
use ratn_model::expression::{EffectExpr, FactExpr};
use ratn_model::fact::{Change, FactKey, Term};
use ratn_model::ontology::Ontology;
use ratn_model::value::Value;

/// The changes of the effects, in order.
pub(super) fn bound(effects: &[EffectExpr], place: &Place<'_>) -> Result<Vec<Change>, Fail> {
    let mut changes = Vec::new();
    for effect in effects {
        match effect {
            EffectExpr::Set(fact, value) => {
                changes.push(Change::Set { fact: key(fact, place)?, value: value.read(place)? });
            }
            EffectExpr::Delete(fact) => changes.push(Change::Delete { pattern: place.pattern(fact)? }),
            EffectExpr::Increase(fact, by) => match by.read(place)? {
                Value::Int(by) => changes.push(Change::Increase { fact: key(fact, place)?, by: by as f64 }),
                Value::Float(by) => changes.push(Change::Increase { fact: key(fact, place)?, by }),
                other => return Err(Fail::Wrong(format!("an increase by {other}"))),
            },
            EffectExpr::ForEach { variable, collection, effects } => match collection.read(place)? {
                Value::List(elements) => {
                    for element in elements {
                        let mut inner = place.clone();
                        inner.variables.push((variable.clone(), element));
                        changes.extend(bound(effects, &inner)?);
                    }
                }
                other => return Err(Fail::Wrong(format!("effects for each of {other}"))),
            },
        }
    }
    Ok(changes)
}

/// Replaces predicted values by measured ones. With `declared`, a fact that is not predicted must not be measured.
pub(super) fn with_measured(
    mut changes: Vec<Change>,
    measured: &[(FactKey, Value)],
    declared: bool,
) -> Result<Vec<Change>, Fail> {
    for (key, value) in measured {
        let mut is_predicted = false;
        for change in &mut changes {
            match change {
                Change::Set { fact, value: predicted } if fact == key => {
                    *predicted = value.clone();
                    is_predicted = true;
                }
                _ => {}
            }
        }
        if !is_predicted && declared {
            return Err(Fail::Wrong(format!("{key} was measured, and no effect declares it")));
        }
        if !is_predicted {
            changes.push(Change::Set { fact: key.clone(), value: value.clone() });
        }
    }
    Ok(changes)
}

pub(super) fn applied(before: &Facts, changes: &[Change], ontology: Option<&Ontology>) -> Result<Facts, Fail> {
    if let Some(ontology) = ontology {
        ontology.check_changes(changes).map_err(|violation| Fail::Wrong(violation.to_string()))?;
    }
    let mut facts = before.clone();
    for change in changes {
        match change {
            Change::Set { fact, value } => drop(facts.insert(fact.clone(), value.clone())),
            Change::Delete { pattern } => {
                let gone: Vec<FactKey> = fitting(&facts, pattern).map(|(key, _)| key.clone()).collect();
                gone.iter().for_each(|key| drop(facts.remove(key)));
            }
            Change::Increase { fact, by } => {
                let whole = by.fract() == 0.0;
                let sum = |old: i64| {
                    let sum = i128::from(old).saturating_add(*by as i128);
                    i64::try_from(sum).map_err(|_| Fail::Wrong(format!("{fact} = {sum} is out of range")))
                };
                let value = match facts.get(fact) {
                    None | Some(Value::Null) if whole => Value::Int(sum(0)?),
                    None | Some(Value::Null) => Value::Float(*by),
                    Some(Value::Int(old)) if whole => Value::Int(sum(*old)?),
                    Some(Value::Int(old)) => Value::Float(*old as f64 + by),
                    Some(Value::Float(old)) => Value::Float(old + by),
                    Some(other) => return Err(Fail::Wrong(format!("{fact} = {other} cannot be increased"))),
                };
                facts.insert(fact.clone(), value);
            }
        }
    }
    // Among the facts of a functional predicate for one subject, at most one holds.
    let holds = |value: &Value| !matches!(value, Value::Null | Value::Bool(false));
    for change in changes {
        let (Some(ontology), Change::Set { fact, .. }) = (ontology, change) else { continue };
        let Some(rivals) = ontology.rivals(fact) else { continue };
        if facts.get(fact).is_some_and(holds)
            && fitting(&facts, &rivals).any(|(key, value)| key != fact && holds(value))
        {
            return Err(Fail::Wrong(format!("a second fact beside {fact}")));
        }
    }
    Ok(facts)
}

/// The key of a fact that is written.
fn key(fact: &FactExpr, place: &Place<'_>) -> Result<FactKey, Fail> {
    let arguments: Option<Vec<Term>> = place.pattern(fact)?.arguments.into_iter().collect();
    match arguments {
        Some(arguments) => Ok(FactKey { predicate: fact.predicate.clone(), arguments }),
        None => Err(Fail::Wrong(format!("{} is written with `?`", fact.predicate))),
    }
}
