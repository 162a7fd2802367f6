//! `filter`, `map`, `sort_by` and others, evaluated element by element.

use super::Fail;
use super::evaluate::{Place, Read, number, order, wrong};
use ratn_model::expression::{Comprehension, Expr};
use ratn_model::value::Value;
use std::cmp::Ordering;

/// The value of a comprehension.
pub(super) fn read(
    (what, element): (Comprehension, &str),
    (list, body): (&Expr, &Expr),
    place: &Place<'_>,
) -> Result<Value, Fail> {
    let Value::List(items) = list.read(place)? else { return wrong("no list") };
    let at = |item: &Value| {
        let mut inside = place.clone();
        inside.elements.push((element.to_owned(), item.clone()));
        inside
    };
    let mut keyed = Vec::new();
    for item in items {
        let inside = at(&item);
        let key = match what {
            Comprehension::Filter | Comprehension::Any | Comprehension::All => Value::Bool(body.is_true(&inside)?),
            _ => body.read(&inside)?,
        };
        // Later elements are not evaluated once the result is known.
        match (what, &key) {
            (Comprehension::Any, Value::Bool(true)) => return Ok(Value::Bool(true)),
            (Comprehension::All, Value::Bool(false)) => return Ok(Value::Bool(false)),
            _ => keyed.push((key, item)),
        }
    }
    let best = |wanted: Ordering, keyed: Vec<(Value, Value)>| {
        let mut best: Option<(Value, Value)> = None;
        for (key, item) in keyed {
            order(&key, &key)?;
            let better = match &best {
                None => true,
                Some((other, _)) => order(&key, other)? == wanted,
            };
            if better {
                best = Some((key, item));
            }
        }
        Ok(best.map_or(Value::Null, |(_, item)| item))
    };
    match what {
        Comprehension::Map => Ok(Value::List(keyed.into_iter().map(|(key, _)| key).collect())),
        Comprehension::Filter => {
            let kept = keyed.into_iter().filter(|(key, _)| *key == Value::Bool(true));
            Ok(Value::List(kept.map(|(_, item)| item).collect()))
        }
        Comprehension::SortBy => Ok(Value::List(ascending(keyed)?.into())),
        Comprehension::MinBy => best(Ordering::Less, keyed),
        Comprehension::MaxBy => best(Ordering::Greater, keyed),
        Comprehension::Any => Ok(Value::Bool(false)),
        Comprehension::All => Ok(Value::Bool(true)),
    }
}

/// Insertion sort of pairs by their first values; returns the second ones.
pub(super) fn ascending(keyed: Vec<(Value, Value)>) -> Result<Vec<Value>, Fail> {
    let real = keyed.iter().any(|(key, _)| matches!(key, Value::Float(_)));
    let mut sorted: Vec<(Value, Value)> = Vec::new();
    for (key, item) in keyed {
        order(&key, &key)?;
        let key = if real { Value::Float(number(&key)?) } else { key };
        let mut at = sorted.len();
        for (i, (other, _)) in sorted.iter().enumerate().rev() {
            if order(other, &key)? != Ordering::Greater {
                break;
            }
            at = i;
        }
        sorted.insert(at, (key, item));
    }
    Ok(sorted.into_iter().map(|(_, item)| item).collect())
}
