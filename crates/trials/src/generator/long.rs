//! Chains of a hundred states and loops of a thousand iterations; a few programs consist only of one.

use super::*;

const CHAIN: u64 = 100;
const LOOP: i64 = 1_000;

impl Maker {
    /// The states of such a task, the names visible behind them, and the outcomes by which they are left; usually
    /// `None`.
    pub(super) fn long(&mut self, room: &Room, visible: &Visible) -> Option<(Vec<StateId>, Visible, Vec<String>)> {
        if !self.features.long {
            return None;
        }
        match self.dice.below(1_500) {
            0..5 => Some((self.chain(room, visible), visible.clone(), Vec::new())),
            5..7 => Some((self.thousand(room, visible), visible.clone(), Vec::new())),
            _ => None,
        }
    }

    /// A chain of actions, each of which uses the ones before it.
    fn chain(&mut self, room: &Room, visible: &Visible) -> Vec<StateId> {
        let mut visible = visible.clone();
        let mut children = Vec::new();
        for number in 0..CHAIN {
            let name = format!("c{number}");
            let id = self.push(name.clone(), name, Some(Program::ROOT));
            let kind = self.action(id, room, &visible);
            self.at(id).kind = kind;
            // Custom outcomes would usually leave the task before its middle.
            self.at(id).outcomes.clear();
            self.only_usual_effects(id);
            let next = number + 1 < CHAIN;
            if next {
                let to = Target::State(StateId(id.0 + 1));
                self.at(id).transitions.insert(ABORTED.to_owned(), to.clone());
                self.at(id).transitions.insert(PREEMPTED.to_owned(), to);
            }
            let defaults =
                [("x".to_owned(), Value::Int(1)), ("list".to_owned(), Value::List(vec![Value::Int(0)].into()))];
            self.at(id).defaults = BTreeMap::from(defaults);
            visible.ports.push(id);
            children.push(id);
        }
        children
    }

    /// A loop with a few actions in it.
    fn thousand(&mut self, room: &Room, visible: &Visible) -> Vec<StateId> {
        let id = self.push("loop".to_owned(), "loop".to_owned(), Some(Program::ROOT));
        let mut inner = visible.clone();
        inner.variables.push("n".to_owned());
        let mut body = Vec::new();
        if self.dice.percent(50) {
            // Each computes a number from the number before.
            body = self.counting(id, "loop", room, &inner, facts::COUNTER);
            body.truncate(3);
            self.states.truncate(body.last().map_or(0, |last| last.0 as usize + 1));
        }
        for number in body.len() as u64..1 + self.dice.below(2) {
            let name = format!("l{number}");
            let part = self.push(name.clone(), format!("loop/{name}"), Some(id));
            let kind = self.action(part, room, &inner);
            self.at(part).kind = kind;
            self.at(part).outcomes.clear();
            // There are not enough of these resources.
            self.at(part).annotations.resources.retain(|resource| resource.kind != PART);
            self.only_usual_effects(part);
            inner.ports.push(part);
            body.push(part);
        }
        let next =
            |failed: usize| body.get(failed + 1).map_or(Target::Outcome(SUCCESS.to_owned()), |id| Target::State(*id));
        for (number, part) in body.iter().enumerate() {
            for outcome in [ABORTED, PREEMPTED] {
                self.states[part.0 as usize].transitions.insert(outcome.to_owned(), next(number));
            }
            let defaults =
                [("x".to_owned(), Value::Int(1)), ("list".to_owned(), Value::List(vec![Value::Int(0)].into()))];
            self.states[part.0 as usize].defaults = BTreeMap::from(defaults);
        }
        let collection = Expr::Call(Function::Range, vec![Expr::Literal(Value::Int(LOOP))]);
        self.at(id).kind =
            StateKind::ForEach { variable: "n".to_owned(), index: None, collection, body, outputs: Vec::new() };
        vec![id]
    }

    fn only_usual_effects(&mut self, id: StateId) {
        let usual = |outcome: &String| [SUCCESS, ABORTED, PREEMPTED].contains(&outcome.as_str());
        self.at(id).annotations.effects.retain(|outcome, _| usual(outcome));
    }
}
