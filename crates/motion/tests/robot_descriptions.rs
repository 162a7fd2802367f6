//! Robot descriptions that say something else than their author meant: read whole, or refused with the place and the likely cause.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use ratn_model::pose::Pose;
use ratn_motion::exact::Exact;
use ratn_motion::geometry::Geometry;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::looks::Looks;
use ratn_motion::mechanism::{MAX_JOINTS, Mechanism};
use ratn_motion::mesh::MeshError;
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
fn a_chain_of_more_links_than_are_supported_is_refused_and_one_of_as_many_is_read() {
    let chain = |links: usize| {
        let one = |n: usize| {
            let (name, parent) = (format!("l{n}"), format!("l{}", n - 1));
            link(&name) + &joint(&format!("j{n}"), &parent, &name)
        };
        robot(&[link("l0") + &(1..links).map(one).collect::<String>()])
    };
    says(&chain(1_025), &["1025 links", "at most 1024"]);
    assert_eq!(RobotModel::read(&chain(1_024), None).unwrap().links.len(), 1_024);
}

#[test]
fn a_colour_or_a_texture_that_names_none_is_passed_over() {
    let seen = |inside: &str| {
        robot(&[format!(
            "<link name='l'><visual><geometry><box size='1 1 1'/></geometry><material name='m &amp; n'>{inside}</material></visual></link>"
        )])
    };
    for (inside, has_colour) in
        [("<texture/>", false), ("<color/>", false), ("<texture><more/></texture><color rgba='1 0 0 1'/>", true)]
    {
        RobotModel::read(&seen(inside), None).unwrap();
        let looks = Looks::read(&seen(inside), &mut |_| Err(MeshError::Kind));
        assert_eq!(looks.lacks, [], "{inside}");
        assert_eq!(looks.visuals.iter().map(|visual| visual.colour.is_some()).collect::<Vec<_>>(), [has_colour]);
    }
    says(
        &seen("\n<color rgba='1 0 0'/>"),
        &["line 3", "`rgba` of `color` is `1 0 0` instead of 4 numbers", "the link `l`"],
    );
}

