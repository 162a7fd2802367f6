//! Shapes that chance hardly ever makes and in which bugs were found.
//!
//! - *Looked twice*: a writer reads and writes nothing at first. An older motion comes out otherwise, so it reads again and
//!   now writes something. Readers that found nothing must read again. It wrote nothing because its list was empty, because
//!   an outcome without effects came first, or because the key was another one; the reader uses a wildcard, `exists`, or a
//!   query.
//! - *Counting*: motions and computations that each compute a number from the number before, with readers among them.
//! - *A counting loop*: the same in a loop.
//! - *Keys*: a chain of writers, each with keys from the port of the one before.

use super::*;
use ratn_model::program::{Nature, WORLD_MODEL};

/// One link of a chain.
struct Link {
    nature: Nature,
    reads: Vec<FactExpr>,
    effects: Vec<EffectExpr>,
    inputs: Vec<(String, Expr)>,
    duration_s: Option<f64>,
}

impl Link {
    fn computes(reads: Vec<FactExpr>) -> Link {
        Link { nature: Nature::Computes, reads, effects: Vec::new(), inputs: Vec::new(), duration_s: None }
    }

    fn acts(effects: Vec<EffectExpr>) -> Link {
        Link { nature: Nature::Irreversible, reads: Vec::new(), effects, inputs: Vec::new(), duration_s: None }
    }

    fn writing(self, effects: Vec<EffectExpr>) -> Link {
        Link { effects, ..self }
    }

    /// Makes it take so long that later nodes are computed meanwhile.
    fn slowly(self) -> Link {
        Link { duration_s: Some(20.0), ..self }
    }

    fn with(mut self, port: &str, value: Expr) -> Link {
        self.inputs.push((port.to_owned(), value));
        self
    }
}

fn x_of(state: StateId) -> Expr {
    Expr::Port { state, port: "x".to_owned() }
}

fn one() -> Expr {
    Expr::Literal(Value::Int(1))
}

fn every(predicate: u64) -> FactExpr {
    FactExpr { predicate: format!("p{predicate}"), arguments: vec![None; facts::arity(predicate)] }
}

/// A fact with this first argument.
fn of(predicate: u64, first: Expr) -> FactExpr {
    let mut fact = every(predicate);
    fact.arguments.iter_mut().for_each(|argument| *argument = Some(Expr::Literal(Value::Int(0))));
    if let Some(argument) = fact.arguments.first_mut() {
        *argument = Some(first);
    }
    fact
}

impl Maker {
    /// One of the patterns as a hierarchy or a loop; `None` if there is no room for one.
    pub(super) fn pattern(&mut self, id: StateId, path: &str, room: &Room, visible: &Visible) -> Option<StateKind> {
        let both: Vec<u64> = room.writable.iter().copied().filter(|p| room.readable.contains(p)).collect();
        let first = self.dice.one_of(&both).copied()?;
        let rest: Vec<u64> = both.into_iter().filter(|other| *other != first).collect();
        let second = self.dice.one_of(&rest).copied()?;
        if room.actuators.is_empty() {
            return None;
        }
        let children = match self.dice.below(4) {
            0 | 1 => self.looked_twice(id, path, room, visible, (first, second)),
            2 => self.keys(id, path, room, visible, (first, second)),
            _ => {
                let children = self.counting(id, path, room, visible, first);
                if self.dice.percent(50) {
                    let variable = format!("v{}", id.0);
                    let times = Expr::Literal(Value::Int(2 + self.dice.below(4) as i64));
                    let collection = Expr::Call(Function::Range, vec![times]);
                    return Some(StateKind::ForEach {
                        variable,
                        index: None,
                        collection,
                        body: children,
                        outputs: Vec::new(),
                    });
                }
                children
            }
        };
        Some(StateKind::Sequence { children, outputs: Vec::new() })
    }

