//! Joint positions from a log: which motion began along which trajectory, or to which posture, and where arm, head and fingers ended
//! according to their drivers.
//!
//! Positions are commanded, not measured. The module knows no robot: joint names come from the trajectory. Pure: the same lines give the
//! same motions.

use ratn_executive::protocol::{Command, Event, Goal, LogEntry, LogLine};
use ratn_model::id::InstanceId;
use ratn_model::program::SUCCESS;
use ratn_model::value::{Trajectory, TrajectoryPoint, Value};
use std::collections::BTreeMap;

/// The output port with the final joint positions.
const END: &str = "end";
/// The port of a posture, without a trajectory: an input or an output of a driver.
const POSTURE: &str = "joints";
/// The action that opens the fingers without giving a width.
const RELEASE: (&str, &str) = ("gripper", "release");
/// For a robot with several arms, the arm's name is between these two parts of the id of a resource.
const ARM_OF: [(&str, char); 2] = [("arm_", '@'), ("gripper_", '@')];

/// The motions under way.
#[derive(Debug, Default)]
pub struct Motions {
    jobs: BTreeMap<InstanceId, Job>,
}

/// A goal that a driver got.
#[derive(Debug)]
struct Job {
    arm: Option<String>,
    releases: bool,
    motion: Option<Motion>,
}

/// A motion of a driver.
#[derive(Debug, Clone, PartialEq)]
pub struct Motion {
    /// When it began, in seconds of the run.
    pub from_s: f64,
    /// Its trajectory or target.
    pub way: Way,
    /// Its expected duration in seconds, if the task gives one.
    pub expected_s: Option<f64>,
    /// The arm's name, if the goal or its lease names one: the arm of a robot with one arm has no name.
    pub arm: Option<String>,
}

/// The trajectory or target of a motion.
#[derive(Debug, Clone, PartialEq)]
pub enum Way {
    /// Along a trajectory of at least one point.
    Along(Trajectory),
    /// To these positions of an arm; the driver chooses the trajectory.
    To(Vec<f64>),
}

