//! Which outputs of other states an expression needs, and of which it takes the first that is there.

use crate::expression::{Expr, Function};
use crate::id::StateId;
use std::collections::BTreeSet;

/// An output of a state.
pub(super) type Flow<'e> = (StateId, &'e str);

/// The outputs that an expression cannot do without, and those of which it takes the first that is there.
#[derive(Default)]
pub(super) struct Ways<'e> {
    pub(super) needed: BTreeSet<Flow<'e>>,
    /// Each `either`, way by way.
    pub(super) either: Vec<Vec<BTreeSet<Flow<'e>>>>,
}

/// Those of an expression.
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

/// So many ways of one expression are looked at. What is sure only by further ones is refused.
const MOST_WAYS: usize = 64;

/// The outputs with which an expression has a value, way by way: what contains several `either` has a way for each choice among them.
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
