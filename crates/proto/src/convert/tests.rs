//! Values come back equal from the wire format, through bytes; meaningless messages are refused with the path of the field.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use super::*;
use crate::types::*;
use proptest::collection::{btree_map, vec};
use proptest::prelude::*;
use prost::Message;
use ratn_model::condition::{Comparison, Condition};
use ratn_model::fact::{Change, FactKey, FactPattern, Footprint, Term};
use ratn_model::id::{FencingToken, LeaseId, ProjectionId, Revision};
use ratn_model::measurement::{Certainty, Measurement};
use ratn_model::pose::Pose;
use ratn_model::resource::{
    Lease, LeasedResource, OperatedUnits, Quantity, Requirement, ResourceClass, ResourceOperation,
};
use ratn_model::value::{Trajectory, TrajectoryPoint};
use std::fmt::Debug;
use std::sync::Arc;

/// Converts a value to the wire format and back.
fn check<T, W>(original: &T) -> Result<(), TestCaseError>
where
    T: Clone + PartialEq + Debug + TryFrom<W, Error = Malformed>,
    W: From<T> + Message + Default,
{
    let bytes = W::from(original.clone()).encode_to_vec();
    let back = T::try_from(W::decode(bytes.as_slice()).unwrap());
    prop_assert_eq!(back.as_ref(), Ok(original));
    Ok(())
}

fn number() -> impl Strategy<Value = f64> {
    prop_oneof![Just(0.0), -1e3..1e3, prop::num::f64::NORMAL]
}

fn a_name() -> impl Strategy<Value = String> {
    "[a-z][a-z_0-9@.-]{0,8}"
}

fn pose() -> impl Strategy<Value = Pose> {
    ([-9.0..9.0, -9.0..9.0, -9.0..9.0], -4.0..4.0, -2.0..2.0, -4.0..4.0)
        .prop_map(|(p, r, q, y)| Pose::from_rpy(p, r, q, y))
}

fn trajectory() -> impl Strategy<Value = Trajectory> {
    let points = vec((0.001..2.0, any::<bool>()), 1..5);
    (vec(a_name(), 0..4), points, number()).prop_map(|(joints, steps, x)| {
        let (mut time_s, count) = (0.0, joints.len());
        let point = |(step, velocities): (f64, bool)| {
            time_s += step;
            let velocities = if velocities { vec![x; count] } else { Vec::new() };
            TrajectoryPoint { time_s, positions: vec![x; count], velocities }
        };
        Trajectory { points: steps.into_iter().map(point).collect(), joints }
    })
}

fn value() -> impl Strategy<Value = Value> {
    let leaf = prop_oneof![
        Just(Value::Null),
        any::<bool>().prop_map(Value::Bool),
        any::<i64>().prop_map(Value::Int),
        number().prop_map(Value::Float),
        ".{0,6}".prop_map(Value::String),
        pose().prop_map(Value::Pose),
        vec(number(), 0..8).prop_map(Value::Joints),
        trajectory().prop_map(Value::Trajectory),
        vec(any::<u8>(), 0..9).prop_map(Value::Bytes),
    ];
    leaf.prop_recursive(4, 24, 4, |inner| {
        prop_oneof![
            vec(inner.clone(), 0..4).prop_map(|items| Value::List(items.into())),
            btree_map(a_name(), inner, 0..4).prop_map(Value::Map),
        ]
    })
}

fn term() -> impl Strategy<Value = Term> {
    prop_oneof![any::<i64>().prop_map(Term::Int), a_name().prop_map(Term::Name)]
}

fn key() -> impl Strategy<Value = FactKey> {
    (a_name(), vec(term(), 0..3)).prop_map(|(predicate, arguments)| FactKey { predicate, arguments })
}

fn pattern() -> impl Strategy<Value = FactPattern> {
    (a_name(), vec(prop::option::of(term()), 0..3))
        .prop_map(|(predicate, arguments)| FactPattern { predicate, arguments })
}

fn footprint() -> impl Strategy<Value = Footprint> {
    prop_oneof![Just(Footprint::Everything), vec(pattern(), 0..3).prop_map(Footprint::Patterns)]
}