/// A change of joint positions.
#[derive(Debug, Clone, PartialEq)]
pub enum Change<'m> {
    /// A motion begins.
    Begins(InstanceId, &'m Motion),
    /// A motion ends; with the final positions if the driver reported them.
    Ends(InstanceId, Motion, Option<&'m [f64]>),
    /// An arm is at these positions.
    Stands {
        /// The arm's name.
        arm: Option<String>,
        /// Its joint positions.
        at: &'m [f64],
    },
    /// The head has this direction, in radians.
    Looks {
        /// Positive to the left.
        pan: f64,
        /// Positive downwards.
        tilt: f64,
    },
    /// The fingers of an arm are open by this width.
    Fingers {
        /// The arm's name.
        arm: Option<String>,
        /// The distance between the fingers, in metres; `None`: fully open.
        width_m: Option<f64>,
    },
}

impl Motions {
    /// The change of joint positions by a line, if any.
    pub fn follow<'m>(&'m mut self, line: &'m LogLine) -> Option<Change<'m>> {
        match &line.entry {
            // A goal on a projection moves nothing.
            LogEntry::Command(Command::Start { instance, goal, .. }) if goal.projection.is_none() => {
                let arm = arm(goal);
                let motion = way(goal).map(|way| Motion {
                    from_s: line.at.seconds(),
                    way,
                    expected_s: goal.expected_s,
                    arm: arm.clone(),
                });
                let job = Job { arm, releases: (&*goal.provider, &*goal.action) == RELEASE, motion };
                self.jobs.insert(*instance, job);
                let motion = self.jobs.get(instance)?.motion.as_ref()?;
                Some(Change::Begins(*instance, motion))
            }
            LogEntry::Event(Event::Finished { instance, outputs, outcome, .. }) => {
                let Job { arm, releases, motion } = self.jobs.remove(instance)?;
                let number = |port: &str| outputs.get(port).and_then(Value::as_number);
                match (motion, outputs.get(END), outputs.get(POSTURE)) {
                    (Some(motion), Some(Value::Joints(at)), _) => Some(Change::Ends(*instance, motion, Some(at))),
                    (Some(motion), ..) => Some(Change::Ends(*instance, motion, None)),
                    (None, _, Some(Value::Joints(at))) => Some(Change::Stands { arm, at }),
                    _ => match (number("pan"), number("tilt"), number("width_m")) {
                        (Some(pan), Some(tilt), _) => Some(Change::Looks { pan, tilt }),
                        (_, _, Some(width_m)) => Some(Change::Fingers { arm, width_m: Some(width_m) }),
                        _ => (releases && outcome == SUCCESS).then_some(Change::Fingers { arm, width_m: None }),
                    },
                }
            }
            LogEntry::Event(Event::Crashed { instance, .. }) | LogEntry::Command(Command::Cancel { instance, .. }) => {
                let motion = self.jobs.remove(instance)?.motion?;
                Some(Change::Ends(*instance, motion, None))
            }
            _ => None,
        }
    }

    /// The motions under way.
    pub fn under_way(&self) -> impl Iterator<Item = (InstanceId, &Motion)> {
        self.jobs.iter().filter_map(|(instance, job)| Some((*instance, job.motion.as_ref()?)))
    }
}

fn way(goal: &Goal) -> Option<Way> {
    let trajectory = goal.inputs.values().find_map(|value| match value {
        Value::Trajectory(trajectory) => Some(trajectory),
        _ => None,
    });
    match (trajectory, goal.inputs.get(POSTURE)) {
        (Some(trajectory), _) => (!trajectory.points.is_empty()).then(|| Way::Along(trajectory.clone())),
        // A goal without a lease moves nothing.
        (None, Some(Value::Joints(positions))) if goal.lease.is_some() => Some(Way::To(positions.clone())),
        _ => None,
    }
}

/// The name of the arm that a goal is for, from the goal or from the one arm in its lease.
fn arm(goal: &Goal) -> Option<String> {
    if let Some(Value::String(arm)) = goal.inputs.get("arm") {
        return Some(arm.clone());
    }
    let resources = goal.lease.iter().flat_map(|lease| &lease.resources);
    let named = |id: &str| {
        ARM_OF
            .iter()
            .find_map(|(before, behind)| id.strip_prefix(before)?.split_once(*behind).map(|(arm, _)| arm.to_owned()))
    };
    let mut arms: Vec<String> = resources.filter_map(|one| named(&one.id)).collect();
    arms.dedup();
    (arms.len() == 1).then(|| arms.remove(0))
}

/// Positions and velocities of a trajectory after `after_s` seconds: at its points as given, between two points linear.
pub fn place(trajectory: &Trajectory, after_s: f64) -> (Vec<f64>, Vec<f64>) {
    let next = trajectory.points.partition_point(|point| point.time_s <= after_s);
    let Some(before) = trajectory.points.get(next.saturating_sub(1)) else { return Default::default() };
    let Some(behind) = trajectory.points.get(next) else {
        return (before.positions.clone(), before.velocities.clone());
    };
    let share = ((after_s - before.time_s) / (behind.time_s - before.time_s)).clamp(0.0, 1.0);
    let between = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a + share * (b - a)).collect();
    (between(&before.positions, &behind.positions), between(&before.velocities, &behind.velocities))
}

