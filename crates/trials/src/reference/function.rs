//! The built-in functions, except those with assumptions about a gripper.

use super::Fail;
use super::comprehension;
use super::evaluate::{LONGEST_LIST, both, number, order, same, wrong};
use ratn_model::expression::{BinaryOperator, Function};
use ratn_model::pose::Pose;
use ratn_model::value::Value;
use std::cmp::Ordering;

pub(super) fn call(function: Function, arguments: &[Value]) -> Result<Value, Fail> {
    match (function, arguments) {
        (Function::GraspPose | Function::PlacePose, _) => Err(Fail::NotMine("what knows a gripper")),
        (Function::Len, [Value::List(items)]) => Ok(Value::Int(items.len() as i64)),
        (Function::Len, [Value::Map(fields)]) => Ok(Value::Int(fields.len() as i64)),
        (Function::Len, [Value::Joints(joints)]) => Ok(Value::Int(joints.len() as i64)),
        (Function::Len, [Value::String(text)]) => Ok(Value::Int(text.chars().count() as i64)),
        (Function::Range, [Value::Int(to)]) => range(0, *to),
        (Function::Range, [Value::Int(from), Value::Int(to)]) => range(*from, *to),
        (Function::Min, [Value::List(items)]) => best(items.iter(), Ordering::Less),
        (Function::Max, [Value::List(items)]) => best(items.iter(), Ordering::Greater),
        (Function::Min, items) => best(items.iter(), Ordering::Less),
        (Function::Max, items) => best(items.iter(), Ordering::Greater),
        (Function::Abs, [Value::Int(i)]) => i.checked_abs().map_or_else(|| wrong("too large"), |i| Ok(Value::Int(i))),
        (Function::Abs, [x]) => Ok(Value::Float(number(x)?.abs())),
        (Function::Sqrt, [x]) if number(x)? >= 0.0 => Ok(Value::Float(number(x)?.sqrt())),
        (Function::Floor, [Value::Int(i)]) => Ok(Value::Int(*i)),
        (Function::Floor, [x]) if number(x)?.abs() <= 9.2e18 => Ok(Value::Int(number(x)?.floor() as i64)),
        (Function::Sum, [Value::List(items)]) => {
            let mut sum = Value::Int(0);
            for item in items {
                number(item)?;
                sum = both(BinaryOperator::Add, &sum, item)?;
            }
            Ok(sum)
        }
        (Function::Distance, [Value::Pose(a), Value::Pose(b)]) => Ok(Value::Float(a.distance(b))),
        (Function::Angle, [Value::Pose(a), Value::Pose(b)]) => Ok(Value::Float(a.angle(b))),
        (Function::Sort, [Value::List(items)]) => {
            let own = items.iter().map(|item| (item.clone(), item.clone())).collect();
            Ok(Value::List(comprehension::ascending(own)?.into()))
        }
        (Function::Reverse, [Value::List(items)]) => Ok(Value::List(items.iter().rev().cloned().collect())),
        (Function::Unique, [Value::List(items)]) => {
            let new = |i: &usize| !items.iter().take(*i).any(|other| same(other, &items[*i]));
            let found: Vec<Value> = (0..items.len()).filter(new).map(|i| items[i].clone()).collect();
            if found.len() > 1_000 { wrong("too many different elements") } else { Ok(Value::List(found.into())) }
        }
        (Function::StartsWith, [Value::String(text), Value::String(prefix)]) => {
            Ok(Value::Bool(text.get(..prefix.len()) == Some(prefix.as_str())))
        }
        (Function::Pose, [x, y, z]) => Ok(Value::Pose(Pose::at(number(x)?, number(y)?, number(z)?))),
        (Function::Pose, [x, y, z, roll, pitch, yaw]) => {
            let at = [number(x)?, number(y)?, number(z)?];
            Ok(Value::Pose(Pose::from_rpy(at, number(roll)?, number(pitch)?, number(yaw)?)))
        }
        (Function::Joints, [_, ..]) => {
            Ok(Value::Joints(arguments.iter().map(number).collect::<Result<Vec<f64>, Fail>>()?))
        }
        (Function::Compose, [Value::Pose(a), Value::Pose(b)]) => Ok(Value::Pose(a.compose(b))),
        (Function::Inverse, [Value::Pose(a)]) => Ok(Value::Pose(a.inverse())),
        (Function::Between, [Value::Pose(a), Value::Pose(b)]) => Ok(Value::Pose(a.inverse().compose(b))),
        (Function::Concat, [_, ..]) => {
            let mut text = String::new();
            for part in arguments {
                match part {
                    Value::String(part) => text.push_str(part),
                    Value::Int(i) => text.push_str(&i.to_string()),
                    other => return wrong(format!("{other} is no text")),
                }
            }
            Ok(Value::String(text))
        }
        (Function::Repeat, [value, Value::Int(times)]) if *times >= 0 && *times as usize <= LONGEST_LIST => {
            Ok(Value::List((0..*times).map(|_| value.clone()).collect()))
        }
        (Function::Take, [Value::List(items), Value::Int(count)]) if *count >= 0 => {
            Ok(Value::List(items.iter().take(*count as usize).cloned().collect()))
        }
        _ => wrong(format!("{} of {arguments:?}", function.name())),
    }
}

fn range(from: i64, to: i64) -> Result<Value, Fail> {
    if to.saturating_sub(from) > LONGEST_LIST as i64 {
        return wrong("too long");
    }
    Ok(Value::List((from..to).map(Value::Int).collect()))
}

fn best<'v>(mut items: impl Iterator<Item = &'v Value>, wanted: Ordering) -> Result<Value, Fail> {
    let Some(mut best) = items.next() else { return wrong("the best of nothing") };
    // A single value must have an order, too.
    order(best, best)?;
    for item in items {
        if order(item, best)? == wanted {
            best = item;
        }
    }
    Ok(best.clone())
}