fn change() -> impl Strategy<Value = Change> {
    prop_oneof![
        (key(), value()).prop_map(|(fact, value)| Change::Set { fact, value }),
        pattern().prop_map(|pattern| Change::Delete { pattern }),
        (key(), number()).prop_map(|(fact, by)| Change::Increase { fact, by }),
    ]
}

fn class() -> impl Strategy<Value = ResourceClass> {
    use ResourceClass::*;
    prop::sample::select(vec![System, Process, Module, World, Task])
}

fn requirement() -> impl Strategy<Value = Requirement> {
    use ResourceOperation::*;
    let operation = prop::sample::select(vec![Block, Consume, Create, Delete, Exists]);
    let attributes = btree_map(a_name(), value(), 0..3);
    let conditions = vec(condition(), 0..3);
    (operation, a_name(), prop::option::of(class()), attributes, conditions, amount(), any::<bool>()).prop_map(
        |(operation, kind, class, attributes, conditions, count, divisible)| Requirement {
            operation,
            kind,
            class,
            attributes,
            conditions,
            count,
            divisible,
        },
    )
}

fn amount() -> impl Strategy<Value = Quantity> {
    (1..=Quantity::MAX.thousandths()).prop_map(Quantity::from_thousandths)
}

fn condition() -> impl Strategy<Value = Condition> {
    let comparison = prop::sample::select(Comparison::WRITTEN.map(|(_, comparison)| comparison).to_vec());
    (a_name(), comparison, value()).prop_map(|(attribute, comparison, value)| {
        let value = match comparison {
            Comparison::Has => Value::Null,
            Comparison::In => Value::List(std::vec![value].into()),
            _ => value,
        };
        Condition { attribute, comparison, value }
    })
}

fn lease() -> impl Strategy<Value = Lease> {
    let resource = (a_name(), a_name(), prop_oneof![Just(String::new()), Just("unix:/a.sock".to_owned())])
        .prop_map(|(id, kind, endpoint)| LeasedResource { superclasses: std::vec![id.clone()], id, kind, endpoint });
    let consumed =
        (a_name(), a_name(), amount(), any::<bool>()).prop_map(|(resource, kind, units, ends_with_session)| {
            OperatedUnits { resource, kind, units, ends_with_session }
        });
    (any::<u64>(), any::<u64>(), vec(resource, 0..3), vec(consumed, 0..3)).prop_map(
        |(id, token, resources, consumed)| Lease { id: LeaseId(id), token: FencingToken(token), resources, consumed },
    )
}

fn resource() -> impl Strategy<Value = Resource> {
    let state = prop::sample::select(vec![ResourceState::Free, ResourceState::Leased, ResourceState::Exhausted]);
    let holding = (any::<u64>(), any::<u64>(), amount(), a_name()).prop_map(|(lease, token, units, session)| Holding {
        lease: LeaseId(lease),
        token: FencingToken(token),
        units,
        holder: format!("{session}/a"),
        opened_by: format!("{session} (certificate)"),
        session,
    });
    (
        a_name(),
        class(),
        a_name(),
        btree_map(a_name(), value(), 0..3),
        amount(),
        any::<[bool; 2]>(),
        state,
        vec(holding, 0..3),
    )
        .prop_map(|(id, class, kind, attributes, capacity, [divisible, renewable], state, holdings)| Resource {
            attributes,
            capacity,
            divisible,
            renewable,
            state,
            holdings,
            session: "s".to_owned(),
            ending: vec![EndingUnits {
                lease: LeaseId(capacity.thousandths()),
                token: FencingToken(1),
                units: capacity,
                session: "t".to_owned(),
                within_ms: 7,
            }],
            revision: Revision(capacity.thousandths()),
            ..Resource::new(id, class, kind).on_host("here")
        })
}

