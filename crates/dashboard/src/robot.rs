//! A robot for the pages: its links, its joints, and which joints belong to an arm, a head, fingers or a base. Pure.

use crate::film::{Film, MOST_JOINTS, Part, Track};
use crate::looks::{self, Packed};
use crate::wire;
use hyper::body::Bytes;
use ratn_model::id::InstanceId;
use ratn_model::pose::Pose;
use ratn_motion::geometry::{Body, Geometry};
use ratn_motion::looks::{Looks, VisualForm};
use ratn_motion::robot::{Configuration, Robot};
use ratn_world::scene::{Placement, Scene, SceneObject, Shape};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Maximum number of links, of joints and of shapes; a robot with more is not shown.
const MOST_LINKS: usize = 512;
const MOST_SHAPES: usize = 4_096;
/// Maximum number of objects sent.
const MOST_OBJECTS: usize = 400;
/// Maximum number of unreadable visuals that are named.
const MOST_LACKS: usize = 8;
/// Maximum length of a name; a longer one is truncated.
const MOST_CHARACTERS: usize = 200;
/// The initial posture of a cell.
const HOME: &str = "home";

/// Loads the robot of a log: the robot with its source, or why it is unknown. May read files.
#[derive(Clone)]
pub struct Robots(Arc<Load>);

type Load = dyn Fn(&str) -> Result<Known, String> + Send + Sync;

/// A robot that was loaded.
#[derive(Debug)]
pub struct Known {
    /// The robot.
    pub robot: Robot,
    /// Its visuals. A robot without visuals is drawn by its collision shapes.
    pub looks: Looks,
    /// Where it comes from, in a few words.
    pub whence: String,
}

impl Robots {
    /// With this function, which gets the robot's name or path from the log, or an empty text.
    pub fn by(load: impl Fn(&str) -> Result<Known, String> + Send + Sync + 'static) -> Robots {
        Robots(Arc::new(load))
    }

    /// Knows no robot.
    pub fn none() -> Robots {
        Robots::by(|_| Err("no robot was named".to_owned()))
    }

    pub(crate) fn load(&self, of_log: &str) -> Result<Shown, String> {
        (self.0)(of_log).and_then(|known| Shown::of(&known))
    }
}

impl std::fmt::Debug for Robots {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Robots(…)")
    }
}

/// A robot that is shown.
#[derive(Debug)]
pub(crate) struct Shown {
    told: wire::Robot,
    /// The meshes of its visuals, by number.
    meshes: Vec<Bytes>,
    joints: BTreeMap<String, usize>,
    arms: Vec<Arm>,
    head: Vec<usize>,
    base: Vec<usize>,
}

#[derive(Debug)]
struct Arm {
    name: String,
    joints: Vec<usize>,
    /// The joint of the fingers, and its open position.
    fingers: Option<(usize, f64)>,
}

impl Shown {
    fn of(known: &Known) -> Result<Shown, String> {
        let Known { robot, looks, whence } = known;
        let model = &robot.model;
        let shapes = model.links.iter().map(|link| link.bodies.len()).sum::<usize>().max(looks.visuals.len());
        if model.links.len() > MOST_LINKS || model.joints.len() > MOST_LINKS || shapes > MOST_SHAPES {
            return Err(format!(
                "{} has {} links and {shapes} shapes: at most {MOST_LINKS} and {MOST_SHAPES} are shown",
                robot.name(),
                model.links.len()
            ));
        }
        let joints: BTreeMap<String, usize> =
            model.joints.iter().enumerate().map(|(index, joint)| (joint.name.clone(), index)).collect();
        let indices =
            |of: &[ratn_motion::robot::Joint]| of.iter().filter_map(|joint| joints.get(&joint.name).copied()).collect();
        let (mut arms, mut tools) = (Vec::new(), Vec::new());
        for name in robot.arm_names() {
            let view = robot.with_arm(name).map_err(|error| error.to_string())?;
            let fingers = view.finger().and_then(|joint| Some((*joints.get(&joint.name)?, view.open_finger_m())));
            arms.push(Arm { name: name.to_owned(), joints: indices(view.arm_joints()), fingers });
            tools.push(view.tool);
        }
        let at_zero = robot.at_zero();
        let arm = robot.posture(HOME).unwrap_or(at_zero.arm);
        let start = robot.positions(&Configuration { arm, finger: robot.open_finger_m(), ..at_zero });
        let slides = |index: usize| {
            model.links.iter().filter_map(|link| link.drive).any(|drive| drive.joint == index && drive.slides)
        };
        let packed = looks::packed(&looks.meshes);
        let told = wire::Robot {
            known: true,
            name: robot.name().to_owned(),
            note: whence.clone(),
            lacks: lacks(looks),
            links: model.links.iter().map(|one| link(one, visuals(one, looks, &packed))).collect(),
            joints: (model.joints.iter().enumerate())
                .map(|(index, joint)| wire::Joint {
                    name: joint.name.clone(),
                    slides: slides(index),
                    start: round(start[index]),
                })
                .collect(),
            tools,
        };
        let (head, base) = (indices(robot.head_joints()), indices(robot.base_joints()));
        let meshes = packed.into_iter().map(|mesh| Bytes::from(mesh.bytes)).collect();
        Ok(Shown { told, meshes, arms, head, base, joints })
    }

