//! Surveys a robot's description for people: its parts, its reach, its collisions, and whether boxes in its workplace can be grasped from above
//! wherever they may stand.

use crate::arm::{self, line};
use crate::collision::{CONTACT_TOLERANCE_M, Checker, Contact, PADDING_M};
use crate::diagnosis::no_joint_parts;
use crate::joint_vector::JointVector;
use crate::pairs::{self, Pair};
use crate::plan::has_room;
use crate::request::unit;
use crate::robot::{Configuration, Joint, Robot};
use crate::robot_model::RobotModel;
use crate::top_grasp::{APPROACH_M, grasp_poses};
use crate::workplace::{Boxes, HOME, Surface, Workplace};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ratn_model::pose::Pose;
use ratn_world::scene::{Placement, Scene, SceneObject, Shape};
use std::collections::{BTreeMap, BTreeSet};
use std::f64::consts::{FRAC_PI_2, FRAC_PI_4, PI, TAU};
use std::ops::RangeInclusive;

/// Number of sampled postures for the reach of the tool.
const SAMPLES: usize = 5_000;
/// Number of postures, and of attempts to find them, for one grasp.
const SOLUTIONS: usize = 12;
const TRIES: usize = 40;

/// Angles of rotated boxes, in radians: after half a turn a box is the same.
const TURNED_RAD: [f64; 3] = [-FRAC_PI_4, FRAC_PI_4, FRAC_PI_2];

/// See the module's description.
#[derive(Debug, Clone, PartialEq)]
pub struct Survey {
    /// The findings, one per line.
    pub lines: Vec<String>,
    /// The faults.
    pub faults: Vec<String>,
}

/// Surveys a robot.
pub fn survey(robot: &Robot) -> Survey {
    let has = |it: bool| if it { "yes" } else { "no" };
    let mut survey = Survey { lines: vec![format!("robot     {}", robot.name())], faults: Vec::new() };
    survey.add_arm(robot, "");
    survey.add_pairs(robot);
    survey.lines.extend([
        format!("base      {}", has(!robot.base_joints().is_empty())),
        format!("head      {}", has(!robot.head_joints().is_empty())),
        format!("camera    {}", has(robot.camera_pose(&robot.at_zero()).is_some())),
    ]);
    let scene = scene(robot.workplace(), None);
    survey.add_postures(robot, &scene, "");
    // `with_arm` accepts every name that the robot itself lists.
    let others: Vec<Robot> = robot.other_arms().filter_map(|name| robot.with_arm(name).ok()).collect();
    for other in &others {
        let whose = format!(" of the arm `{}`", other.arm_name());
        survey.add_arm(other, &whose);
        survey.add_postures(other, &scene, &whose);
    }
    survey.add_exceptions(robot);
    let Survey { mut lines, mut faults } = survey;
    match robot.workplace() {
        None => lines.push("workplace none: the simulated cell does not take it".to_owned()),
        Some(workplace) => {
            for (what, points) in [("boxes", region(workplace, &workplace.boxes)), ("places", workplace.places.poses())]
            {
                // Boxes are where the first arm takes them; another arm may bring them to their places.
                let others = if what == "places" { &others[..] } else { &[] };
                let able = others.iter().filter(|other| other.posture(HOME).is_some());
                let serves = |point: &Pose| able.clone().any(|other| beyond(other, workplace, point).is_none());
                let beyond =
                    points.iter().filter_map(|point| beyond(robot, workplace, point).filter(|_| !serves(point)));
                let beyond: Vec<String> = beyond.collect();
                let (all, good) = (points.len(), points.len() - beyond.len());
                lines.push(format!("{what:<10}{good} of {all} points can be served from above"));
                faults.extend(beyond.into_iter().map(|why| format!("{what}: {why}")));
            }
            faults.extend(turned(robot, workplace, &workplace.boxes).into_iter().map(|why| format!("boxes: {why}")));
            for share in &workplace.others {
                let whose = others.iter().find(|other| other.arm_name() == share.arm);
                let turned = whose.iter().flat_map(|arm| turned(arm, workplace, &share.boxes));
                faults.extend(turned.map(|why| format!("boxes of the arm `{}`: {why}", share.arm)));
                for (what, points) in [("boxes", region(workplace, &share.boxes)), ("places", share.places.poses())] {
                    let beyond: Vec<String> = whose
                        .iter()
                        .flat_map(|arm| points.iter().filter_map(|at| beyond(arm, workplace, at)))
                        .collect();
                    let (all, good) = (points.len(), points.len() - beyond.len());
                    lines.push(format!("{what:<10}`{}`: {good} of {all} points can be served from above", share.arm));
                    faults.extend(beyond.into_iter().map(|why| format!("{what} of the arm `{}`: {why}", share.arm)));
                }
            }
        }
    }
    Survey { lines, faults }
}

