//! What an arm keeps from another arm and from the head of the same robot, also while its fingers open: two gantries whose hands slide along x, y and z, and a head with a
//! stick, so that every distance is known.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_cell::config::CellConfig;
use ratn_cell::core::cell::Cell;
use ratn_cell::core::protocol::{Command, Ending, Event, Request, Ticket};
use ratn_cell::core::snapshot::Snapshot;
use ratn_model::pose::Pose;
use ratn_model::value::TrajectoryPoint;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::timing::{Section, parameterise};
use std::f64::consts::FRAC_PI_2;
use tempfile::TempDir;

mod bench;
#[allow(dead_code, reason = "not every test needs all of it")]
mod duo;
mod gantry;
use bench::{Bench, grasp as close};
use gantry::*;

fn starts(bench: &mut Bench, arm: usize, request: Request) -> Ticket {
    let (ticket, commands) = bench.start_with(arm, request);
    assert_eq!(commands, []);
    ticket
}

/// Why a cell with this robot is refused.
fn refused_robot(description: &str) -> String {
    let folder = tempfile::tempdir().unwrap();
    Cell::new(config(folder.path(), description)).err().unwrap().to_string()
}

#[test]
fn closed_fingers_of_an_arm_that_stands_are_in_the_way_where_they_are() {
    let (mut bench, _folder) = gantry();
    let (before, between) = (between_the_fingers(0.1), between_the_fingers(0.0));
    // Through open fingers.
    goes(&mut bench, RIGHT, before);
    goes(&mut bench, RIGHT, between);
    goes(&mut bench, RIGHT, before);
    assert_eq!(bench.cell.unintended_contacts(), []);
    assert!(matches!(bench.perform_with(LEFT, close()), Ending::Aborted(_)), "they close around nothing");
    assert_eq!(bench.cell.measured_of(LEFT).finger, 0.0);
    let reason = refused(&mut bench, RIGHT, to(between, 0.5));
    assert!(reason.contains("the trajectory is refused") && reason.contains("left_finger"), "{reason}");
    // Nor where they will be when they open.
    let [x, y, z] = between;
    let reason = refused(&mut bench, RIGHT, to([x, y + 0.045, z], 0.5));
    assert!(reason.contains("the trajectory is refused") && reason.contains("left_finger"), "{reason}");
}

#[test]
fn fingers_do_not_close_on_another_arm_that_stands_between_them() {
    let (mut bench, _folder) = gantry();
    goes(&mut bench, RIGHT, between_the_fingers(0.1));
    goes(&mut bench, RIGHT, between_the_fingers(0.0));
    let reason = refused(&mut bench, LEFT, close());
    assert!(reason.starts_with("the fingers stay where they are: left_finger"), "{reason}");
    assert!(reason.contains("nearer than 3 mm to right_hand of the arm `right`, which stands there"), "{reason}");
    assert_eq!(bench.cell.measured_of(LEFT).finger, 0.04);
    goes(&mut bench, RIGHT, between_the_fingers(0.1));
    let ending = bench.perform_with(LEFT, close());
    assert!(matches!(&ending, Ending::Aborted(reason) if reason.contains("nothing stopped the fingers")), "{ending:?}");
    assert_eq!(bench.cell.unintended_contacts(), []);
}

#[test]
fn fingers_do_not_close_on_the_way_of_another_arm_nor_does_an_arm_set_out_between_closing_fingers() {
    let (mut bench, _folder) = gantry();
    goes(&mut bench, RIGHT, between_the_fingers(0.1));
    let (_, commands) = bench.start_with(RIGHT, to(between_the_fingers(0.0), 0.1));
    assert_eq!(commands, []);
    let reason = refused(&mut bench, LEFT, close());
    assert!(
        reason.contains("nearer than 20 mm to right_hand of the arm `right`, which is under way with goal"),
        "{reason}"
    );

    let (mut bench, _folder) = gantry();
    goes(&mut bench, RIGHT, between_the_fingers(0.1));
    let (_, commands) = bench.start_with(LEFT, close());
    assert_eq!(commands, []);
    let reason = refused(&mut bench, RIGHT, to(between_the_fingers(0.0), 0.5));
    assert!(reason.contains("to left_finger"), "{reason}");
}