    /// The vertices of a mesh, by its number ([`looks`]).
    pub(crate) fn mesh(&self, number: usize) -> Option<Bytes> {
        self.meshes.get(number).cloned()
    }

    /// The robot in the pages' notation.
    pub(crate) fn told(&self) -> wire::Robot {
        self.told.clone()
    }

    /// Checks whether the log may be of this robot; the error says why not.
    fn may_be_of(&self, film: &Film) -> Result<(), String> {
        let name = &self.told.name;
        match (film.drives(), self.base.is_empty()) {
            (Some(false), false) => Err(format!("{name} has a base that drives, and the system of the run had none")),
            (Some(true), true) => Err(format!("the system of the run had a base that drives, and {name} has none")),
            _ => film.parts().try_for_each(|(part, positions)| {
                let joints = self.joints_of(part)?;
                // Open fingers have no position.
                if *positions == 0 { Ok(()) } else { self.of_length(*positions, &joints) }
            }),
        }
    }

    /// Checks that there are as many positions as joints; a part without joints accepts any number.
    fn of_length(&self, positions: usize, joints: &[usize]) -> Result<(), String> {
        if joints.is_empty() || joints.len() == positions {
            return Ok(());
        }
        let name = &self.told.name;
        Err(format!("the log has positions for {positions} joints where {name} has {}", joints.len()))
    }

    /// The joints of a part, or why the robot has no such part.
    fn joints_of(&self, part: &Part) -> Result<Vec<usize>, String> {
        let name = &self.told.name;
        match part {
            Part::Named(names) => names
                .iter()
                .map(|joint| {
                    self.joints.get(joint).copied().ok_or_else(|| format!("{name} has no joint `{}`", cut(joint)))
                })
                .collect(),
            Part::Arm(arm) => Ok(self.arm(arm.as_deref())?.joints.clone()),
            Part::Fingers(arm) => {
                Ok(self.arm(arm.as_deref())?.fingers.map(|(joint, _)| vec![joint]).unwrap_or_default())
            }
            // If the robot lacks this part, the log may still be of it.
            Part::Head => Ok(self.head.clone()),
            Part::Base => Ok(self.base.clone()),
        }
    }

    /// For a robot with one arm, every name means that arm.
    fn arm(&self, name: Option<&str>) -> Result<&Arm, String> {
        let found = match (name, self.arms.as_slice()) {
            (_, [only]) => Some(only),
            (Some(name), arms) => arms.iter().find(|arm| arm.name == name),
            (None, arms) => arms.first(),
        };
        found.ok_or_else(|| format!("{} has no arm `{}`", self.told.name, cut(name.unwrap_or_default())))
    }

    fn track(&self, track: &Track, path: String) -> Result<wire::Track, String> {
        let joints = self.joints_of(&track.part)?;
        let mut points: Vec<wire::Point> = track.points.iter().map(point).collect();
        if let (Part::Fingers(arm), [open]) = (&track.part, points.as_mut_slice())
            && open.positions.is_empty()
        {
            open.positions.extend(self.arm(arm.as_deref())?.fingers.map(|(_, open_m)| open_m));
        }
        points.iter().try_for_each(|point| self.of_length(point.positions.len(), &joints))?;
        let (id, from_s, until_s, estimated) = (track.id, track.from_s, track.until_s, track.estimated);
        Ok(wire::Track { id, joints, from_s, until_s, estimated, path, points })
    }
}