fn update() -> impl Strategy<Value = ResourceUpdate> {
    use ResourceEventKind::*;
    let kind = prop::sample::select(vec![Created, Updated, Deleted, Leased, Released]);
    let event = (any::<u64>(), kind, resource(), any::<u64>()).prop_map(|(revision, kind, resource, lease)| {
        ResourceUpdate::Event(ResourceEvent {
            part: 2,
            revision: Revision(revision),
            kind,
            resource,
            lease: matches!(kind, Leased | Released).then_some((LeaseId(lease), FencingToken(lease))),
            reason: "because".to_owned(),
        })
    });
    let snapshot = (any::<u64>(), vec(resource(), 0..3), any::<u64>()).prop_map(|(revision, resources, youngest)| {
        ResourceUpdate::Snapshot { revision: Revision(revision), resources, youngest: LeaseId(youngest) }
    });
    prop_oneof![event, snapshot]
}

fn measurement() -> impl Strategy<Value = Measurement> {
    let certainty =
        prop_oneof![(0.0..=1.0).prop_map(Certainty::Confidence), vec(-1.0..1.0, 9).prop_map(Certainty::Covariance),];
    (a_name(), prop::option::of(certainty)).prop_map(|(source, certainty)| Measurement { source, certainty })
}

fn record() -> impl Strategy<Value = FactRecord> {
    let measured = measurement().prop_map(Arc::new);
    (key(), value(), any::<u64>(), prop::option::of(a_name()), prop::option::of(measured)).prop_map(
        |(key, value, revision, writer, measured)| FactRecord {
            key,
            value,
            revision: Revision(revision),
            writer: writer.map(Arc::from),
            measured,
        },
    )
}

fn goal() -> impl Strategy<Value = Goal> {
    let inputs = btree_map(a_name(), value(), 0..3);
    (a_name(), a_name(), inputs, any::<u64>(), prop::option::of(lease()), prop::option::of(any::<u64>())).prop_map(
        |(id, action, inputs, seed, lease, projection)| Goal {
            id,
            action,
            inputs,
            seed,
            session: lease.as_ref().map_or_else(String::new, |_| "run-1".to_owned()),
            lease,
            projection: projection.map(ProjectionId),
            world_pool: "unix:/world.sock".to_owned(),
            deadline_ms: seed / 2,
            grace_ms: seed / 3,
            improves: seed.is_multiple_of(2).then(|| vec!["end".to_owned(); (seed % 3) as usize]),
        },
    )
}

fn outcome() -> impl Strategy<Value = GoalOutcome> {
    let fact = (value(), prop::option::of(measurement()));
    (a_name(), btree_map(a_name(), value(), 0..3), btree_map(key(), fact, 0..3), ".{0,9}").prop_map(
        |(outcome, outputs, facts, reason)| {
            let of = |(key, (_, by)): (&FactKey, &(Value, Option<Measurement>))| Some((key.clone(), by.clone()?));
            let evidence = facts.iter().filter_map(of).collect();
            let measured = facts.into_iter().map(|(key, (value, _))| (key, value)).collect();
            GoalOutcome { outcome, outputs, measured, evidence, reason }
        },
    )
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn what_goes_onto_the_wire_comes_back_the_same(
        value in value(), key in key(), record in record(), footprint in footprint(), change in change(), requirement in requirement(),
        lease in lease(), update in update(), goal in goal(), outcome in outcome(),
    ) {
        check::<_, v1::Fact>(&record)?;
        let told = WorldChange {
            revision: Revision(7),
            commit: "run/i1".to_owned(),
            written: vec![record.clone()],
            gone: vec![key.clone()],
            writer: Some("place[1]".into()),
        };
        check::<_, v1::WorldPoolServiceWatchResponse>(&WorldUpdate::Changed(told))?;
        let snapshot = WorldUpdate::Snapshot { revision: Revision(7), facts: vec![record.clone()] };
        check::<_, v1::WorldPoolServiceWatchResponse>(&snapshot)?;
        let (before, after) = (Some(record.clone()), None);
        check::<_, v1::FactDifference>(&FactDifference { key: key.clone(), before, after })?;
        let (was, is) = (Some(value.clone()), None);
        let contradiction =
            Contradiction { projection: ProjectionId(3), fact: key.clone(), was, is, revision: Revision(7) };
        check::<_, v1::Contradiction>(&contradiction)?;
        check::<_, v1::FactVersion>(&FactVersion {
            revision: Revision(7),
            commit: String::new(),
            fact: Some(record),
            writer: Some("place[1]".into()),
        })?;
        check::<_, v1::Value>(&value)?;
        check::<_, v1::FactKey>(&key)?;
        check::<_, v1::Footprint>(&footprint)?;
        check::<_, v1::Change>(&change)?;
        check::<_, v1::Requirement>(&requirement)?;
        check::<_, v1::Lease>(&lease)?;
        check::<_, v1::ResourceServiceWatchResponse>(&update)?;
        check::<_, v1::Goal>(&goal)?;
        check::<_, v1::GoalResult>(&outcome)?;
    }

    #[test]
    fn no_bytes_make_a_conversion_panic(bytes in vec(any::<u8>(), 0..200)) {
        if let Ok(goal) = v1::Goal::decode(bytes.as_slice()) {
            let _ = Goal::try_from(goal);
        }
        if let Ok(change) = v1::Change::decode(bytes.as_slice()) {
            let _ = Change::try_from(change);
        }
    }
}

