//! What a simulated cell requires of a robot: a workplace, a camera, arms that can be told apart, grippers that can hold the boxes, and free space to
//! stand in. The cell does not start with a robot that misses a requirement; `ratn robot check` lists all of them beforehand.
//!
//! The requirements for any use of a description (its names, its limits, the kinds of its joints) are checked where it is read. Whether each place of
//! the workplace can be reached is surveyed (`ratn_motion::survey`); the cell lays objects where they can be reached.

use super::arms::FIRST;
use super::environment::Furniture;
use super::grasping::{NotGrasped, Pads};
use super::placement::furniture;
use crate::config::Setting;
use ratn_model::pose::Pose;
use ratn_motion::exact::Touch;
use ratn_motion::geometry::Geometry;
use ratn_motion::robot::{Configuration, Robot};
use ratn_motion::space::Obstacle;
use ratn_motion::top_grasp::grasp_poses;
use ratn_motion::workplace::{Boxes, HOME, Workplace};
use std::f64::consts::TAU;
use std::fmt;

/// A requirement that a robot does not meet.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Unmet {
    /// Where to look: a part of the robot.toml, and the arm.
    pub place: String,
    /// What is wrong.
    pub what: String,
    /// Why the cell needs it.
    pub why: &'static str,
    /// What to do.
    pub next: String,
}

impl fmt::Display for Unmet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Unmet { place, what, why, next } = self;
        write!(f, "{place}: {what}; {why}; {next}")
    }
}

/// Maximum number of characters in the name of an arm.
const MAX_NAME: usize = 64;

/// Maximum distance of a finger from its nominal position, in metres: as far as pads give way.
const FINGER_OFF_M: f64 = 0.002;

/// Maximum overlap of an object with its support, in metres: numbers in descriptions are rounded.
const STANDS_IN_M: f64 = 0.001;

/// The requirements that a robot does not meet in a scene.
pub fn unmet(robot: &Robot, setting: Setting) -> Vec<Unmet> {
    let mut unmet = Vec::new();
    let Some(workplace) = robot.workplace() else {
        return vec![Unmet {
            place: "[workplace]".to_owned(),
            what: "there is none".to_owned(),
            why: "nobody knows where the table and the boxes are",
            next: "add one to the robot.toml (docs/robots.md)".to_owned(),
        }];
    };
    if robot.camera_pose(&robot.at_zero()).is_none() {
        unmet.push(Unmet {
            place: "[camera]".to_owned(),
            what: "there is none".to_owned(),
            why: "the cell's pictures are taken from it",
            next: "name the link of its optical frame (z forward, x right, y down) as `link`".to_owned(),
        });
    }
    unmet.extend(away(robot));
    if setting == Setting::Table && workplace.tableware.is_none() {
        unmet.push(Unmet {
            place: "[workplace.tableware]".to_owned(),
            what: "there is none".to_owned(),
            why: "nobody knows where the rack and the places are",
            next: "add it (docs/robots.md), or use the scene `boxes`".to_owned(),
        });
    }
    let (names, standing): (Vec<&str>, _) = (robot.arm_names().collect(), standing(robot, setting));
    for (number, name) in names.iter().enumerate() {
        // `with_arm` accepts every name that the robot itself lists.
        let Ok(view) = robot.with_arm(name) else { continue };
        let of_arm = if names.len() > 1 { format!(" of the arm `{name}`") } else { String::new() };
        if names.len() > 1 {
            unmet.extend(named(name));
        }
        unmet.extend((0..number).find_map(|other| shared(robot, [other, number], [names[other], name])));
        unmet.extend(ungrasping(&view, number == FIRST, share(workplace, number, name), &of_arm));
        unmet.extend(in_the_way(&view, &standing, &of_arm, &unmet));
    }
    unmet
}

/// A base that cannot be at the origin.
fn away(robot: &Robot) -> Option<Unmet> {
    let ([x, y], heading) = robot.drive_area()?;
    let limits = [("x", Some(x), "m"), ("y", Some(y), "m"), ("its heading", heading, "rad")];
    let leaves_out = |(what, limits, unit): (&'static str, Option<[f64; 2]>, &'static str)| {
        let [low, high] = limits?;
        // A heading is the same after a whole turn: a drive begins with the equivalent one within the limits.
        let origins: &[f64] = if unit == "rad" { &[0.0, TAU, -TAU] } else { &[0.0] };
        (!origins.iter().any(|at| (low..=high).contains(at))).then_some((what, [low, high], unit))
    };
    let (what, [low, high], unit) = limits.into_iter().find_map(leaves_out)?;
    Some(Unmet {
        place: "[base]".to_owned(),
        what: format!("{what} goes from {low} to {high} {unit}, which leaves out 0"),
        why: "the cell begins with the base at the origin",
        next: "let `area` and the limits of the base's joints have the origin in them".to_owned(),
    })
}

/// The boxes of an arm: for the first arm those of the workplace.
fn share<'w>(workplace: &'w Workplace, number: usize, name: &str) -> Option<&'w Boxes> {
    match number {
        FIRST => Some(&workplace.boxes),
        _ => workplace.others.iter().find(|share| share.arm == name).map(|share| &share.boxes),
    }
}

