//! Robot descriptions that say something else than their author meant: read whole, or refused with the place and the likely cause.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use ratn_model::pose::Pose;
use ratn_motion::exact::Exact;
use ratn_motion::geometry::Geometry;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::mechanism::{MAX_JOINTS, Mechanism};
use ratn_motion::reach::{Reach, Target};
use ratn_motion::robot_model::RobotModel;
use ratn_motion::robot_state::{RobotState, StateError};
use ratn_motion::space::{Obstacle, Space, State};
use std::collections::BTreeMap;

const AIMM: &str = include_str!("../robots/aimm.urdf");

fn link(name: &str) -> String {
    format!("<link name='{name}'/>\n")
}

fn joint(name: &str, parent: &str, child: &str) -> String {
    with(name, parent, child, "<limit lower='-1' upper='1' velocity='1' effort='1'/>")
}

fn with(name: &str, parent: &str, child: &str, inside: &str) -> String {
    format!(
        "<joint name='{name}' type='revolute'><parent link='{parent}'/><child link='{child}'/><axis xyz='0 0 1'/>{inside}</joint>\n"
    )
}

fn robot(parts: &[String]) -> String {
    format!("<robot name='r'>\n{}</robot>", parts.concat())
}

/// All that is said about a description.
fn refusal(urdf: &str) -> String {
    let error = RobotModel::read(urdf, None).unwrap_err();
    let mut said = error.to_string();
    let mut next = std::error::Error::source(&error);
    while let Some(cause) = next {
        said += &format!(": {cause}");
        next = cause.source();
    }
    said
}

#[track_caller]
fn says(urdf: &str, parts: &[&str]) {
    let said = refusal(urdf);
    for part in parts {
        assert!(said.contains(part), "`{part}` is not in: {said}");
    }
}

#[test]
fn a_stray_link_and_one_that_hangs_on_a_name_that_is_misspelt_are_refused() {
    let arm = [link("base"), link("upper"), joint("shoulder", "base", "upper")].concat();
    assert!(RobotModel::read(&robot(std::slice::from_ref(&arm)), None).is_ok());
    // Before the root it took its place.
    says(&robot(&[link("stray"), arm.clone()]), &["line 2", "`stray`", "`base`", "one root", "line 3"]);
    says(&robot(&[arm.clone(), link("stray")]), &["`stray`", "`base`", "one root"]);
    let hanging = |parent: &str, child: &str| robot(&[arm.clone(), link("fore"), joint("elbow", parent, child)]);
    assert_eq!(RobotModel::read(&hanging("upper", "fore"), None).unwrap().links.len(), 3);
    says(&hanging("uper", "fore"), &["line 6", "`elbow`", "no link `uper`", "did you mean `upper`?"]);
    says(&hanging("upper", "four"), &["line 6", "`elbow`", "no link `four`", "did you mean `fore`?"]);
    let circle = [link("a"), link("b"), joint("ab", "a", "b"), joint("ba", "b", "a")].concat();
    says(&robot(std::slice::from_ref(&circle)), &["circle", "`a`"]);
    says(&robot(&[arm.clone(), circle]), &["circle", "`a`", "`base`"]);
    says(
        &robot(&[arm, link("beside"), joint("again", "beside", "upper")]),
        &["`upper`", "`shoulder`", "`again`", "line 6"],
    );
}

#[test]
fn two_joints_or_links_with_one_name_are_refused_with_both_places() {
    let arm = [link("base"), link("upper"), joint("shoulder", "base", "upper")].concat();
    says(&robot(&[arm.clone(), link("upper")]), &["line 5", "link `upper`", "line 3"]);
    let again = [link("fore"), joint("shoulder", "upper", "fore")].concat();
    says(&robot(&[arm, again]), &["line 6", "joint `shoulder`", "line 4"]);
}