#[test]
fn an_arm_keeps_a_margin_from_one_that_stands_and_may_leave_where_it_is_nearer() {
    let (mut bench, _folder) = gantry();
    // The hands are 0.12 m wide and hang at the same height.
    let beside = |gap_m: f64| [HOMES[LEFT][0], HOMES[LEFT][1] - 0.12 - gap_m, 0.0];
    goes(&mut bench, RIGHT, beside(0.05));
    let reason = refused(&mut bench, RIGHT, to(beside(0.001), 0.3));
    assert!(reason.contains("comes nearer than 3 mm to left_hand of the arm `left`, which stands there"), "{reason}");
    goes(&mut bench, RIGHT, beside(0.012));

    with_right_at(&mut bench, beside(0.001));
    let reason = refused(&mut bench, RIGHT, to(beside(0.0001), 0.1));
    assert!(reason.contains("comes nearer than 3 mm to left_hand"), "{reason}");
    goes(&mut bench, RIGHT, beside(0.05));
}

#[test]
fn ways_that_are_too_long_to_be_compared_are_refused_by_name() {
    let (mut bench, _folder) = gantry();
    ajar(&mut bench);
    // To and fro, 180 m in all.
    let home = bench.cell.measured_of(LEFT).arm;
    let mut far = home;
    far[0] += 1.0;
    let leg = |from: JointVector, to: JointVector| {
        parameterise(bench.cell.robot_of(LEFT), &[Section::AsGiven(vec![from, to])], 1.0, &mut |_, _| false)
    };
    let mut trajectory = leg(home, far);
    for i in 1..180 {
        let next = if i % 2 == 0 { leg(home, far) } else { leg(far, home) };
        let began_s = trajectory.duration_s();
        let later = |point: TrajectoryPoint| TrajectoryPoint { time_s: point.time_s + began_s, ..point };
        trajectory.points.extend(next.points.into_iter().skip(1).map(later));
    }
    let (_, commands) = bench.start_with(LEFT, Request::Follow { trajectory });
    assert_eq!(commands, []);
    let [_, y, z] = HOMES[RIGHT];
    let reason = refused(&mut bench, RIGHT, to([1.0, y, z], 0.5));
    let said = "its way and that of the arm `left`, which is under way with goal 3, are too long";
    assert!(reason.contains(said) && reason.contains("in shorter motions"), "{reason}");
}

#[test]
fn an_arm_that_carries_the_other_one_is_refused_and_so_are_names_that_are_no_part_of_an_id() {
    let carries = description()
        .replacen("\"left_x\"", "\"torso\", \"left_x\"", 1)
        .replace("home = [0.0, 0.4", "home = [1.5, 0.0, 0.4");
    let reason = refused_robot(&carries);
    assert!(
        reason.contains("the robot `gantry` cannot stand in a cell: `joints` of the arm `right`: the link `right_1`"),
        "{reason}"
    );
    assert!(reason.contains("by those of the arm `left`"), "{reason}");
    for (name, number) in [("left", 0), ("right", 1)] {
        for wrong in ["a/b".to_owned(), String::new(), "a".repeat(65)] {
            let named = description().replace(&format!("name = \"{name}\""), &format!("name = \"{wrong}\""));
            let reason = refused_robot(&named);
            assert!(reason.contains("use 1 to 64 letters"), "{number}: {reason}");
        }
    }
    let longest = description().replace("name = \"left\"", &format!("name = \"{}\"", "a".repeat(64)));
    let folder = tempfile::tempdir().unwrap();
    assert!(Cell::new(config(folder.path(), &longest)).is_ok());
}

