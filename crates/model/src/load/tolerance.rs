//! Reads `tolerance` of a task: the difference within which a measured value counts as the predicted one.
//!
//! One number (for numbers and joints), or `{number, position, angle, predicates: {name: the same}}`. The ontology's
//! tolerances hold for predicates that the task does not mention.

use super::fields::Fields;
use super::names::suggestion;
use super::yaml::{Content, Node};
use crate::tolerance::{Deviation, Tolerances};

const KEYS: [&str; 3] = ["number", "position", "angle"];

pub(super) fn tolerances(fields: &mut Fields<'_, '_>, root: &Node) -> Tolerances {
    let mut tolerances = Tolerances::default();
    if let Some(node) = root.get("tolerance") {
        tolerances.default = deviation(fields, node, true);
        for entry in node.get("predicates").map(Node::entries).unwrap_or_default() {
            if let Some(ontology) = &fields.task.ontology
                && ontology.predicate(&entry.key).is_none()
            {
                let message = format!("the ontology has no predicate `{}`", entry.key);
                let known = ontology.predicates().map(|(name, _)| name);
                let help = suggestion(&entry.key, known, "", "declare it in the ontology");
                fields.error("unknown-predicate", entry.at, message, help);
            }
            let own = deviation(fields, &entry.value, false);
            tolerances.predicates.insert(entry.key.clone(), own);
        }
    }
    match &fields.task.ontology {
        Some(ontology) => ontology.tolerances(tolerances),
        None => tolerances,
    }
}

fn deviation(fields: &mut Fields<'_, '_>, node: &Node, of_task: bool) -> Deviation {
    match &node.content {
        Content::Map(_) => {
            let known: Vec<&str> = KEYS.into_iter().chain(of_task.then_some("predicates")).collect();
            fields.keys(node, &known);
            let mut of = |key: &str| node.get(key).and_then(|node| number(fields, node));
            Deviation { number: of("number"), position_m: of("position"), angle_rad: of("angle") }
        }
        _ => Deviation { number: number(fields, node), ..Deviation::default() },
    }
}

fn number(fields: &mut Fields<'_, '_>, node: &Node) -> Option<f64> {
    let number = match node.content {
        Content::Int(i) => Some(i as f64),
        Content::Float(x) => Some(x),
        _ => None,
    };
    let number = number.filter(|x| x.is_finite() && *x >= 0.0);
    if number.is_none() {
        let help =
            "write `tolerance: 0.01`, or `{number: 0.01, position: 0.015, angle: 0.09, predicates: {…}}`: m, rad";
        fields.error("type-mismatch", node.at, "a tolerance is a number from 0", help);
    }
    number
}
