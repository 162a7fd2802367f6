//! The built-in functions.
//!
//! The assumptions of the two geometric functions about a gripper are in [`crate::grasp`]. `place_pose` gives two poses that differ
//! by half a turn about the vertical, because a box looks the same from both, unless the number of such turns is given.

use super::evaluate::{MAX_LIST, binary, described, equal, number, order};
use super::{BinaryOperator, Function};
use crate::grasp;
use crate::list::List;
use crate::pose::Pose;
use crate::value::Value;
use std::cmp::Ordering;
use std::f64::consts::TAU;

/// Classes of objects that are wider than the opened fingers, and open at the top.
const HELD_BY_THE_RIM: [&str; 2] = ["Bowl", "Plate"];

/// Classes of round objects that are narrower than the opened fingers.
const HELD_AROUND: [&str; 2] = ["Can", "Cup"];

/// Limit of different elements in `unique`, because each element is compared with all found ones.
const MAX_UNIQUE: usize = 1_000;

/// Limit of turns; a planner takes no more alternatives.
const MAX_TURNS: i64 = 64;

impl Function {
    /// All functions.
    pub const ALL: [Function; 26] = [
        Function::Len,
        Function::Range,
        Function::Min,
        Function::Max,
        Function::Abs,
        Function::Sqrt,
        Function::Floor,
        Function::Sum,
        Function::If,
        Function::Either,
        Function::Pose,
        Function::Joints,
        Function::Compose,
        Function::Inverse,
        Function::Between,
        Function::Distance,
        Function::Angle,
        Function::GraspPose,
        Function::PlacePose,
        Function::Concat,
        Function::Repeat,
        Function::Take,
        Function::Sort,
        Function::Reverse,
        Function::Unique,
        Function::StartsWith,
    ];

    /// Its name in an expression.
    pub fn name(self) -> &'static str {
        match self {
            Function::Len => "len",
            Function::Range => "range",
            Function::Min => "min",
            Function::Max => "max",
            Function::Abs => "abs",
            Function::Sqrt => "sqrt",
            Function::Floor => "floor",
            Function::Sum => "sum",
            Function::If => "if",
            Function::Either => "either",
            Function::Pose => "pose",
            Function::Joints => "joints",
            Function::Compose => "compose",
            Function::Inverse => "inverse",
            Function::Between => "between",
            Function::Distance => "distance",
            Function::Angle => "angle",
            Function::GraspPose => "grasp_pose",
            Function::PlacePose => "place_pose",
            Function::Concat => "concat",
            Function::Repeat => "repeat",
            Function::Take => "take",
            Function::Sort => "sort",
            Function::Reverse => "reverse",
            Function::Unique => "unique",
            Function::StartsWith => "starts_with",
        }
    }

    /// The function with this name.
    pub fn named(name: &str) -> Option<Function> {
        Function::ALL.into_iter().find(|f| f.name() == name)
    }

    /// Its usage.
    pub fn usage(self) -> &'static str {
        match self {
            Function::Len => "len(list)",
            Function::Range => "range(n) or range(from, to)",
            Function::Min => "min(a, b, …)",
            Function::Max => "max(a, b, …)",
            Function::Abs => "abs(x)",
            Function::Sqrt => "sqrt(x)",
            Function::Floor => "floor(x)",
            Function::Sum => "sum(list)",
            Function::If => "if(condition, a, b)",
            Function::Either => "either(a, b, …)",
            Function::Pose => "pose(x, y, z) or pose(x, y, z, roll, pitch, yaw)",
            Function::Joints => "joints(a, b, …)",
            Function::Compose => "compose(pose, pose)",
            Function::Inverse => "inverse(pose)",
            Function::Between => "between(pose, pose)",
            Function::Distance => "distance(pose, pose)",
            Function::Angle => "angle(pose, pose)",
            Function::GraspPose => {
                "grasp_pose(object), an object being {pose, size, class}, the class where it has one"
            }
            Function::PlacePose => "place_pose(target, in_gripper) or place_pose(target, in_gripper, turns)",
            Function::Concat => "concat(a, b, …)",
            Function::Repeat => "repeat(value, n)",
            Function::Take => "take(list, n)",
            Function::Sort => "sort(list)",
            Function::Reverse => "reverse(list)",
            Function::Unique => "unique(list)",
            Function::StartsWith => "starts_with(text, prefix)",
        }
    }

    /// Whether it takes this number of arguments.
    pub fn takes(self, arguments: usize) -> bool {
        match self {
            Function::Len
            | Function::Abs
            | Function::Sqrt
            | Function::Floor
            | Function::Sum
            | Function::Inverse
            | Function::GraspPose
            | Function::Sort
            | Function::Reverse
            | Function::Unique => arguments == 1,
            Function::Range => matches!(arguments, 1 | 2),
            Function::Compose
            | Function::Between
            | Function::Distance
            | Function::Angle
            | Function::Repeat
            | Function::Take
            | Function::StartsWith => arguments == 2,
            Function::PlacePose => matches!(arguments, 2 | 3),
            Function::If => arguments == 3,
            Function::Pose => matches!(arguments, 3 | 6),
            Function::Either => arguments >= 2,
            Function::Min | Function::Max | Function::Joints | Function::Concat => arguments >= 1,
        }
    }
}