/// Checks the name of one of several arms. The only arm of a robot is `arm@sim`, whatever its name.
fn named(name: &str) -> Option<Unmet> {
    let part_of_id = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-' | '.');
    let is_good = (1..=MAX_NAME).contains(&name.len()) && name.chars().all(part_of_id);
    (!is_good).then(|| Unmet {
        place: format!("`name` of the arm `{name}`"),
        what: "it is no part of an id".to_owned(),
        why: "it becomes part of the id of the arm's resource",
        next: format!("use 1 to {MAX_NAME} letters, digits, `_`, `-` and `.`"),
    })
}

/// A link that two arms move.
fn shared(robot: &Robot, [other, arm]: [usize; 2], [other_name, name]: [&str; 2]) -> Option<Unmet> {
    let links = robot.links_of(arm);
    let link = robot.links_of(other).into_iter().find(|link| links.contains(link))?;
    let link = &robot.model.links[link].name;
    Some(Unmet {
        place: format!("`joints` of the arm `{name}`"),
        what: format!("the link `{link}` is moved by them and by those of the arm `{other_name}`"),
        why: "a lease of one arm would move the other",
        next: "leave the joints that carry several arms out of `joints` of every arm".to_owned(),
    })
}

/// Why the gripper of an arm cannot hold the cell's objects. An arm without boxes needs no gripper.
fn ungrasping(view: &Robot, is_first: bool, boxes: Option<&Boxes>, of_arm: &str) -> Option<Unmet> {
    let unmet = |what: String, why: &'static str, next: &str| {
        Some(Unmet { place: format!("[gripper]{of_arm}"), what, why, next: next.to_owned() })
    };
    let (Some(joint), Some(finger)) = (view.finger(), view.finger_link()) else {
        let needs_one = is_first || boxes.is_some();
        return needs_one
            .then(|| unmet("there is none".to_owned(), "the boxes are taken with it", "add one (docs/robots.md)"))?;
    };
    let name = &view.model.links[finger].name;
    let Some(part) = view.pad() else {
        return unmet(
            format!(
                "none of the shapes of its finger `{name}` is a box that lies along the axes of the tool's frame, or a mesh"
            ),
            "the pad that holds is found on such a shape",
            "give the finger one, or turn the tool's frame so that y is the way the fingers close",
        );
    };
    if !view.arm_links.contains(&finger) {
        return unmet(
            format!("its finger `{name}` is not carried by the arm"),
            "what is grasped is carried by the arm",
            "hang the fingers on a link behind the arm's last joint",
        );
    }
    if let Some(unmet) = off_the_hand(view, finger, of_arm) {
        return Some(unmet);
    }
    let outward = if part.middle[1] < 0.0 { -1.0 } else { 1.0 };
    let (opens, ways) = (joint.upper, view.finger_ways());
    let goes = |way: [f64; 3], y: f64| (way[1] - y).abs().max(way[0].abs()).max(way[2].abs()) <= FINGER_OFF_M;
    let way = ways.iter().find(|(link, _)| *link == finger).map_or([0.0; 3], |(_, way)| *way);
    if !goes(way, outward * opens) {
        // Adding zero turns -0 into 0.
        let millimetres = |at: [f64; 3]| {
            let [x, y, z] = at.map(|c| (1e3 * c).round() + 0.0);
            format!("({x:.0}, {y:.0}, {z:.0}) mm")
        };
        let goes_by = format!(
            "when its joint `{}` goes from 0 to {:.0} mm, its finger `{name}` goes by {} in the tool's frame",
            joint.name,
            1e3 * opens,
            millimetres(way)
        );
        if goes(way, -outward * opens) {
            let (side, axis) = if outward < 0.0 { ("below", "-y") } else { ("above", "y") };
            let pad = millimetres(part.middle);
            return unmet(
                format!(
                    "{goes_by}, and its pad, of its boxes the one nearest to the other finger, is at {pad}, where y is {side} 0"
                ),
                "a finger opens away from the middle, to the side of its pad",
                &format!(
                    "let the joint slide the finger along {axis} of the tool's frame, or give the finger a box for its pad on the other side (shapes of \
                     links that are fixed to it do not count)"
                ),
            );
        }
        return unmet(
            goes_by,
            "the position of the joint is how far each finger is from the middle, along the tool's y",
            "let the joint slide the finger along y of the tool's frame, away from the middle, with 0 where the fingers meet",
        );
    }
    let opposite: Vec<usize> =
        ways.iter().filter(|(_, way)| goes(*way, -outward * opens)).map(|(link, _)| *link).collect();
    let Some(other) = opposite.first().map(|link| &view.model.links[*link].name) else {
        return unmet(
            format!("no link goes the other way when its finger `{name}` opens"),
            "a box is held between two fingers",
            "add the other finger, with a joint that mimics the first one",
        );
    };
    let Some(second) = opposite.iter().copied().find(|link| !view.model.links[*link].bodies.is_empty()) else {
        return unmet(
            format!("its other finger `{other}` has no shape"),
            "a box is held between two fingers",
            "give it a <collision> like that of the first one",
        );
    };
    if let Some(unmet) = off_the_hand(view, second, of_arm) {
        return Some(unmet);
    }
    let from_middle = part.middle[1].abs() - part.half[1];
    if from_middle.abs() > FINGER_OFF_M {
        return unmet(
            format!(
                "with its joint at 0 the pad of its finger `{name}` is {:.1} mm from the middle",
                1e3 * from_middle
            ),
            "0 is where the fingers meet",
            "move the finger's joint or the tool's frame by that much",
        );
    }
    let boxes = boxes?;
    if joint.lower > boxes.least[1] / 2.0 {
        let [closed, narrow] = [2.0 * joint.lower, boxes.least[1]].map(|m| 1e3 * m);
        return unmet(
            format!("its fingers close to {closed:.0} mm, and the narrowest boxes are {narrow:.0} mm wide"),
            "the fingers close until they hold",
            "lower the lower limit of its joint, or make `boxes.least` wider",
        );
    }
    let pads = Pads::of(view)?;
    let held =
        [boxes.least, boxes.greatest].into_iter().find_map(|size| Some((size, holds(&pads, opens, size).err()?)));
    let ([long, wide, high], error) = held?;
    unmet(
        format!("its fingers do not hold a box of {long} by {wide} by {high} m that is taken from above: {error}"),
        "the boxes are taken so",
        "let the pads be about the tool's frame, as large as they are, or change the boxes of [workplace]",
    )
}