#[test]
fn a_snapshot_of_a_robot_with_another_tool_or_pad_is_refused() {
    let (mut bench, _folder) = gantry();
    let commands = bench.event(Event::Save);
    let [Command::Saved { snapshot }] = &commands[..] else { panic!("{commands:?}") };
    let check = |description: &str| {
        let folder = tempfile::tempdir().unwrap();
        let cell = Cell::new(config(folder.path(), description)).unwrap();
        snapshot.check_robot(cell.robot()).map_err(|error| error.to_string())
    };
    assert_eq!(check(&description()), Ok(()));
    for (from, to) in [
        ("tool = \"right_tool\"", "tool = \"right_hand\""),
        ("name = \"right\"", "name = \"other\""),
        ("finger = \"right_finger_a\"", "finger = \"right_finger_b\""),
        ("finger = \"left_finger_a\"", "finger = \"left_finger_b\""),
    ] {
        let refused = check(&description().replace(from, to));
        assert!(refused.as_ref().is_err_and(|reason| reason.contains("`gantry` (digest ")), "{to}: {refused:?}");
    }
}

#[test]
fn fingers_do_not_close_where_another_arm_holds_something_askew() {
    let folder = tempfile::tempdir().unwrap();
    let robot = duo::write(folder.path()).display().to_string();
    let mut bench = Bench::of(CellConfig { robot, boxes: 1, seed: 2, ..CellConfig::default() });
    let commands = bench.event(Event::Save);
    let [Command::Saved { snapshot }] = &commands[..] else { panic!("{commands:?}") };
    let mut state: serde_json::Value = serde_json::from_str(&snapshot.to_json()).unwrap();
    let tool = |arm: usize| bench.cell.robot_of(arm).tool_pose(&bench.cell.measured_of(arm));
    let askew = tool(LEFT).compose(&Pose::from_rpy([0.0; 3], 0.0, 0.0, 20_f64.to_radians()));
    let in_tool = tool(RIGHT).inverse().compose(&askew);
    state["posture"]["other_arms"][0]["held"] = serde_json::json!({ "object": 0, "in_tool": in_tool, "friction": 0.6 });
    let held = Snapshot::from_json(&state.to_string()).unwrap();
    bench.event(Event::PutBack { snapshot: Box::new(held) });
    let reason = refused(&mut bench, LEFT, close());
    assert!(reason.contains("slc_1 is between the fingers, and the arm `right` holds it"), "{reason}");
}

#[test]
#[ignore = "it measures, and says so with --nocapture"]
fn how_long_it_takes_to_compare_two_motions_of_ten_seconds() {
    let folder = tempfile::tempdir().unwrap();
    let robot = duo::write(folder.path()).display().to_string();
    for left_moves in [false, true] {
        let mut bench = Bench::of(CellConfig { robot: robot.clone(), boxes: 1, seed: 2, ..CellConfig::default() });
        let turned = |bench: &Bench, arm: usize, sign: f64| {
            let by = [1.5, 0.3, 0.4, 0.3, -0.4, 0.5, 0.8];
            let home = bench.cell.measured_of(arm).arm;
            Request::MoveTo { joints: JointVector::from_fn(7, |j| home[j] + sign * by[j]), speed: 0.07 }
        };
        let (left, right) = (turned(&bench, LEFT, 1.0), turned(&bench, RIGHT, -1.0));
        if left_moves {
            assert_eq!(bench.start_with(LEFT, left).1, []);
        }
        let began = std::time::Instant::now();
        assert_eq!(bench.start_with(RIGHT, right).1, []);
        let lasts_s = bench.cell.next_wake().unwrap().since(bench.now).as_secs_f64();
        println!("started in {:?}, beside an arm on its way: {left_moves}, lasts {lasts_s:.1} s", began.elapsed());
    }
}

