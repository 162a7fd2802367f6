//! Constants that have no value: what needs neither variables, outputs nor facts is evaluated here and now, as it will be then.

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
        // Another value may be given to the run.
        let message = format!("`{}`, with what parameters are by default: {problem}", named(subject.program, expr));
        findings.warning(RULE, subject.place_of(state, slot), &state.path, message, HELP_WITH_DEFAULTS);
    }
}

/// Joint positions of another number than the provider's.
fn joints(subject: &Subject<'_>, state: &State, slot: Slot<'_>, expr: &Expr, scope: &dyn Scope) -> Option<String> {
    let StateKind::Action { provider, .. } = &state.kind else { return None };
    let known = subject.catalogue.providers.get(provider)?;
    let wanted = known.joints?;
    let Ok(Value::Joints(found)) = expr.evaluate(scope) else { return None };
    let fits = !matches!(slot, Slot::Input(_)) || usize::try_from(wanted).is_ok_and(|wanted| wanted == found.len());
    (!fits).then(|| {
        let count = found.len();
        match &known.chain {
            None => format!("`{provider}` has {wanted} joints, and these are the positions of {count}"),
            Some(JointChain { robot, arm, joints }) => format!(
                "the arm `{arm}` of the robot `{robot}` has {wanted} joints ({}), and these are the positions of {count}",
                joints.join(", ")
            ),
        }
    })
}

/// The parameters of the task in a state, as they are where the run is given no others: those that nothing assigns to, and that are not hidden by a
/// variable of the same name.
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

/// Whether a state has a variable of this name.
fn binds(state: &State, name: &str) -> bool {
    let of_loop = match &state.kind {
        StateKind::ForEach { variable, index, .. } => variable == name || index.as_deref() == Some(name),
        _ => false,
    };
    of_loop || state.variables.iter().any(|(own, _)| own == name)
}

/// What is wrong with the first part that is a constant and has no value. A part that may be passed over (the branches of an `if`, the
/// right of `and` and `or`) does not count unless the whole is a constant.
pub(crate) fn problem(expr: &Expr) -> Option<EvaluateError> {
    match expr.evaluate(&NothingKnown) {
        Ok(_) => None,
        Err(error @ EvaluateError::Wrong { .. }) => Some(error),
        Err(EvaluateError::NotYetKnown { .. }) => parts(expr).into_iter().find_map(problem),
    }
}

/// The parts that are evaluated whenever the whole is.
fn parts(expr: &Expr) -> Vec<&Expr> {
    use crate::expression::BinaryOperator::{And, Or};
    match expr {
        Expr::Literal(_)
        | Expr::Variable(_)
        | Expr::Output(_)
        | Expr::Port { .. }
        | Expr::Unknown(_)
        | Expr::Element(_) => Vec::new(),
        // Its body is evaluated for no element of an empty list.
        Expr::Each { list, .. } => vec![list],
        // What is not looked at when an earlier condition fails.
        Expr::Query(_) | Expr::Find(..) => Vec::new(),
        Expr::Field(of, _) | Expr::Unary(_, of) | Expr::Binary(And | Or, of, _) => vec![of],
        Expr::Index(a, b) | Expr::Binary(_, a, b) => vec![a, b],
        Expr::Call(Function::If, arguments) => arguments.iter().take(1).collect(),
        // Which of them is evaluated is known only while the task runs.
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
