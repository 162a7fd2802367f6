//! Constant expressions without a value: an expression without variables, outputs and facts is evaluated here as it will be at run time.

use super::{Subject, named};
use crate::catalogue::JointChain;
use crate::diagnostic::Findings;
use crate::expression::scope::NothingKnown;
use crate::expression::{EvaluateError, Expr, FactExpr, Function, Scope};
use crate::program::{State, StateKind};
use crate::slot::Slot;
use crate::value::Value;
use std::borrow::Cow;

pub(crate) const RULE: &str = "invalid-constant";
pub(crate) const HELP: &str = "it fails whenever it is evaluated: write a value that there is";

const HELP_WITH_DEFAULTS: &str = "write a default that fits, or give the run another value (`--set`)";

pub(super) fn check(subject: &Subject<'_>, state: &State, slot: Slot<'_>, expr: &Expr, findings: &mut Findings) {
    let problem = match problem(expr) {
        Some(EvaluateError::Wrong { problem, .. }) => Some(problem),
        Some(EvaluateError::NotYetKnown { .. }) | None => joints(subject, state, slot, expr, &NothingKnown),
    };
    if let Some(problem) = problem {
        let message = format!("`{}`: {problem}", named(subject.program, expr));
        findings.error(RULE, subject.place_of(state, slot), &state.path, message, HELP);
    } else if let Some(problem) = joints(subject, state, slot, expr, &Defaults { subject, state }) {
        // A run may set other values.
        let message = format!("`{}`, with what parameters are by default: {problem}", named(subject.program, expr));
        findings.warning(RULE, subject.place_of(state, slot), &state.path, message, HELP_WITH_DEFAULTS);
    }
}

/// By how much a position may exceed its limit, in radians or metres, as for the controller of an arm.
const POSITION_TOLERANCE: f64 = 1e-3;

/// The problem of joint positions that the provider's arm cannot have: their number differs from that of its joints, or one is beyond its limits.
fn joints(subject: &Subject<'_>, state: &State, slot: Slot<'_>, expr: &Expr, scope: &dyn Scope) -> Option<String> {
    let StateKind::Action { provider, .. } = &state.kind else { return None };
    let known = subject.catalogue.providers.get(provider)?;
    let wanted = known.joints?;
    let Ok(Value::Joints(found)) = expr.evaluate(scope) else { return None };
    if !matches!(slot, Slot::Input(_)) {
        return None;
    }
    let count = found.len();
    if usize::try_from(wanted) == Ok(count) {
        return known.chain.as_ref().and_then(|chain| beyond(chain, &found));
    }
    Some(match &known.chain {
        None => format!("`{provider}` has {wanted} joints, and these are the positions of {count}"),
        Some(JointChain { robot, arm, joints, .. }) => format!(
            "the arm `{arm}` of the robot `{robot}` has {wanted} joints ({}), and these are the positions of {count}",
            joints.join(", ")
        ),
    })
}

/// The first position beyond the limits of its joint.
fn beyond(JointChain { robot, arm, joints, limits }: &JointChain, positions: &[f64]) -> Option<String> {
    let mut all = joints.iter().zip(limits).zip(positions);
    let ((joint, ([lower, upper], unit)), q) = all.find(|((_, ([lower, upper], _)), q)| {
        !(lower - POSITION_TOLERANCE..=upper + POSITION_TOLERANCE).contains(*q)
    })?;
    Some(format!(
        "the joint `{joint}` of the arm `{arm}` of the robot `{robot}` cannot be at {q} {unit}: its limits are {lower:.3} to {upper:.3} {unit}"
    ))
}

/// The scope of a state with the defaults of the task's parameters, except parameters that are assigned or hidden by a variable of the same name.
struct Defaults<'a> {
    subject: &'a Subject<'a>,
    state: &'a State,
}

impl Scope for Defaults<'_> {
    fn variable(&self, name: &str) -> Option<Cow<'_, Value>> {
        let program = self.subject.program;
        let is_assigned = program.states.iter().any(|state| state.assign.iter().any(|(to, _)| to == name));
        let is_hidden = self.subject.around(self.state.id).any(|around| binds(around, name));
        let default = program.parameters.iter().find(|parameter| parameter.name == name)?.default.as_ref();
        default.filter(|_| !is_assigned && !is_hidden).map(Cow::Borrowed)
    }
}

fn binds(state: &State, name: &str) -> bool {
    let of_loop = match &state.kind {
        StateKind::ForEach { variable, index, .. } => variable == name || index.as_deref() == Some(name),
        _ => false,
    };
    of_loop || state.variables.iter().any(|(own, _)| own == name)
}

/// The error of the first constant part without a value. Parts that may be skipped (the branches of an `if`, the right side of `and` and `or`)
/// count only if the whole expression is constant.
pub(crate) fn problem(expr: &Expr) -> Option<EvaluateError> {
    match expr.evaluate(&NothingKnown) {
        Ok(_) => None,
        Err(error @ EvaluateError::Wrong { .. }) => Some(error),
        Err(EvaluateError::NotYetKnown { .. }) => parts(expr).into_iter().find_map(problem),
    }
}

/// The parts that are always evaluated with the whole.
fn parts(expr: &Expr) -> Vec<&Expr> {
    use crate::expression::BinaryOperator::{And, Or};
    match expr {
        Expr::Literal(_)
        | Expr::Variable(_)
        | Expr::Output(_)
        | Expr::Port { .. }
        | Expr::Unknown(_)
        | Expr::Element(_) => Vec::new(),
        // The body is not evaluated if the list is empty.
        Expr::Each { list, .. } => vec![list],
        // Later conditions are not evaluated if an earlier one fails.
        Expr::Query(_) | Expr::Find(..) => Vec::new(),
        Expr::Field(of, _) | Expr::Unary(_, of) | Expr::Binary(And | Or, of, _) => vec![of],
        Expr::Index(a, b) | Expr::Binary(_, a, b) => vec![a, b],
        Expr::Call(Function::If, arguments) => arguments.iter().take(1).collect(),
        // Which argument is evaluated is known only at run time.
        Expr::Call(Function::Either, _) => Vec::new(),
        Expr::List(items) | Expr::Call(_, items) => items.iter().collect(),
        Expr::Map(fields) => fields.iter().map(|(_, item)| item).collect(),
        Expr::Fact(fact) | Expr::Exists(fact) => of_fact(fact),
    }
}

fn of_fact(fact: &FactExpr) -> Vec<&Expr> {
    fact.arguments.iter().flatten().collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::expression::BinaryOperator;

    fn broken() -> Expr {
        let number = |i| Box::new(Expr::Literal(Value::Int(i)));
        Expr::Binary(BinaryOperator::Divide, number(1), number(0))
    }

    #[test]
    fn a_broken_constant_beside_what_is_not_known_is_found() {
        let sum = Expr::Binary(BinaryOperator::Add, Box::new(Expr::Variable("n".into())), Box::new(broken()));
        assert!(problem(&sum).is_some());
        assert!(problem(&Expr::Variable("n".into())).is_none());
    }

    #[test]
    fn a_broken_constant_that_may_be_passed_over_is_not_complained_of() {
        let unknown = || Expr::Variable("sure".into());
        let choice = Expr::Call(Function::If, vec![unknown(), Expr::Literal(Value::Int(1)), broken()]);
        assert!(problem(&choice).is_none());
        let either = Expr::Binary(BinaryOperator::Or, Box::new(unknown()), Box::new(broken()));
        assert!(problem(&either).is_none());
    }
}