#[test]
fn limits_that_contradict_themselves_are_refused_and_endless_ones_are_held() {
    let turning = |limit: &str| {
        robot(&[link("base"), link("a"), link("b"), joint("other", "base", "a"), with("turn", "a", "b", limit)])
    };
    let limit = |lower: &str, upper: &str| {
        turning(&format!("<limit lower='{lower}' upper='{upper}' velocity='1' effort='1'/>"))
    };
    says(&limit("1", "-1"), &["line 6", "`turn`", "1", "-1", "above"]);
    says(&limit("inf", "inf"), &["line 6", "`turn`", "inf"]);
    let endless = RobotModel::read(&limit("-inf", "inf"), None).unwrap();
    let neutral = RobotState::neutral(&endless);
    assert_eq!(neutral.positions(), [0.0, 0.0]);
    assert!(endless.planned(&["other".to_owned()], &neutral).is_ok());
    let refused = endless.planned(&["turn".to_owned()], &neutral).unwrap_err().to_string();
    assert!(refused.contains("`turn`") && refused.contains("-inf to inf"), "{refused}");
    let wide = RobotModel::read(&limit("-1e16", "1e16"), None).unwrap();
    let refused = wide.planned(&["turn".to_owned()], &RobotState::neutral(&wide)).unwrap_err().to_string();
    assert!(refused.contains("`turn`") && refused.contains("continuous"), "{refused}");
    // Nothing is at infinity.
    for position in [f64::INFINITY, f64::NEG_INFINITY, f64::NAN] {
        let there = BTreeMap::from([("turn".to_owned(), position)]);
        let refused = RobotState::neutral(&endless).with(&endless, &there);
        assert!(matches!(refused, Err(StateError::Beyond { .. })), "{refused:?}");
    }
}

#[test]
fn what_mimics_narrows_the_limits_and_the_speed_of_the_joint_that_it_follows() {
    let followed_by = |follower: &str, mimic: &str| {
        let driver = "<limit lower='-1' upper='2' velocity='3' effort='1'/>";
        let links = [link("base"), link("a"), link("b")].concat();
        robot(&[links, with("drive", "base", "a", driver), with("follow", "a", "b", &format!("{follower}{mimic}"))])
    };
    let limits = |urdf: &str| {
        let model = RobotModel::read(urdf, None).unwrap();
        let joint = &model.joints[0];
        (joint.lower, joint.upper, joint.velocity)
    };
    let narrow = "<limit lower='-0.6' upper='0.9' velocity='1' effort='1'/>";
    assert_eq!(limits(&followed_by(narrow, "<mimic joint='drive'/>")), (-0.6, 0.9, 1.0));
    assert_eq!(limits(&followed_by(narrow, "<mimic joint='drive' multiplier='-2'/>")), (-0.45, 0.3, 0.5));
    let (lower, upper, _) = limits(&followed_by(narrow, "<mimic joint='drive' multiplier='2' offset='-0.1'/>"));
    assert!((lower + 0.25).abs() < 1e-12 && (upper - 0.5).abs() < 1e-12, "{lower} {upper}");
    // What says nothing of itself follows anywhere.
    let free = limits(&followed_by("", "<mimic joint='drive' multiplier='5'/>"));
    assert_eq!(free, (-1.0, 2.0, 3.0));
    let no_range = "<limit velocity='30' effort='1'/>";
    assert_eq!(limits(&followed_by(no_range, "<mimic joint='drive' multiplier='20'/>")), (-1.0, 2.0, 1.5));
    let model = RobotModel::read(&followed_by(narrow, "<mimic joint='drive' multiplier='2'/>"), None).unwrap();
    let there = BTreeMap::from([("drive".to_owned(), 0.5)]);
    assert!(matches!(RobotState::neutral(&model).with(&model, &there), Err(StateError::Beyond { .. })));
    says(
        &followed_by("<limit lower='5' upper='6' velocity='1' effort='1'/>", "<mimic joint='drive'/>"),
        &["`follow`", "5 to 6", "`drive`", "-1 to 2"],
    );
}

