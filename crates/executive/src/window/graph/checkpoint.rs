//! The graph's part of a checkpoint: the places of its instances, and the projections of its routines.

use super::Graph;
use super::instance::{Body, Node, Status};
use crate::checkpoint::Broken;
use crate::interpreter::Interpreter;
use crate::window::growth::environment::{Collector, Restored};

impl Graph {
    /// Collects what its instances share.
    pub(crate) fn collect<'a>(&'a self, places: &mut Collector<'a>) {
        for instance in self.iter() {
            places.add(&instance.environment);
            instance.producer.iter().for_each(|producer| places.add_producer(producer));
        }
    }

    /// Restores the environments and producers of its instances.
    pub(crate) fn restore(&mut self, places: &mut Restored) -> Result<(), Broken> {
        for instance in self.instances.iter_mut() {
            instance.environment = places.environment()?;
            if let Some(producer) = &mut instance.producer {
                *producer = places.producer()?;
                if producer.instance != instance.id {
                    return Err("an instance with the outputs of another");
                }
            }
        }
        Ok(())
    }

    /// Routines under way, oldest first.
    pub(crate) fn routines(&self) -> impl Iterator<Item = &Interpreter> {
        self.iter().filter_map(|instance| match &instance.node()?.status {
            Status::RunningRoutine(interpreter, _) => Some(&**interpreter),
            _ => None,
        })
    }

    pub(crate) fn routines_mut(&mut self) -> impl Iterator<Item = &mut Interpreter> {
        self.instances.iter_mut().filter_map(|instance| match &mut instance.body {
            Body::Node(Node { status: Status::RunningRoutine(interpreter, _), .. }) => Some(&mut **interpreter),
            _ => None,
        })
    }
}