impl Survey {
    /// Adds a description of an arm; `robot` is seen from it.
    fn add_arm(&mut self, robot: &Robot, whose: &str) {
        let joints: Vec<&str> = robot.arm_joints().iter().map(|joint| joint.name.as_str()).collect();
        let tool = &robot.model.links[robot.tool].name;
        let [below, above, away] = extent(robot);
        let opening = match robot.finger() {
            Some(_) => format!("opens to {:.0} mm", 2e3 * robot.open_finger_m()),
            None => "none: it grasps nothing".to_owned(),
        };
        if robot.finger().is_some() && 2.0 * robot.open_finger_m() > away {
            self.faults.push(format!(
                "the gripper{whose} opens to {:.2} m, further than the arm reaches ({away:.2} m): the limits of a sliding joint are in metres",
                2.0 * robot.open_finger_m()
            ));
        }
        let arm = if whose.is_empty() { String::new() } else { format!("`{}`, ", robot.arm_name()) };
        self.lines.extend([
            format!("arm       {arm}{} joints to the link `{tool}`: {}", joints.len(), joints.join(", ")),
            format!(
                "reach     {away:.2} m from the arm's first joint; the tool's height from {below:.2} to {above:.2} m"
            ),
            format!("gripper   {opening}"),
        ]);
        let limits = |(joint, slides): (&Joint, &bool)| {
            let (unit, range) = (unit(*slides), format!("{:.3} to {:.3}", joint.lower, joint.upper));
            let range = if joint.endless { "turns without end".to_owned() } else { format!("{range} {unit}") };
            let Joint { name, velocity, acceleration, jerk, .. } = joint;
            format!(
                "limits    {name}: {range}; {velocity:.3} {unit}/s, {acceleration:.3} {unit}/s², {jerk:.3} {unit}/s³"
            )
        };
        self.lines.extend(robot.arm_joints().iter().zip(robot.arm_slides()).map(limits));
    }

    /// Adds the pairs of links that are not checked although no SRDF excepts them, those that the search does not check, and those that block every motion.
    fn add_pairs(&mut self, robot: &Robot) {
        let (model, checks) = (&robot.model, robot.model.checks());
        let says = match (model.has_exceptions(), checks.unsaid.is_empty()) {
            (true, true) => "the SRDF says which are not checked".to_owned(),
            (true, false) => "those that the SRDF excepts are not checked, nor are those that meet in every posture".to_owned(),
            (false, _) => {
                "no SRDF excepts any; not checked are neighbours that are made to touch, and those that meet in every posture".to_owned()
            }
        };
        self.lines.push(format!("pairs     {says}{}", listed(model, &checks.unsaid)));
        if !checks.by_shapes.is_empty() {
            let names = listed(model, &checks.by_shapes);
            self.lines.push(format!(
                "          not seen by the search, but by the check of its ends and of the finished path{names}"
            ));
        }
        let arm = robot.arm(&robot.at_zero());
        for (a, b) in pairs::never_apart(&arm) {
            let names = [&arm.links[a].name[..], &arm.links[b].name];
            let [a, b] = names;
            self.faults.push(format!("{a} meets {b} in every posture of the arm, {}", no_joint_parts(names)));
        }
    }

    /// Adds the lines that an SRDF lacks, or begins with where there is none and something is amiss: one with any exception takes the place of what is
    /// left out by itself.
    fn add_exceptions(&mut self, robot: &Robot) {
        let model = &robot.model;
        let excepted = &model.checks().excepted;
        let (said, pairs): (_, Vec<Pair>) = if model.has_exceptions() {
            let lacking = pairs::checks(model).excepted.difference(excepted).copied().collect();
            ("the SRDF leaves these out, which are made to touch, so they are checked", lacking)
        } else if !self.faults.is_empty() {
            (
                "an SRDF with any exception takes the place of what is left out by itself: begin it with",
                excepted.iter().copied().collect(),
            )
        } else {
            return;
        };
        if !pairs.is_empty() {
            self.lines.push(format!("srdf      {said}"));
            let line = |pair: &Pair| format!("          {}", pairs::exception(model, *pair, "Adjacent"));
            self.lines.extend(pairs.iter().map(line));
        }
    }