/// The value of a call, or what is wrong with the arguments. `if` and `either` are evaluated elsewhere, because they skip
/// arguments.
pub(crate) fn call(function: Function, arguments: &[Value]) -> Result<Value, String> {
    if !function.takes(arguments.len()) {
        return Err(format!("expected `{}`", function.usage()));
    }
    match (function, arguments) {
        (Function::Len, [Value::List(items)]) => Ok(length(items.len())),
        (Function::Len, [Value::Map(fields)]) => Ok(length(fields.len())),
        (Function::Len, [Value::Joints(joints)]) => Ok(length(joints.len())),
        (Function::Len, [Value::String(text)]) => Ok(length(text.chars().count())),
        (Function::Len, [other, ..]) => Err(format!("{} has no length", described(other))),
        (Function::Range, [to]) => range(0, int(to)?),
        (Function::Range, [from, to]) => range(int(from)?, int(to)?),
        (Function::Min, _) => extreme(arguments, std::cmp::Ordering::Less),
        (Function::Max, _) => extreme(arguments, std::cmp::Ordering::Greater),
        (Function::Abs, [Value::Int(i)]) => i.checked_abs().map(Value::Int).ok_or_else(|| "too large".to_owned()),
        (Function::Abs, [x]) => Ok(Value::Float(number(x)?.abs())),
        (Function::Sqrt, [x]) => match number(x)? {
            x if x >= 0.0 => Ok(Value::Float(x.sqrt())),
            x => Err(format!("{x} has no square root")),
        },
        (Function::Floor, [Value::Int(i)]) => Ok(Value::Int(*i)),
        (Function::Floor, [x]) => match number(x)?.floor() {
            // Floats in this range convert to int exactly.
            x if (-9.2e18..=9.2e18).contains(&x) => Ok(Value::Int(x as i64)),
            x => Err(format!("{x} is too large for an int")),
        },
        (Function::Sum, [Value::List(items)]) => sum(items),
        (Function::Pose, _) => {
            let n = arguments.iter().map(number).collect::<Result<Vec<f64>, _>>()?;
            let angle = |i: usize| n.get(i).copied().unwrap_or(0.0);
            Ok(Value::Pose(Pose::from_rpy([n[0], n[1], n[2]], angle(3), angle(4), angle(5))))
        }
        (Function::Joints, _) => Ok(Value::Joints(arguments.iter().map(number).collect::<Result<_, _>>()?)),
        (Function::Compose, [a, b]) => Ok(Value::Pose(pose(a)?.compose(pose(b)?))),
        (Function::Between, [a, b]) => Ok(Value::Pose(pose(a)?.inverse().compose(pose(b)?))),
        (Function::Distance, [a, b]) => Ok(Value::Float(pose(a)?.distance(pose(b)?))),
        (Function::Angle, [a, b]) => Ok(Value::Float(pose(a)?.angle(pose(b)?))),
        (Function::Inverse, [a]) => Ok(Value::Pose(pose(a)?.inverse())),
        (Function::GraspPose, [object]) => grasp_poses(object),
        (Function::PlacePose, [target, in_gripper]) => Ok(place_poses(pose(target)?, pose(in_gripper)?, 2)),
        (Function::PlacePose, [target, in_gripper, turns]) => match int(turns)? {
            turns @ 1..=MAX_TURNS => Ok(place_poses(pose(target)?, pose(in_gripper)?, turns)),
            other => Err(format!("{other} turns: expected 1 to {MAX_TURNS}")),
        },
        (Function::Concat, _) => {
            let parts = arguments.iter().map(|part| match part {
                Value::String(text) => Ok(text.clone()),
                Value::Int(i) => Ok(i.to_string()),
                other => Err(format!("expected strings and ints, found {}", described(other))),
            });
            Ok(Value::String(parts.collect::<Result<String, _>>()?))
        }
        (Function::Repeat, [value, times]) => {
            let times =
                usize::try_from(int(times)?).map_err(|_| "cannot repeat a negative number of times".to_owned())?;
            if times > MAX_LIST {
                return Err(format!("the list is longer than {MAX_LIST}"));
            }
            Ok(Value::List(vec![value.clone(); times].into()))
        }
        (Function::Take, [Value::List(items), count]) => {
            let count = usize::try_from(int(count)?).map_err(|_| "cannot take a negative number".to_owned())?;
            Ok(Value::List(items.iter().take(count).cloned().collect()))
        }
        (Function::Sort, [Value::List(items)]) => {
            let keyed = items.iter().map(|item| (item.clone(), item.clone())).collect();
            Ok(Value::List(sorted(keyed)?.into()))
        }
        (Function::Reverse, [Value::List(items)]) => Ok(Value::List(items.iter().rev().cloned().collect())),
        (Function::Unique, [Value::List(items)]) => unique(items),
        (Function::StartsWith, [Value::String(text), Value::String(prefix)]) => {
            Ok(Value::Bool(text.starts_with(prefix.as_str())))
        }
        _ => Err(format!("expected `{}`", function.usage())),
    }
}

