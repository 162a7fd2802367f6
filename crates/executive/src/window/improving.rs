//! Results that are still being improved: the goals that go on, what they hold, and the best results so far.

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

/// The goals that go on although they have a result, by instance. The instance may have retired.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(crate) struct Improving(BTreeMap<InstanceId, Improvement>);

/// A goal that goes on improving its result.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct Improvement {
    pub(crate) state: StateId,
    pub(crate) attempt: u32,
    pub(crate) held: Held,
    /// The facts that it goes on sensing, if it senses.
    pub(crate) senses: Footprint,
    /// The producer that stores its outputs.
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

    /// Whether this attempt of an instance is still improving.
    pub(crate) fn is(&self, id: InstanceId, attempt: u32) -> bool {
        self.0.get(&id).is_some_and(|improvement| improvement.attempt == attempt)
    }

    pub(crate) fn has(&self, id: InstanceId) -> bool {
        self.0.contains_key(&id)
    }

    pub(crate) fn get_mut(&mut self, id: InstanceId) -> Option<&mut Improvement> {
        self.0.get_mut(&id)
    }

    /// The goal stops improving.
    pub(crate) fn end(&mut self, id: InstanceId) -> Option<Improvement> {
        self.0.remove(&id)
    }

    /// All of them, oldest instance first.
    pub(crate) fn iter(&self) -> impl Iterator<Item = (InstanceId, &Improvement)> {
        self.0.iter().map(|(id, improvement)| (*id, improvement))
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Collects their producers for a checkpoint.
    pub(crate) fn collect<'a>(&'a self, places: &mut Collector<'a>) {
        self.0.values().for_each(|improvement| places.add_producer(&improvement.producer));
    }

    /// Restores their producers.
    pub(crate) fn restore(&mut self, places: &mut Restored) -> Result<(), Broken> {
        for (id, improvement) in &mut self.0 {
            improvement.producer = places.producer()?;
            if improvement.producer.instance != *id {
                return Err("a result that gets better with the outputs of another");
            }
        }
        Ok(())
    }

    /// Checks that every improving instance has a result.
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
