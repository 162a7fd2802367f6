//! Resources that are selected by attributes, divisible, scarce, or not renewable.

use super::*;
use crate::{BATTERY, POWER};
use ratn_model::condition::{Comparison, ConditionExpr};
use ratn_model::program::{Nature, ResourceExpr};
use ratn_model::resource::Quantity;

impl Maker {
    /// Further resources that a node requires.
    pub(super) fn supplies(&mut self, annotations: &mut Annotations, room: &Room, visible: &Visible) {
        if !self.features.supplies {
            return;
        }
        if self.dice.percent(15) {
            let tool = self.tool(visible);
            annotations.resources.push(tool);
        }
        if self.dice.percent(15) {
            let part = [250, 500, 1_250, 1_500][self.dice.below(4) as usize];
            let count = Quantity::from_thousandths(part);
            annotations.resources.push(ResourceExpr { count, ..block(POWER) });
        }
        if room.is_alone && annotations.nature == Nature::Irreversible && self.dice.percent(12) {
            let count = Quantity::from_thousandths(125 * (1 + self.dice.below(4)));
            let battery = ResourceExpr { count, ..resource(ResourceOperation::Consume, BATTERY, 1) };
            annotations.resources.push(battery);
        }
    }

    /// One of three tools, selected by its attributes; one always matches.
    fn tool(&mut self, visible: &Visible) -> ResourceExpr {
        let mut tool = block(TOOL);
        let condition = |comparison, value| ConditionExpr { attribute: "level".to_owned(), comparison, value };
        let number = |n: i64| Expr::Literal(Value::Int(n));
        match self.dice.below(6) {
            0 => tool.conditions.push(condition(Comparison::GreaterOrEqual, number(2))),
            1 => tool.conditions.push(condition(Comparison::In, Expr::List(vec![number(1), number(3)]))),
            2 => tool.conditions.push(ConditionExpr {
                attribute: "cuts".to_owned(),
                comparison: Comparison::Has,
                value: Expr::Literal(Value::Null),
            }),
            3 if !visible.ports.is_empty() => {
                let state = visible.ports[self.dice.below(visible.ports.len() as u64) as usize];
                let x = Box::new(Expr::Port { state, port: "x".to_owned() });
                let is = Expr::Binary(BinaryOperator::Equal, x, Box::new(number(1)));
                let level = Expr::Call(Function::If, vec![is, number(2), number(3)]);
                tool.attributes.push(("level".to_owned(), level));
            }
            4 if !visible.variables.is_empty() => {
                let name = self.dice.one_of(&visible.variables).cloned().unwrap_or_default();
                let is = Expr::Binary(BinaryOperator::Equal, Box::new(Expr::Variable(name)), Box::new(number(1)));
                let level = Expr::Call(Function::If, vec![is, number(1), number(2)]);
                tool.attributes.push(("level".to_owned(), level));
            }
            _ => tool.attributes.push(("level".to_owned(), number(1 + self.dice.below(3) as i64))),
        }
        tool
    }
}

/// A routine acquires everything inside at once, and no two tools are alike: each routine uses only one.
pub(super) fn one_tool_per_routine(program: &mut Program) {
    let mut chosen: BTreeMap<StateId, ResourceExpr> = BTreeMap::new();
    for at in 0..program.states.len() {
        let state = &program.states[at];
        let outermost = around(program, state).filter(|state| state.is_routine()).last().map(|state| state.id);
        let Some(routine) = outermost else { continue };
        let tools = program.states[at].annotations.resources.extract_if(.., |r| r.kind == TOOL);
        for tool in tools.collect::<Vec<_>>() {
            let same = chosen.entry(routine).or_insert_with(|| tool.clone()).selects_the_same(&tool);
            // A routine's selectors are evaluated before it begins, so they must be constants.
            let is_constant = tool.attributes.iter().all(|(_, value)| matches!(value, Expr::Literal(_)));
            if same && is_constant {
                program.states[at].annotations.resources.push(tool);
            }
        }
    }
}