    fn link(&mut self, parent: StateId, around: &str, room: &Room, visible: &Visible, link: Link) -> StateId {
        let name = format!("t{}", self.states.len());
        let id = self.push(name.clone(), format!("{around}/{name}"), Some(parent));
        let mut annotations = Annotations {
            nature: link.nature,
            reads: Some(link.reads),
            effects: BTreeMap::from([(SUCCESS.to_owned(), link.effects)]),
            ..Annotations::default()
        };
        match annotations.nature {
            Nature::Computes => annotations.resources = vec![block("Planner"), block(WORLD_MODEL)],
            Nature::Senses(_) => annotations.resources = vec![block("Eye")],
            Nature::Irreversible => {
                let actuator = self.dice.one_of(&room.actuators).copied().unwrap_or("Arm");
                annotations.resources = vec![block(actuator)];
                if self.features.weak && self.dice.percent(40) {
                    annotations.exceptions = Some(Exceptions::Imprecise);
                }
            }
        }
        if annotations.nature != Nature::Computes {
            annotations.effects.insert(ABORTED.to_owned(), Vec::new());
            annotations.effects.insert(PREEMPTED.to_owned(), Vec::new());
        }
        annotations.duration_s = link.duration_s.map(|seconds| Expr::Literal(Value::Float(seconds)));
        let mut inputs = link.inputs;
        let variables = visible.variables.iter().enumerate();
        inputs.extend(variables.map(|(n, variable)| (format!("variable{n}"), Expr::Variable(variable.clone()))));
        let outputs =
            BTreeMap::from([("x".to_owned(), Type::Int), ("list".to_owned(), Type::List(Box::new(Type::Int)))]);
        let state = self.at(id);
        state.annotations = annotations;
        let (provider, action) = ("oracle".to_owned(), "act".to_owned());
        state.kind = StateKind::Action { provider, action, inputs, outputs };
        id
    }

    fn looked_twice(
        &mut self,
        id: StateId,
        path: &str,
        room: &Room,
        visible: &Visible,
        (first, second): (u64, u64),
    ) -> Vec<StateId> {
        let held = of(first, Expr::Literal(Value::Int(0)));
        let slow = self.link(id, path, room, visible, Link::computes(Vec::new()));
        let says = Expr::Literal(Value::Int(self.dice.below(3) as i64));
        let grasp = Link::acts(vec![EffectExpr::Set(held.clone(), says)]).with("in0", x_of(slow)).slowly();
        let grasp = self.link(id, path, room, visible, grasp);
        let held = if self.dice.percent(30) { every(first) } else { held };
        let own = Expr::Output("list".to_owned());
        let each = |collection: Expr| EffectExpr::ForEach {
            variable: "o".to_owned(),
            collection,
            effects: vec![EffectExpr::Set(of(second, Expr::Variable("o".to_owned())), one())],
        };
        let mut children = vec![slow, grasp];
        let look = match self.dice.below(2) {
            0 => Link::computes(vec![held]),
            _ => Link { nature: Nature::Senses(vec![held]), ..Link::computes(Vec::new()) },
        };
        match self.dice.below(4) {
            // It writes facts with keys from its own list.
            0 => children.push(self.link(id, path, room, visible, look.writing(vec![each(own)]))),
            // Its outcomes have different effects.
            1 => {
                let look = self.link(id, path, room, visible, look);
                let state = self.at(look);
                state.outcomes = vec![FOUND.to_owned(), EMPTY.to_owned()];
                let (found, empty) = (of(second, one()), of(second, Expr::Literal(Value::Int(2))));
                state.annotations.effects.insert(FOUND.to_owned(), vec![EffectExpr::Set(found, one())]);
                state.annotations.effects.insert(EMPTY.to_owned(), vec![EffectExpr::Delete(empty)]);
                let next = Target::State(StateId(look.0 + 1));
                state.transitions.insert(FOUND.to_owned(), next.clone());
                state.transitions.insert(EMPTY.to_owned(), next);
                children.push(look);
            }
            // Another node writes what it saw.
            2 => {
                let look = self.link(id, path, room, visible, look);
                let list = Expr::Port { state: look, port: "list".to_owned() };
                let note = Link::computes(Vec::new()).writing(vec![each(list)]);
                let note = self.link(id, path, room, visible, note);
                children.extend([look, note]);
            }
            _ => {
                let look = self.link(id, path, room, visible, look);
                let set = EffectExpr::Set(of(second, x_of(look)), x_of(look));
                let acts = if self.dice.percent(50) {
                    Link::acts(vec![set])
                } else {
                    Link::computes(Vec::new()).writing(vec![set])
                };
                let note = self.link(id, path, room, visible, acts);
                children.extend([look, note]);
            }
        }
        let plan = match self.dice.below(3) {
            0 => Link::computes(vec![every(second)]),
            1 => Link::computes(Vec::new()).with("is", Expr::Exists(every(second))),
            _ => {
                let mut asked = every(second);
                if let Some(argument) = asked.arguments.first_mut() {
                    *argument = Some(Expr::Unknown("o".to_owned()));
                }
                Link::computes(Vec::new()).with("is", Expr::Query(vec![Expr::Exists(asked)]))
            }
        };
        let plan = self.link(id, path, room, visible, plan);
        let go = self.link(id, path, room, visible, Link::acts(Vec::new()).with("in0", x_of(plan)));
        children.extend([plan, go]);
        children
    }

