//! Whether what a result was made of has come true.
//!
//! A computing or sensing node begins in a world of predictions; what a motion measures may differ from what its effect
//! declared. When it retires, everything older is real: what it read then is compared with what it saw when it began,
//! however the difference came about. A result that was made of something else is not accepted.

use crate::window::Window;
use ratn_model::fact::{FactKey, Footprint};
use ratn_model::id::InstanceId;
use ratn_model::value::Value;
use ratn_world::world::World;
use std::collections::{BTreeMap, BTreeSet};

impl Window {
    /// The first fact that an instance saw otherwise than `world` says, by more than the tolerance, as a sentence.
    pub(super) fn deviation(&self, id: InstanceId, world: &World) -> Option<String> {
        let instance = self.instances.alive.get(&id)?;
        let read = instance.reads.clone().union(instance.senses.clone());
        let (saw, is) = (facts(&read, instance.seen.as_ref()?), facts(&read, world));
        let keys: BTreeSet<&FactKey> = saw.keys().chain(is.keys()).copied().collect();
        keys.into_iter().find_map(|key| {
            let (saw, is) = (saw.get(key).copied(), is.get(key).copied());
            let same = match (saw, is) {
                (Some(saw), Some(is)) => self.tolerance.equal(saw, is),
                (saw, is) => saw == is,
            };
            let said = |value: Option<&Value>| value.map_or("nothing".to_owned(), ToString::to_string);
            (!same).then(|| {
                format!(
                    "it was computed from {key} = {}, as predicted, and that came out as {}; run in HSM mode, or do not declare the \
                     effect's value",
                    said(saw),
                    said(is)
                )
            })
        })
    }
}

fn facts<'a>(footprint: &Footprint, world: &'a World) -> BTreeMap<&'a FactKey, &'a Value> {
    world.iter().filter(|(key, _)| footprint.contains(key)).map(|(key, fact)| (key, &fact.value)).collect()
}