#[test]
fn a_head_does_not_turn_into_the_way_of_an_arm_nor_into_one_that_stands() {
    let (mut bench, _folder) = with_head("world");
    assert_eq!(bench.start_with(LEFT, to(IN_THE_WAY, 0.1)).1, []);
    let reason = refused(&mut bench, LEFT, look(ROUND));
    assert!(
        reason.starts_with("the head stays where it is: head of the head comes nearer than 20 mm to left_hand"),
        "{reason}"
    );
    assert!(reason.contains("of the arm `left`, which is under way with goal 1"), "{reason}");
    // As far as the ways are apart.
    assert_eq!(bench.start_with(LEFT, look(SHORT)).1, []);
    bench.pass(60.0);
    let reason = refused(&mut bench, LEFT, look(ROUND));
    assert!(reason.contains("comes nearer than 3 mm to left_hand of the arm `left`, which stands there"), "{reason}");
    goes(&mut bench, LEFT, ASIDE);
    bench.done(look(ROUND));
    assert_eq!(bench.cell.unintended_contacts(), []);
}

#[test]
fn a_head_does_not_turn_into_a_link_of_its_own_robot_that_no_arm_moves() {
    // A mast where the stick comes to when it has turned by 2 rad.
    let mast = format!(
        "<link name='mast'><collision><geometry><box size='0.02 0.02 0.4'/></geometry></collision></link>\
         <joint name='mast' type='fixed'><parent link='world'/><child link='mast'/><origin xyz='{} {} 1.5'/></joint>",
        0.6 + 0.4 * 2.0_f64.cos(),
        0.4 * 2.0_f64.sin()
    );
    let (mut bench, _folder) = with_head_and("world", &mast);
    goes(&mut bench, LEFT, ASIDE);
    let reason = refused(&mut bench, LEFT, look(ROUND));
    assert!(
        reason.starts_with("the head stays where it is: head of the head comes nearer than 3 mm to mast"),
        "{reason}"
    );
    // As far as there is room, and away again.
    bench.done(look(1.9));
    bench.done(look(SHORT));
    assert_eq!(bench.cell.unintended_contacts(), []);
}

#[test]
fn an_arm_does_not_set_out_into_the_way_of_a_head_that_turns() {
    let (mut bench, _folder) = with_head("world");
    goes(&mut bench, LEFT, ASIDE);
    assert_eq!(bench.start_with(LEFT, look(ROUND)).1, []);
    bench.pass(0.1);
    let reason = refused(&mut bench, LEFT, to(IN_THE_WAY, 0.5));
    assert!(reason.starts_with("the trajectory is refused: on the way left_hand of the arm `left`"), "{reason}");
    assert!(reason.contains("to head of the head, which is under way with goal"), "{reason}");
    // Away from it, and the other arm.
    assert_eq!(bench.start_with(LEFT, to([0.0, 0.7, 0.1], 0.5)).1, []);
    assert_eq!(bench.start_with(RIGHT, to([0.0, -0.5, 0.1], 0.5)).1, []);
    bench.pass(60.0);
    // A head that stands is what the check of the trajectory knows.
    let reason = refused(&mut bench, LEFT, to(IN_THE_WAY, 0.5));
    assert!(reason.contains("the trajectory is refused"), "{reason}");
    assert_eq!(bench.cell.unintended_contacts(), []);
}

#[test]
fn an_arm_whose_joints_carry_the_head_moves_before_or_after_it() {
    // One arm alone hangs from the torso.
    let (mut bench, _folder) = with_head("left_2");
    assert_eq!(bench.start_with(LEFT, to([0.0, 0.5, 0.0], 0.1)).1, []);
    let reason = refused(&mut bench, LEFT, look(SHORT));
    assert!(reason.contains("is moved by the head and by the arm `left`, which is under way with goal 1"), "{reason}");
    bench.pass(60.0);
    assert_eq!(bench.start_with(LEFT, look(SHORT)).1, []);
    let reason = refused(&mut bench, LEFT, to([0.0, 0.4, 0.0], 0.5));
    assert!(reason.contains("is moved by the arm `left` and by the head, which is under way"), "{reason}");
}

