//! Parameters, scoped variables and assignments to them.

use super::*;
use ratn_model::program::Parameter;

impl Maker {
    /// Adds scoped variables to a sequence; they are visible inside from here on.
    pub(super) fn variables(&mut self, id: StateId, room: &Room, visible: &mut Visible) -> Vec<(String, Expr)> {
        if !self.features.variables || !self.dice.percent(35) {
            return Vec::new();
        }
        let name = format!("n{}", id.0);
        let value = match visible.ports.last() {
            Some(state) if !room.is_preemptive && self.dice.percent(30) => {
                Expr::Port { state: *state, port: "x".to_owned() }
            }
            _ if self.dice.percent(40) => self.number_of_fact(room),
            _ => Expr::Literal(Value::Int(self.dice.below(ARGUMENTS) as i64)),
        };
        visible.variables.push(name.clone());
        visible.assignable.push(name.clone());
        vec![(name, value)]
    }

    /// A fact's value, or 0 if it is absent.
    pub(super) fn number_of_fact(&mut self, room: &Room) -> Expr {
        if self.features.facts && !self.features.blind && self.dice.percent(30) {
            let query = self.query(room, &Visible::default());
            return Expr::Call(Function::If, vec![query, Expr::Literal(Value::Int(1)), Expr::Literal(Value::Int(2))]);
        }
        let fact = self.fact(&room.readable, &Visible::default());
        let absent = Expr::Literal(Value::Int(0));
        Expr::Call(Function::If, vec![Expr::Exists(fact.clone()), Expr::Fact(fact), absent])
    }

    pub(super) fn assignments(&mut self, visible: &Visible, outputs: bool) -> Vec<(String, Expr)> {
        if !self.features.variables || !self.dice.percent(30) {
            return Vec::new();
        }
        let Some(name) = self.dice.one_of(&visible.assignable).cloned() else { return Vec::new() };
        let one = Box::new(Expr::Literal(Value::Int(1)));
        let value = match self.dice.below(3) {
            0 if outputs => Expr::Output("x".to_owned()),
            1 => Expr::Literal(Value::Int(self.dice.below(ARGUMENTS) as i64)),
            _ => Expr::Binary(BinaryOperator::Add, Box::new(Expr::Variable(name.clone())), one),
        };
        vec![(name, value)]
    }

    /// Parameters of the task, visible everywhere except in libraries.
    pub(super) fn parameters(&mut self, visible: &mut Visible) -> Vec<Parameter> {
        if !self.features.libraries || !self.dice.percent(40) {
            return Vec::new();
        }
        let name = "k0".to_owned();
        visible.variables.push(name.clone());
        vec![Parameter { name, ty: Type::Any, default: Some(Value::Int(self.dice.below(ARGUMENTS) as i64)) }]
    }

    /// The parameters of a library: its scoped variables, with values from the names visible where it is used.
    pub(super) fn given(&mut self, id: StateId, room: &Room, visible: &Visible) -> (Vec<(String, Expr)>, Visible) {
        let mut inner = Visible::default();
        let mut given = Vec::new();
        for number in 0..self.dice.below(3) {
            let value = match self.dice.below(4) {
                0 if !visible.variables.is_empty() => {
                    let name = self.dice.one_of(&visible.variables).cloned().unwrap_or_default();
                    Expr::Variable(name)
                }
                1 if !visible.ports.is_empty() => {
                    let state = visible.ports[self.dice.below(visible.ports.len() as u64) as usize];
                    Expr::Port { state, port: "x".to_owned() }
                }
                2 => self.number_of_fact(room),
                _ => Expr::Literal(Value::Int(self.dice.below(ARGUMENTS) as i64)),
            };
            let name = format!("g{}_{number}", id.0);
            inner.variables.push(name.clone());
            inner.assignable.push(name.clone());
            given.push((name, value));
        }
        (given, inner)
    }
}
