//! States that wait. A condition uses facts that only its own region may write, so that it becomes true at one place of the program.
//! Where regions share facts, it may use these, too (only if the runs need not end alike). Each state that waits for a signal has its
//! own signal name.

use super::*;
use ratn_model::program::CLOCK;
use ratn_model::wait::{ANSWER, ASK, CONDITION, SECONDS, SIGNAL, TIMEOUT, UNTIL, VALUE, foreseen};

/// The choices of every question: the first two may be outcomes.
const CHOICES: [&str; 4] = [FOUND, EMPTY, "left", "right"];

impl Maker {
    pub(super) fn wait(&mut self, id: StateId, room: &Room, visible: &Visible) -> StateKind {
        let text = |text: &str| Expr::Literal(Value::String(text.to_owned()));
        let number = |number: u64| Expr::Literal(Value::Int(number as i64));
        let mut annotations = Annotations { reads: Some(Vec::new()), ..Annotations::default() };
        let mut outcomes = Vec::new();
        let mut outputs = BTreeMap::new();
        let has_timeout = self.dice.percent(50);
        let (action, inputs) = match self.dice.below(6) {
            0 => (SECONDS, vec![("seconds".to_owned(), number(self.dice.below(4)))]),
            1 => (UNTIL, vec![("until".to_owned(), number(self.dice.below(60)))]),
            2 | 3 if !room.writable.is_empty() => {
                let condition = self.awaited_condition(room);
                annotations.effects.insert(SUCCESS.to_owned(), foreseen(&condition));
                (CONDITION, vec![("for".to_owned(), condition)])
            }
            4 => {
                let mut inputs = vec![
                    ("question".to_owned(), text("which way?")),
                    ("choices".to_owned(), Expr::List(CHOICES.map(text).into())),
                ];
                if has_timeout && self.dice.percent(60) {
                    let default = self.dice.one_of(&CHOICES).map_or(FOUND, |choice| choice);
                    inputs.push(("default".to_owned(), text(default)));
                }
                if self.features.transitions {
                    outcomes.extend(CHOICES[..self.dice.below(3) as usize].iter().map(|choice| (*choice).to_owned()));
                }
                outputs.insert(ANSWER.to_owned(), Type::String);
                (ASK, inputs)
            }
            _ => {
                outputs.insert(VALUE.to_owned(), Type::Any);
                (SIGNAL, vec![("signal".to_owned(), text(&format!("signal_{}", id.0)))])
            }
        };
        if has_timeout && !matches!(action, SECONDS | UNTIL) {
            annotations.timeout_s = Some(crate::oracle::TIMEOUT_S);
            if !inputs.iter().any(|(port, _)| port == "default") {
                outcomes.push(TIMEOUT.to_owned());
            }
        }
        for outcome in [SUCCESS, ABORTED, PREEMPTED].map(str::to_owned).into_iter().chain(outcomes.clone()) {
            annotations.effects.entry(outcome).or_default();
        }
        let assign = match (outputs.keys().next(), visible.assignable.first()) {
            (Some(port), Some(name)) if self.dice.percent(70) => vec![(name.clone(), Expr::Output(port.clone()))],
            _ => Vec::new(),
        };
        let state = self.at(id);
        (state.annotations, state.outcomes, state.assign) = (annotations, outcomes, assign);
        StateKind::Action { provider: CLOCK.to_owned(), action: action.to_owned(), inputs, outputs }
    }

    /// A condition on one or two facts, with constant arguments and values.
    fn awaited_condition(&mut self, room: &Room) -> Expr {
        let place = self.dice.below(room.writable.len() as u64) as usize;
        let first = self.awaited_fact(room.writable[place]);
        if room.writable.len() == 1 || self.dice.percent(60) {
            return first;
        }
        // With another predicate, because two conditions that exclude each other would never become true.
        let second = self.awaited_fact(room.writable[(place + 1) % room.writable.len()]);
        Expr::Binary(BinaryOperator::And, Box::new(first), Box::new(second))
    }

    fn awaited_fact(&mut self, predicate: u64) -> Expr {
        let fact = fact_at(predicate, self.dice.below(ARGUMENTS) as i64);
        let not = |inner| Expr::Unary(ratn_model::expression::UnaryOperator::Not, Box::new(inner));
        match self.dice.below(4) {
            0 => Expr::Exists(fact),
            1 => not(Expr::Exists(fact)),
            _ => {
                let value = Expr::Literal(Value::Int(self.dice.below(3) as i64));
                Expr::Binary(BinaryOperator::Equal, Box::new(Expr::Fact(fact)), Box::new(value))
            }
        }
    }
}
