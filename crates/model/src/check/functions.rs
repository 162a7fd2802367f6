//! Unknown functions. Predicates need no declaration, so `graps_pose($box)` parses as the value of a fact. If the task never mentions
//! such a fact and a function has a similar name, the function is meant. A fact that nothing writes or declares is reported, because
//! it is null wherever it is read.

use super::types::Wrong;
use super::{Subject, expressions, named};
use crate::diagnostic::Findings;
use crate::expression::{Comprehension, EffectExpr, Expr, FactExpr, Function};
use crate::load::distance;
use crate::slot::Slot;
use crate::value::Type;
use std::collections::BTreeSet;

/// From this length on a name may differ in two letters, a shorter one in one.
const LONG_NAME: usize = 8;
/// Short names are similar to too many words; they cause only a warning.
const SHORT_NAME: usize = 3;

/// Functions of other languages that people write, with their replacement here. None of them exists here, and no task has facts with
/// these names unless it declares them.
const OF_OTHER_LANGUAGES: [(&str, &str); 36] = [
    ("acos", ""),
    ("asin", ""),
    ("atan", ""),
    ("atan2", ""),
    ("avg", "sum(list) / len(list)"),
    ("bool", ""),
    ("ceil", "-floor(-x)"),
    ("contains", "x in list"),
    ("cos", ""),
    ("count", "len(list)"),
    ("degrees", "x * 57.29578"),
    ("dist", "distance(pose, pose)"),
    ("enumerate", "for: x in list, with index: i"),
    ("exp", ""),
    ("float", "1.0 * x"),
    ("int", "floor(x)"),
    ("keys", ""),
    ("length", "len(list)"),
    ("log", ""),
    ("mean", "sum(list) / len(list)"),
    ("norm", "distance(pose, pose)"),
    ("now", ""),
    ("pow", "x * x"),
    ("radians", "x / 57.29578"),
    ("random", ""),
    ("reversed", "reverse(list)"),
    ("round", "floor(x + 0.5)"),
    ("rotate", "compose(pose, pose)"),
    ("sin", ""),
    ("size", "len(list)"),
    ("sorted", "sort(list)"),
    ("str", "concat(a, b, …)"),
    ("tan", ""),
    ("transform", "compose(pose, pose)"),
    ("values", ""),
    ("zip", ""),
];

/// The error that a fact with an impossible argument is an unknown function.
pub(super) fn no_fact(subject: &Subject<'_>, fact: &FactExpr, about: &Type) -> Wrong {
    let name = fact.predicate.as_str();
    let whole = named(subject.program, &Expr::Fact(fact.clone()));
    let article = if matches!(about, Type::Record(_)) { "a map" } else { &format!("{about}") };
    let message = format!(
        "`{whole}`: there is no function `{name}`, and it is no fact: those are about individuals and ints, not about {article}"
    );
    let help = match (meant(name, fact.arguments.len(), subject.functions), elsewhere(name)) {
        (Some((_, usage, _)), _) => format!("did you mean `{usage}`?"),
        (None, Some(here)) if !here.is_empty() => format!("write `{here}`"),
        _ => "the functions that there are stand in docs/task-files.md".to_owned(),
    };
    Wrong { rule: "unknown-function", message, help }
}

/// The replacement of a function of another language; empty if there is none.
fn elsewhere(name: &str) -> Option<&'static str> {
    OF_OTHER_LANGUAGES.iter().find(|(other, _)| *other == name).map(|(_, here)| *here)
}

pub(super) fn check(subject: &Subject<'_>, findings: &mut Findings) {
    let program = subject.program;
    let known = predicates(subject);
    let awaited = awaited(subject);
    let mut told = BTreeSet::new();
    for state in &program.states {
        for (slot, expr) in expressions(program, state) {
            let at = subject.place_of(state, slot);
            // Already reported for its argument.
            if findings.has("unknown-function", at) {
                continue;
            }
            for fact in expr.fact_expressions() {
                let name = fact.predicate.as_str();
                if known.contains(name) || fact.arguments.iter().any(Option::is_none) {
                    continue;
                }
                let whole = named(program, &Expr::Fact(fact.clone()));
                let message = format!("`{whole}` is read as a fact, and nothing in the task says that there is one");
                let declare = "name it in `reads`, `world` or the effects of a state";
                let function = meant(name, fact.arguments.len(), subject.functions);
                let near = nearest(name, &known);
                match (function, near) {
                    (Some((function, usage, takes)), _) => {
                        let help = format!("did you mean `{usage}`? If it is a fact, {declare}");
                        if takes && function.len() > SHORT_NAME {
                            findings.error("unknown-function", at, &state.path, message, help);
                        } else {
                            findings.warning("unknown-function", at, &state.path, message, help);
                        }
                    }
                    (None, _) if let Some(here) = elsewhere(name) => {
                        let instead = match here {
                            "" => "those that there are stand in docs/task-files.md".to_owned(),
                            here => format!("write `{here}`"),
                        };
                        let help = format!("there is no function `{name}`: {instead}. If it is a fact, {declare}");
                        findings.error("unknown-function", at, &state.path, message, help);
                    }
                    // Reported by `unestablished-precondition`.
                    (None, None) if matches!(slot, Slot::Requires(_)) => {}
                    // The task waits for it, so somebody else writes it.
                    (None, None) if awaited.contains(name) => {}
                    // Reported once per name: a fact that nothing writes is null wherever it is read.
                    (None, near) if told.insert(name.to_owned()) => {
                        let help = match near {
                            Some(near) => {
                                format!("did you mean `{near}`? If the world that the task begins in has it, {declare}")
                            }
                            None => format!("if the world that the task begins in has it, {declare}"),
                        };
                        findings.warning("unknown-fact", at, &state.path, message, help);
                    }
                    (None, _) => {}
                }
            }
        }
    }
    deleted(subject, findings);
}