#[test]
fn fingers_open_further_while_their_arm_moves_whichever_begins_first() {
    for arm_first in [false, true] {
        let (mut bench, _folder) = gantry();
        ajar(&mut bench);
        let both = [Request::Release, to(ASIDE, 0.2)];
        let both = if arm_first { both.into_iter().rev().collect::<Vec<_>>() } else { both.to_vec() };
        for request in both {
            assert_eq!(bench.start_with(LEFT, request).1, []);
        }
        let ended = bench.pass(0.79);
        assert!(matches!(&ended[..], [Command::Ended { ending: Ending::Done(_), .. }]), "the fingers: {ended:?}");
        let at = bench.cell.measured_of(LEFT);
        assert!(at.finger == 0.04 && at.arm[1] > HOMES[LEFT][1] && at.arm[1] < ASIDE[1], "{at:?}");
        bench.pass(60.0);
        assert_eq!(bench.cell.measured_of(LEFT).arm[1], ASIDE[1]);
        assert_eq!(bench.cell.unintended_contacts(), []);
    }
}

#[test]
fn no_arm_leaves_before_its_fingers_have_parted_nor_while_they_close() {
    let (mut bench, _folder) = gantry();
    assert_eq!(bench.start_with(LEFT, close()).1, []);
    bench.pass(0.1);
    let reason = refused(&mut bench, LEFT, to(ASIDE, 0.2));
    assert!(reason.contains("an arm does not move while its fingers close"), "{reason}");
    bench.pass(60.0);
    assert_eq!(bench.start_with(LEFT, Request::Release).1, []);
    // Of 40 mm in 0.8 s each has gone 2 and 4 mm.
    bench.pass(0.04);
    let reason = refused(&mut bench, LEFT, to(ASIDE, 0.2));
    assert!(reason.contains("nor before they have parted from what they let go"), "{reason}");
    bench.pass(0.04);
    assert_eq!(bench.start_with(LEFT, to(ASIDE, 0.2)).1, []);
    // Nor does anything close on the way, nor begin to part.
    bench.pass(0.8);
    let reason = refused(&mut bench, LEFT, close());
    assert!(reason.contains("an arm does not move while its fingers close"), "{reason}");
    bench.pass(60.0);
    assert!(matches!(bench.perform_with(LEFT, close()), Ending::Aborted(_)));
    assert_eq!(bench.start_with(LEFT, to([0.0, 0.4, 0.0], 0.2)).1, []);
    let reason = refused(&mut bench, LEFT, Request::Release);
    assert!(reason.contains("nor before they have parted from what they let go"), "{reason}");
}

#[test]
fn opening_in_two_parts_takes_as_long_as_at_once() {
    let (mut bench, _folder) = gantry();
    assert!(matches!(bench.perform_with(LEFT, close()), Ending::Aborted(_)));
    let began = bench.now;
    for request in [Request::OpenTo { width: 0.01 }, Request::OpenTo { width: 0.05 }, Request::Release] {
        assert!(matches!(bench.perform_with(LEFT, request), Ending::Done(_)));
    }
    let lasted_s = bench.now.since(began).as_secs_f64();
    assert!((lasted_s - 0.8).abs() < 1e-6, "{lasted_s}");
    for (width, wrong) in [(0.08, "80 mm apart"), (0.05, "80 mm apart"), (0.2, "at most 80 mm"), (f64::NAN, "NaN")] {
        let reason = refused(&mut bench, LEFT, Request::OpenTo { width });
        assert!(reason.contains("input `width_m` is") && reason.contains(wrong), "{reason}");
    }
}