    /// Adds the tool position of each posture of this arm, and whether the posture collides with the table or the robot itself, whose other arms are
    /// in their postures `home`, or leaves the planner no free space.
    fn add_postures(&mut self, robot: &Robot, scene: &Scene, whose: &str) {
        let mut checker = Checker::new(robot, scene, &arm::assumed(robot, scene), PADDING_M);
        for (name, posture) in robot.postures() {
            let [x, y, z] = arm::reach(robot).pose(posture).position;
            let touch = checker.collision(posture, Contact::None);
            let start = Configuration { arm: *posture, ..arm::assumed(robot, scene) };
            let (state, fault) = match (touch, has_room(robot, scene, &start)) {
                (Some(touch), _) => (format!("COLLIDES: {touch}"), Some(format!("collides: {touch}"))),
                (None, Err(error)) => (format!("NO ROOM: {error}"), Some(format!("leaves no room: {error}"))),
                (None, Ok(())) => ("free".to_owned(), None),
            };
            self.lines.push(format!("posture   {name}: {state}; the tool is at ({x:.3}, {y:.3}, {z:.3})"));
            self.faults.extend(fault.map(|fault| format!("the posture `{name}`{whose} {fault}")));
        }
    }
}

/// The names of pairs after a colon.
fn listed(model: &RobotModel, pairs: &BTreeSet<Pair>) -> String {
    if pairs.is_empty() { String::new() } else { format!(": {}", pairs::named(model, &mut pairs.iter(), usize::MAX)) }
}

/// The tool's minimum and maximum height, and its maximum distance from the arm's first joint.
fn extent(robot: &Robot) -> [f64; 3] {
    let reach = arm::reach(robot);
    let joints = robot.arm_joints();
    let foot = robot.pose(&robot.at_zero(), robot.arm_joint_links[0]).position;
    let ranges: Vec<_> = joints.iter().zip(robot.arm_slides()).map(|(joint, slides)| range(joint, *slides)).collect();
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let mut extent = [f64::INFINITY, f64::NEG_INFINITY, 0.0];
    for _ in 0..SAMPLES {
        let posture = JointVector::from_fn(joints.len(), |j| random.random_range(ranges[j].clone()));
        let at = reach.pose(&posture).position;
        let away = (0..3).map(|i| (at[i] - foot[i]).powi(2)).sum::<f64>().sqrt();
        extent = [extent[0].min(at[2]), extent[1].max(at[2]), extent[2].max(away)];
    }
    extent
}

/// All positions of a joint; for one with more than a whole turn, one turn, about zero if its limits allow that.
fn range(Joint { lower, upper, .. }: &Joint, slides: bool) -> RangeInclusive<f64> {
    if slides || upper - lower <= TAU {
        return *lower..=*upper;
    }
    let least = (-PI).clamp(*lower, upper - TAU);
    least..=least + TAU
}

/// The corners and the centre of the region for boxes.
fn region(workplace: &Workplace, boxes: &Boxes) -> Vec<Pose> {
    let ([x_low, x_high], [y_low, y_high]) = (boxes.x, boxes.y);
    let middle = ((x_low + x_high) / 2.0, (y_low + y_high) / 2.0);
    let points = [(x_low, y_low), (x_low, y_high), (x_high, y_low), (x_high, y_high), middle];
    points.map(|(x, y)| Pose::at(x, y, workplace.table.top_m())).to_vec()
}

/// Why rotated boxes cannot be grasped anywhere in the region, with all such angles that have the same reason; empty if unrotated boxes cannot be
/// grasped either. The cell rotates boxes anyway, where they can be grasped.
fn turned(robot: &Robot, workplace: &Workplace, boxes: &Boxes) -> Vec<String> {
    let points = region(workplace, boxes);
    let nowhere = |yaw: f64| {
        let lying = points.iter().map(|at| at.compose(&Pose::from_rpy([0.0; 3], 0.0, 0.0, yaw)));
        let reasons: Option<Vec<String>> = lying.map(|at| beyond(robot, workplace, &at)).collect();
        reasons?.pop()
    };
    if nowhere(0.0).is_some() {
        return Vec::new();
    }
    let mut ways: BTreeMap<String, Vec<String>> = BTreeMap::new();
    for yaw in TURNED_RAD {
        if let Some(reason) = nowhere(yaw) {
            ways.entry(reason).or_default().push(format!("{:.0}°", yaw.to_degrees()));
        }
    }
    let said = |(reason, angles): (String, Vec<String>)| {
        let angles = angles.join(", ");
        format!("the cell lays them turned, and turned by {angles} none can be taken: {reason}")
    };
    ways.into_iter().map(said).collect()
}