    /// Writers that each compute a number from the number before, and readers.
    pub(super) fn counting(
        &mut self,
        id: StateId,
        path: &str,
        room: &Room,
        visible: &Visible,
        predicate: u64,
    ) -> Vec<StateId> {
        let fact = of(predicate, Expr::Literal(Value::Int(0)));
        let mut children = Vec::new();
        let count = 2 + self.dice.below(5);
        for _ in 0..count {
            let before = Box::new(Expr::Fact(fact.clone()));
            let by = self.amount(&Visible::default(), true);
            let link = match self.dice.below(6) {
                0 | 1 => {
                    let read = if self.dice.percent(40) { every(predicate) } else { fact.clone() };
                    Link::computes(vec![read])
                }
                2 => Link::acts(vec![EffectExpr::Increase(fact.clone(), by)]),
                3 => Link::computes(Vec::new()).writing(vec![EffectExpr::Increase(fact.clone(), by)]),
                _ => {
                    let next = Expr::Binary(BinaryOperator::Add, before, Box::new(by));
                    Link::acts(vec![EffectExpr::Set(fact.clone(), next)])
                }
            };
            let link = match children.last() {
                Some(last) if self.dice.percent(60) => link.with("in0", x_of(*last)),
                _ => link,
            };
            let link = if link.nature == Nature::Irreversible && self.dice.percent(30) { link.slowly() } else { link };
            children.push(self.link(id, path, room, visible, link));
        }
        children
    }

    /// A chain of writers, each with keys from the port of the one before; then a reader of them all.
    fn keys(
        &mut self,
        id: StateId,
        path: &str,
        room: &Room,
        visible: &Visible,
        (first, second): (u64, u64),
    ) -> Vec<StateId> {
        let start = EffectExpr::Set(of(first, one()), Expr::Output("x".to_owned()));
        let mut children = vec![self.link(id, path, room, visible, Link::acts(vec![start]).slowly())];
        let mut last = self.link(id, path, room, visible, Link::computes(vec![every(first)]));
        children.push(last);
        for _ in 0..1 + self.dice.below(3) {
            let target = if self.dice.percent(70) { second } else { first };
            let fact = of(target, x_of(last));
            let effect = match self.dice.below(4) {
                0 => EffectExpr::Delete(fact),
                1 => EffectExpr::Increase(fact, one()),
                _ => EffectExpr::Set(fact, Expr::Output("x".to_owned())),
            };
            let read = if self.dice.percent(50) { every(first) } else { of(second, one()) };
            let link = Link::computes(vec![read]).writing(vec![effect.clone()]);
            let link = if self.dice.percent(40) { Link::acts(vec![effect]) } else { link };
            last = self.link(id, path, room, visible, link.with("in0", x_of(last)));
            children.push(last);
        }
        let plan = self.link(id, path, room, visible, Link::computes(vec![every(second)]));
        let go = self.link(id, path, room, visible, Link::acts(Vec::new()).with("in0", x_of(plan)));
        children.extend([plan, go]);
        children
    }
}