#[test]
fn workers_and_pools_come_back_the_same() {
    for state in [WorkerState::Starting, WorkerState::Ready, WorkerState::Stopping, WorkerState::Exited] {
        let worker = WorkerStatus {
            id: "path-planner-1@compute".to_owned(),
            template: "path-planner".to_owned(),
            state,
            pid: 42,
            endpoint: "unix:/a.sock".to_owned(),
            reason: "killed by signal 9".to_owned(),
            resident_bytes: 1 << 20,
            cpu_millicores: 1500,
            limits: "memory 64 MiB (cgroup)".to_owned(),
            age_s: 1_500,
            held: true,
        };
        let pool = PoolStatus {
            template: worker.template.clone(),
            kind: "PathPlanner".to_owned(),
            min: 1,
            max: 4,
            workers: vec![worker],
            failure: "crashes in a loop".to_owned(),
            spares: 1,
            crashes: 7,
            last_exit: "path-planner-0@compute: killed by signal 9".to_owned(),
        };
        let modes = [TrackingMode::Cgroup, TrackingMode::Subreaper, TrackingMode::Marker].map(Some);
        for tracking in [None].into_iter().chain(modes) {
            let pools = vec![pool.clone()];
            let host = HostPools { host: "compute".to_owned(), draining: true, clock_us: 7, tracking, pools };
            assert_eq!(HostPools::try_from(v1::ListPoolsResponse::from(host.clone())), Ok(host));
        }
    }
}

fn refused<T, W>(message: W, expected: &str)
where
    T: TryFrom<W, Error = Malformed> + Debug,
{
    let error = T::try_from(message).unwrap_err().to_string();
    assert!(error.contains(expected), "`{error}` does not say `{expected}`");
}