#[test]
fn a_fault_is_said_once() {
    let mesh = |attribute: &str| {
        robot(&[format!("<link name='l'><collision><geometry><mesh {attribute}/></geometry></collision></link>")])
    };
    for (attribute, fault) in [("", "`mesh` has no attribute `filename`"), ("filename='l.stl'", "no folder to look in")]
    {
        assert_eq!(refusal(&mesh(attribute)).matches(fault).count(), 1, "{}", refusal(&mesh(attribute)));
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
fn a_mimic_of_an_unknown_joint_is_refused_where_it_stands() {
    let follows = |name: &str| {
        let finger = |name: &str, more: &str| with(name, "hand", &format!("{name}_link"), more);
        let (own, mimic) =
            ("<limit lower='-1' upper='1' velocity='1' effort='1'/>", format!("<mimic joint='{name}'/>"));
        robot(&[link("hand"), link("left_link"), link("right_link"), finger("left", own), finger("right", &mimic)])
    };
    says(&follows("lift"), &["line 6", "the joint `right` mimics `lift`", "did you mean `left`?"]);
    assert!(RobotModel::read(&follows("left"), None).is_ok());
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

/// A robot whose link `foot` has this shape, on line 3.
fn shaped(geometry: &str) -> String {
    let foot = format!("<link name='foot'>\n<collision><geometry>{geometry}</geometry></collision></link>\n");
    robot(&[foot, link("tool"), joint("turn", "foot", "tool")])
}

#[test]
fn a_size_below_zero_or_without_an_end_is_refused_with_line_element_and_link() {
    for (geometry, attribute) in [
        ("<box size='0.1 -0.1 0.1'/>", "`size` of `box`"),
        ("<sphere radius='-0.1'/>", "`radius` of `sphere`"),
        ("<cylinder radius='-0.1' length='0.2'/>", "`radius` of `cylinder`"),
        ("<cylinder radius='0.1' length='-0.2'/>", "`length` of `cylinder`"),
        ("<capsule radius='-0.1' length='0.2'/>", "`radius` of `capsule`"),
        ("<capsule radius='0.1' length='-0.2'/>", "`length` of `capsule`"),
    ] {
        says(&shaped(geometry), &["line 3", attribute, "below 0", "in metres", "link `foot`"]);
        for number in ["NaN", "inf", "1e300"] {
            let geometry = geometry.replacen("-0.1", number, 1).replacen("-0.2", number, 1);
            says(&shaped(&geometry), &["line 3", attribute, number, "link `foot`"]);
        }
    }
    for scale in ["1 0 1", "1 inf 1", "1 NaN 1"] {
        let mesh = format!("<mesh filename='foot.stl' scale='{scale}'/>");
        says(&shaped(&mesh), &["line 3", "`scale` of `mesh`", scale, "link `foot`"]);
    }
    // A mesh that is mirrored is one; here only its file is missing.
    let mirrored = refusal(&shaped("<mesh filename='foot.stl' scale='1 -1 1'/>"));
    assert!(mirrored.contains("`foot.stl`") && !mirrored.contains("scale"), "{mirrored}");
}

#[test]
fn a_flat_shape_and_a_point_are_shapes() {
    for geometry in
        ["<box size='0.2 0.2 0'/>", "<box size='0 0 0'/>", "<sphere radius='0'/>", "<cylinder radius='0' length='0'/>"]
    {
        let mechanism = Mechanism::read(&shaped(geometry), None, &[]).unwrap();
        let ball = |z: f64| {
            let geometry = Geometry::Sphere { radius: 0.05 };
            [Obstacle { name: "ball".into(), pose: Pose::at(0.0, 0.0, z), geometry }]
        };
        let state: State = [0.0; MAX_JOINTS];
        assert!(Space::new(&mechanism, &ball(0.5)[..]).is_free(&state), "{geometry}");
        assert!(!Space::new(&mechanism, &ball(0.01)[..]).is_free(&state), "{geometry}");
    }
}

#[test]
fn numbers_that_no_robot_can_have_are_refused_where_they_stand() {
    let limited = |limit: &str| robot(&[link("a"), link("b"), with("turn", "a", "b", &format!("\n<limit {limit}/>"))]);
    for (limit, parts) in [
        ("lower='-1' upper='1' velocity='-1' effort='1'", ["`velocity` of `limit`", "below 0"]),
        ("lower='-1' upper='1' velocity='NaN' effort='1'", ["`velocity` of `limit`", "NaN"]),
        ("lower='NaN' upper='1' velocity='1' effort='1'", ["`lower` of `limit`", "NaN"]),
        ("lower='-1' upper='1' velocity='1' effort='1' acceleration='-2'", ["`acceleration` of `limit`", "below 0"]),
        ("lower='-1' upper='1' velocity='1' effort='1' jerk='fast'", ["`jerk` of `limit`", "a number"]),
    ] {
        says(&limited(limit), &[&parts[..], &["line 5", "joint `turn`"]].concat());
    }
    let axis = |xyz: &str| {
        let joint = with("turn", "a", "b", "").replace("<axis xyz='0 0 1'/>", &format!("\n<axis xyz='{xyz}'/>"));
        robot(&[link("a"), link("b"), joint])
    };
    says(&axis("0 0 0"), &["line 5", "`turn`", "no length", "`0 0 1`"]);
    says(&axis("0 1e300 0"), &["line 5", "`xyz` of `axis`", "joint `turn`"]);
    // What is fixed has no axis that counts.
    assert!(RobotModel::read(&axis("0 0 0").replace("revolute", "fixed"), None).is_ok());
    let heavy = |inertial: &str| robot(&[format!("<link name='a'>\n<inertial>{inertial}</inertial></link>\n")]);
    let inertia = "<inertia ixx='1' ixy='0' ixz='0' iyy='1' iyz='0' izz='1'/>";
    assert!(RobotModel::read(&heavy(&format!("<mass value='1'/>{inertia}")), None).is_ok());
    says(&heavy(&format!("<mass value='-1'/>{inertia}")), &["line 3", "`value` of `mass`", "below 0", "link `a`"]);
    says(&heavy(&format!("<mass value='NaN'/>{inertia}")), &["line 3", "`value` of `mass`", "NaN", "link `a`"]);
    let far = heavy(&format!("<origin xyz='1e9 0 0'/><mass value='1'/>{inertia}"));
    says(&far, &["line 3", "`xyz` of `origin`", "1e9", "link `a`"]);
    let broken = inertia.replace("izz='1'", "izz='inf'");
    says(&heavy(&format!("<mass value='1'/>{broken}")), &["line 3", "`izz` of `inertia`", "inf", "link `a`"]);
}
