//! Results that are there and still get better: which goals go on, what they hold, the best that they have given.

use super::graph::Graph;
use super::graph::instance::Held;
use super::growth::environment::{Collector, Producer, Restored};
use crate::binding::Outputs;
use crate::checkpoint::Broken;
use ratn_model::fact::Footprint;
use ratn_model::id::{InstanceId, StateId};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::sync::Arc;

/// The goals that go on although their result is there, by instance. The instance may have retired.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(crate) struct Improving(BTreeMap<InstanceId, Improvement>);

/// A goal that goes on.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct Improvement {
    pub(crate) state: StateId,
    pub(crate) attempt: u32,
    pub(crate) held: Held,
    /// What it goes on looking at, if it senses.
    pub(crate) senses: Footprint,
    /// Where its outputs stand.
    #[serde(skip)]
    pub(crate) producer: Arc<Producer>,
    /// The best outputs since the first.
    pub(crate) best: Option<Outputs>,
}

impl Improving {
    /// A goal has given its first result and goes on.
    pub(crate) fn begin(&mut self, id: InstanceId, improvement: Improvement) {
        self.0.insert(id, improvement);
    }

    /// Whether this attempt of an instance goes on.
    pub(crate) fn is(&self, id: InstanceId, attempt: u32) -> bool {
        self.0.get(&id).is_some_and(|improvement| improvement.attempt == attempt)
    }

    pub(crate) fn has(&self, id: InstanceId) -> bool {
        self.0.contains_key(&id)
    }

    pub(crate) fn get_mut(&mut self, id: InstanceId) -> Option<&mut Improvement> {
        self.0.get_mut(&id)
    }

    /// It does not go on.
    pub(crate) fn end(&mut self, id: InstanceId) -> Option<Improvement> {
        self.0.remove(&id)
    }

    /// All of them, those that began first before the others.
    pub(crate) fn iter(&self) -> impl Iterator<Item = (InstanceId, &Improvement)> {
        self.0.iter().map(|(id, improvement)| (*id, improvement))
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// What they share with places of the program.
    pub(crate) fn collect<'a>(&'a self, places: &mut Collector<'a>) {
        self.0.values().for_each(|improvement| places.add_producer(&improvement.producer));
    }

    /// Gives back what they shared.
    pub(crate) fn restore(&mut self, places: &mut Restored) -> Result<(), Broken> {
        for (id, improvement) in &mut self.0 {
            improvement.producer = places.producer()?;
            if improvement.producer.instance != *id {
                return Err("a result that gets better with the outputs of another");
            }
        }
        Ok(())
    }

    /// What is wrong, if anything: what gets better is there.
    pub(crate) fn check_invariants(&self, graph: &Graph) -> Result<(), String> {
        for (id, improvement) in &self.0 {
            let is_there = match graph.get(*id) {
                Some(instance) => instance.outputs().is_some(),
                None => improvement.producer.real.get().is_some(),
            };
            if !is_there {
                return Err(format!("{id} gets better, and has no result"));
            }
        }
        Ok(())
    }
}
