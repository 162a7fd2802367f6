//! `resources` of a state: `{block: Arm}`, `{create: BoxDelivered, class: task, with: {box: $box.id}}`, `world_model`.

use super::fields::Fields;
use super::yaml::{Content, Entry, Node};
use crate::condition::ConditionExpr;
use crate::expression::Expr;
use crate::program::{ResourceExpr, WORLD_MODEL};
use crate::resource::{Quantity, ResourceClass, ResourceOperation};

const OPERATIONS: [(&str, ResourceOperation); 5] = [
    ("block", ResourceOperation::Block),
    ("consume", ResourceOperation::Consume),
    ("create", ResourceOperation::Create),
    ("delete", ResourceOperation::Delete),
    ("exists", ResourceOperation::Exists),
];

const CLASSES: [(&str, ResourceClass); 5] = [
    ("system", ResourceClass::System),
    ("process", ResourceClass::Process),
    ("module", ResourceClass::Module),
    ("world", ResourceClass::World),
    ("task", ResourceClass::Task),
];

/// Reads the lines of `resources`; a line that cannot be parsed is reported and left out.
pub(crate) fn list(fields: &mut Fields<'_, '_>, node: &Node) -> Vec<ResourceExpr> {
    let mut resources = Vec::new();
    for item in node.items() {
        if let Some(resource) = resource(fields, item) {
            fields.note(format!("resources.{}", resources.len()), item.at);
            resources.push(resource);
        }
    }
    resources
}

fn resource(fields: &mut Fields<'_, '_>, item: &Node) -> Option<ResourceExpr> {
    if matches!(item.content, Content::Text(_)) {
        let word = fields.resource_kind(item)?;
        let kind = if word == "world_model" { WORLD_MODEL } else { word }.to_owned();
        return Some(ResourceExpr::new(ResourceOperation::Block, kind));
    }
    let expected = "write `{block: Arm}` with one of block, consume, create, delete, exists";
    let operations: Vec<(&Entry, ResourceOperation)> = item
        .entries()
        .iter()
        .filter_map(|entry| OPERATIONS.iter().find(|(name, _)| *name == entry.key).map(|(_, op)| (entry, *op)))
        .collect();
    let [(entry, operation)] = operations.as_slice() else {
        fields.error("invalid-state", item.at, "a resource has exactly one operation", expected);
        return None;
    };
    fields.keys(
        item,
        &[
            "block",
            "consume",
            "create",
            "delete",
            "exists",
            "class",
            "count",
            "divisible",
            "where",
            "with",
            "hold",
            "unordered",
        ],
    );
    if let Some(node) = item.get("divisible").filter(|_| *operation != ResourceOperation::Create) {
        let help = "leave it out: what is there already says so itself";
        fields.error("conflicting-annotations", node.at, "`divisible` is said of a `create`", help);
    }
    for key in ["hold", "unordered"] {
        if let Some(node) = item.get(key).filter(|_| *operation != ResourceOperation::Block) {
            let help = "leave it out: nothing of it is held while the state runs";
            fields.error("conflicting-annotations", node.at, format!("`{key}` is said of a `block`"), help);
        }
    }
    let kind = fields.resource_kind(&entry.value)?.to_owned();
    let count = item.get("count").map_or(Some(Quantity::ONE), |node| fields.quantity(node, "count"))?;
    let divisible = item.get("divisible").is_some_and(|node| fields.flag(node));
    let class = match item.get("class") {
        None => None,
        Some(node) => {
            let name = fields.word(node, "a class")?;
            let class = CLASSES.iter().find(|(known, _)| *known == name).map(|(_, class)| *class);
            if class.is_none() {
                let message = format!("there is no resource class `{name}`");
                fields.error("unknown-resource", node.at, message, "system, process, module, world or task");
            }
            class
        }
    };
    let attributes = item.get("where").into_iter().chain(item.get("with")).flat_map(Node::entries);
    let attributes: Vec<(String, Option<Expr>)> =
        attributes.map(|attribute| (attribute.key.clone(), fields.expression(&attribute.value))).collect();
    let attributes = attributes.into_iter().filter_map(|(name, value)| Some((name, value?))).collect();
    let list = item.get("where").filter(|node| !matches!(node.content, Content::Map(_)));
    let lines = list.map_or_else(Vec::new, Node::items);
    let conditions: Vec<Option<ConditionExpr>> = lines.iter().map(|line| condition(fields, line)).collect();
    let conditions: Vec<ConditionExpr> = conditions.into_iter().flatten().collect();
    if *operation == ResourceOperation::Create && !lines.is_empty() {
        let help = "give it attributes: `with: {payload: 2.5}`";
        fields.error("invalid-state", item.at, "what is created is not chosen by conditions", help);
    }
    let unordered = item.get("unordered").is_some_and(|node| fields.flag(node));
    Some(ResourceExpr { operation: *operation, kind, class, attributes, conditions, count, divisible, unordered })
}

/// `payload >= 2.5`, `tool in [gripper, welder]`, `has camera`.
fn condition(fields: &mut Fields<'_, '_>, line: &Node) -> Option<ConditionExpr> {
    if let Content::Text(text) = &line.content
        && let Some(condition) = ConditionExpr::presence(text)
    {
        return Some(condition);
    }
    if let Some(condition) = ConditionExpr::comparison(fields.expression(line)?) {
        return Some(condition);
    }
    let help = ConditionExpr::WRITTEN;
    fields.error("invalid-expression", line.at, "this is no condition on an attribute", help);
    None
}