#[test]
fn fingers_do_not_open_on_the_way_of_their_arm_where_another_arm_stands_beside_it() {
    // The tip of the right arm's rod is beside the way of the left arm's fingers: 18 mm off where they are closed, in them where they are open.
    let beside = |bench: &mut Bench| {
        ajar(bench);
        let [x, y, z] = between_the_fingers(0.0);
        let before = between_the_fingers(0.1);
        goes(bench, RIGHT, before);
        with_right_at(bench, [x, y + 0.035, z]);
    };
    let away = [HOMES[LEFT][0], HOMES[LEFT][1], 0.2];
    let (mut bench, _folder) = gantry();
    beside(&mut bench);
    // The arm alone may go, and the fingers may not open, neither before nor beside that.
    let reason = refused(&mut bench, LEFT, Request::Release);
    assert!(reason.starts_with("the fingers stay where they are: left_finger"), "{reason}");
    assert_eq!(bench.start_with(LEFT, to(away, 0.1)).1, []);
    let reason = refused(&mut bench, LEFT, Request::Release);
    assert!(reason.starts_with("the fingers stay where they are: left_finger"), "{reason}");
    bench.pass(60.0);
    assert!(matches!(bench.perform_with(LEFT, Request::Release), Ending::Done(_)), "up there is room");
    assert_eq!(bench.cell.unintended_contacts(), []);
}

#[test]
fn fingers_do_not_open_on_the_way_of_their_arm_where_its_own_robot_is() {
    for arm_first in [false, true] {
        let (mut bench, _folder) = with_post();
        ajar(&mut bench);
        let far = [0.0, 0.63, 0.0];
        if arm_first {
            assert_eq!(bench.start_with(LEFT, to(far, 0.2)).1, []);
            let reason = refused(&mut bench, LEFT, Request::Release);
            assert!(reason.starts_with("the fingers stay where they are: while its fingers open, "), "{reason}");
        } else {
            assert_eq!(bench.start_with(LEFT, Request::Release).1, []);
            let reason = refused(&mut bench, LEFT, to(far, 0.2));
            assert!(reason.starts_with("the trajectory is refused: while its fingers open, "), "{reason}");
            assert!(reason.contains("post") && reason.contains("finger"), "{reason}");
        }
        // Where the post is far, both go.
        bench.pass(60.0);
        goes(&mut bench, LEFT, [0.0, 0.3, 0.0]);
        assert_eq!(bench.cell.unintended_contacts(), []);
    }
}

#[test]
fn fingers_of_an_arm_that_stands_move_neither_into_their_own_robot_nor_into_a_head_that_stands() {
    let (mut bench, _folder) = with_post();
    ajar(&mut bench);
    goes(&mut bench, LEFT, [0.0, 0.63, 0.0]);
    let reason = refused(&mut bench, LEFT, Request::Release);
    assert!(reason.starts_with("the fingers stay where they are: ") && reason.contains("link post"), "{reason}");
    // Open around the post they do not close on it.
    goes(&mut bench, LEFT, [0.0, 0.63, 0.2]);
    assert!(matches!(bench.perform_with(LEFT, Request::Release), Ending::Done(_)));
    goes(&mut bench, LEFT, [0.0, 0.66, 0.2]);
    goes(&mut bench, LEFT, [0.0, 0.66, 0.0]);
    let reason = refused(&mut bench, LEFT, close());
    assert!(reason.starts_with("the fingers stay where they are: ") && reason.contains("link post"), "{reason}");

    let (mut bench, _folder) = with_head("world");
    bench.done(look(FRAC_PI_2));
    ajar(&mut bench);
    // The stick ends 15 mm beside the fingers.
    for at in [[0.3, 0.53, 0.2], [0.6, 0.53, 0.2], [0.6, 0.53, 0.06]] {
        goes(&mut bench, LEFT, at);
    }
    let reason = refused(&mut bench, LEFT, Request::Release);
    assert!(reason.starts_with("the fingers stay where they are: ") && reason.contains("link head"), "{reason}");
    assert!(
        matches!(bench.perform_with(LEFT, Request::OpenTo { width: 0.02 }), Ending::Done(_)),
        "so far there is room"
    );
    assert_eq!(bench.cell.unintended_contacts(), []);
}

