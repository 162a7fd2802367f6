//! Which groups of a family a resource may fit, found without asking each of them.
//!
//! A group that wants an attribute to have a value is filed under that name and value; of several, under the one with the fewest others
//! beside it. A resource is then compared with the groups that are filed under what it says itself, and with those that are filed under
//! nothing (conditions alone, values that are neither a truth value, a number nor a text). What is found may fit, and nothing
//! else does.

use crate::group::Key;
use crate::resource::Description;
use ratn_model::resource::Requirement;
use ratn_model::value::Value;
use std::collections::{BTreeMap, BTreeSet};

/// See the module.
#[derive(Debug, Clone, Default)]
pub(crate) struct Selectors {
    by_attribute: BTreeMap<String, BTreeMap<Wanted, BTreeSet<Key>>>,
    others: BTreeSet<Key>,
}

/// Where a group is filed: under the value of an attribute, or under nothing.
pub(crate) type Place = Option<(String, Wanted)>;

/// A value: equal values are filed alike, and some that are not equal, too.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Wanted {
    Bool(bool),
    /// The bits of a float; a whole number equals a float of that size.
    Number(u64),
    Text(String),
}

impl Wanted {
    fn of(value: &Value) -> Option<Wanted> {
        match value {
            Value::Bool(value) => Some(Wanted::Bool(*value)),
            // Adding zero makes one zero of the two.
            Value::Int(_) | Value::Float(_) => value.as_number().map(|number| Wanted::Number((number + 0.0).to_bits())),
            Value::String(text) => Some(Wanted::Text(text.clone())),
            _ => None,
        }
    }
}

impl Selectors {
    /// Files a group; where, for [`Selectors::remove`].
    pub(crate) fn insert(&mut self, key: &Key, selector: &Requirement) -> Place {
        let places = selector.attributes.iter().filter_map(|(name, value)| Some((name.clone(), Wanted::of(value)?)));
        let beside = |(name, wanted): &(String, Wanted)| {
            self.by_attribute.get(name).and_then(|values| values.get(wanted)).map_or(0, BTreeSet::len)
        };
        let place = places.min_by_key(beside);
        match &place {
            Some((name, wanted)) => {
                let values = self.by_attribute.entry(name.clone()).or_default();
                values.entry(wanted.clone()).or_default().insert(key.clone());
            }
            None => drop(self.others.insert(key.clone())),
        }
        place
    }

    pub(crate) fn remove(&mut self, key: &Key, place: &Place) {
        let Some((name, wanted)) = place else {
            self.others.remove(key);
            return;
        };
        let Some(values) = self.by_attribute.get_mut(name) else { return };
        if let Some(keys) = values.get_mut(wanted) {
            keys.remove(key);
            if keys.is_empty() {
                values.remove(wanted);
            }
        }
        if values.is_empty() {
            self.by_attribute.remove(name);
        }
    }

    /// Those that a resource of this description may fit, each once.
    pub(crate) fn candidates<'a>(&'a self, description: &'a Description) -> impl Iterator<Item = &'a Key> + 'a {
        let host = description.attributes.get("host").is_none().then_some("host");
        let names = description.attributes.iter().map(|(name, _)| name).chain(host);
        let filed = names.filter_map(|name| {
            let values = self.by_attribute.get(name)?;
            values.get(&Wanted::of(description.attribute(name)?.as_ref())?)
        });
        self.others.iter().chain(filed.flatten())
    }
}
