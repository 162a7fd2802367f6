//! The outputs of other states that an expression needs, and those among which `either` chooses.

use crate::expression::{Expr, Function};
use crate::id::StateId;
use std::collections::BTreeSet;

pub(super) type Flow<'e> = (StateId, &'e str);

/// The outputs that an expression always needs, and its `either` choices.
#[derive(Default)]
pub(super) struct Ways<'e> {
    pub(super) needed: BTreeSet<Flow<'e>>,
    /// By `either`, the outputs that each argument needs.
    pub(super) either: Vec<Vec<BTreeSet<Flow<'e>>>>,
}

/// The outputs that an expression needs.
pub(super) fn ways(expr: &Expr) -> Ways<'_> {
    fn collect<'e>(expr: &'e Expr, ways: &mut Ways<'e>) {
        match expr {
            Expr::Port { state, port } => drop(ways.needed.insert((*state, port.as_str()))),
            Expr::Call(Function::Either, all) => ways.either.push(all.iter().flat_map(alternatives).collect()),
            _ => {
                let mut parts = Vec::new();
                expr.parts(&mut |part| parts.push(part));
                parts.into_iter().for_each(|part| collect(part, ways));
            }
        }
    }
    let mut ways = Ways::default();
    collect(expr, &mut ways);
    ways
}

/// Limit of alternatives per expression; what only further ones would make certain is refused.
const MOST_WAYS: usize = 64;

/// The alternative sets of outputs with which an expression has a value: with several `either`, one for each combination of their
/// arguments.
fn alternatives(expr: &Expr) -> Vec<BTreeSet<Flow<'_>>> {
    match expr {
        Expr::Port { state, port } => vec![BTreeSet::from([(*state, port.as_str())])],
        Expr::Call(Function::Either, all) => all.iter().flat_map(alternatives).take(MOST_WAYS).collect(),
        _ => {
            let mut parts = Vec::new();
            expr.parts(&mut |part| parts.push(alternatives(part)));
            parts.into_iter().fold(vec![BTreeSet::new()], |ways, part| {
                let both = |way: &BTreeSet<_>| part.iter().map(|other| way | other).collect::<Vec<_>>();
                ways.iter().flat_map(both).take(MOST_WAYS).collect()
            })
        }
    }
}