#[test]
fn how_slow_a_motion_is_does_not_decide_whether_something_may_go_beside_it() {
    let far = |arm: usize| [1.0, HOMES[arm][1], HOMES[arm][2]];
    for arm_first in [false, true] {
        let (mut bench, _folder) = gantry();
        ajar(&mut bench);
        let mut both = [Request::Release, to(far(LEFT), 0.01)];
        if arm_first {
            both.reverse();
        }
        for request in both {
            starts(&mut bench, LEFT, request);
        }
        // Beside another arm, too, whose fingers may open.
        starts(&mut bench, RIGHT, to(far(RIGHT), 0.01));
    }
}

#[test]
fn fingers_that_open_a_little_count_as_open_as_those_do_that_stand() {
    for opens in [false, true] {
        let (mut bench, _folder) = gantry();
        assert!(matches!(bench.perform_with(LEFT, close()), Ending::Aborted(_)), "they close around nothing");
        goes(&mut bench, RIGHT, between_the_fingers(0.1));
        if opens {
            starts(&mut bench, LEFT, Request::OpenTo { width: 0.02 });
        }
        // 1.5 mm beside the finger where that is open.
        let [x, y, z] = between_the_fingers(0.0);
        let reason = refused(&mut bench, RIGHT, to([x, y + 0.0565, z], 0.5));
        assert!(reason.contains("left_finger"), "{opens}: {reason}");
    }
}

#[test]
fn of_two_arms_on_their_ways_neither_goes_where_the_other_ones_fingers_may_open_whichever_begins_first() {
    // The rod is well below the hand.
    let [x, y, _] = between_the_fingers(0.0);
    let z = -0.09;
    let [left_x, left_y, left_z] = HOMES[LEFT];
    for left_first in [true, false] {
        let (mut bench, _folder) = gantry();
        ajar(&mut bench);
        goes(&mut bench, RIGHT, [x - 0.1, y + 0.06, z]);
        let mut both = [(LEFT, to([left_x, left_y, left_z + 0.05], 0.1)), (RIGHT, to([x, y + 0.06, z], 0.1))];
        if !left_first {
            both.reverse();
        }
        let [(first, goes_first), (second, goes_second)] = both;
        starts(&mut bench, first, goes_first);
        let reason = refused(&mut bench, second, goes_second);
        assert!(reason.contains("20 mm") && reason.contains("left_finger"), "{left_first}: {reason}");
    }
}

#[test]
fn moving_fingers_keep_as_far_from_an_arm_on_its_way_whichever_begins_first() {
    // The rod passes 10 mm below the tips of the fingers.
    let below = |x_m: f64| {
        let [x, y, _] = between_the_fingers(x_m);
        [x, y, -0.115]
    };
    for fingers_first in [true, false] {
        let (mut bench, _folder) = gantry();
        goes(&mut bench, RIGHT, below(0.1));
        let mut both = [(LEFT, close()), (RIGHT, to(below(0.0), 0.1))];
        if !fingers_first {
            both.reverse();
        }
        let [(first, goes_first), (second, goes_second)] = both;
        starts(&mut bench, first, goes_first);
        let reason = refused(&mut bench, second, goes_second);
        assert!(reason.contains("20 mm") && reason.contains("under way with goal"), "{fingers_first}: {reason}");
        // One after the other they go.
        bench.pass(60.0);
        goes(&mut bench, RIGHT, below(0.01));
        assert!(
            matches!(bench.perform_with(LEFT, close()), Ending::Aborted(reason) if reason.contains("nothing stopped"))
        );
    }
}