/// A finger that is not attached to the hand.
fn off_the_hand(view: &Robot, finger: usize, of_arm: &str) -> Option<Unmet> {
    let (hand, on) = (view.hand()?, view.model.links[finger].parent?);
    let name = |link: usize| &view.model.links[link].name;
    (hand != on).then(|| Unmet {
        place: format!("[gripper]{of_arm}"),
        what: format!("its finger `{}` hangs on `{}`, and `hand` is `{}`", name(finger), name(on), name(hand)),
        why: "what hangs on the hand may touch what is taken, and nothing else may",
        next: format!("name `{}` as `hand`, or hang the finger on `{}`", name(on), name(hand)),
    })
}

/// Whether fingers that are this far open hold a box of this size.
fn holds(pads: &Pads, finger: f64, size: [f64; 3]) -> Result<(), NotGrasped> {
    let standing = Pose::at(0.0, 0.0, size[2] / 2.0);
    let cuboids = [("it".to_owned(), standing, size)];
    let [first, second] = grasp_poses(&standing, size).map(|tool| pads.close(&tool, finger, &cuboids).map(drop));
    first.or(second)
}

/// All furniture, as obstacles.
fn standing(robot: &Robot, setting: Setting) -> Vec<Obstacle> {
    let parts = |piece: Furniture| piece.parts.into_iter().map(move |part| (piece.name.clone(), part));
    let solid = |(name, (pose, size)): (String, (Pose, [f64; 3]))| Obstacle {
        name,
        pose,
        geometry: Geometry::Box { half: size.map(|edge| edge / 2.0) },
    };
    furniture(robot, setting).into_iter().flat_map(parts).map(solid).collect()
}

/// Furniture or links that the robot overlaps with when the cell begins, unless reported for another arm.
fn in_the_way(view: &Robot, standing: &[Obstacle], of_arm: &str, said: &[Unmet]) -> Vec<Unmet> {
    let touches = view.touches(&first_posture(view), standing);
    let deep = touches.into_iter().filter(|touch| touch.depth_m > STANDS_IN_M);
    let unmet = |touch: Touch| {
        let is_furniture = standing.iter().any(|obstacle| obstacle.name == touch.other);
        let is_carried = view.link(&touch.link).is_some_and(|link| view.arm_links.contains(&link));
        let (place, next) = match (is_furniture, is_carried) {
            (true, false) => {
                ("[workplace]".to_owned(), format!("move the {} of [workplace], or the link in the URDF", touch.other))
            }
            (true, true) => (
                format!("[postures] `{HOME}`{of_arm}"),
                format!("change the posture, or move the {} of [workplace]", touch.other),
            ),
            (false, _) => (
                format!("[postures] `{HOME}`{of_arm}"),
                "change the posture, or except the pair in the SRDF where the links are made to touch".to_owned(),
            ),
        };
        Unmet { place, what: format!("the link {touch}"), why: "the cell begins so", next }
    };
    deep.map(unmet).filter(|unmet| !said.iter().any(|other| other.what == unmet.what)).collect()
}

/// Every arm in its posture `home` with open fingers, as seen from one arm.
fn first_posture(view: &Robot) -> Configuration {
    let mut first = view.with_all_arms(&view.at_zero());
    for (number, name) in view.arm_names().enumerate() {
        let Ok(arm) = view.with_arm(name) else { continue };
        first.set_finger(number, arm.open_finger_m());
        if let Some(home) = arm.posture(HOME) {
            first.set_joints(number, home);
        }
    }
    first
}
