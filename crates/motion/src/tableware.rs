//! The tableware in a cell: a rack on the table, rows of places on it, and rows of target places on the table.
//!
//! This is `[workplace.tableware]` of a `robot.toml`; a robot without it has no such scene. Metres in the world frame. Rows are along y: those on the
//! rack to the right, those on the table to the left.

use crate::workplace::Slab;
use serde::Deserialize;

/// See the module's description.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tableware {
    /// The rack's board, on the table.
    pub rack: Slab,
    /// The region of the rack to which an injected fault moves objects.
    pub region: Region,
    /// The rows of bowls.
    pub bowls: Rows,
    /// The rows of forks, which point along x.
    pub forks: Rows,
    /// The rows of cups.
    pub cups: Rows,
    /// The row of plates, which lie on the table from the beginning.
    pub plates: Row,
    /// Distance between neighbouring places of a row of bowls, forks or cups.
    pub between: f64,
}

/// A rectangle.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Region {
    /// Minimum and maximum x.
    pub x: [f64; 2],
    /// Minimum and maximum y.
    pub y: [f64; 2],
}

/// The rows of places for objects of a kind: x and y of the first place of each.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rows {
    /// On the rack.
    pub rack: [f64; 2],
    /// On the table.
    pub table: [f64; 2],
}

/// A row of places on the table.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Row {
    /// x and y of its first place.
    pub table: [f64; 2],
    /// Distance between neighbouring places.
    pub between: f64,
}

impl Tableware {
    /// An error in it, if any.
    pub(crate) fn fault(&self, table: &Slab) -> Option<String> {
        let Tableware { rack, region: Region { x, y }, bowls, forks, cups, plates, between } = self;
        let on_rack = [bowls, forks, cups].map(|rows| rows.rack);
        let on_table = [bowls.table, forks.table, cups.table, plates.table];
        let numbers = [rack.centre.as_slice(), &rack.size, x, y, on_rack.as_flattened(), on_table.as_flattened()];
        if numbers.concat().iter().chain([between, &plates.between]).any(|number| !number.is_finite()) {
            Some("`tableware` has a number that is not finite".to_owned())
        } else if rack.size.iter().any(|edge| *edge <= 0.0) || *between <= 0.0 || plates.between <= 0.0 {
            Some("`tableware.rack.size` and what is `between` places are above 0".to_owned())
        } else if x[0] > x[1] || y[0] > y[1] {
            Some("`tableware.region.x` and `.y` are each a least and a greatest value".to_owned())
        } else if let Some([x, y]) = on_rack.into_iter().find(|[x, y]| !rack.holds(*x, *y)) {
            Some(format!("a row of `tableware` begins on the rack at ({x}, {y}), which is beyond the rack"))
        } else if let Some([x, y]) = on_table.into_iter().find(|[x, y]| !table.holds(*x, *y)) {
            Some(format!("a row of `tableware` begins on the table at ({x}, {y}), which is beyond the table"))
        } else {
            None
        }
    }
}