/// An unknown robot.
pub(crate) fn unknown(note: String) -> wire::Robot {
    wire::Robot { note, ..wire::Robot::default() }
}

/// The cell in the pages' notation, from a version on.
pub(crate) fn cell(
    film: &Film,
    version: u64,
    robot: Result<&Shown, &str>,
    path: impl Fn(InstanceId) -> String,
) -> wire::Cell {
    let version = if version > film.version() { 0 } else { version };
    let track =
        |shown: &Shown, track: &Track| shown.track(track, track.instance.map_or_else(String::new, |id| cut(&path(id))));
    // A log that moves joints which this robot lacks is of another robot, at all its moments.
    let (fits, note, tracks) = match robot {
        Err(note) => (false, note.to_owned(), Vec::new()),
        Ok(shown) => match shown.may_be_of(film) {
            Err(note) => (false, note, Vec::new()),
            Ok(()) => match film.since(version).map(|one| track(shown, one)).collect::<Result<Vec<_>, String>>() {
                Ok(tracks) => (true, String::new(), tracks),
                Err(note) => (false, note, Vec::new()),
            },
        },
    };
    let scene = film.scene(version);
    let of = |scene: &Option<Scene>| scene.as_ref().map_or(0, |scene| scene.objects.len());
    let untold = scene.as_ref().map_or(0, of).saturating_sub(MOST_OBJECTS);
    let note = match &scene {
        Some(None) if note.is_empty() => "the facts of the log make no scene: objects are not shown".to_owned(),
        _ if note.is_empty() && film.leaves_out() => format!("motions of more than {MOST_JOINTS} joints are not shown"),
        _ => note,
    };
    wire::Cell {
        version: film.version(),
        fresh: version == 0,
        fits,
        note,
        tracks,
        kept: film.tracks().map(|track| track.id).collect(),
        base: place(&film.base()),
        objects: scene.map(|scene| scene.map_or_else(Vec::new, |scene| objects(&scene))),
        untold,
        ..wire::Cell::default()
    }
}

fn objects(scene: &Scene) -> Vec<wire::Object> {
    let told = |object: &SceneObject| {
        let (pose, held) = match object.placement {
            Placement::World(pose) => (pose, false),
            Placement::Gripper(pose) | Placement::Hand { pose, .. } => (pose, true),
        };
        let (kind, size) = match object.shape {
            Shape::Box { size } => ("box", size.to_vec()),
            Shape::Cylinder { radius, length } => ("cylinder", vec![radius, length]),
        };
        wire::Object { name: cut(&object.name), shape: shape(kind, &size, &pose), held }
    };
    scene.objects.iter().take(MOST_OBJECTS).map(told).collect()
}

/// The cell's report of an object: its bounding box.
pub(crate) fn true_object(name: &str, size: [f64; 3], pose: &Pose, held: bool) -> wire::Object {
    wire::Object { name: cut(name), shape: shape("box", &size, pose), held }
}

/// The visuals of a link. If one of them cannot be read, the collision shapes are added.
fn visuals(link: &ratn_motion::robot::Link, looks: &Looks, packed: &[Packed]) -> Vec<wire::Visual> {
    let own = looks.visuals.iter().filter(|visual| visual.link == link.name);
    let mut seen: Vec<wire::Visual> = own
        .map(|visual| {
            let colour = visual.colour.map(|colour| colour.map(round).to_vec());
            match &visual.form {
                VisualForm::Primitive(primitive) => wire::Visual { shape: body(primitive), mesh: None, colour },
                VisualForm::Mesh { mesh, pose } => {
                    let centre = Pose { position: packed[*mesh].centre, ..Pose::IDENTITY };
                    let shape = shape("mesh", &packed[*mesh].size, &pose.compose(&centre));
                    wire::Visual { shape, mesh: Some(*mesh), colour }
                }
            }
        })
        .collect();
    if !looks.visuals.is_empty() && looks.lacks.iter().any(|lack| lack.link == link.name) {
        let stands_in = |one: &Body| wire::Visual { shape: body(one), mesh: None, colour: None };
        seen.extend(link.bodies.iter().map(stands_in));
    }
    seen
}

