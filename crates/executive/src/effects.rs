//! The effects of a finished node: as declared, with measured values in place of predicted ones.

use crate::plan::NodeNature;
use ratn_model::expression::{EffectExpr, EvaluateError, Scope};
use ratn_model::fact::{Change, FactKey};
use ratn_model::program::{SUCCESS, State};
use ratn_model::value::Value;

/// The declared effects of an outcome; `None` if the state may then write every fact.
pub(crate) fn declared<'a>(state: &'a State, nature: NodeNature, outcome: &str) -> Option<&'a [EffectExpr]> {
    match state.annotations.effects.get(outcome) {
        Some(effects) => Some(effects),
        // Without a declaration, a computing node changes nothing, and a sensing node that failed has learned nothing.
        None if nature == NodeNature::Computes => Some(&[]),
        None if nature == NodeNature::Senses && outcome != SUCCESS => Some(&[]),
        None => None,
    }
}

/// Error: the changes of a finished node cannot be made.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub(crate) enum EffectError {
    /// An effect's expression has no value even though the node has finished.
    #[error("an effect cannot be evaluated: {0}")]
    Evaluate(#[from] EvaluateError),
    /// A provider measured a fact that no effect of this outcome declares.
    #[error(
        "it measured {fact} = {value}, which none of its effects for outcome `{outcome}` declares; declare it, or drop the effects annotation"
    )]
    Undeclared {
        /// The fact.
        fact: String,
        /// The measured value.
        value: String,
        /// The outcome.
        outcome: String,
    },
}

/// Binds the declared effects in `scope`; measured values replace the predicted ones.
pub(crate) fn actual(
    declared: Option<&[EffectExpr]>,
    outcome: &str,
    measured: &[(FactKey, Value)],
    scope: &dyn Scope,
) -> Result<Vec<Change>, EffectError> {
    let mut changes = match declared {
        Some(effects) => EffectExpr::bind(effects, scope)?,
        None => Vec::new(),
    };
    for (key, value) in measured {
        let mut predicted = false;
        for change in &mut changes {
            if let Change::Set { fact, value: old } = change
                && fact == key
            {
                *old = value.clone();
                predicted = true;
            }
        }
        match (predicted, declared) {
            (true, _) => {}
            (false, None) => changes.push(Change::Set { fact: key.clone(), value: value.clone() }),
            (false, Some(_)) => {
                return Err(EffectError::Undeclared {
                    fact: key.to_string(),
                    value: value.to_string(),
                    outcome: outcome.to_owned(),
                });
            }
        }
    }
    Ok(changes)
}