/// Sorts pairs by their first values (numbers or strings) and returns the second ones; equal ones keep their order.
pub(super) fn sorted(mut keyed: Vec<(Value, Value)>) -> Result<Vec<Value>, String> {
    // All keys are checked first, so that no later comparison can fail.
    if let Some((first, _)) = keyed.first() {
        for (key, _) in &keyed {
            order(first, key)?;
        }
    }
    // Two different large ints may equal the same float, which would be no order. With a float among them, all are compared as
    // floats.
    if keyed.iter().any(|(key, _)| matches!(key, Value::Float(_))) {
        let real = |key: &Value| key.as_number().unwrap_or(0.0);
        keyed.sort_by(|(a, _), (b, _)| real(a).total_cmp(&real(b)));
    } else {
        keyed.sort_by(|(a, _), (b, _)| order(a, b).unwrap_or(Ordering::Equal));
    }
    Ok(keyed.into_iter().map(|(_, value)| value).collect())
}

fn sum(items: &List) -> Result<Value, String> {
    items.iter().try_fold(Value::Int(0), |sum, item| binary(BinaryOperator::Add, &sum, item)).and_then(
        |sum| match sum {
            Value::Int(_) | Value::Float(_) => Ok(sum),
            other => Err(format!("expected numbers, found {}", described(&other))),
        },
    )
}

/// The elements without duplicates. The number of different elements is bounded, because it takes that many comparisons per
/// element.
fn unique(items: &List) -> Result<Value, String> {
    let mut found: Vec<Value> = Vec::new();
    for item in items {
        if !found.iter().any(|other| equal(other, item)) {
            found.push(item.clone());
        }
        if found.len() > MAX_UNIQUE {
            return Err(format!("it has more than {MAX_UNIQUE} different elements"));
        }
    }
    Ok(Value::List(found.into()))
}

fn length(n: usize) -> Value {
    Value::Int(i64::try_from(n).unwrap_or(i64::MAX))
}

fn int(value: &Value) -> Result<i64, String> {
    match value {
        Value::Int(i) => Ok(*i),
        other => Err(format!("expected an int, found {}", described(other))),
    }
}

fn pose(value: &Value) -> Result<&Pose, String> {
    match value {
        Value::Pose(pose) => Ok(pose),
        other => Err(format!("expected a pose, found {}", described(other))),
    }
}

fn range(from: i64, to: i64) -> Result<Value, String> {
    if to.saturating_sub(from) > i64::try_from(MAX_LIST).unwrap_or(i64::MAX) {
        return Err(format!("the list is longer than {MAX_LIST}"));
    }
    Ok(Value::List((from..to).map(Value::Int).collect()))
}

/// The smallest or greatest of the arguments, or of the elements of the only argument.
fn extreme(arguments: &[Value], wanted: std::cmp::Ordering) -> Result<Value, String> {
    let candidates: Vec<&Value> = match arguments {
        [Value::List(items)] => items.iter().collect(),
        _ => arguments.iter().collect(),
    };
    let mut best = *candidates.first().ok_or("the list is empty")?;
    if !matches!(best, Value::String(_)) {
        number(best)?;
    }
    for candidate in candidates.into_iter().skip(1) {
        if order(candidate, best)? == wanted {
            best = candidate;
        }
    }
    Ok(best.clone())
}

