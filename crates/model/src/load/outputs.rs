//! Reads `outputs` of composite states: the values of inner states that are visible after the state has ended.
//!
//! ```text
//! outputs:
//!   way: either(drive.way, reach.way)              the first that was written
//!   seen: { value: look.boxes, default: [] }       the default if the value was not written, or the state has not run
//!   all: { each: look.boxes, type: list<any> }     in a loop: a list with one value per iteration
//! ```

use super::fields::Fields;
use super::names::OfLoop;
use super::outline::{Form, Step};
use super::yaml::Node;
use crate::expression::{Expr, Function};
use crate::guard::Collected;
use crate::list::List;
use crate::program::TaskOutput;
use crate::value::{Type, Value};
use std::collections::BTreeMap;

/// Whether an output is written as a mapping.
pub(crate) fn is_long(node: &Node) -> bool {
    node.get("value").is_some() || node.get("each").is_some()
}

/// The outputs of a state.
pub(crate) fn read(fields: &mut Fields<'_, '_>, step: &Step<'_>) -> Vec<TaskOutput> {
    let Some(node) = step.body.get("outputs") else { return Vec::new() };
    let is_loop = matches!(step.form, Form::ForEach { .. } | Form::While { .. });
    let mut outputs = Vec::new();
    fields.view.inside = true;
    for entry in node.entries() {
        fields.note(format!("outputs.{}", entry.key), entry.at);
        let long = is_long(&entry.value);
        let each = entry.value.get("each").filter(|_| long);
        let ty = match entry.value.get("type") {
            Some(node) if long => super::declared_type(fields, node),
            _ => None,
        };
        if long {
            let what = if is_loop && each.is_some() { "each" } else { "value" };
            fields.keys(&entry.value, &["type", what, "default", "description"]);
        }
        let written = each.or_else(|| entry.value.get("value").filter(|_| long)).unwrap_or(&entry.value);
        fields.view.of_loop = if each.is_some() { OfLoop::All } else { OfLoop::Nothing };
        let Some(value) = fields.expression(written) else { continue };
        fields.view.of_loop = OfLoop::default();
        let (name, ty) = (entry.key.clone(), ty.unwrap_or(Type::Any));
        match fields.view.state.filter(|_| is_loop && each.is_some()) {
            Some(id) => {
                fields.out.guards.entry(id).or_default().collected.push(Collected { name: name.clone(), value });
                outputs.push(TaskOutput { name, ty, value: Expr::Literal(Value::List(List::new())) });
            }
            None => outputs.push(TaskOutput { name, ty, value }),
        }
    }
    fields.view.of_loop = OfLoop::default();
    fields.view.inside = false;
    outputs
}

/// Adds defaults: an output whose value was not written has its default.
pub(crate) fn with_defaults(outputs: &mut [TaskOutput], defaults: &BTreeMap<String, Value>) {
    for output in outputs.iter_mut().filter(|output| !output.value.flows().is_empty()) {
        if let Some(default) = defaults.get(&output.name) {
            let value = std::mem::replace(&mut output.value, Expr::Literal(Value::Null));
            output.value = Expr::Call(Function::Either, vec![value, Expr::Literal(default.clone())]);
        }
    }
}
