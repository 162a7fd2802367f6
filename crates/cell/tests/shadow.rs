//! What the arm hides from the camera while it carries something: why a look beside a motion may have to be taken again.

#![allow(clippy::unwrap_used, clippy::print_stdout, reason = "a test may panic and print")]

use ratn_cell::core::picture::develop;
use ratn_cell::core::protocol::{Command, Ending, Product, Request};
use ratn_model::pose::Pose;
use ratn_motion::aimm;
use ratn_motion::plan::Goal;

mod bench;
use bench::{Bench, grasp};

/// How much nearer than a point something has to be in the picture to be in its way, in metres.
const NEARER_M: f64 = 0.03;

/// How much of the top of an object is hidden in a picture that is taken now, 0 to 1.
fn hidden(bench: &mut Bench, object: usize) -> f64 {
    let (ticket, mut commands) = bench.start(Request::Capture { frames: 10 });
    let captured =
        |commands: &[Command]| {
            commands.iter().find_map(|command| match command {
                Command::Ended {
                    ticket: ended, ending: Ending::Done(Product::Captured { camera, exposures }), ..
                } if *ended == ticket => Some((*camera, exposures.clone())),
                _ => None,
            })
        };
    let (camera, exposures) = loop {
        if let Some(captured) = captured(&commands) {
            break captured;
        }
        commands = bench.pass(0.05);
    };
    let noise = &bench.cell.config().camera.noise;
    let image = develop(bench.cell.robot(), &camera, noise, bench.cell.seed(), &exposures);
    let truth = &bench.cell.ground_truth()[object];
    let side = [-0.4, -0.2, 0.0, 0.2, 0.4];
    let top = side.iter().flat_map(|x| side.map(|y| [x * truth.size[0], y * truth.size[1], truth.size[2] / 2.0]));
    let is_hidden = |point: [f64; 3]| {
        let [x, y, depth] = camera.pose.inverse().transform(truth.pose.transform(point));
        let at = camera.intrinsics;
        let [column, row] = [at.fx * x / depth + at.cx, at.fy * y / depth + at.cy].map(|pixel| pixel.round() as usize);
        image.at(column, row).is_none_or(|seen| seen < depth - NEARER_M)
    };
    top.filter(|point| is_hidden(*point)).count() as f64 / 25.0
}

/// How much of the second box is hidden in each picture while the first one is carried to the deck, and in one when it is there.
fn carried(seed: u64) -> (Vec<f64>, f64) {
    let mut bench = Bench::new(2, seed);
    bench.done(Request::LookAt { target: [0.80, 0.0, 0.70] });
    bench.reach_for(0);
    bench.done(grasp());
    let held = bench.cell.ground_truth()[0].clone();
    let in_tool = bench.cell.robot().tool_pose(&bench.cell.configuration()).inverse().compose(&held.pose);
    let slot = aimm::slots()[4].compose(&Pose::at(0.0, 0.0, held.size[2] / 2.0 + 0.003));
    let goals = vec![Goal::Pose(slot.compose(&in_tool.inverse()))];
    let trajectory = bench.plan(&bench.cell.scene(), goals, 0.10, 0.10);
    let ends = trajectory.points.last().unwrap().time_s;
    assert_eq!(bench.start(Request::Follow { trajectory }).1, []);
    let began = bench.now;
    let mut while_it_moves = Vec::new();
    while bench.now.since(began).as_secs_f64() < ends {
        while_it_moves.push(hidden(&mut bench, 1));
    }
    bench.pass(2.0);
    (while_it_moves, hidden(&mut bench, 1))
}

#[test]
fn the_arm_may_hide_the_next_box_while_it_carries_this_one_and_not_when_it_has_come_to_the_deck() {
    let seen = [1, 2, 3, 4].map(carried);
    println!("{seen:.2?}");
    assert!(seen.iter().any(|(while_it_moves, _)| while_it_moves.iter().any(|share| *share > 0.5)), "{seen:.2?}");
    assert!(seen.iter().all(|(_, there)| *there < 0.1), "{seen:.2?}");
}