/// The visuals that are missing, in a sentence each.
fn lacks(looks: &Looks) -> Vec<String> {
    let told = looks.lacks.iter().take(MOST_LACKS).map(|lack| match lack.link.as_str() {
        "" => cut(&lack.reason),
        link => cut(&format!("{link}: {}", lack.reason)),
    });
    let more = looks.lacks.len().saturating_sub(MOST_LACKS);
    told.chain((more > 0).then(|| format!("{more} more"))).collect()
}

fn link(link: &ratn_motion::robot::Link, visuals: Vec<wire::Visual>) -> wire::Link {
    wire::Link {
        name: link.name.clone(),
        parent: link.parent,
        at: place(&link.origin),
        joint: link.drive.map(|drive| drive.joint),
        axis: link.drive.map_or_else(|| vec![0.0, 0.0, 1.0], |drive| drive.axis.map(round).to_vec()),
        slides: link.drive.is_some_and(|drive| drive.slides),
        factor: link.drive.map_or(1.0, |drive| drive.factor),
        shapes: link.bodies.iter().map(body).collect(),
        visuals,
    }
}

fn body(body: &Body) -> wire::Shape {
    let (kind, size) = match body.geometry {
        Geometry::Box { half } => ("box", half.map(|half| 2.0 * half).to_vec()),
        Geometry::Cylinder { radius, half_length } => ("cylinder", vec![radius, 2.0 * half_length]),
        Geometry::Capsule { radius, half_length } => ("capsule", vec![radius, 2.0 * half_length]),
        Geometry::Sphere { radius } => ("sphere", vec![radius, 0.0]),
    };
    shape(kind, &size, &body.upright())
}

fn shape(kind: &'static str, size: &[f64], at: &Pose) -> wire::Shape {
    wire::Shape { kind, size: size.iter().copied().map(round).collect(), at: place(at) }
}

fn place(pose: &Pose) -> wire::Place {
    wire::Place { position: pose.position.map(round).to_vec(), quaternion: pose.quaternion_xyzw.map(round).to_vec() }
}

fn point(point: &ratn_model::value::TrajectoryPoint) -> wire::Point {
    let rounded = |values: &[f64]| values.iter().copied().map(round).collect();
    // Velocities in another number than the joints are ignored.
    let velocities =
        if point.velocities.len() == point.positions.len() { rounded(&point.velocities) } else { Vec::new() };
    wire::Point { after_s: point.time_s, positions: rounded(&point.positions), velocities }
}

/// Rounds to a micrometre, or a microradian: shorter to send, and invisible.
fn round(value: f64) -> f64 {
    let rounded = (value * 1e6).round() / 1e6;
    match rounded.is_finite() {
        true if rounded == 0.0 => 0.0,
        true => rounded,
        // A value this large has no such digits.
        false => value,
    }
}

