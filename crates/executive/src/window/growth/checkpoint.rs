//! The growth's part of a checkpoint: the places of its cursors and of the ends of regions.

use super::Growth;
use super::environment::{Collector, Restored};
use crate::checkpoint::Broken;

impl Growth {
    /// Collects what its cursors share.
    pub(crate) fn collect<'a>(&'a self, places: &mut Collector<'a>) {
        self.cursors.iter().for_each(|cursor| places.add(&cursor.environment));
        self.regions.values().for_each(|regions| regions.collect(places));
    }

    /// Restores the environments and producers of its cursors.
    pub(crate) fn restore(&mut self, places: &mut Restored) -> Result<(), Broken> {
        for cursor in &mut self.cursors {
            cursor.environment = places.environment()?;
        }
        self.regions.values_mut().try_for_each(|regions| regions.restore(places))
    }
}
