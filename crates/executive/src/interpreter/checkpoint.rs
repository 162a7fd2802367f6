//! The interpreter's part of a checkpoint: its threads with their shared variables, and its projection as the difference
//! from the root.

use super::{Interpreter, Target, Thread};
use crate::checkpoint::{Pool, at};
use ratn_model::fact::{Change, FactPattern};
use ratn_model::value::Value;
use ratn_world::world::{Fact, World};
use serde::de::Error;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::cmp::Ordering;
use std::collections::BTreeMap;
use std::sync::Arc;

/// The shared values, and per thread the names of its variables with the places of their values.
type Form<V, T, N> = (Vec<V>, Vec<(u64, T, Vec<(N, u32)>)>);

/// Keeps which threads share a value: a join recognizes an assignment by a value that is not shared.
pub(super) fn serialize<S: Serializer>(threads: &BTreeMap<u64, Thread>, to: S) -> Result<S::Ok, S::Error> {
    let mut values: Pool<&Value> = Pool::default();
    let mut forms = Vec::new();
    for (id, thread) in threads {
        let mut variables = Vec::with_capacity(thread.variables.len());
        for (name, value) in &thread.variables {
            let place = match values.find(value) {
                Some(place) => place,
                None => values.add(value, &**value),
            };
            variables.push((name.as_str(), place));
        }
        forms.push((*id, thread, variables));
    }
    let form: Form<&Value, &Thread, &str> = (values.into_forms(), forms);
    form.serialize(to)
}

pub(super) fn deserialize<'d, D: Deserializer<'d>>(from: D) -> Result<BTreeMap<u64, Thread>, D::Error> {
    let (values, forms): Form<Value, Thread, String> = Form::deserialize(from)?;
    let values: Vec<Arc<Value>> = values.into_iter().map(Arc::new).collect();
    let mut threads = BTreeMap::new();
    for (id, mut thread, variables) in forms {
        for (name, place) in variables {
            thread.variables.push((name, at(&values, place, "a variable without a value").map_err(D::Error::custom)?));
        }
        threads.insert(id, thread);
    }
    Ok(threads)
}

impl Interpreter {
    /// The world of its projection, if it works on a projection.
    pub(crate) fn projection(&self) -> Option<&World> {
        match &self.target {
            Target::Actual => None,
            Target::Projection { world, .. } => Some(world),
        }
    }

    pub(crate) fn set_projection(&mut self, projection: World) {
        if let Target::Projection { world, .. } = &mut self.target {
            *world = projection;
        }
    }
}

pub(crate) fn difference(root: &World, world: &World) -> Vec<Change> {
    let mut changes = Vec::new();
    let (mut root, mut world) = (root.iter().peekable(), world.iter().peekable());
    loop {
        let order = match (root.peek(), world.peek()) {
            (Some((before, _)), Some((after, _))) => before.cmp(after),
            (Some(_), None) => Ordering::Less,
            (None, Some(_)) => Ordering::Greater,
            (None, None) => return changes,
        };
        let before = if order == Ordering::Greater { None } else { root.next() };
        let after = if order == Ordering::Less { None } else { world.next() };
        match (before, after) {
            (Some((key, _)), None) => changes.push(Change::Delete { pattern: FactPattern::of(key) }),
            (before, Some((key, fact))) if before.is_none_or(|(_, before)| !is_same(before, fact)) => {
                changes.push(Change::Set { fact: key.clone(), value: fact.value.clone() });
            }
            _ => {}
        }
    }
}

/// NaN is not equal to itself; such a fact is written once more.
fn is_same(a: &Fact, b: &Fact) -> bool {
    std::ptr::eq(a, b) || a.value == b.value
}