#[test]
fn what_means_nothing_is_refused_with_its_path() {
    refused::<Value, _>(v1::Value { kind: None }, "kind: is not set: one of null, boolean");
    refused::<Value, _>(v1::Value::from(Value::Float(f64::NAN)), "number: is NaN");
    refused::<Value, _>(v1::Value::from(Value::Joints(vec![0.0, f64::INFINITY])), "joints[1]: is inf");
    let nested = Value::map([("a", Value::List(vec![Value::Null, Value::Float(f64::NAN)].into()))]);
    refused::<Value, _>(v1::Value::from(nested.clone()), "[a][1].number: is NaN");
    let goal = Goal {
        id: "g".to_owned(),
        action: "plan".to_owned(),
        inputs: [("start".to_owned(), nested)].into(),
        ..Goal::default()
    };
    refused::<Goal, _>(v1::Goal::from(goal.clone()), "inputs[start][a][1].number: is NaN");
    refused::<Goal, _>(v1::Goal::from(Goal { action: String::new(), ..goal.clone() }), "action: is empty");
    refused::<Goal, _>(
        v1::Goal::from(Goal { action: "a\u{7}".to_owned(), ..goal.clone() }),
        "action: holds control characters",
    );
    refused::<Goal, _>(
        v1::Goal::from(Goal { action: "a\u{200b}b".to_owned(), ..goal }),
        "action: holds U+200B, which is not seen",
    );
    let has = v1::Condition {
        attribute: "endpoint".to_owned(),
        comparison: v1::Comparison::Has.into(),
        value: Some(Value::Int(1).into()),
    };
    refused::<Condition, _>(has, "value: is set: `has` asks whether the attribute is there and takes none");
    refused::<Pose, _>(v1::Pose { position_m: vec![0.0; 2], quaternion_xyzw: vec![0.0, 0.0, 0.0, 1.0] }, "exactly 3");
    refused::<Pose, _>(v1::Pose { position_m: vec![0.0; 3], quaternion_xyzw: vec![0.0; 4] }, "has length 0");
    let point = |time_s| TrajectoryPoint { time_s, positions: vec![0.0], velocities: vec![] };
    let back = Trajectory { joints: vec!["a".to_owned()], points: vec![point(1.0), point(0.5)] };
    refused::<Trajectory, _>(v1::Trajectory::from(back), "points[1].time_s: is 0.5: times start at 0 and grow");
    let short = Trajectory { joints: vec![], points: vec![point(1.0)] };
    refused::<Trajectory, _>(v1::Trajectory::from(short), "points[0].positions: has 1 numbers for 0 joints");
    refused::<FactKey, _>(v1::FactKey { predicate: "x".repeat(2000), arguments: vec![] }, "at most 1024");
    refused::<Change, _>(v1::Change { kind: None }, "one of set, delete, increase");
    refused::<Requirement, _>(
        v1::Requirement { kind: "Arm".to_owned(), count: 1.0, operation: 99, ..Default::default() },
        "operation: 99",
    );
    for (count, why) in [
        (0.0, "count: is 0: it must be more than nothing"),
        (-1.0, "count: is -1: an amount is not negative"),
        (f64::NAN, "count: is `NaN`: an amount is a number"),
        (f64::INFINITY, "count: is `inf`: an amount is a number"),
        (0.1234, "count: is 0.1234: an amount has at most three decimals"),
        (1e300, "an amount is at most 4294967295"),
    ] {
        let requirement = v1::Requirement { kind: "Arm".to_owned(), operation: 1, count, ..Default::default() };
        refused::<Requirement, _>(requirement, why);
        let resource = v1::Resource { kind: "Arm".to_owned(), class: 3, capacity: count, ..Default::default() };
        refused::<Resource, _>(resource, &why.replace("count", "capacity"));
    }
}

#[test]
fn nesting_and_size_have_an_end() {
    let nested = |depth: usize| (0..depth).fold(Value::Null, |inner, _| Value::List(vec![inner].into()));
    assert!(Value::try_from(v1::Value::from(nested(MAX_DEPTH))).is_ok());
    refused::<Value, _>(v1::Value::from(nested(MAX_DEPTH + 1)), "nest deeper than 16");
    refused::<Value, _>(
        v1::Value::from(Value::List(vec![Value::Null; MAX_ELEMENTS + 1].into())),
        "more than 200000 elements",
    );
    // The deepest value that is allowed also survives the decoder's own limit.
    let bytes = v1::Value::from(nested(MAX_DEPTH)).encode_to_vec();
    assert!(v1::Value::decode(bytes.as_slice()).is_ok());
}

#[test]
fn what_is_selected_by_is_few() {
    let kinds = |count: usize| v1::ListRequest { kinds: vec!["Arm".to_owned(); count], ..Default::default() };
    assert!(ResourceFilter::try_from(kinds(MAX_SELECTED)).is_ok());
    refused::<ResourceFilter, _>(kinds(MAX_SELECTED + 1), "kinds: has 257 elements: at most 256 are allowed");
    let attributes = |count: usize| {
        let attributes = (0..count).map(|number| (number.to_string(), v1::Value::from(Value::Int(1)))).collect();
        v1::Requirement { kind: "Arm".to_owned(), operation: 1, count: 1.0, attributes, ..Default::default() }
    };
    assert!(Requirement::try_from(attributes(MAX_SELECTED)).is_ok());
    refused::<Requirement, _>(attributes(MAX_SELECTED + 1), "attributes: has 257 elements");
}
