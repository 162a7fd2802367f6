//! What the cell tells the robot differs from what is true, by errors of stated sizes from a seed; what the judge sees does not.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_cell::config::{CellConfig, ErrorsConfig};
use ratn_cell::core::protocol::{Product, Request};
use ratn_model::pose::Pose;
use ratn_motion::aimm;
use ratn_motion::base::{DriveRequest, plan_drive};
use ratn_motion::pace::Control;
use ratn_motion::plan::Goal;
use ratn_world::scene::Scene;

mod bench;
use bench::Bench;

const ROUGH: ErrorsConfig = ErrorsConfig::ROUGH;

fn bench(seed: u64, errors: ErrorsConfig) -> Bench {
    Bench::of(CellConfig { boxes: 1, seed, errors, ..CellConfig::default() })
}

#[test]
fn the_arm_is_where_its_encoders_do_not_quite_have_it() {
    let mut greatest: f64 = 0.0;
    for seed in 1..=5 {
        let mut bench = bench(seed, ROUGH);
        bench.done(Request::MoveTo { joints: aimm::OBSERVATION, speed: 0.5 });
        let Product::ArmSensed { joints } = bench.done(Request::SenseArm) else { panic!() };
        assert_eq!(joints, aimm::OBSERVATION, "controllers drive to where the encoders say");
        let off = (0..7).map(|j| (bench.cell.configuration().arm[j] - joints[j]).abs()).fold(0.0, f64::max);
        greatest = greatest.max(off);
        assert!(off > 0.0 && off < 6.0 * (ROUGH.encoder_rad + ROUGH.encoder_wave_rad), "seed {seed}: {off}");
    }
    assert!(greatest > ROUGH.encoder_rad, "{greatest}");
}

#[test]
fn the_base_believes_to_stand_beside_where_it_stands_and_elsewhere_beside_at_every_stop() {
    let mut bench = bench(7, ROUGH);
    bench.go_believing(&Scene { base: Pose::IDENTITY, objects: vec![] }, Goal::Joints(aimm::STOWED));
    let mut offs: Vec<Pose> = Vec::new();
    for goal in [[-1.0, 0.0, 0.0], [-1.0, 0.5, 0.3], [-1.5, 0.0, 0.0]] {
        let Product::BaseSensed { pose } = bench.done(Request::SenseBase) else { panic!() };
        offs.push(pose.inverse().compose(&bench.cell.base_pose()));
        let request = DriveRequest {
            start: bench.cell.measured(),
            goals: vec![goal],
            position_tolerance_m: 0.0,
            heading_tolerance_rad: 0.0,
            seen: None,
            speed: 0.7,
            seed: 2,
        };
        let scene = Scene { base: pose, objects: vec![] };
        let drive = plan_drive(bench.cell.robot(), &scene, &request, &mut |_| Control::Continue).unwrap();
        let Product::Driven { end, .. } = bench.done(Request::Drive { trajectory: drive.trajectory }) else { panic!() };
        assert_eq!(bench.done(Request::SenseBase), Product::BaseSensed { pose: end });
        let (believed, stands) = (Pose::at(goal[0], goal[1], 0.0), bench.cell.base_pose());
        assert!(end.distance(&believed) > 1e-4, "at the stop it is localised anew");
        let far = 6.0 * ROUGH.localisation_m;
        assert!(stands.distance(&believed) < far && stands.distance(&end) < far, "{stands:?} {end:?}");
    }
    for (i, off) in offs.iter().enumerate() {
        assert!(off.distance(&Pose::IDENTITY) > 1e-4, "{offs:?}");
        assert!(offs[..i].iter().all(|other| other.distance(off) > 1e-4), "{offs:?}");
    }
}

#[test]
fn the_camera_is_not_quite_where_it_is_said_to_be() {
    let mut bench = bench(3, ROUGH);
    bench.done(Request::LookAt { target: aimm::TABLE_CENTRE });
    let Product::Captured { camera, exposures } = bench.done(Request::Capture { frames: 2 }) else { panic!() };
    let scenery = &exposures[0].scenery;
    assert_eq!(camera.pose, bench.cell.robot().camera_pose(&bench.cell.measured()).unwrap());
    assert_eq!(scenery.measured, bench.cell.measured(), "the robot is told where it has itself");
    // As seen from the base: where that stands is another matter.
    let told = bench.cell.believed_base_pose().inverse().compose(&camera.pose);
    let eye = bench.cell.base_pose().inverse().compose(&scenery.eye);
    let (far, turned) = (told.distance(&eye), told.angle(&eye));
    assert!(far > 0.1 * ROUGH.camera_m && far < 6.0 * ROUGH.camera_m, "{far} m");
    assert!(turned > 0.1 * ROUGH.camera_rad && turned < 6.0 * ROUGH.camera_rad, "{turned} rad");
}

#[test]
fn what_is_in_the_hand_is_felt_across_the_fingers_and_believed_along_them() {
    let mut bench = bench(4, ErrorsConfig::NONE);
    bench.reach_for(0);
    let truth = bench.cell.ground_truth()[0].clone();
    let tool = bench.cell.robot().tool_pose(&bench.cell.configuration());
    let true_in_tool = tool.inverse().compose(&truth.pose);
    // Seen 6 mm too far along the fingers, 4 mm too far across them, 3 mm too high.
    let [x, y, z] = true_in_tool.position;
    let believed = Pose { position: [x + 0.006, y + 0.004, z + 0.003], ..true_in_tool };
    let request = Request::Grasp { object: "box_1".to_owned(), expected: Some(believed) };
    let Product::Grasped { in_gripper: Some(felt), .. } = bench.done(request) else { panic!() };
    let held = bench.cell.ground_truth()[0].pose;
    let held = bench.cell.robot().tool_pose(&bench.cell.configuration()).inverse().compose(&held);
    let off: [f64; 3] = std::array::from_fn(|i| felt.position[i] - held.position[i]);
    assert!((off[0] - 0.006).abs() < 1e-3 && (off[2] - 0.003).abs() < 1e-3, "nobody measured that: {off:?}");
    assert!(off[1].abs() < 1e-6, "the fingers are at both of its faces: {off:?}");
}
