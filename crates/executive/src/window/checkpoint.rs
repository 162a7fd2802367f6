//! The window's part of a checkpoint: itself, but for what its places share, which is beside it, and the projections of its routines,
//! which are what they have otherwise than the root.

use super::Window;
use super::growth::environment::{Collector, Places};
use crate::checkpoint::Broken;
use crate::interpreter::difference;
use crate::plan::Plan;
use ratn_model::fact::Change;
use ratn_model::id::Revision;
use ratn_model::tolerance::Tolerance;
use ratn_world::world::World;
use serde::{Deserialize, Serialize};

/// What a window is beside its own fields.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct Beside<'a> {
    places: Places<'a>,
    /// Of every routine under way that works on a projection, oldest first.
    projections: Vec<(Revision, Vec<Change>)>,
}

impl Window {
    pub(crate) fn beside(&self, root: &World) -> Beside<'_> {
        let mut places = Collector::default();
        self.graph.collect(&mut places);
        self.growth.collect(&mut places);
        self.improving.collect(&mut places);
        let projection = |world: &World| (world.revision(), difference(root, world));
        let projections = self.graph.routines().filter_map(|routine| routine.projection()).map(projection).collect();
        Beside { places: places.finish(), projections }
    }

    /// The window as it was, from its own fields.
    pub(crate) fn restore(
        &mut self,
        plan: &Plan,
        root: &World,
        tolerance: Tolerance,
        beside: Beside<'_>,
    ) -> Result<(), Broken> {
        self.tolerance = tolerance;
        let Beside { places, projections } = beside;
        let mut places = places.restored(plan)?;
        self.graph.restore(&mut places)?;
        self.growth.restore(&mut places)?;
        self.improving.restore(&mut places)?;
        places.finish()?;
        let mut projections = projections.into_iter();
        for routine in self.graph.routines_mut().filter(|routine| routine.projection().is_some()) {
            let (revision, changes) = projections.next().ok_or("a routine without its projection")?;
            let world = root.project(&changes).map_err(|_| "a projection that cannot be")?;
            routine.set_projection(world.numbered(revision));
        }
        if projections.next().is_some() { Err("a projection without its routine") } else { Ok(()) }
    }
}