fn cut(text: &str) -> String {
    text.chars().take(MOST_CHARACTERS).collect()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    fn shown(name: &str) -> Shown {
        let (robot, looks) = (Robot::built_in(name).unwrap(), Looks::default());
        Shown::of(&Known { robot, looks, whence: "the test".to_owned() }).unwrap()
    }

    fn film(lines: &[&str]) -> Film {
        let mut film = Film::default();
        lines.iter().for_each(|line| film.apply(&serde_json::from_str(line).unwrap()));
        film
    }

    const MOVE_TO: &str = r#"{"at":1000000000,"command":"start","instance":1,"attempt":1,"goal":{"provider":"arm","action":"move_to","inputs":{"joints":{"joints":[0.1,0.2,0.3,0.4,0.5,0.6,0.7]}},"seed":1,"lease":{"id":1,"token":1,"resources":[{"id":"arm@sim","kind":"Arm","endpoint":""}]},"projection":null,"expected_s":4.0}}"#;
    const GRASPED: [&str; 2] = [
        r#"{"at":1,"command":"start","instance":2,"attempt":1,"goal":{"provider":"gripper","action":"grasp","inputs":{},"seed":1,"lease":null,"projection":null,"expected_s":null}}"#,
        r#"{"at":2000000000,"event":"finished","instance":2,"attempt":1,"outcome":"success","outputs":{"width_m":{"float":0.07}},"measured":[],"reason":""}"#,
    ];
    const FOREIGN: &str = r#"{"at":1000000000,"command":"start","instance":3,"attempt":1,"goal":{"provider":"arm","action":"follow","inputs":{"trajectory":{"trajectory":{"joints":["elbow"],"points":[{"time_s":0.0,"positions":[0.0],"velocities":[]}]}}},"seed":1,"lease":null,"projection":null,"expected_s":null}}"#;

    #[test]
    fn a_robot_is_told_as_a_tree_whose_mimics_follow_the_joint_that_they_mimic() {
        for name in Robot::built_in_names() {
            let robot = shown(name).told();
            assert!(robot.links[0].parent.is_none() && robot.links.iter().skip(1).all(|link| link.parent.is_some()));
            let after = |(index, link): (usize, &wire::Link)| link.parent.is_none_or(|parent| parent < index);
            assert!(robot.links.iter().enumerate().all(after), "parents come first");
            let fingers = robot.joints.iter().enumerate().filter(|(_, joint)| joint.name.ends_with("finger"));
            for (finger, joint) in fingers.clone() {
                assert_eq!(robot.links.iter().filter(|link| link.joint == Some(finger)).count(), 2, "{name}");
                assert!(joint.slides && joint.start > 0.0, "the fingers begin open");
            }
            assert_eq!(fingers.count(), robot.tools.len(), "{name}");
            assert!(robot.tools.iter().all(|tool| robot.links[*tool].name.ends_with("tool")));
        }
        let aimm = shown("aimm").told();
        let mast = aimm.links.iter().find(|link| link.name == "mast").unwrap();
        assert_eq!((mast.shapes[0].kind, mast.shapes[0].size.as_slice()), ("cylinder", &[0.03, 1.4][..]));
        assert_eq!(mast.shapes[0].at.quaternion, [0.0, 0.0, 0.0, 1.0], "it stands upright");
    }

    /// The frames as the pages compute them.
    fn frames(robot: &wire::Robot, positions: &[f64]) -> Vec<Pose> {
        let three = |values: &[f64]| <[f64; 3]>::try_from(values).unwrap();
        let mut frames: Vec<Pose> = Vec::new();
        for link in &robot.links {
            let quaternion_xyzw = link.at.quaternion.as_slice().try_into().unwrap();
            let at = Pose { position: three(&link.at.position), quaternion_xyzw };
            let drive = |joint| ratn_motion::robot::Drive {
                joint,
                axis: three(&link.axis),
                slides: link.slides,
                factor: link.factor,
            };
            let moved = link.joint.map_or(at, |joint| at.compose(&drive(joint).moved(positions[joint])));
            frames.push(link.parent.map_or(moved, |parent| frames[parent].compose(&moved)));
        }
        frames
    }

    #[test]
    fn the_links_that_are_told_stand_where_those_of_the_robot_do() {
        for name in Robot::built_in_names() {
            let robot = Robot::built_in(name).unwrap();
            let at_zero = robot.at_zero();
            let mut arm = robot.posture("home").unwrap();
            arm.iter_mut().enumerate().for_each(|(index, joint)| *joint += 0.1 * index as f64);
            let there = Configuration { base: [1.0, -2.0, 0.7], arm, pan: 0.3, tilt: 0.2, finger: 0.02, ..at_zero };
            let told = frames(&shown(name).told(), &robot.positions(&there));
            for (own, told) in robot.poses(&there).iter().zip(&told) {
                let apart = own.inverse().compose(told).position;
                assert!(apart.iter().all(|metres| metres.abs() < 1e-4), "{name}: {apart:?}");
            }
        }
    }

    #[test]
    fn a_motion_to_a_posture_takes_as_long_as_is_expected_and_fingers_half_of_their_opening() {
        let lines = [&[MOVE_TO][..], &GRASPED].concat();
        let shown = shown("aimm");
        let cell = cell(&film(&lines), 0, Ok(&shown), |id| format!("state {}", id.0));
        assert!(cell.fits && cell.fresh, "{}", cell.note);
        let [moved, fingers] = cell.tracks.as_slice() else { panic!("{:?}", cell.tracks) };
        assert_eq!((moved.path.as_str(), moved.estimated, moved.joints.len()), ("state 1", true, 7));
        assert_eq!((moved.from_s, moved.points[0].after_s, moved.points[0].positions[6]), (1.0, 4.0, 0.7));
        let name = &shown.told.joints[fingers.joints[0]].name;
        assert_eq!((name.as_str(), fingers.points[0].positions.as_slice()), ("finger", &[0.035][..]));
    }

    #[test]
    fn a_log_of_another_robot_shows_no_robot_and_says_why() {
        let shown_robot = shown("aimm");
        let other = cell(&film(&[FOREIGN]), 0, Ok(&shown_robot), |_| String::new());
        assert_eq!((other.fits, other.note.as_str()), (false, "aimm has no joint `elbow`"));
        let six = shown("ur5");
        let seven = cell(&film(&[MOVE_TO]), 0, Ok(&six), |_| String::new());
        assert_eq!(seven.note, "the log has positions for 7 joints where ur5 has 6");
        let standing = r#"{"at":0,"event":"started","task":"t","digest":"d","mode":"cdtn","parameters":{},"seed":1,"world":[],"revision":1,"capacity":{"Arm":1,"Gripper":1}}"#;
        let of_panda = cell(&film(&[standing]), 0, Ok(&shown_robot), |_| String::new());
        assert_eq!(of_panda.note, "aimm has a base that drives, and the system of the run had none");
        let unknown = cell(&film(&[MOVE_TO]), 0, Err("no robot was named"), |_| String::new());
        assert_eq!((unknown.fits, unknown.note.as_str(), unknown.tracks.len()), (false, "no robot was named", 0));
    }

    #[test]
    fn a_log_of_another_robot_does_not_become_one_of_this_with_time() {
        let mut film = film(&[FOREIGN]);
        // As many motions under way as it takes for the earlier track to be dropped.
        let known = FOREIGN.replace("elbow", "arm_joint_1");
        for id in 10..210 {
            let line = known.replace(r#""instance":3"#, &format!(r#""instance":{id}"#));
            film.apply(&serde_json::from_str(&line).unwrap());
        }
        assert!(film.tracks().all(|track| track.part == Part::Named(vec!["arm_joint_1".to_owned()])));
        let told = cell(&film, 0, Ok(&shown("aimm")), |_| String::new());
        assert_eq!((told.fits, told.note.as_str()), (false, "aimm has no joint `elbow`"));
    }

    #[test]
    fn that_motions_of_very_many_joints_are_left_out_is_said() {
        let names: Vec<String> = (0..65).map(|number| format!("\"j{number}\"")).collect();
        let wide = FOREIGN.replace(r#"["elbow"]"#, &format!("[{}]", names.join(",")));
        let told = cell(&film(&[&wide]), 0, Ok(&shown("aimm")), |_| String::new());
        assert_eq!((told.fits, told.note.as_str()), (true, "motions of more than 64 joints are not shown"));
    }

    #[test]
    fn a_number_without_a_millionth_is_told_as_it_is() {
        for (value, told) in [(1e305, 1e305), (-1.7e308, -1.7e308), (0.123_456_7, 0.123_457), (-1e-9, 0.0)] {
            assert_eq!(round(value).to_bits(), f64::to_bits(told), "{value}");
        }
    }

    #[test]
    fn objects_are_told_once_until_one_of_them_changes() {
        let started = r#"{"at":0,"event":"started","task":"t","digest":"d","mode":"cdtn","parameters":{},"seed":1,"world":[[{"predicate":"shape","arguments":["box"]},{"map":{"type":{"string":"box"},"size":{"list":[{"float":0.1},{"float":0.2},{"float":0.3}]}}}],[{"predicate":"at","arguments":["box"]},{"pose":{"position":[1.0,0.0,0.5],"quaternion_xyzw":[0.0,0.0,0.0,1.0]}}]],"revision":1}"#;
        let held = r#"{"at":1,"event":"world_changed","revision":2,"facts":[[{"predicate":"in_gripper","arguments":["box"]},{"pose":{"position":[0.0,0.0,0.05],"quaternion_xyzw":[0.0,0.0,0.0,1.0]}}]]}"#;
        let mut film = film(&[started]);
        let shown = shown("aimm");
        let first = cell(&film, 0, Ok(&shown), |_| String::new());
        let objects = first.objects.unwrap();
        assert_eq!(
            (objects[0].name.as_str(), objects[0].shape.size.as_slice(), objects[0].held),
            ("box", &[0.1, 0.2, 0.3][..], false)
        );
        assert_eq!(cell(&film, first.version, Ok(&shown), |_| String::new()).objects, None);
        film.apply(&serde_json::from_str(held).unwrap());
        let after = cell(&film, first.version, Ok(&shown), |_| String::new());
        assert!(!after.fresh && after.objects.unwrap()[0].held);
    }
}
