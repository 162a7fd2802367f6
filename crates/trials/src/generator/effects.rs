//! Effects of nodes: keys, lists and amounts that come from ports and facts.

use super::*;

fn one() -> Expr {
    Expr::Literal(Value::Int(1))
}

impl Maker {
    /// An effect of a node.
    pub(super) fn effect(&mut self, room: &Room, visible: &Visible, own_outputs: bool) -> EffectExpr {
        if room.writable.is_empty() {
            // It may write nothing: an effect without consequence.
            return EffectExpr::Delete(fact_at(PREDICATES + 1, 0));
        }
        if let Some(effect) = self.special_effect(room, visible, own_outputs) {
            return effect;
        }
        let mut fact = self.fact(&room.writable, visible);
        self.key_from_port(&mut fact, room, visible, own_outputs);
        if self.dice.percent(15) {
            return EffectExpr::Delete(fact);
        }
        for argument in fact.arguments.iter_mut().filter(|argument| argument.is_none()) {
            *argument = Some(Expr::Literal(Value::Int(0)));
        }
        if self.dice.percent(15) {
            let by = if self.features.amounts { self.amount(visible, own_outputs) } else { one() };
            return EffectExpr::Increase(fact, by);
        }
        if own_outputs && self.features.effects && self.dice.percent(15) {
            let variable = "each".to_owned();
            if let Some(key) = fact.arguments.first_mut() {
                *key = Some(Expr::Variable(variable.clone()));
            }
            let value = Expr::Literal(Value::Int(self.dice.below(3) as i64));
            let collection = Expr::Output("list".to_owned());
            return EffectExpr::ForEach { variable, collection, effects: vec![EffectExpr::Set(fact, value)] };
        }
        if fact.predicate == format!("p{}", facts::RECORD) && self.dice.percent(90) {
            let record = facts::record(self.dice.below(3) as i64, self.dice.below(3) as i64);
            return EffectExpr::Set(fact, Expr::Literal(record));
        }
        let value = match self.dice.below(4) {
            0 if own_outputs => Expr::Output("x".to_owned()),
            1 if own_outputs && !visible.ports.is_empty() => {
                let state = visible.ports[self.dice.below(visible.ports.len() as u64) as usize];
                Expr::Port { state, port: "x".to_owned() }
            }
            2 if self.features.facts => self.lookup(room, &Visible::default()),
            2 => Expr::Fact(self.fact(&room.readable, &Visible::default())),
            _ => Expr::Literal(Value::Int(self.dice.below(3) as i64)),
        };
        EffectExpr::Set(fact, value)
    }

    /// Nested quantified effects, and effects that depend on the fact itself.
    fn special_effect(&mut self, room: &Room, visible: &Visible, own_outputs: bool) -> Option<EffectExpr> {
        if self.features.keys && !room.is_preemptive && own_outputs && self.dice.percent(15) {
            return Some(self.nested(room, visible));
        }
        if self.features.amounts && !self.features.blind && self.dice.percent(8) {
            let both: Vec<u64> = room.writable.iter().copied().filter(|p| room.readable.contains(p)).collect();
            let predicate = self.dice.one_of(&both).copied()?;
            let mut fact = self.fact(&[predicate], visible);
            for argument in fact.arguments.iter_mut().filter(|argument| argument.is_none()) {
                *argument = Some(Expr::Literal(Value::Int(0)));
            }
            let before = Expr::Call(Function::If, vec![Expr::Exists(fact.clone()), Expr::Fact(fact.clone()), one()]);
            let by = self.amount(visible, own_outputs);
            let now = Expr::Binary(BinaryOperator::Add, Box::new(before), Box::new(by));
            return Some(EffectExpr::Set(fact, now));
        }
        None
    }

    /// An effect for each element of a list, for each element of another one.
    fn nested(&mut self, room: &Room, visible: &Visible) -> EffectExpr {
        let (outer, inner) = ("each".to_owned(), "other".to_owned());
        let mut fact = self.fact(&room.writable, visible);
        let names = [outer.clone(), inner.clone()];
        for (argument, name) in fact.arguments.iter_mut().zip(names) {
            *argument = Some(Expr::Variable(name));
        }
        let wildcards = fact.arguments.iter_mut().filter(|argument| argument.is_none());
        wildcards.for_each(|argument| *argument = Some(Expr::Literal(Value::Int(0))));
        let (of, within) = (self.list_of_numbers(visible, true), self.list_of_numbers(visible, true));
        let effect = match self.dice.below(5) {
            0 => EffectExpr::Delete(fact),
            1 => EffectExpr::Increase(fact, Expr::Variable(inner.clone())),
            2 => EffectExpr::Set(fact, Expr::Variable(inner.clone())),
            _ => EffectExpr::Set(fact, one()),
        };
        let within = if self.dice.percent(20) {
            Expr::Call(Function::Range, vec![Expr::Variable(outer.clone())])
        } else {
            within
        };
        let effects = vec![EffectExpr::ForEach { variable: inner, collection: within, effects: vec![effect] }];
        EffectExpr::ForEach { variable: outer, collection: of, effects }
    }

    /// A list, usually from a port, which may be empty.
    pub(super) fn list_of_numbers(&mut self, visible: &Visible, own_outputs: bool) -> Expr {
        let actions: Vec<StateId> = visible.ports.iter().copied().filter(|id| self.is_action(*id)).collect();
        match self.dice.below(6) {
            0 => Expr::List(Vec::new()),
            1 => Expr::List((0..1 + self.dice.below(2)).map(|n| Expr::Literal(Value::Int(n as i64))).collect()),
            2 | 3 if own_outputs => Expr::Output("list".to_owned()),
            _ => match self.dice.one_of(&actions) {
                Some(state) => Expr::Port { state: *state, port: "list".to_owned() },
                None => Expr::List(Vec::new()),
            },
        }
    }

    /// Replaces one of the fact's arguments by the value of a port.
    fn key_from_port(&mut self, fact: &mut FactExpr, room: &Room, visible: &Visible, own_outputs: bool) {
        if !self.features.keys || room.is_preemptive || !own_outputs || !self.dice.percent(25) {
            return;
        }
        let key = match self.dice.one_of(&visible.ports).copied() {
            Some(state) if self.dice.percent(65) => Expr::Port { state, port: "x".to_owned() },
            _ => Expr::Output("x".to_owned()),
        };
        if let Some(argument) = fact.arguments.first_mut() {
            *argument = Some(key);
        }
    }

    /// The increment of a number: any number.
    pub(super) fn amount(&mut self, visible: &Visible, own_outputs: bool) -> Expr {
        const SOME: [f64; 7] = [1.0, 0.5, -1.0, 0.1, -0.3, 2.5, 0.001];
        let number = Expr::Literal(Value::Float(SOME[self.dice.below(7) as usize]));
        match self.dice.below(6) {
            0 if own_outputs => {
                let x = Box::new(Expr::Output("x".to_owned()));
                Expr::Binary(BinaryOperator::Multiply, x, Box::new(number))
            }
            1 if own_outputs && !visible.ports.is_empty() => {
                let state = visible.ports[self.dice.below(visible.ports.len() as u64) as usize];
                Expr::Unary(UnaryOperator::Negate, Box::new(Expr::Port { state, port: "x".to_owned() }))
            }
            2 => Expr::Literal(Value::Int(self.dice.below(5) as i64 - 2)),
            _ => number,
        }
    }
}