/// Reports facts that are deleted but never written, if the name of a written fact is similar.
fn deleted(subject: &Subject<'_>, findings: &mut Findings) {
    let known = mentioned(subject, true);
    for state in &subject.program.states {
        for (outcome, effects) in &state.annotations.effects {
            for fact in effects.iter().flat_map(EffectExpr::written) {
                let name = fact.predicate.as_str();
                if !known.contains(name)
                    && let Some(near) = nearest(name, &known)
                {
                    let whole = named(subject.program, &Expr::Fact(fact.clone()));
                    let message = format!("nothing writes `{whole}`, which is deleted");
                    let help = format!("did you mean `{near}`?");
                    let at = subject.place_of(state, Slot::Effect(outcome));
                    findings.warning("unknown-fact", at, &state.path, message, help);
                }
            }
        }
    }
}

/// The predicate with a similar name, for a name that nothing in the task writes or declares.
pub(super) fn meant_predicate<'a>(subject: &Subject<'a>, name: &str) -> Option<&'a str> {
    let known = predicates(subject);
    if known.contains(name) { None } else { nearest(name, &known) }
}

/// The predicate with the most similar name.
fn nearest<'a>(name: &str, known: &BTreeSet<&'a str>) -> Option<&'a str> {
    let allowed = if name.len() >= LONG_NAME { 2 } else { 1 };
    let near = known.iter().map(|other| (edits(name, other), *other)).min_by_key(|(edits, _)| *edits)?;
    (near.0 <= allowed).then_some(near.1)
}

/// The function with the most similar name, its usage, and whether it takes this number of arguments.
fn meant<'o>(
    predicate: &str,
    arguments: usize,
    own: &'o [(String, String, usize)],
) -> Option<(&'o str, &'o str, bool)> {
    let functions = Function::ALL.into_iter().map(|f| (f.name(), f.usage(), f.takes(arguments)));
    let comprehensions = Comprehension::ALL.into_iter().map(|c| (c.name(), c.usage(), arguments == 2));
    let all = functions.chain(comprehensions).chain([("exists", "exists fact(…)", arguments == 1)]);
    let own = own.iter().map(|(name, usage, count)| (name.as_str(), usage.as_str(), arguments == *count));
    let all = own.chain(all);
    let allowed = if predicate.len() >= LONG_NAME { 2 } else { 1 };
    let near = all.map(|function| (edits(predicate, function.0), function)).min_by_key(|(edits, _)| *edits)?;
    (near.0 <= allowed).then_some(near.1)
}

/// Edit distance of two names; swapping two neighbours counts as one edit.
fn edits(a: &str, b: &str) -> usize {
    let plain = distance(a, b);
    let differ: Vec<usize> =
        a.bytes().zip(b.bytes()).enumerate().filter(|(_, (x, y))| x != y).map(|(i, _)| i).collect();
    match differ.as_slice() {
        [i, j] if a.len() == b.len() && j - i == 1 && a.as_bytes()[*i] == b.as_bytes()[*j] => plain.min(1),
        _ => plain,
    }
}

/// The predicates that the task mentions: those that it writes, declares in `reads`, senses, looks up with `?`, or sets at the start.
fn predicates<'a>(subject: &Subject<'a>) -> BTreeSet<&'a str> {
    mentioned(subject, false)
}

/// The predicates in conditions of waits: whoever waits for a fact expects somebody else to write it.
fn awaited<'a>(subject: &Subject<'a>) -> BTreeSet<&'a str> {
    let waits = subject.program.states.iter().filter(|state| state.is_pause());
    let expressions = waits.flat_map(|state| expressions(subject.program, state));
    expressions.flat_map(|(_, expr)| expr.fact_expressions()).map(|fact| fact.predicate.as_str()).collect()
}

/// The predicates that the task mentions; with `made`, facts that are only deleted do not count.
fn mentioned<'a>(subject: &Subject<'a>, made: bool) -> BTreeSet<&'a str> {
    let program = subject.program;
    let mut known = BTreeSet::new();
    known.extend(program.ontology.iter().flat_map(|ontology| ontology.predicates()).map(|(name, _)| name));
    let written = |effect: &'a EffectExpr| {
        let facts = if made { effect.made() } else { effect.written() };
        facts.into_iter().map(|fact| fact.predicate.as_str())
    };
    known.extend(program.initial.iter().flat_map(written));
    for state in &program.states {
        let annotations = &state.annotations;
        // Effects that a wait foresees do not count: their names may be misspelled.
        let effects = annotations.effects.values().filter(|_| !state.is_pause());
        known.extend(effects.flatten().flat_map(written));
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
            assert_eq!(meant(word, arguments, &[]).map(|m| m.0), Some(name));
        }
        assert!(meant("taken", 1, &[]).is_some_and(|(_, _, takes)| !takes));
    }

    #[test]
    fn the_predicates_of_everyday_tasks_are_no_functions() {
        for word in
            ["at", "on", "open", "held", "holding", "in_gripper", "hand_empty", "shape", "on_table", "has", "visible"]
        {
            assert_eq!(meant(word, 1, &[]), None, "{word}");
        }
    }
}
