//! Declared durations of states, and their numbers of attempts.

use super::*;

impl Maker {
    /// Adds estimates to an action.
    pub(super) fn estimates(&mut self, annotations: &mut Annotations, visible: &Visible) {
        if !self.features.estimates {
            return;
        }
        if self.dice.percent(30) {
            let some = Expr::Literal(Value::Float(self.dice.below(200) as f64 / 10.0));
            annotations.duration_s = Some(match self.dice.below(3) {
                0 if !visible.ports.is_empty() => {
                    let state = visible.ports[self.dice.below(visible.ports.len() as u64) as usize];
                    Expr::Port { state, port: "x".to_owned() }
                }
                1 if !visible.variables.is_empty() => {
                    let name = self.dice.one_of(&visible.variables).cloned().unwrap_or_default();
                    Expr::Binary(BinaryOperator::Multiply, Box::new(Expr::Variable(name)), Box::new(some))
                }
                _ => some,
            });
        }
        if self.dice.percent(20) {
            annotations.attempts = Some(1 + self.dice.below(4) as u32);
        }
    }
}
