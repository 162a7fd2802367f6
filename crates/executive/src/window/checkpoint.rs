//! The window's part of a checkpoint: its own fields, plus what its places share, plus the projections of its routines as differences
//! from the root.

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

/// The parts of a window that are stored beside its own fields.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct Beside<'a> {
    places: Places<'a>,
    /// By routine under way on a projection, oldest first: base and changes.
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

    /// Restores the window from its own fields and these parts.
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
