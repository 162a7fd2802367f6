//! Annotations of random states: true, but often incomplete.

use super::*;
use ratn_model::program::{Nature, ResourceExpr, Retry, STOPPED, WORLD_MODEL};
use ratn_model::resource::ResourceClass;

impl Maker {
    /// The annotations of an action.
    pub(super) fn annotations(&mut self, room: &Room, visible: &Visible, custom: bool) -> Annotations {
        let mut annotations = Annotations::default();
        let facts = |maker: &mut Maker, most: u64| -> Vec<FactExpr> {
            (0..maker.dice.below(most + 1)).map(|_| maker.fact(&room.readable, visible)).collect()
        };
        // In a preemptive concurrency no region waits for a worker: each has one of every kind.
        let nature = match self.dice.below(10) {
            5 | 6 if room.is_preemptive => 0,
            7.. if room.actuators.is_empty() => 0,
            nature => nature,
        };
        match nature {
            0..=4 => {
                annotations.nature = Nature::Computes;
                annotations.reads = (!room.is_alone || self.dice.percent(90)).then(|| facts(self, 3));
                let planners = if !room.is_preemptive && self.dice.percent(15) { 2 } else { 1 };
                annotations.resources =
                    vec![resource(ResourceOperation::Block, "Planner", planners), block(WORLD_MODEL)];
                if self.features.effects && self.dice.percent(10) {
                    let effect = self.effect(room, visible, true);
                    annotations.effects.insert(SUCCESS.to_owned(), vec![effect]);
                }
                annotations.deterministic = self.features.speculation && self.dice.percent(15);
            }
            5 | 6 => {
                annotations.nature = Nature::Senses(facts(self, 2));
                annotations.resources = vec![block("Eye")];
                if self.dice.percent(30) {
                    annotations.resources.push(block(WORLD_MODEL));
                }
                if !room.is_alone || self.dice.percent(85) {
                    let effects =
                        if self.dice.percent(60) { vec![self.effect(room, visible, true)] } else { Vec::new() };
                    annotations.effects.insert(SUCCESS.to_owned(), effects);
                }
            }
            _ => {
                annotations.reads = (!room.is_alone || self.dice.percent(80)).then(|| facts(self, 2));
                let actuator = self.dice.one_of(&room.actuators).copied().unwrap_or("Arm");
                annotations.resources = vec![block(actuator)];
                if room.is_alone && self.dice.percent(20) {
                    let operation = match self.dice.below(4) {
                        0 => ResourceOperation::Exists,
                        1 => ResourceOperation::Consume,
                        2 => ResourceOperation::Delete,
                        _ => ResourceOperation::Create,
                    };
                    annotations.resources.push(task_resource(operation));
                }
                if !room.is_alone || self.dice.percent(85) {
                    let count = self.dice.below(3);
                    let effects = (0..count).map(|_| self.effect(room, visible, true)).collect();
                    annotations.effects.insert(SUCCESS.to_owned(), effects);
                }
                if !room.is_alone || self.dice.percent(30) {
                    let effect = self.effect(room, &Visible::default(), false);
                    annotations.effects.insert(ABORTED.to_owned(), vec![effect]);
                }
                if self.features.weak {
                    annotations.exceptions = match self.dice.below(4) {
                        0 => Some(Exceptions::Imprecise),
                        1 => Some(Exceptions::Precise),
                        _ => None,
                    };
                    annotations.resources[0].unordered = self.dice.percent(30);
                }
            }
        }
        if custom {
            for outcome in [FOUND, EMPTY, AGAIN] {
                let must = !room.is_alone && annotations.nature != Nature::Computes;
                if must || (self.features.effects && self.dice.percent(60)) {
                    let effects = (0..self.dice.below(2)).map(|_| self.effect(room, visible, true)).collect();
                    annotations.effects.insert(outcome.to_owned(), effects);
                }
            }
        }
        if !room.is_alone && self.features.incidents {
            annotations.effects.insert(STOPPED.to_owned(), Vec::new());
        }
        if !room.is_alone && annotations.nature == Nature::Irreversible {
            // The outcome `preempted`, too, must not write facts of another region.
            annotations.effects.insert("preempted".to_owned(), Vec::new());
        }
        if !room.is_preemptive && self.dice.percent(10) {
            let required = self.required(room, visible);
            annotations.requires.push(required);
        }
        if self.features.retries && !room.is_preemptive {
            if self.dice.percent(20) {
                let backoff_s = if self.dice.percent(50) { 0.0 } else { 0.5 };
                annotations.retry = Some(Retry { count: 1 + self.dice.below(2) as u32, backoff_s });
            }
            if self.dice.percent(10) {
                annotations.timeout_s = Some(crate::oracle::TIMEOUT_S);
            }
        }
        if !room.is_preemptive {
            self.supplies(&mut annotations, room, visible);
            self.estimates(&mut annotations, visible);
        }
        annotations
    }

    /// A precondition that is true more often than not.
    pub(super) fn required(&mut self, room: &Room, visible: &Visible) -> Expr {
        if self.features.blind {
            return Expr::Literal(Value::Bool(true));
        }
        if self.features.facts && self.dice.percent(30) {
            return self.query(room, visible);
        }
        let fact = self.fact(&room.readable, visible);
        let number = |n: i64| Box::new(Expr::Literal(Value::Int(n)));
        let not = |e: Expr| Expr::Unary(UnaryOperator::Not, Box::new(e));
        match self.dice.below(4) {
            // A numeric condition; an absent fact is no number.
            0 if self.features.effects => {
                let less = Expr::Binary(BinaryOperator::Less, Box::new(Expr::Fact(fact.clone())), number(3));
                Expr::Binary(BinaryOperator::Or, Box::new(not(Expr::Exists(fact))), Box::new(less))
            }
            1 if self.features.effects => not(Expr::Exists(fact)),
            _ => not(Expr::Binary(BinaryOperator::Equal, Box::new(Expr::Fact(fact)), number(1))),
        }
    }
}

/// A block of one unit.
pub(super) fn block(kind: &str) -> ResourceExpr {
    resource(ResourceOperation::Block, kind, 1)
}

pub(super) fn resource(operation: ResourceOperation, kind: &str, count: u32) -> ResourceExpr {
    ResourceExpr { count: count.into(), ..ResourceExpr::new(operation, kind) }
}

pub(super) fn task_resource(operation: ResourceOperation) -> ResourceExpr {
    ResourceExpr { class: Some(ResourceClass::Task), ..resource(operation, PART, 1) }
}