/// The table, and a box on a point of a surface.
fn scene(workplace: Option<&Workplace>, floor: Option<&Pose>) -> Scene {
    let Some(workplace) = workplace else { return Scene { base: Pose::IDENTITY, objects: Vec::new() } };
    let cuboid = |name: &str, pose: Pose, size: [f64; 3]| SceneObject {
        name: name.to_owned(),
        shape: Shape::Box { size },
        placement: Placement::World(pose),
    };
    let [x, y, z] = workplace.table.centre;
    let size = workplace.boxes.greatest;
    let standing = floor.map(|floor| cuboid("box", floor.compose(&Pose::at(0.0, 0.0, size[2] / 2.0)), size));
    let table = cuboid("table", Pose::at(x, y, z), workplace.table.size);
    Scene { base: Pose::IDENTITY, objects: standing.into_iter().chain([table]).collect() }
}

/// Why a box on this point cannot be grasped from above, if so.
fn beyond(robot: &Robot, workplace: &Workplace, floor: &Pose) -> Option<String> {
    let scene = scene(Some(workplace), Some(floor));
    let (reach, home) = (arm::reach(robot), robot.posture(HOME)?);
    let mut checker = Checker::new(robot, &scene, &arm::assumed(robot, &scene), PADDING_M);
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let size = workplace.boxes.greatest;
    let mut why = "no posture of the arm gets there".to_owned();
    for grasp in grasp_poses(&floor.compose(&Pose::at(0.0, 0.0, size[2] / 2.0)), size) {
        for posture in reach.solutions(&reach.target(grasp), &home, SOLUTIONS, TRIES, &mut random) {
            match line(&reach, &posture, [0.0, 0.0, APPROACH_M]) {
                Err(error) => why = error.to_string(),
                Ok(postures) => {
                    let contact = Contact::Gripper(CONTACT_TOLERANCE_M);
                    match postures.iter().find_map(|posture| checker.collision(posture, contact)) {
                        None => return None,
                        Some(collision) => why = collision.to_string(),
                    }
                }
            }
        }
    }
    let [x, y, z] = floor.position;
    let on = if workplace.places.on == Surface::Base { " (seen from the base)" } else { "" };
    Some(format!("a box at ({x:.2}, {y:.2}, {z:.2}){on} cannot be taken from above: {why}"))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::panic, reason = "a test may panic")]
    use super::*;

    #[test]
    fn every_built_in_robot_is_good_and_says_what_it_has() {
        for name in Robot::built_in_names() {
            let Survey { lines, faults } = survey(&Robot::built_in(name).unwrap());
            assert!(faults.is_empty(), "{faults:?}\n{lines:#?}");
            assert_eq!(lines[0], format!("robot     {name}"));
            assert!(lines.iter().any(|line| line.starts_with("posture   home: free")), "{lines:#?}");
        }
    }

    #[test]
    fn a_gripper_that_cannot_turn_does_not_take_boxes_that_lie_turned() {
        let slide = |name: &str, parent: &str, child: &str, axis: &str| {
            format!(
                "<link name='{child}'/><joint name='{name}' type='prismatic'><parent link='{parent}'/><child link='{child}'/>\
                 <axis xyz='{axis}'/><limit lower='-1' upper='1' velocity='1' effort='1'/></joint>"
            )
        };
        let finger = |name: &str, side: &str, mimic: &str| {
            format!(
                "<link name='{name}'><collision><origin xyz='0 {side}0.005 -0.06'/><geometry><box size='0.02 0.01 0.08'/></geometry>\
                 </collision></link><joint name='{name}' type='prismatic'><parent link='hand'/><child link='{name}'/>\
                 <axis xyz='0 {side}1 0'/><limit lower='0' upper='0.04' velocity='1' effort='1'/>{mimic}</joint>"
            )
        };
        let turn = |limits: &str| {
            format!(
                "<link name='hand'/><joint name='turn' type='revolute'><parent link='z'/><child link='hand'/><axis xyz='0 0 1'/>\
                 <limit {limits} velocity='1' effort='1'/></joint>"
            )
        };
        let urdf = |limits: &str| {
            [
                "<robot name='r'><link name='foot'/><link name='up'/><joint name='mount' type='fixed'><parent link='foot'/><child link='up'/>\
                 <origin xyz='0 0 1.5'/></joint>"
                    .to_owned(),
                slide("x", "up", "x", "1 0 0"),
                slide("y", "x", "y", "0 1 0"),
                slide("z", "y", "z", "0 0 1"),
                turn(limits),
                finger("a", "", ""),
                finger("b", "-", "<mimic joint='a'/>"),
                "<link name='tool'/><joint name='tool' type='fixed'><parent link='hand'/><child link='tool'/>\
                 <origin xyz='0 0 -0.1' rpy='3.141592653589793 0 0'/></joint></robot>"
                    .to_owned(),
            ]
            .concat()
        };
        let toml = "name = 'r'\nurdf = 'r'\n[arm]\njoints = ['x', 'y', 'z', 'turn']\ntool = 'tool'\n[gripper]\njoint = 'a'\nhand = 'hand'\n\
                    finger = 'a'\n[postures]\nhome = [0, 0, 0, 0]\n[workplace]\ntable = { centre = [0, 0, 0.675], size = [0.8, 1.4, 0.05] }\n\
                    boxes = { x = [-0.1, 0.1], y = [-0.1, 0.1], least = [0.05, 0.04, 0.07], greatest = [0.10, 0.05, 0.10] }\n\
                    places = { on = 'table', yaw = 0, at = [[0.2, 0.2, 0.70]] }\n";
        let faults_from = |limits: &str, home: &str| {
            let toml = toml.replace("home = [0, 0, 0, 0]", &format!("home = [0, 0, 0, {home}]"));
            let description = crate::description::RobotDescription::read(&toml).unwrap();
            let robot = Robot::of(description, &urdf(limits), None, &mut |_| unreachable!("it has no meshes")).unwrap();
            survey(&robot).faults
        };
        let faults = |limits: &str| faults_from(limits, "0");
        assert_eq!(faults("lower='-3.1' upper='3.1'"), Vec::<String>::new());
        let stiff = faults("lower='-0.01' upper='0.01'");
        let [said] = &stiff[..] else { panic!("{stiff:?}") };
        assert!(
            said.contains("turned by -45°, 45°, 90°") && said.contains("no posture of the arm gets there"),
            "{said}"
        );
        // If not even an unrotated box can be grasped, that error is enough.
        let nowhere = faults_from("lower='0.3' upper='0.4'", "0.3");
        assert!(!nowhere.is_empty() && nowhere.iter().all(|fault| !fault.contains("turned")), "{nowhere:?}");
    }

    #[test]
    fn a_rail_of_eight_metres_and_limits_beyond_half_a_turn_are_surveyed() {
        let urdf = "<robot name='rail'><link name='foot'/><link name='cart'/><link name='tool'/>\
            <joint name='rail' type='prismatic'><parent link='foot'/><child link='cart'/><axis xyz='0 0 1'/>\
            <limit lower='0' upper='8' velocity='1' effort='1'/></joint>\
            <joint name='turn' type='revolute'><parent link='cart'/><child link='tool'/><axis xyz='0 1 0'/>\
            <limit lower='3.5' upper='6' velocity='1' effort='1'/></joint></robot>";
        let toml = "name = 'rail'\nurdf = 'rail'\n[arm]\njoints = ['rail', 'turn']\ntool = 'tool'\n";
        let description = crate::description::RobotDescription::read(toml).unwrap();
        let robot = Robot::of(description, urdf, None, &mut |_| unreachable!("it has no meshes")).unwrap();
        let [below, above, _] = extent(&robot);
        assert!(below < 0.1 && above > 7.9, "{below} to {above}");
        let turning = |lower, upper| range(&Joint { lower, upper, ..robot.arm_joints()[1].clone() }, false);
        assert_eq!(turning(-2.0 * TAU, 2.0 * TAU), -PI..=PI);
        assert_eq!(turning(-3.5, 1.0), -3.5..=1.0);
        assert_eq!(turning(2.0, 20.0), 2.0..=2.0 + TAU);
    }
}
