//! Hierarchies, conditions and loops.

use super::*;

impl Maker {
    pub(super) fn hierarchy(
        &mut self,
        id: StateId,
        path: &str,
        depth: u64,
        room: &Room,
        visible: &Visible,
    ) -> StateKind {
        let mut inner = visible.clone();
        self.at(id).variables = Vec::new();
        let variables = if self.features.libraries && !room.is_preemptive && self.dice.percent(20) {
            let (given, seen) = self.given(id, room, visible);
            inner = seen;
            given
        } else {
            self.variables(id, room, &mut inner)
        };
        let (children, inner, outcomes) = self.list(id, path, depth + 1, room, inner, false);
        let own = inner.ports.iter().rev().find(|state| !visible.ports.contains(state)).copied();
        let outputs: Vec<TaskOutput> = own
            .filter(|_| self.dice.percent(70))
            .map(|state| {
                let port = Expr::Port { state, port: "x".to_owned() };
                let value = if self.dice.percent(30) { self.number_of_fact(room) } else { port };
                TaskOutput { name: "x".to_owned(), ty: Type::Any, value }
            })
            .into_iter()
            .collect();
        let assign = self.assignments(visible, !outputs.is_empty());
        let mut annotations = self.boundary(room, visible);
        annotations.routine = !room.is_preemptive && self.dice.percent(25);
        let state = self.at(id);
        state.variables = variables;
        state.outcomes = outcomes;
        state.assign = assign;
        state.annotations = annotations;
        StateKind::Sequence { children, outputs }
    }

    /// The annotations of a hierarchy or a concurrency at its entry and exit.
    pub(super) fn boundary(&mut self, room: &Room, visible: &Visible) -> Annotations {
        let mut annotations = Annotations::default();
        for (outcome, chance) in [(SUCCESS, 20), (ABORTED, 20), (FOUND, 10)] {
            if (outcome != FOUND || self.features.effects) && self.dice.percent(chance) {
                let effect = self.effect(room, &Visible::default(), false);
                annotations.effects.insert(outcome.to_owned(), vec![effect]);
            }
        }
        if !room.is_preemptive && self.dice.percent(15) {
            let required = self.required(room, visible);
            annotations.requires.push(required);
        }
        if !room.is_preemptive && self.dice.percent(20) {
            annotations.resources.push(resource(ResourceOperation::Block, "Planner", 2));
        }
        if room.is_alone && self.dice.percent(20) {
            annotations.resources.push(task_resource(ResourceOperation::Create));
        }
        annotations
    }

    pub(super) fn condition(
        &mut self,
        id: StateId,
        path: &str,
        depth: u64,
        room: &Room,
        visible: &Visible,
    ) -> StateKind {
        self.at(id).annotations.routine = self.dice.percent(15);
        let predicate = self.predicate(room, visible);
        let (then, _, mut outcomes) = self.list(id, path, depth + 1, room, visible.clone(), false);
        let mut otherwise = Vec::new();
        if self.dice.percent(60) {
            let (list, _, more) = self.list(id, path, depth + 1, room, visible.clone(), false);
            otherwise = list;
            outcomes.extend(more);
        }
        outcomes.sort();
        outcomes.dedup();
        self.at(id).outcomes = outcomes;
        StateKind::Condition { predicate, then, otherwise, outputs: Vec::new() }
    }

    pub(super) fn for_each(
        &mut self,
        id: StateId,
        path: &str,
        depth: u64,
        room: &Room,
        visible: &Visible,
    ) -> StateKind {
        let variable = format!("v{}", id.0);
        let lists = visible.ports.last().copied().filter(|state| self.is_action(*state));
        let collection = match lists {
            Some(state) if self.dice.percent(70) => Expr::Port { state, port: "list".to_owned() },
            _ if self.features.keys && self.dice.percent(40) => self.list_of_numbers(visible, false),
            _ => {
                let items = (0..self.dice.below(3)).map(|n| Expr::Literal(Value::Int(n as i64)));
                Expr::List(items.collect())
            }
        };
        self.at(id).annotations.routine = self.dice.percent(15);
        let mut inner = visible.clone();
        inner.variables.push(variable.clone());
        let index = (self.features.whiles && self.dice.percent(25)).then(|| format!("i{}", id.0));
        inner.variables.extend(index.clone());
        let (body, _, outcomes) = self.list(id, path, depth + 1, room, inner, true);
        self.at(id).outcomes = outcomes;
        StateKind::ForEach { variable, index, collection, body, outputs: Vec::new() }
    }

    /// A `while` or `do … while` that counts its iterations.
    pub(super) fn repeat(&mut self, id: StateId, path: &str, depth: u64, room: &Room, visible: &Visible) -> StateKind {
        let index = format!("i{}", id.0);
        let limit = Expr::Literal(Value::Int(1 + self.dice.below(3) as i64));
        let counted = Expr::Binary(BinaryOperator::Less, Box::new(Expr::Variable(index.clone())), Box::new(limit));
        self.at(id).annotations.routine = self.dice.percent(12);
        let mut inner = visible.clone();
        inner.variables.push(index.clone());
        let (body, seen, outcomes) = self.list(id, path, depth + 1, room, inner, true);
        // An output of the body, or one that is visible outside.
        let own = seen.ports.iter().rev().find(|state| !visible.ports.contains(state)).copied();
        let body_first = self.dice.percent(40);
        let predicate = match own {
            Some(state) if body_first && self.dice.percent(50) => {
                let x = Expr::Port { state, port: "x".to_owned() };
                Expr::Binary(BinaryOperator::NotEqual, Box::new(x), Box::new(Expr::Literal(Value::Int(0))))
            }
            _ if self.dice.percent(60) => self.predicate(room, visible),
            _ => Expr::Literal(Value::Bool(true)),
        };
        let predicate = Expr::Binary(BinaryOperator::And, Box::new(counted), Box::new(predicate));
        self.at(id).outcomes = outcomes;
        StateKind::While { predicate, body_first, index: Some(index), body, outputs: Vec::new() }
    }
}
