//! Robots whose spheres are coarse: what is refused, and what is found, is what the exact shapes say.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_model::pose::Pose;
use ratn_motion::connect::{Budget, ConnectError};
use ratn_motion::exact::Exact;
use ratn_motion::geometry::Geometry;
use ratn_motion::mechanism::{MAX_JOINTS, Mechanism};
use ratn_motion::problems::Problem;
use ratn_motion::space::{Obstacle, Space};
use ratn_motion::trial::{self, Settings, Trial};

/// Excepts nothing that matters, so that all pairs with shapes are checked.
const OTHERS: &str = "<robot name='r'><disable_collisions link1='low' link2='lamp' reason='Never'/></robot>";

/// A slab whose spheres stand out by centimetres, with a rib across, and a plate 4 mm above it that slides along it and is lifted. The lamp between
/// has a shape, so that the two are no neighbours.
fn slab(srdf: Option<&str>) -> Mechanism {
    let cuboid = |at: &str, size: &str| {
        format!("<collision><origin xyz='{at}'/><geometry><box size='{size}'/></geometry></collision>")
    };
    let slide = |name: &str, parent: &str, child: &str, at: &str, axis: &str, upper: f64| {
        format!(
            "<joint name='{name}' type='prismatic'><parent link='{parent}'/><child link='{child}'/><origin xyz='{at}'/><axis xyz='{axis}'/>\
             <limit lower='-0.02' upper='{upper}' velocity='1' effort='1'/></joint>"
        )
    };
    let urdf = format!(
        "<robot name='r'><link name='low'>{}{}</link><link name='lamp'>{}</link><link name='plate'>{}</link>{}{}</robot>",
        cuboid("0.6 0 0", "2 0.4 0.04"),
        cuboid("0.6 0 0.07", "0.02 0.4 0.1"),
        cuboid("0 0 3", "0.02 0.02 0.02"),
        cuboid("0 0 0", "0.1 0.1 0.04"),
        slide("along", "low", "lamp", "0 0 0.044", "1 0 0", 1.2),
        slide("up", "lamp", "plate", "0 0 0", "0 0 1", 0.6),
    );
    Mechanism::read(&urdf, srdf, &[]).unwrap()
}

fn run(mechanism: &Mechanism, start: [f64; 2], goal: [f64; 2]) -> Trial {
    let problem = Problem { start: start.to_vec(), goal: goal.to_vec(), ..Problem::default() };
    let settings = Settings { budget: Budget { iterations: 5000, seed: 1 }, repetitions: 1, limit: f64::INFINITY };
    trial::run(mechanism, &problem, settings, &mut || 0.0)
}

#[test]
fn ends_that_only_the_spheres_find_touching_are_no_refusal_and_the_way_between_is_searched_by_the_shapes() {
    let mechanism = slab(Some(OTHERS));
    assert!(mechanism.by_shapes.is_empty() && !Space::new(&mechanism, &[]).is_free(&[0.0; MAX_JOINTS]));
    // Over the rib, which the straight way goes through.
    assert!(Exact::new(&mechanism, &[]).touch_along(&[vec![0.0, 0.0], vec![1.2, 0.0]], 100.0).is_some());
    let found = run(&mechanism, [0.0, 0.0], [1.2, 0.0]).outcome.unwrap();
    assert_eq!(found.touch, None);
    assert!(found.path.iter().any(|posture| posture[1] > 0.096), "{:?}", found.path);
}

#[test]
fn a_slot_that_only_the_spheres_find_too_narrow_is_passed_by_the_shapes() {
    let urdf = "<robot name='r'><link name='foot'/><link name='plate'><collision><geometry><box size='0.6 0.6 0.02'/></geometry></collision></link>\
                <joint name='along' type='prismatic'><parent link='foot'/><child link='plate'/><axis xyz='1 0 0'/>\
                <limit lower='-1.5' upper='1.5' velocity='1' effort='1'/></joint></robot>";
    let mechanism = Mechanism::read(urdf, None, &[]).unwrap();
    let shelf = |name: &str, z: f64| Obstacle {
        name: name.to_owned(),
        pose: Pose::at(0.0, 0.0, z),
        geometry: Geometry::Box { half: [0.15, 1.0, 0.05] },
    };
    let pass = |gap_m: f64| {
        let z = 0.06 + gap_m;
        let obstacles = vec![shelf("upper", z), shelf("lower", -z)];
        let problem = Problem { obstacles, start: vec![-1.0], goal: vec![1.0], ..Problem::default() };
        let settings = Settings { budget: Budget { iterations: 500, seed: 1 }, repetitions: 1, limit: f64::INFINITY };
        trial::run(&mechanism, &problem, settings, &mut || 0.0)
    };
    let found = pass(0.003).outcome.unwrap();
    assert_eq!((found.touch, found.path.len()), (None, 2));
    // Too narrow for the shapes, too.
    let refused = pass(-0.003);
    assert!(
        refused.outcome.is_err() && refused.diagnosis.concat().contains("plate and lower"),
        "{:?}",
        refused.diagnosis
    );
}

#[test]
fn a_path_on_which_a_pair_meets_that_the_search_does_not_see_is_searched_again_by_the_shapes() {
    let mechanism = slab(None);
    let seen = (mechanism.link("low").unwrap(), mechanism.link("plate").unwrap());
    assert!(mechanism.by_shapes.contains(&seen), "{:?}", mechanism.by_shapes);
    let found = run(&mechanism, [0.0, 0.0], [1.2, 0.0]).outcome.unwrap();
    assert_eq!(found.touch, None);
    assert!(found.path.iter().any(|posture| posture[1] > 0.096), "{:?}", found.path);
}

#[test]
fn pairs_that_the_search_does_not_see_are_looked_at_in_start_and_goal() {
    let mechanism = slab(None);
    let refused = run(&mechanism, [0.0, -0.01], [1.2, 0.0]);
    assert_eq!(refused.outcome, Err(ConnectError::Start));
    assert_eq!(refused.diagnosis, ["start state: low is 6.0 mm inside plate"]);
    let refused = run(&mechanism, [0.0, 0.0], [1.2, -0.01]);
    assert_eq!(refused.outcome, Err(ConnectError::Goal { goals: 1 }));
    assert_eq!(refused.diagnosis, ["goal state: low is 6.0 mm inside plate"]);
}