fn grasp_poses(object: &Value) -> Result<Value, String> {
    let expected = || "expected an object {pose: pose, size: [x, y, z]}".to_owned();
    let (Some(Value::Pose(centre)), Some(Value::List(size))) = (object.field("pose"), object.field("size")) else {
        return Err(expected());
    };
    let edges = size.iter().map(number).collect::<Result<Vec<f64>, _>>()?;
    let [x, y, z] = <[f64; 3]>::try_from(edges).map_err(|_| expected())?;
    let class = match object.field("class") {
        Some(Value::String(class)) => class.as_str(),
        _ => "",
    };
    let grasps = match class {
        rim if HELD_BY_THE_RIM.contains(&rim) => grasp::at_rim(centre, [x, y, z]),
        round if HELD_AROUND.contains(&round) => grasp::around(centre, [x, y, z]),
        _ => grasp::from_above(centre, [x, y, z]).to_vec(),
    };
    Ok(Value::List(grasps.into_iter().map(Value::Pose).collect()))
}

fn place_poses(target: &Pose, in_gripper: &Pose, turns: i64) -> Value {
    let tool = |turn: i64| {
        let turned = Pose::from_rpy([0.0; 3], 0.0, 0.0, TAU * turn as f64 / turns as f64);
        Value::Pose(target.compose(&turned).compose(&in_gripper.inverse()))
    };
    Value::List((0..turns).map(tool).collect())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]

    use super::*;
    use std::f64::consts::PI;

    fn poses(value: &Value) -> Vec<Pose> {
        let Value::List(items) = value else { return Vec::new() };
        items.iter().map(|item| *pose(item).unwrap()).collect()
    }

    fn object(yaw: f64, size: [f64; 3]) -> Value {
        Value::map([
            ("pose", Value::Pose(Pose::from_rpy([0.7, 0.1, 0.75], 0.0, 0.0, yaw))),
            ("size", Value::List(size.map(Value::Float).to_vec().into())),
        ])
    }

    fn close(a: [f64; 3], b: [f64; 3]) -> bool {
        a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-9)
    }

    #[test]
    fn a_grasp_comes_from_above_with_the_fingers_across_the_shorter_side() {
        for yaw in [0.0, 0.7, -2.0] {
            let body = Pose::from_rpy([0.0; 3], 0.0, 0.0, yaw);
            for (size, across) in [([0.08, 0.14, 0.10], [1.0, 0.0, 0.0]), ([0.14, 0.08, 0.10], [0.0, 1.0, 0.0])] {
                let grasps = poses(&call(Function::GraspPose, &[object(yaw, size)]).unwrap());
                let (there, back) = (body.rotate(across), body.rotate(across.map(|c| -c)));
                assert_eq!(grasps.len(), 2);
                assert!((grasps[0].angle(&grasps[1]) - PI).abs() < 1e-6);
                for grasp in grasps {
                    assert!(close(grasp.rotate([0.0, 0.0, 1.0]), [0.0, 0.0, -1.0]));
                    let closing = grasp.rotate([0.0, 1.0, 0.0]);
                    assert!(close(closing, there) || close(closing, back));
                    assert!(close(grasp.position, [0.7, 0.1, 0.77]));
                }
            }
        }
    }

    #[test]
    fn a_bowl_is_grasped_at_its_rim() {
        let Value::Map(mut bowl) = object(0.0, [0.13, 0.13, 0.05]) else { panic!() };
        bowl.insert("class".to_owned(), Value::String("Bowl".to_owned()));
        let grasps = poses(&call(Function::GraspPose, &[Value::Map(bowl)]).unwrap());
        assert_eq!(grasps, grasp::at_rim(&Pose::from_rpy([0.7, 0.1, 0.75], 0.0, 0.0, 0.0), [0.13, 0.13, 0.05]));
    }

    #[test]
    fn a_held_object_placed_at_its_target_is_there() {
        let target = Pose::from_rpy([-0.2, 0.1, 0.65], 0.0, 0.0, 0.4);
        let in_gripper = Pose::from_rpy([0.01, 0.0, 0.02], PI, 0.0, 0.3);
        let tools = poses(&call(Function::PlacePose, &[Value::Pose(target), Value::Pose(in_gripper)]).unwrap());
        let first = tools[0].compose(&in_gripper);
        assert!(first.distance(&target) < 1e-9 && first.angle(&target) < 1e-6);
        let second = tools[1].compose(&in_gripper);
        assert!(second.distance(&target) < 1e-9 && (second.angle(&target) - PI).abs() < 1e-6);
        let place =
            |turns| call(Function::PlacePose, &[Value::Pose(target), Value::Pose(in_gripper), Value::Int(turns)]);
        let eight = poses(&place(8).unwrap());
        assert_eq!((eight.len(), eight[0]), (8, tools[0]));
        assert!((eight[1].compose(&in_gripper).angle(&target) - PI / 4.0).abs() < 1e-6);
        assert!(place(1).is_ok() && place(0).is_err() && place(65).is_err());
    }

    #[test]
    fn every_function_is_found_by_its_name() {
        for function in Function::ALL {
            assert_eq!(Function::named(function.name()), Some(function));
        }
    }
}
