//! Why a start or a goal is refused: the joint with its range, the two things that touch, and how deep, also where only the spheres of the search do.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_model::pose::Pose;
use ratn_motion::connect::{Budget, ConnectError};
use ratn_motion::exact::Exact;
use ratn_motion::geometry::Geometry;
use ratn_motion::mechanism::Mechanism;
use ratn_motion::problems::Problem;
use ratn_motion::space::{Obstacle, Space, state};
use ratn_motion::trial::{self, Settings, Trial};

/// A cube on a slide along z, and a cube that turns about z above it.
fn cubes(gap_m: f64) -> Mechanism {
    let cube = "<collision><geometry><box size='0.2 0.2 0.2'/></geometry></collision>";
    let urdf = format!(
        "<robot name='cubes'><link name='foot'/><link name='low'>{cube}</link><link name='high'>{cube}</link>\
         <joint name='slide' type='prismatic'><parent link='foot'/><child link='low'/><axis xyz='0 0 1'/>\
         <limit lower='-0.5' upper='0.5' velocity='1' effort='1'/></joint>\
         <joint name='turn' type='revolute'><parent link='foot'/><child link='high'/><origin xyz='0 0 {}'/><axis xyz='0 0 1'/>\
         <limit lower='-1' upper='1' velocity='1' effort='1'/></joint></robot>",
        0.2 + gap_m
    );
    Mechanism::read(
        &urdf,
        Some("<robot name='cubes'><disable_collisions link1='foot' link2='low' reason='Never'/></robot>"),
        &[],
    )
    .unwrap()
}

fn run(mechanism: &Mechanism, start: [f64; 2], goal: [f64; 2], obstacles: Vec<Obstacle>) -> Trial {
    let problem = Problem { obstacles, start: start.to_vec(), goal: goal.to_vec(), ..Problem::default() };
    let settings = Settings { budget: Budget { iterations: 1000, seed: 1 }, repetitions: 1, limit: f64::INFINITY };
    trial::run(mechanism, &problem, settings, &mut || 0.0)
}

#[track_caller]
fn says(trial: &Trial, parts: &[&str]) {
    let said = trial.diagnosis.join("\n");
    assert!(parts.iter().all(|part| said.contains(part)), "{parts:?} are not in: {said}");
}

#[test]
fn a_joint_beyond_its_range_is_named_with_the_range() {
    let refused = run(&cubes(0.3), [0.0, 0.0], [0.0, 1.25], Vec::new());
    assert_eq!(refused.outcome, Err(ConnectError::Goal { goals: 1 }));
    says(&refused, &["goal state: turn is at 1.25", "-1 to 1", "2.50e-1"]);
    let refused = run(&cubes(0.3), [-0.6, 0.0], [0.0, 0.0], Vec::new());
    assert_eq!(refused.outcome, Err(ConnectError::Start));
    says(&refused, &["start state: slide is at -0.6", "-0.5 to 0.5"]);
}

#[test]
fn what_touches_is_named_with_its_depth() {
    says(&run(&cubes(0.3), [0.35, 0.0], [0.0, 0.0], Vec::new()), &["start state: low is 50.0 mm inside high"]);
    let ball =
        Obstacle { name: "ball".into(), pose: Pose::at(0.0, 0.0, -0.14), geometry: Geometry::Sphere { radius: 0.05 } };
    says(&run(&cubes(0.3), [0.0, 0.0], [0.2, 0.0], vec![ball]), &["start state: low is 10.0 mm inside ball"]);
}

#[test]
fn what_only_the_spheres_of_the_search_touch_refuses_nothing() {
    let mechanism = cubes(0.3);
    let at = |gap_m: f64| {
        let pose = Pose::at(0.0, 0.0, -0.11 - gap_m);
        vec![Obstacle { name: "ball".into(), pose, geometry: Geometry::Sphere { radius: 0.01 } }]
    };
    let is_doubtful = |obstacles: &Vec<Obstacle>| {
        Exact::new(&mechanism, obstacles).touch(&[0.0; 2]).is_none()
            && !Space::new(&mechanism, obstacles).is_free(&state(&[0.0; 2]))
    };
    let beside = (1..30).map(|mm| at(1e-3 * f64::from(mm))).find(is_doubtful).unwrap();
    let found = |trial: Trial| trial.outcome.map(|found| (found.path.len(), found.touch));
    assert_eq!(found(run(&mechanism, [0.0, 0.0], [0.2, 0.0], beside.clone())), Ok((2, None)));
    // Through the ball there is no way.
    let refused = run(&mechanism, [0.0, 0.0], [-0.2, 0.0], beside);
    says(&refused, &["goal state: low is", "inside ball"]);
    // The cubes are a few millimetres apart at zero, and further apart below.
    let near = cubes(0.005);
    assert!(Exact::new(&near, &[]).touch(&[0.0; 2]).is_none());
    assert!(!Space::new(&near, &[]).is_free(&state(&[0.0; 2])));
    assert_eq!(found(run(&near, [-0.3, 0.0], [0.0, 0.0], Vec::new())), Ok((2, None)));
}

#[test]
fn where_there_is_no_path_it_is_said_what_is_in_the_way_and_the_search_is_not_repeated() {
    let wall = Obstacle {
        name: "wall".into(),
        pose: Pose::at(0.0, 0.0, 0.15),
        geometry: Geometry::Box { half: [0.5, 0.5, 0.01] },
    };
    let problem = Problem { obstacles: vec![wall], start: vec![0.0, 0.0], goal: vec![0.45, 0.0], ..Problem::default() };
    let mechanism = cubes(2.0);
    let times = std::cell::Cell::new(0);
    let mut clock = || {
        times.set(times.get() + 1);
        f64::from(times.get())
    };
    let mut run = |repetitions: usize, limit: f64| {
        times.set(0);
        let settings = Settings { budget: Budget { iterations: 2000, seed: 1 }, repetitions, limit };
        let trial = trial::run(&mechanism, &problem, settings, &mut clock);
        (trial, times.get())
    };
    let (once, times) = run(1, f64::INFINITY);
    assert_eq!(once.outcome, Err(ConnectError::Exhausted { iterations: 2000 }));
    says(&once, &["on the straight way low is", "inside wall", "of 100 postures drawn", "low and wall"]);
    assert!(run(50, f64::INFINITY).1 <= times + 1);
    // The clock counts how often it is asked.
    let (stopped, _) = run(50, 2.0);
    assert!(matches!(stopped.outcome, Err(ConnectError::TimeUp { .. })), "{:?}", stopped.outcome);
    says(&stopped, &["inside wall"]);
}