#[test]
fn beside_an_arm_that_stands_nearby_fingers_and_their_arm_move_one_after_the_other() {
    // The tip of the right arm's rod is 3.3 mm beside a finger, which opens along it.
    let set_out = || {
        let (mut bench, folder): (Bench, TempDir) = gantry();
        ajar(&mut bench);
        let [x, y, z] = between_the_fingers(0.0);
        goes(&mut bench, RIGHT, [x - 0.1, y, z]);
        with_right_at(&mut bench, [x - 0.005 - 0.01 - 0.0033, y + 0.01, z]);
        (bench, folder)
    };
    let up = || to([HOMES[LEFT][0], HOMES[LEFT][1], 0.05], 0.1);
    for arm_first in [false, true] {
        let (mut bench, _folder) = set_out();
        let mut both = [Request::Release, up()];
        if arm_first {
            both.reverse();
        }
        let [first, second] = both;
        starts(&mut bench, LEFT, first);
        let reason = refused(&mut bench, LEFT, second.clone());
        assert!(reason.contains("nearer than 3 mm to right_hand"), "{arm_first}: {reason}");
        bench.pass(60.0);
        let ending = bench.perform_with(LEFT, second);
        assert!(matches!(ending, Ending::Done(_)), "{arm_first}: {ending:?}");
        assert_eq!(bench.cell.unintended_contacts(), []);
    }
}

#[test]
fn no_picture_is_taken_while_an_arm_moves_that_carries_the_camera() {
    // One arm alone hangs from the torso, and the camera with it.
    let (mut bench, _folder) = with_head("left_2");
    starts(&mut bench, LEFT, to([0.0, 0.7, 0.0], 0.5));
    let reason = refused(&mut bench, LEFT, Request::Capture { frames: 1 });
    assert!(reason.contains("Arm of the arm `left` is under way") && reason.contains("carries the camera"), "{reason}");
    bench.pass(60.0);
    starts(&mut bench, LEFT, Request::Capture { frames: 10 });
    for way in [to([0.0, 0.5, 0.0], 0.5), follow(&bench, LEFT, [0.0, 0.5, 0.0])] {
        let reason = refused(&mut bench, LEFT, way);
        assert!(reason.contains("Camera is under way") && reason.contains("carries the camera"), "{reason}");
    }
    starts(&mut bench, RIGHT, to([0.0, -0.5, 0.1], 0.5));
}

/// A trajectory of an arm from where it is.
fn follow(bench: &Bench, arm: usize, there: [f64; 3]) -> Request {
    let way = vec![bench.cell.measured_of(arm).arm, JointVector::of(there)];
    let trajectory = parameterise(bench.cell.robot_of(arm), &[Section::AsGiven(way)], 1.0, &mut |_, _| false);
    Request::Follow { trajectory }
}

#[test]
fn fingers_do_not_pass_through_a_link_of_their_own_robot_however_thin_both_are() {
    for thick in [0.002, 0.003, 0.004, 0.01] {
        let post = "<link name='post'><collision><geometry><box size='0.01 0.002 0.06'/></geometry></collision></link>\
                    <joint name='post' type='fixed'><parent link='world'/><child link='post'/><origin xyz='0 0.422 1.42'/></joint></robot>";
        let folder = tempfile::tempdir().unwrap();
        let config = config(folder.path(), &description());
        let middle = thick / 2.0;
        let thin = urdf()
            .replace("0 0.005 -0.06", &format!("0 {middle} -0.06"))
            .replace("0 -0.005 -0.06", &format!("0 -{middle} -0.06"))
            .replace("0.02 0.01 0.08", &format!("0.02 {thick} 0.08"));
        std::fs::write(folder.path().join("gantry.urdf"), thin.replace("</robot>", post)).unwrap();
        let mut bench = Bench::of(config);
        let reason = refused(&mut bench, LEFT, close());
        assert!(reason.contains("while its fingers close") && reason.contains("link post"), "{thick}: {reason}");
    }
}
