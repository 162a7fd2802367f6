//! Reads `effects` of a state and `world` of a task.
//!
//! A list (or one text) holds for success; a mapping has a list per outcome. An item is an effect as text, or `{for: b
//! in boxes, do: [...]}`; instead of `do` one of `set`, `delete`, `increase` or `decrease` with one text is allowed.

use super::fields::Fields;
use super::outline::header;
use super::yaml::{Content, Entry, Node};
use crate::expression::EffectExpr;
use crate::expression::parse::{parse_effect, parse_expression};
use crate::program::SUCCESS;
use std::collections::BTreeMap;

/// Keys that replace `do` with one effect.
const VERBS: [&str; 4] = ["set", "delete", "increase", "decrease"];

pub(crate) fn by_outcome(fields: &mut Fields<'_, '_>, node: &Node) -> BTreeMap<String, Vec<EffectExpr>> {
    let mut effects = BTreeMap::new();
    match &node.content {
        Content::Map(outcomes) if node.get("for").is_none() => {
            for Entry { key, at, value } in outcomes {
                fields.note(format!("effects.{key}"), *at);
                effects.insert(key.clone(), list(fields, value));
            }
        }
        _ => {
            fields.note(format!("effects.{SUCCESS}"), node.at);
            effects.insert(SUCCESS.to_owned(), list(fields, node));
        }
    }
    effects
}

/// Reads a list of effects; an effect that cannot be parsed is reported and left out.
pub(crate) fn list(fields: &mut Fields<'_, '_>, node: &Node) -> Vec<EffectExpr> {
    node.items().into_iter().filter_map(|item| effect(fields, item)).collect()
}

fn effect(fields: &mut Fields<'_, '_>, item: &Node) -> Option<EffectExpr> {
    let Content::Map(entries) = &item.content else { return fields.effect(item) };
    let Some(for_each) = item.get("for") else {
        let message = "expected an effect as text or `{for: variable in list, do: [...]}`";
        fields.error("invalid-expression", item.at, message, "quote an effect that contains `: ` or a comma");
        return None;
    };
    fields.keys(item, &["for", "do", "set", "delete", "increase", "decrease"]);
    let path = fields.path.clone();
    let (variable, head) = header(for_each, &path, &mut fields.out.findings)?;
    let collection = fields.parsed(head.node, &head.collection, head.offset, parse_expression)?;
    fields.view.variables.push(variable.clone());
    let mut effects = item.get("do").map(|node| list(fields, node)).unwrap_or_default();
    for entry in entries.iter().filter(|entry| VERBS.contains(&entry.key.as_str())) {
        let Content::Text(text) = &entry.value.content else {
            fields.error("invalid-expression", entry.at, "expected an effect as text", "");
            continue;
        };
        effects.extend(fields.parsed(&entry.value, &format!("{} {text}", entry.key), 0, parse_effect));
    }
    fields.view.variables.pop();
    Some(EffectExpr::ForEach { variable, collection, effects })
}
