//! Joints that turn without end go the short way, and the long way where the short one is blocked.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_model::pose::Pose;
use ratn_motion::connect::Budget;
use ratn_motion::geometry::Geometry;
use ratn_motion::mechanism::Mechanism;
use ratn_motion::problems::Problem;
use ratn_motion::space::Obstacle;
use ratn_motion::trial::{self, Found, Settings};
use std::f64::consts::TAU;

/// A hand of a clock, and a second one at its end.
fn clock(kind: &str, beside: &str) -> Mechanism {
    let hand = |name: &str, parent: &str, x: f64| {
        format!(
            "<link name='{name}'><collision><origin xyz='0.2 0 0'/><geometry><box size='0.36 0.02 0.02'/></geometry></collision></link>\
             <joint name='{name}_turns' type='{kind}'><parent link='{parent}'/><child link='{name}'/><origin xyz='{x} 0 0'/>\
             <axis xyz='0 0 1'/><limit lower='-3.1' upper='3.1' velocity='1' effort='1'/></joint>"
        )
    };
    let urdf = format!(
        "<robot name='clock'><link name='foot'/>{}{}{beside}</robot>",
        hand("first", "foot", 0.0),
        hand("second", "first", 0.4)
    );
    let excepted = "<robot name='clock'><disable_collisions link1='first' link2='second'/></robot>";
    Mechanism::read(&urdf, Some(excepted), &["first_turns".to_owned(), "second_turns".to_owned()]).unwrap()
}

fn solve(mechanism: &Mechanism, start: [f64; 2], goal: [f64; 2], obstacles: &[Obstacle]) -> Option<Found> {
    let obstacles = obstacles.to_vec();
    let problem = Problem { obstacles, start: start.to_vec(), goal: goal.to_vec(), ..Problem::default() };
    let settings = Settings { budget: Budget { iterations: 20_000, seed: 1 }, repetitions: 1 };
    trial::run(mechanism, &problem, settings, &mut || 0.0).outcome.ok()
}

/// It begins at the start, ends at the goal but for whole turns, goes on without a jump, and touches nothing.
#[track_caller]
fn check(found: &Found, start: [f64; 2], goal: [f64; 2], length_rad: std::ops::Range<f32>) {
    let (first, last) = (&found.path[0], &found.path[found.path.len() - 1]);
    for j in 0..2 {
        assert!((first[j] - start[j]).abs() < 1e-5, "{first:?} is not {start:?}");
        let turns = (last[j] - goal[j]) / TAU;
        assert!((turns - turns.round()).abs() < 1e-5, "{last:?} is not {goal:?}");
    }
    let way: f64 = found.path.windows(2).map(|pair| (pair[1][0] - pair[0][0]).hypot(pair[1][1] - pair[0][1])).sum();
    assert!((way - f64::from(found.length_rad)).abs() < 1e-3, "{way}");
    assert!(length_rad.contains(&found.length_rad), "{}", found.length_rad);
    assert_eq!(found.touch, None);
}

#[test]
fn the_way_between_postures_that_are_nearly_a_turn_apart_is_short() {
    let mechanism = clock("continuous", "");
    for (start, goal, length_rad) in [
        ([3.0, 0.0], [-3.0, 0.0], 0.28..0.29),
        ([-3.0, 2.5], [3.0, -2.5], 1.30..1.33),
        ([0.5, 0.0], [0.5 + 2.0 * TAU, 0.0], 0.0..1e-3),
        // Beyond half a turn.
        ([5.0 * TAU + 0.1, 0.0], [-0.1, 4.0], 2.28..2.31),
    ] {
        check(&solve(&mechanism, start, goal, &[]).unwrap(), start, goal, length_rad);
    }
}

#[test]
fn positions_that_are_too_many_turns_from_zero_are_refused_and_say_so() {
    let mechanism = clock("continuous", "");
    let far = 1e4 * TAU;
    check(&solve(&mechanism, [far - 1.0, 0.0], [0.5, 0.0], &[]).unwrap(), [far - 1.0, 0.0], [0.5, 0.0], 1.49..1.51);
    for (start, goal, which) in [([far + 1.0, 0.0], [0.5, 0.0], "start"), ([0.5, 0.0], [0.0, -1e16], "goal")] {
        let problem = Problem { start: start.to_vec(), goal: goal.to_vec(), ..Problem::default() };
        let settings = Settings { budget: Budget { iterations: 20_000, seed: 1 }, repetitions: 1 };
        let trial = trial::run(&mechanism, &problem, settings, &mut || 0.0);
        assert!(trial.outcome.is_err(), "{:?}", trial.outcome);
        let said = trial.diagnosis.join("; ");
        assert!(said.contains(which) && said.contains("turns from zero") && said.contains("10000"), "{said}");
    }
    // A joint with limits is what they say.
    assert!(solve(&clock("revolute", ""), [far, 0.0], [0.5, 0.0], &[]).is_none());
}

#[test]
fn where_the_short_way_is_blocked_it_turns_the_other_way() {
    let mechanism = clock("continuous", "");
    let pose = Pose::at(-0.3, 0.0, 0.0);
    let post = [Obstacle { name: "post".into(), pose, geometry: Geometry::Sphere { radius: 0.03 } }];
    let (start, goal) = ([2.7, 0.0], [-2.7, 0.0]);
    check(&solve(&mechanism, start, goal, &[]).unwrap(), start, goal, 0.88..0.89);
    check(&solve(&mechanism, start, goal, &post).unwrap(), start, goal, 5.3..5.5);
}

#[test]
fn joints_with_limits_and_those_that_others_follow_turn_as_before() {
    let (start, goal) = ([3.0, 0.0], [-3.0, 0.0]);
    let limited = clock("revolute", "");
    check(&solve(&limited, start, goal, &[]).unwrap(), start, goal, 5.9..6.1);
    assert!(solve(&limited, [0.5, 0.0], [0.5 + TAU, 0.0], &[]).is_none());
    // After a whole turn of the first hand the wheel is half a turn on.
    let wheel = "<link name='wheel'/><joint name='wheel_turns' type='continuous'><parent link='foot'/><child link='wheel'/>\
                 <axis xyz='0 0 1'/><mimic joint='first_turns' multiplier='0.5'/></joint>";
    let followed = clock("continuous", wheel);
    check(&solve(&followed, start, goal, &[]).unwrap(), start, goal, 5.9..6.1);
    let (start, goal) = ([0.0, 3.0], [0.0, -3.0]);
    check(&solve(&followed, start, goal, &[]).unwrap(), start, goal, 0.28..0.29);
}
