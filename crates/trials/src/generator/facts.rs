//! Facts and ways to look them up: keys, wildcards, fields, queries.

use super::*;

/// Predicates that exist only with [`Features::facts`], with their arity.
const WIDER: [(u64, usize); 5] = [(COUNTER, 0), (21, 2), (22, 2), (23, 3), (RECORD, 1)];
/// The counter `p20()`.
pub(super) const COUNTER: u64 = 20;
/// A predicate whose value is usually a record of two numbers, `a` and `b`.
pub(super) const RECORD: u64 = 24;

/// The predicates that programs with these features read and write.
pub(super) fn predicates(features: &Features) -> Vec<u64> {
    let wider = WIDER.iter().map(|(predicate, _)| *predicate).filter(|_| features.facts);
    (0..PREDICATES).chain(wider).collect()
}

/// The initial facts of the predicates that not all programs have.
pub(super) fn initial(features: &Features) -> Vec<EffectExpr> {
    let number = |n: i64| Expr::Literal(Value::Int(n));
    let set = |predicate: u64, arguments: &[i64], value: Expr| {
        let arguments = arguments.iter().map(|n| Some(number(*n))).collect();
        EffectExpr::Set(FactExpr { predicate: format!("p{predicate}"), arguments }, value)
    };
    let mut all = Vec::new();
    if features.facts {
        all.push(set(COUNTER, &[], number(0)));
        all.push(set(21, &[0, 1], number(1)));
        all.push(set(21, &[1, 1], number(2)));
        all.push(set(23, &[0, 1, 2], Expr::Literal(Value::Bool(true))));
        all.push(set(RECORD, &[0], Expr::Literal(record(1, 2))));
    }
    if features.tolerance {
        all.push(set(tolerance::TOLERANT, &[0], Expr::Literal(Value::Float(1.0))));
    }
    all
}

pub(super) fn arity(predicate: u64) -> usize {
    WIDER.iter().find(|(wider, _)| *wider == predicate).map_or(1, |(_, arity)| *arity)
}

pub(super) fn record(a: i64, b: i64) -> Value {
    Value::map([("a", Value::Int(a)), ("b", Value::Int(b))])
}

impl Maker {
    pub(super) fn fact(&mut self, among: &[u64], visible: &Visible) -> FactExpr {
        let argument = match self.dice.one_of(&visible.variables).cloned() {
            Some(variable) if self.dice.percent(40) => Some(Expr::Variable(variable)),
            _ if self.dice.percent(15) => None,
            _ => Some(Expr::Literal(Value::Int(self.dice.below(ARGUMENTS) as i64))),
        };
        // If it may read nothing, a predicate that nobody writes.
        let predicate = self.dice.one_of(among).copied().unwrap_or(PREDICATES);
        let mut fact = FactExpr { predicate: format!("p{predicate}"), arguments: vec![argument] };
        if self.features.facts && arity(predicate) != 1 {
            fact.arguments = (0..arity(predicate)).map(|_| self.argument(visible)).collect();
        }
        fact
    }

    /// An argument of a fact with several arguments; `None` is a wildcard.
    fn argument(&mut self, visible: &Visible) -> Option<Expr> {
        match self.dice.below(10) {
            0 | 1 => None,
            2..5 if !visible.variables.is_empty() => self.dice.one_of(&visible.variables).cloned().map(Expr::Variable),
            5 => Some(Expr::Literal(Value::String(["cup", "box"][self.dice.below(2) as usize].to_owned()))),
            _ => Some(Expr::Literal(Value::Int(self.dice.below(ARGUMENTS) as i64))),
        }
    }

    /// An expression that looks up a fact, or tests whether it exists.
    pub(super) fn lookup(&mut self, room: &Room, visible: &Visible) -> Expr {
        let fact = self.fact(&room.readable, visible);
        if fact.predicate == format!("p{RECORD}") && self.dice.percent(80) {
            let field = Expr::Field(Box::new(Expr::Fact(fact.clone())), "a".to_owned());
            if self.dice.percent(20) {
                return field;
            }
            let absent = Expr::Literal(Value::Int(0));
            return Expr::Call(Function::If, vec![Expr::Exists(fact), field, absent]);
        }
        match self.dice.below(3) {
            0 => Expr::Exists(fact),
            1 => self.query(room, visible),
            _ => Expr::Fact(fact),
        }
    }

    /// A query over readable facts: whether matching facts exist.
    pub(super) fn query(&mut self, room: &Room, visible: &Visible) -> Expr {
        let unknown = |name: &str| Expr::Unknown(name.to_owned());
        let is = |a: Expr, b: Expr| Expr::Binary(BinaryOperator::Equal, Box::new(a), Box::new(b));
        let not = |e: Expr| Expr::Unary(UnaryOperator::Not, Box::new(e));
        let number = Expr::Literal(Value::Int(self.dice.below(3) as i64));
        let first = self.asked(room, visible, "a");
        let conditions = match self.dice.below(7) {
            0 => vec![Expr::Exists(first)],
            1 => vec![Expr::Fact(first)],
            2 => vec![is(Expr::Fact(first), unknown("v")), not(is(unknown("v"), number))],
            3 => {
                let second = self.asked(room, visible, "a");
                vec![Expr::Exists(first), not(Expr::Exists(second))]
            }
            4 => {
                let second = self.asked(room, visible, "b");
                vec![is(Expr::Fact(first), unknown("v")), is(Expr::Fact(second), unknown("v"))]
            }
            5 => vec![is(Expr::Fact(first), number)],
            _ => {
                let some = Expr::List(vec![number, Expr::Literal(Value::Int(1))]);
                let within = Expr::Binary(BinaryOperator::In, Box::new(unknown("v")), Box::new(some));
                vec![is(Expr::Fact(first), unknown("v")), within]
            }
        };
        let query = Expr::Query(conditions);
        if self.dice.percent(30) { not(query) } else { query }
    }

    /// A fact in a query: some of its arguments are the query variable with this name.
    fn asked(&mut self, room: &Room, visible: &Visible, name: &str) -> FactExpr {
        let mut fact = self.fact(&room.readable, visible);
        let mut is_asked = false;
        for argument in &mut fact.arguments {
            if argument.is_none() || self.dice.percent(50) {
                *argument = if is_asked { None } else { Some(Expr::Unknown(name.to_owned())) };
                is_asked = true;
            }
        }
        fact
    }
}
