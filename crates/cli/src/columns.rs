//! Tables for people.

use crate::fitted::{padded, visible};
use ratn_model::readable::in_line;
use std::borrow::Cow;

/// Maximum width of a column; a wider cell shifts only the rest of its own row.
const WIDEST: usize = 100;

/// A table with a heading.
pub(crate) fn columns<const N: usize>(head: &[&str; N], mut rows: Vec<[String; N]>) -> String {
    rows.insert(0, head.map(str::to_owned));
    aligned(&rows).join("\n")
}

/// Columns as wide as their widest cell, two spaces apart; the last one is not padded. Control characters in cells are escaped.
pub(crate) fn aligned(rows: &[impl AsRef<[String]>]) -> Vec<String> {
    let rows: Vec<Vec<Cow<'_, str>>> =
        rows.iter().map(|row| row.as_ref().iter().map(|cell| in_line(cell)).collect()).collect();
    let width = |column: usize| rows.iter().filter_map(|row| row.get(column)).map(|cell| visible(cell)).max();
    let widths: Vec<usize> = (0..).map_while(width).map(|width| width.min(WIDEST)).collect();
    let line = |row: &Vec<Cow<'_, str>>| {
        let cells: Vec<String> = row.iter().zip(&widths).map(|(cell, width)| padded(cell, *width)).collect();
        cells.join("  ").trim_end().to_owned()
    };
    rows.iter().map(line).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_stand_below_each_other_also_with_wide_long_and_hostile_cells() {
        let row = |cells: [&str; 2]| cells.map(str::to_owned);
        let rows = [row(["漢字", "a"]), row(["arm", "b\u{1b}[2J\n"]), row([&"x".repeat(70_000), "c"])];
        let lines = aligned(&rows);
        assert_eq!(lines[0], format!("漢字{}  a", " ".repeat(WIDEST - 4)));
        assert_eq!(lines[1], format!("arm{}  b\\u{{1b}}[2J\\u{{a}}", " ".repeat(WIDEST - 3)));
        assert!(lines[2].ends_with("xx  c"));
    }
}