/// A slide whose screw turns a paddle `per_metre` radians for each metre; with all its turns the paddle passes a post again and again.
fn lead_screw(per_metre: f64) -> Mechanism {
    let limits = "<limit lower='0' upper='1' velocity='1' effort='1'/>";
    let urdf = format!(
        "<robot name='screw'><link name='base'/><link name='slide'/><link name='screw'><collision><origin xyz='0.2 0 0'/>\
         <geometry><box size='0.4 0.01 0.01'/></geometry></collision></link>\
         <joint name='along' type='prismatic'><parent link='base'/><child link='slide'/><axis xyz='0 0 1'/>{limits}</joint>\
         <joint name='turn' type='continuous'><parent link='slide'/><child link='screw'/><axis xyz='0 0 1'/>\
         <mimic joint='along' multiplier='{per_metre}'/></joint></robot>"
    );
    Mechanism::read(&urdf, None, &[]).unwrap()
}

#[test]
fn a_screw_that_turns_far_for_each_metre_is_looked_at_as_closely_as_it_turns() {
    for per_metre in [40.0, 400.0, 4000.0] {
        let mechanism = lead_screw(per_metre);
        // Where the paddle is after three eighths of a turn and some whole ones, half way up.
        let turns = (0.5 * per_metre / std::f64::consts::TAU).floor() + 0.375;
        let (height, angle) = (turns * std::f64::consts::TAU / per_metre, 0.375 * std::f64::consts::TAU);
        let geometry = Geometry::Sphere { radius: 0.01 };
        let pose = Pose::at(0.38 * angle.cos(), 0.38 * angle.sin(), height);
        let post = [Obstacle { name: "post".into(), pose, geometry }];
        let (from, to): (State, State) = ([0.0; MAX_JOINTS], std::array::from_fn(|j| if j == 0 { 1.0 } else { 0.0 }));
        let mut space = Space::new(&mechanism, &post);
        assert!(space.is_free(&from) && space.is_free(&to), "{per_metre}");
        assert!(!space.is_free_motion(&from, &to), "{per_metre}: looked past the post");
        let touch = Exact::new(&mechanism, &post).touch_along(&[vec![0.0], vec![1.0]], 128.0);
        assert!(touch.is_some(), "{per_metre}: the exact check looked past the post");
    }
}

/// Our arm of seven joints, and joints beside it that are planned for too and move nothing of it.
fn arm_and(others: &[&str]) -> Mechanism {
    let mut names: Vec<String> = others.iter().map(|name| (*name).to_owned()).collect();
    names.extend((1..=7).map(|i| format!("arm_joint_{i}")));
    Mechanism::read(AIMM, None, &names).unwrap()
}

#[test]
fn joints_beside_the_chain_stay_where_they_are_in_closed_form() {
    let mut mechanism = arm_and(&["tilt", "pan"]);
    (mechanism.joints[0].lower, mechanism.joints[0].upper) = (0.3, 1.2);
    let reach = Reach::new(&mechanism, mechanism.link("tool").unwrap(), Pose::IDENTITY);
    let mut random = ChaCha8Rng::seed_from_u64(4);
    let mut elsewhere = 0;
    for _ in 0..50 {
        let posture = reach.random(&mut random);
        let target = Target::at(reach.pose(&posture));
        let postures = reach.postures(&target);
        assert!(!postures.is_empty(), "{posture:?} reaches it");
        let near = reach.nearest(&postures, &posture);
        let closest = near.first().unwrap();
        assert!(ratn_motion::reach::distance(closest, &posture) < 1e-3, "{closest:?} instead of {posture:?}");
        let stayed = |found: &JointVector| found[..2] == posture[..2];
        assert!(near.iter().all(stayed));
        for _ in 0..8 {
            for found in reach.anywhere(&postures, &posture, &mut random) {
                assert!(target.is_met_by(&reach.pose(&found)));
                assert!((0.3..=1.2).contains(&found[0]));
                elsewhere += usize::from(!stayed(&found));
            }
        }
    }
    assert!(elsewhere > 50, "{elsewhere}: where the others stand in the way, no posture is found");
}
