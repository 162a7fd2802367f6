//! Functions that are not there. Predicates need no declaration, so `graps_pose($box)` reads as the value of a fact; where nothing in
//! the task says that there is such a fact and a function is called almost so, it is meant.

use super::{Subject, expressions, named};
use crate::diagnostic::Findings;
use crate::expression::{EffectExpr, Expr, Function};
use crate::load::distance;
use std::collections::BTreeSet;

/// So long a name may differ in two letters, a shorter one in one.
const LONG_NAME: usize = 8;
/// So short a function's name is close to too many words to refuse one.
const SHORT_NAME: usize = 3;

pub(super) fn check(subject: &Subject<'_>, findings: &mut Findings) {
    let program = subject.program;
    let known = predicates(subject);
    for state in &program.states {
        for (slot, expr) in expressions(program, state) {
            for fact in expr.fact_expressions() {
                if known.contains(fact.predicate.as_str()) || fact.arguments.iter().any(Option::is_none) {
                    continue;
                }
                let Some((name, usage, takes)) = meant(&fact.predicate, fact.arguments.len()) else { continue };
                let at = subject.place_of(state, slot);
                let whole = named(program, &Expr::Fact(fact.clone()));
                let message = format!("`{whole}` is read as a fact, and nothing in the task says that there is one");
                let help = format!(
                    "did you mean `{usage}`? If it is a fact, name it in `reads`, `world` or the effects of a state"
                );
                if takes && name.len() > SHORT_NAME {
                    findings.error("unknown-function", at, &state.path, message, help);
                } else {
                    findings.warning("unknown-function", at, &state.path, message, help);
                }
            }
        }
    }
}

/// The function that a name is almost the name of, how it is called, and whether so many arguments fit.
fn meant(predicate: &str, arguments: usize) -> Option<(&'static str, &'static str, bool)> {
    let functions = Function::ALL.into_iter().map(|f| (f.name(), f.usage(), f.takes(arguments)));
    let all = functions.chain([("exists", "exists fact(…)", arguments == 1)]);
    let allowed = if predicate.len() >= LONG_NAME { 2 } else { 1 };
    let near = all.map(|function| (edits(predicate, function.0), function)).min_by_key(|(edits, _)| *edits)?;
    (near.0 <= allowed).then_some(near.1)
}

/// Edits between two names; two neighbours in the wrong order are one.
fn edits(a: &str, b: &str) -> usize {
    let plain = distance(a, b);
    let differ: Vec<usize> =
        a.bytes().zip(b.bytes()).enumerate().filter(|(_, (x, y))| x != y).map(|(i, _)| i).collect();
    match differ.as_slice() {
        [i, j] if a.len() == b.len() && j - i == 1 && a.as_bytes()[*i] == b.as_bytes()[*j] => plain.min(1),
        _ => plain,
    }
}

/// The predicates that the task says there are: what it writes, reads by declaration, senses, asks for with `?` or holds at the start.
fn predicates<'a>(subject: &Subject<'a>) -> BTreeSet<&'a str> {
    let program = subject.program;
    let mut known = BTreeSet::new();
    let written = |effect: &'a EffectExpr| effect.written().into_iter().map(|fact| fact.predicate.as_str());
    known.extend(program.initial.iter().flat_map(written));
    for state in &program.states {
        let annotations = &state.annotations;
        known.extend(annotations.effects.values().flatten().flat_map(written));
        let named = annotations.reads.iter().flatten().chain(annotations.senses());
        known.extend(named.map(|fact| fact.predicate.as_str()));
        for (_, expr) in expressions(program, state) {
            let open = expr.fact_expressions().into_iter().filter(|fact| fact.arguments.iter().any(Option::is_none));
            known.extend(open.map(|fact| fact.predicate.as_str()));
        }
    }
    known
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_word_with_a_letter_wrong_is_the_function() {
        for (word, arguments, name) in
            [("graps_pose", 1, "grasp_pose"), ("exist", 1, "exists"), ("jonits", 7, "joints"), ("lenn", 1, "len")]
        {
            assert_eq!(meant(word, arguments).map(|m| m.0), Some(name));
        }
        assert!(meant("taken", 1).is_some_and(|(_, _, takes)| !takes));
    }

    #[test]
    fn the_predicates_of_everyday_tasks_are_no_functions() {
        for word in
            ["at", "on", "open", "held", "holding", "in_gripper", "hand_empty", "shape", "on_table", "has", "visible"]
        {
            assert_eq!(meant(word, 1), None, "{word}");
        }
    }
}
