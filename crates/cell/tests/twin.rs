//! A table with boxes for two arms.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_cell::config::{CellConfig, Goods, Setting};
use ratn_cell::core::placement::{PlacementError, objects, workplace};
use ratn_motion::robot::Robot;

mod bench;
use bench::Bench;

fn boxes(count: usize) -> Goods {
    CellConfig { boxes: count, ..CellConfig::default() }.goods()
}

#[test]
fn each_arm_has_as_many_boxes_on_its_own_side_of_the_table() {
    let robot = Robot::built_in("twin").unwrap();
    for seed in 1..=5 {
        let table = objects(&robot, Setting::Boxes, boxes(3), seed).unwrap();
        assert_eq!(table.len(), 6);
        for (i, placed) in table.iter().enumerate() {
            let (share, _) = workplace(&robot).shares().nth(i / 3).unwrap();
            let [_, y, _] = placed.pose.position;
            assert!((share.y[0]..=share.y[1]).contains(&y), "{placed:?}");
        }
        assert_eq!(table, objects(&robot, Setting::Boxes, boxes(3), seed).unwrap());
    }
    let refused = objects(&robot, Setting::Boxes, boxes(4), 1);
    assert!(matches!(refused, Err(PlacementError::Places { count: 4, places: 3, .. })), "{refused:?}");
}

#[test]
fn a_cell_with_two_arms_begins_with_all_boxes_on_the_table_and_none_at_its_place() {
    let bench = Bench::of(CellConfig { robot: "twin".to_owned(), boxes: 3, seed: 4, ..CellConfig::default() });
    let truth = bench.cell.ground_truth();
    assert_eq!(truth.len(), 6);
    assert!(truth.iter().all(|object| object.on == "table" && !object.in_place), "{truth:?}");
}
