//! Task resources, counted as sums per kind.

use super::evaluate::{Place, Read, wrong};
use super::{Fail, Reference};
use ratn_model::condition::Comparison;
use ratn_model::program::{ResourceExpr, State, StateKind};
use ratn_model::resource::ResourceOperation as Operation;
use ratn_model::value::Value;

impl Reference<'_> {
    /// Checks the requirements of an action or of a whole routine: selectors have values, and required resources exist.
    pub(super) fn asks(&mut self, state: &State, variables: &[(String, Value)]) -> Result<(), Fail> {
        let program = self.program;
        let mut wanted: Vec<&ResourceExpr> = Vec::new();
        let mut open = vec![state];
        while let Some(inner) = open.pop() {
            let is_action = matches!(inner.kind, StateKind::Action { .. });
            wanted.extend(inner.annotations.resources.iter().filter(|line| match line.operation {
                Operation::Block | Operation::Exists => true,
                Operation::Consume => is_action,
                Operation::Create | Operation::Delete => false,
            }));
            open.extend(inner.children().map(|child| program.state(child)));
        }
        let around = std::iter::successors(state.parent, |id| program.state(*id).parent);
        let blocks = around.flat_map(|id| &program.state(id).annotations.resources);
        wanted.extend(blocks.filter(|line| line.operation == Operation::Block));
        self.selected(&wanted, variables, None)?;
        if !wanted.is_empty() && self.refused.contains(&state.path) {
            return wrong("it is refused");
        }
        for line in wanted {
            match line.operation {
                Operation::Consume => self.take(line)?,
                Operation::Exists
                    if self.result.units.get(&line.kind).is_some_and(|u| *u < line.count.thousandths()) =>
                {
                    return Err(Fail::NotMine("a resource that is not there"));
                }
                _ => {}
            }
        }
        Ok(())
    }

    /// Creates and deletes a state's resources at its end; a composite state also consumes then.
    pub(super) fn operates(
        &mut self,
        state: &State,
        variables: &[(String, Value)],
        own: &super::Outputs,
    ) -> Result<(), Fail> {
        let is_action = matches!(state.kind, StateKind::Action { .. });
        let lines = state.annotations.resources.iter().filter(|line| match line.operation {
            Operation::Create | Operation::Delete => true,
            Operation::Consume => !is_action,
            Operation::Block | Operation::Exists => false,
        });
        let lines: Vec<&ResourceExpr> = lines.collect();
        self.selected(&lines, variables, Some(own))?;
        for line in lines {
            if line.operation == Operation::Create {
                *self.result.units.entry(line.kind.clone()).or_default() += line.count.thousandths();
            } else {
                self.take(line)?;
            }
        }
        Ok(())
    }

    /// Evaluates every selector; which resource it selects does not matter here.
    fn selected(
        &self,
        lines: &[&ResourceExpr],
        variables: &[(String, Value)],
        own: Option<&super::Outputs>,
    ) -> Result<(), Fail> {
        let place: Place<'_> = self.place(variables, own);
        for line in lines {
            for (_, value) in &line.attributes {
                value.read(&place)?;
            }
            for condition in &line.conditions {
                let value = condition.value.read(&place)?;
                if condition.comparison == Comparison::In && !matches!(value, Value::List(_)) {
                    return wrong("`in` what is no list");
                }
            }
        }
        Ok(())
    }

    fn take(&mut self, line: &ResourceExpr) -> Result<(), Fail> {
        // Only task resources are counted.
        let Some(units) = self.result.units.get_mut(&line.kind) else { return Ok(()) };
        let left = units.checked_sub(line.count.thousandths());
        *units = left.ok_or(Fail::NotMine("a resource that is not there"))?;
        Ok(())
    }
}
