//! The task that fetches boxes on a table, with the numbers of a robot's own workplace in place of the written ones.

use anyhow::{Context, ensure};
use ratn_motion::robot::Robot;
use ratn_motion::workplace::{Surface, Workplace};
use std::fmt::Write;

/// The robot for whose workplace the task is written.
const WRITTEN_FOR: &str = "panda";

/// The workplace of a robot that can do the task with this number of boxes; or why it cannot.
pub(super) fn workplace<'r>(robot: &'r Robot, observation: &str, boxes: u32) -> Result<&'r Workplace, String> {
    let own = "run your own task with `ratn run TASK --robot`";
    let workplace = robot.workplace().ok_or_else(|| {
        format!("it has no [workplace]: add one, with a table, boxes and places (docs/robots.md), or {own}")
    })?;
    let places = workplace.places.at.len();
    if workplace.places.on == Surface::Base {
        Err(format!("its places are on its base, and the demo's task brings boxes to places on the table: {own}"))
    } else if robot.camera_pose(&robot.at_zero()).is_none() {
        Err(format!("it has no [camera], and the demo's task looks for the boxes: {own}"))
    } else if robot.posture(observation).is_none() {
        Err(format!(
            "it has no posture `{observation}`, in which the arm is out of the camera's view: add it to [postures]"
        ))
    } else if places < boxes as usize {
        Err(format!("its [workplace] has {places} places: ask for so many with --boxes, not for {boxes}"))
    } else {
        Ok(workplace)
    }
}

/// The task's text for another workplace.
pub(super) fn at(text: &str, workplace: &Workplace) -> anyhow::Result<String> {
    let written_for = Robot::built_in(WRITTEN_FOR).context("the robot that the task is written for")?;
    let written = written_for.workplace().context("the workplace that the task is written for")?;
    let mut text = text.to_owned();
    for (from, to) in parts(written).into_iter().zip(parts(workplace)) {
        ensure!(text.contains(&from), "the task does not say `{from}`");
        text = text.replace(&from, &to);
    }
    Ok(text)
}

/// The parts of the task's text that depend on a workplace.
fn parts(workplace: &Workplace) -> [String; 6] {
    let Workplace { table, boxes, places, .. } = workplace;
    let top = number(table.top_m());
    let mut lines = String::new();
    for (index, [x, y, z]) in places.at.iter().enumerate() {
        let (x, y, z, yaw) = (number(*x), number(*y), number(*z), places.yaw);
        let _ = writeln!(lines, "  - \"at(place_{}) = pose({x}, {y}, {z}, 0, 0, {yaw})\"", index + 1);
    }
    // Margins for a box that stands at the edge in any orientation, and for a box that lies as the places do.
    let [longer, ..] = boxes.greatest;
    let (around, along) = (longer + 0.04, 2.0 * longer);
    let (cosine, sine) = (places.yaw.cos().abs(), places.yaw.sin().abs());
    let beside = [along * cosine + around * sine, along * sine + around * cosine];
    let of_places = [0, 1].map(|axis| range(places.at.iter().map(|at| at[axis])));
    [
        format!("at(table) = pose({})", numbers(&table.centre)),
        format!("shape(table) = {{type: box, size: [{}]}}", numbers(&table.size)),
        lines,
        region([boxes.x, boxes.y], [around; 2], &top),
        region(of_places, beside, &top),
        format!("surface_m: {top}"),
    ]
}

fn range(values: impl Iterator<Item = f64>) -> [f64; 2] {
    values.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], value| [low.min(value), high.max(value)])
}

/// The region that the camera looks at: a rectangle on the table, and a margin around it.
fn region([x, y]: [[f64; 2]; 2], around: [f64; 2], top: &str) -> String {
    let centre = [x, y].map(|[low, high]| number((low + high) / 2.0));
    let size = [(x, around[0]), (y, around[1])].map(|([low, high], around)| number(high - low + around));
    format!("region: {{ pose: \"pose({}, {top})\", size: [{}] }}", centre.join(", "), size.join(", "))
}

fn numbers(values: &[f64]) -> String {
    values.iter().map(|value| number(*value)).collect::<Vec<_>>().join(", ")
}

/// Rounded to a tenth of a millimetre.
fn number(value: f64) -> String {
    // Adding 0 removes the sign of a zero.
    ((value * 1e4).round() / 1e4 + 0.0).to_string()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::super::{FETCH_ON_TABLE, OBSERVATION};
    use super::*;
    use ratn_model::catalogue::Catalogue;

    fn built_in(name: &str) -> Robot {
        Robot::built_in(name).unwrap()
    }

    #[test]
    fn the_task_is_written_with_the_workplace_of_the_built_in_robots() {
        for name in ["panda", "ur5"] {
            let robot = built_in(name);
            assert_eq!(at(FETCH_ON_TABLE.1, workplace(&robot, OBSERVATION, 6).unwrap()).unwrap(), FETCH_ON_TABLE.1);
        }
    }

    #[test]
    fn another_workplace_has_other_numbers_in_the_same_task() {
        let mut own = built_in("panda").workplace().unwrap().clone();
        own.table.centre[2] = 0.375;
        own.table.size[0] = 0.9;
        (own.boxes.x, own.boxes.y) = ([0.4, 0.5], [-0.3, -0.1]);
        (own.places.at, own.places.yaw) = (vec![[0.4, 0.2, 0.4], [0.5, 0.2, 0.4]], 0.0);
        let text = at(FETCH_ON_TABLE.1, &own).unwrap();
        for said in [
            "at(table) = pose(0.6, 0, 0.375)",
            "size: [0.9, 1.2, 0.05]",
            "  - \"at(place_2) = pose(0.5, 0.2, 0.4, 0, 0, 0)\"\n\noutputs:",
            "region: { pose: \"pose(0.45, -0.2, 0.4)\", size: [0.26, 0.36] }",
            "region: { pose: \"pose(0.45, 0.2, 0.4)\", size: [0.34, 0.16] }",
        ] {
            assert!(text.contains(said), "{said}: {text}");
        }
        assert!(!text.contains("0.7,") && !text.contains("surface_m: 0.7"), "{text}");
        ratn_model::load::load(&text, "t.yaml", &Catalogue::standard()).unwrap();
    }

    #[test]
    fn a_robot_that_cannot_do_it_is_refused_with_what_it_lacks() {
        let refusal =
            |name: &str, observation: &str, boxes| workplace(&built_in(name), observation, boxes).unwrap_err();
        assert!(refusal("aimm", OBSERVATION, 1).starts_with("its places are on its base"));
        assert!(refusal("panda", "asleep", 1).starts_with("it has no posture `asleep`"));
        assert!(refusal("panda", OBSERVATION, 7).starts_with("its [workplace] has 6 places"));
    }
}
