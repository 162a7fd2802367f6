//! Actions, and the predicates of conditions.

use super::*;
use ratn_model::program::{Nature, STOPPED};

impl Maker {
    pub(super) fn action(&mut self, id: StateId, room: &Room, visible: &Visible) -> StateKind {
        let mut inputs: Vec<(String, Expr)> = Vec::new();
        for (number, variable) in visible.variables.iter().enumerate() {
            inputs.push((format!("variable{number}"), Expr::Variable(variable.clone())));
        }
        for (number, state) in visible.ports.iter().rev().take(3).enumerate() {
            if !room.is_preemptive && self.dice.percent(45) {
                inputs.push((format!("in{number}"), Expr::Port { state: *state, port: "x".to_owned() }));
            }
        }
        let custom = self.features.transitions && self.dice.percent(45);
        let annotations = self.annotations(room, visible, custom);
        if let Some(fact) = annotations.reads.iter().flatten().next()
            && self.dice.percent(30)
        {
            inputs.push(("fact".to_owned(), Expr::Fact(fact.clone())));
        }
        let mut annotations = annotations;
        self.looked_at(&mut annotations, &mut inputs, room, visible);
        let stops =
            custom && self.features.incidents && annotations.nature == Nature::Irreversible && self.dice.percent(20);
        let assign = self.assignments(visible, true);
        let state = self.at(id);
        state.annotations = annotations;
        state.assign = assign;
        if custom {
            state.outcomes = vec![FOUND.to_owned(), EMPTY.to_owned(), AGAIN.to_owned()];
            state.outcomes.extend(stops.then(|| STOPPED.to_owned()));
        }
        let outputs =
            BTreeMap::from([("x".to_owned(), Type::Int), ("list".to_owned(), Type::List(Box::new(Type::Int)))]);
        let action = if custom { "look" } else { "act" };
        StateKind::Action { provider: "oracle".to_owned(), action: action.to_owned(), inputs, outputs }
    }

    pub(super) fn predicate(&mut self, room: &Room, visible: &Visible) -> Expr {
        if let Some(predicate) = self.special_predicate(room, visible) {
            return predicate;
        }
        let what = match visible.ports.last() {
            Some(state) if self.dice.percent(60) => Expr::Port { state: *state, port: "x".to_owned() },
            _ if self.dice.percent(20) && !visible.variables.is_empty() => {
                let name = self.dice.one_of(&visible.variables).cloned().unwrap_or_default();
                Expr::Variable(name)
            }
            _ if self.features.blind => Expr::Literal(Value::Int(1)),
            _ => Expr::Fact(self.fact(&room.readable, visible)),
        };
        let limit = Expr::Literal(Value::Int(self.dice.below(3) as i64));
        Expr::Binary(BinaryOperator::Equal, Box::new(what), Box::new(limit))
    }

    /// Adds inputs with facts and queries, facts with keys from ports, and the tolerated predicate.
    fn looked_at(
        &mut self,
        annotations: &mut Annotations,
        inputs: &mut Vec<(String, Expr)>,
        room: &Room,
        visible: &Visible,
    ) {
        if room.is_preemptive || self.features.blind {
            return;
        }
        if self.features.keys && !visible.ports.is_empty() && self.dice.percent(15) {
            let state = visible.ports[self.dice.below(visible.ports.len() as u64) as usize];
            let key = Expr::Port { state, port: "x".to_owned() };
            let facts = match (&mut annotations.nature, &mut annotations.reads) {
                (Nature::Senses(facts), _) => facts,
                (_, Some(reads)) => reads,
                (_, None) => return,
            };
            if let Some(argument) = facts.first_mut().and_then(|fact| fact.arguments.first_mut()) {
                *argument = Some(key.clone());
                // The oracle knows from the inputs which facts it may see.
                inputs.push(("key".to_owned(), key));
            }
        }
        if self.features.facts && annotations.reads.is_some() && self.dice.percent(15) {
            let lookup = self.lookup(room, visible);
            inputs.push(("asked".to_owned(), lookup));
        }
        self.tolerated(annotations, room);
    }

    fn special_predicate(&mut self, room: &Room, visible: &Visible) -> Option<Expr> {
        if self.features.tolerance && room.tolerant && self.dice.percent(8) {
            return Some(self.tolerated_comparison());
        }
        (self.features.facts && !self.features.blind && self.dice.percent(20)).then(|| self.query(room, visible))
    }
}