/// At most `most` points of a trajectory, evenly chosen, including its first and its last one.
pub fn thinned(points: &[TrajectoryPoint], most: usize) -> Vec<&TrajectoryPoint> {
    if points.len() <= most.max(2) {
        return points.iter().collect();
    }
    let steps = most.max(2) - 1;
    (0..=steps).map(|step| &points[step * (points.len() - 1) / steps]).collect()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    fn point(time_s: f64, at: f64) -> TrajectoryPoint {
        TrajectoryPoint { time_s, positions: vec![at], velocities: vec![0.5] }
    }

    #[test]
    fn between_two_points_of_a_trajectory_the_way_is_straight() {
        let trajectory = Trajectory { joints: vec!["j".to_owned()], points: vec![point(0.0, 1.0), point(2.0, 3.0)] };
        assert_eq!(place(&trajectory, 0.5), (vec![1.5], vec![0.5]));
        assert_eq!(place(&trajectory, 9.0).0, [3.0]);
    }

    #[test]
    fn a_long_trajectory_is_thinned_and_keeps_its_ends() {
        let points: Vec<TrajectoryPoint> = (0..1000).map(|n| point(f64::from(n), 0.0)).collect();
        let thin = thinned(&points, 100);
        assert_eq!((thin.len(), thin[0].time_s, thin[99].time_s), (100, 0.0, 999.0));
        assert_eq!(thinned(&points[..7], 100).len(), 7);
    }

    #[test]
    fn a_plan_is_no_motion_and_a_motion_says_where_it_ended() {
        let line = |text: &str| serde_json::from_str::<LogLine>(text).unwrap();
        let start = |instance: u64, projection: &str| {
            line(&format!(
                r#"{{"at":1000000000,"command":"start","instance":{instance},"attempt":1,"goal":{{"provider":"arm","action":"move_to","inputs":{{"joints":{{"joints":[1.0]}}}},"seed":1,"lease":{{"id":1,"token":1,"resources":[]}},"projection":{projection},"expected_s":2.0}}}}"#
            ))
        };
        let end = line(
            r#"{"at":3000000000,"event":"finished","instance":2,"attempt":1,"outcome":"success","outputs":{"end":{"joints":[0.9]}},"measured":[],"reason":""}"#,
        );
        let mut motions = Motions::default();
        assert_eq!(motions.follow(&start(1, "7")), None);
        assert!(
            matches!(motions.follow(&start(2, "null")), Some(Change::Begins(InstanceId(2), motion)) if motion.from_s == 1.0 && motion.expected_s == Some(2.0))
        );
        assert!(matches!(motions.follow(&end), Some(Change::Ends(_, _, Some([at]))) if *at == 0.9));
        assert_eq!(motions.follow(&end), None, "it is over once");
        assert_eq!(motions.under_way().count(), 0);
    }

    #[test]
    fn what_drivers_say_of_head_and_fingers_is_told() {
        let job = |action: &str, resource: &str, outputs: &str| {
            let start = format!(
                r#"{{"at":1,"command":"start","instance":1,"attempt":1,"goal":{{"provider":"gripper","action":"{action}","inputs":{{}},"seed":1,"lease":{{"id":1,"token":1,"resources":[{{"id":"{resource}","kind":"K","endpoint":""}}]}},"projection":null,"expected_s":null}}}}"#
            );
            let end = format!(
                r#"{{"at":2,"event":"finished","instance":1,"attempt":1,"outcome":"success","outputs":{{{outputs}}},"measured":[],"reason":""}}"#
            );
            let (start, end): (LogLine, LogLine) =
                (serde_json::from_str(&start).unwrap(), serde_json::from_str(&end).unwrap());
            let mut motions = Motions::default();
            assert_eq!(motions.follow(&start), None);
            format!("{:?}", motions.follow(&end))
        };
        let grasped = job("grasp", "gripper_left@sim", r#""width_m":{"float":0.07}"#);
        assert_eq!(grasped, r#"Some(Fingers { arm: Some("left"), width_m: Some(0.07) })"#);
        assert_eq!(job("release", "gripper@sim", ""), "Some(Fingers { arm: None, width_m: None })");
        let looked = job("look_at", "pan-tilt@sim", r#""pan":{"float":0.1},"tilt":{"float":0.2}"#);
        assert_eq!(looked, "Some(Looks { pan: 0.1, tilt: 0.2 })");
        assert_eq!(job("wait", "gripper@sim", ""), "None");
    }
}
