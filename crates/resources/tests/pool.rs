//! The pool, feature by feature.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_model::condition::{Comparison, Condition};
use ratn_model::id::LeaseId;
use ratn_model::resource::{Lease, Quantity, Requirement, ResourceClass, ResourceOperation};
use ratn_model::time::Timestamp;
use ratn_model::value::Value;
use ratn_resources::{
    AcquireRequest, Change, EndReason, Kinds, Limits, Notice, Obstacle, Pool, PoolError, ProvidedCount, Refusal, Reply,
    Request, ResourceSpec, SessionId, WaiterId,
};
use std::time::Duration;

/// A pool with a session `a` that provides and a session `b`, both with a TTL of 10 s, and a clock.
struct Bench {
    pool: Pool,
    now: Timestamp,
}

impl Bench {
    fn new() -> Bench {
        let mut bench = Bench { pool: Pool::new(Limits::default()), now: Timestamp(0) };
        for name in ["a", "b"] {
            assert!(bench.pool.keep_alive(bench.now, &session(name), name, Duration::from_secs(10)).unwrap());
        }
        bench
    }

    fn with(resources: &[(&str, u32)]) -> Bench {
        let mut bench = Bench::new();
        for (kind, capacity) in resources {
            bench.create("a", ResourceSpec::new(ResourceClass::Module, *kind).capacity(*capacity));
        }
        bench.pool.take_notices();
        bench
    }

    fn create(&mut self, owner: &str, spec: ResourceSpec) -> String {
        self.pool.create(self.now, Some(&session(owner)), spec).unwrap().id.clone()
    }

    fn at(&mut self, seconds: f64) -> Vec<Notice> {
        self.now = Timestamp::from_seconds(seconds);
        self.pool.advance(self.now);
        self.notices()
    }

    fn acquire(&mut self, owner: &str, requirements: &[Requirement]) -> WaiterId {
        self.acquire_as(AcquireRequest::new(session(owner), requirements.to_vec()))
    }

    fn acquire_as(&mut self, request: AcquireRequest) -> WaiterId {
        let waiter = self.pool.acquire(self.now, request).unwrap();
        self.pool.check_invariants().unwrap();
        waiter
    }

    fn granted(&mut self, owner: &str, requirements: &[Requirement]) -> Lease {
        let waiter = self.acquire(owner, requirements);
        let notices = self.notices();
        grants(&notices).into_iter().find(|(id, _)| *id == waiter).expect("granted at once").1
    }

    fn release(&mut self, lease: LeaseId) -> Vec<WaiterId> {
        self.pool.release(self.now, None, lease).unwrap();
        grants(&self.notices()).into_iter().map(|(waiter, _)| waiter).collect()
    }

    fn notices(&mut self) -> Vec<Notice> {
        self.pool.check_invariants().unwrap();
        self.pool.take_notices()
    }
}

fn session(name: &str) -> SessionId {
    SessionId::from(name)
}

fn requirement(operation: ResourceOperation, kind: &str, count: u32) -> Requirement {
    Requirement { count: count.into(), ..Requirement::new(operation, kind) }
}

fn block(kind: &str) -> Requirement {
    requirement(ResourceOperation::Block, kind, 1)
}

fn grants(notices: &[Notice]) -> Vec<(WaiterId, Lease)> {
    notices
        .iter()
        .filter_map(|notice| match notice {
            Notice::Granted { waiter, lease } => Some((*waiter, lease.clone())),
            _ => None,
        })
        .collect()
}

fn changes(notices: &[Notice]) -> Vec<&Change> {
    notices
        .iter()
        .filter_map(|notice| match notice {
            Notice::Event(event) => Some(&event.change),
            _ => None,
        })
        .collect()
}

#[test]
fn a_free_resource_is_granted_at_once_with_its_endpoint() {
    let mut bench = Bench::new();
    let spec = ResourceSpec::new(ResourceClass::Process, "PathPlanner")
        .id("planner-1@compute")
        .attribute("endpoint", Value::String("unix:/p1".into()));
    bench.create("a", spec);
    let lease = bench.granted("b", &[block("PathPlanner")]);
    let resource = lease.resource("PathPlanner").unwrap();
    assert_eq!((resource.id.as_str(), resource.endpoint.as_str()), ("planner-1@compute", "unix:/p1"));
}

#[test]
fn a_held_resource_goes_to_the_next_waiter_with_a_larger_token() {
    let mut bench = Bench::with(&[("Arm", 1)]);
    let first = bench.granted("a", &[block("Arm")]);
    let waiter = bench.acquire("b", &[block("Arm")]);
    assert!(grants(&bench.notices()).is_empty());
    bench.pool.release(bench.now, None, first.id).unwrap();
    let granted = grants(&bench.notices());
    assert_eq!(granted[0].0, waiter);
    assert!(granted[0].1.token > first.token);
}

#[test]
fn larger_priority_goes_first_and_equals_in_the_order_of_arrival() {
    let mut bench = Bench::with(&[("Arm", 1)]);
    let mut held = bench.granted("a", &[block("Arm")]).id;
    let asks = [0, 5, 0, 5];
    let waiters: Vec<WaiterId> = asks
        .map(|priority| bench.acquire_as(AcquireRequest::new(session("b"), vec![block("Arm")]).priority(priority)))
        .to_vec();
    let mut order = Vec::new();
    for _ in asks {
        bench.pool.release(bench.now, None, held).unwrap();
        let granted = grants(&bench.notices());
        order.push(granted[0].0);
        held = granted[0].1.id;
    }
    assert_eq!(order, [waiters[1], waiters[3], waiters[0], waiters[2]]);
}

#[test]
fn an_acquire_takes_all_or_nothing() {
    let mut bench = Bench::with(&[("Arm", 1), ("Gripper", 1)]);
    let arm = bench.granted("a", &[block("Arm")]);
    let both = bench.acquire("b", &[block("Arm"), block("Gripper")]);
    assert_eq!(bench.pool.get("Gripper-2").unwrap().free, 1, "nothing is held while waiting");
    assert_eq!(bench.release(arm.id), [both]);
    assert_eq!(bench.pool.get("Gripper-2").unwrap().free, 0);
}

#[test]
fn a_large_request_is_not_overtaken_for_what_it_waits_for_but_other_kinds_pass() {
    let mut bench = Bench::with(&[("PathPlanner", 2), ("Detector", 1)]);
    let one = bench.granted("a", &[block("PathPlanner")]);
    let large = bench.acquire("b", &[requirement(ResourceOperation::Block, "PathPlanner", 2)]);
    let small = bench.acquire("b", &[block("PathPlanner")]);
    let other = bench.acquire("b", &[block("Detector")]);
    let granted = grants(&bench.notices());
    assert_eq!(granted.iter().map(|(waiter, _)| *waiter).collect::<Vec<_>>(), [other]);
    assert!(matches!(&bench.pool.explain(small).unwrap().obstacles[..],
        [Obstacle::Reserved { waiters, .. }] if waiters[..] == [large]));
    assert_eq!(bench.release(one.id), [large]);
}

#[test]
fn where_overtaking_is_allowed_nobody_reserves_what_another_lacks_while_it_lacks_what_that_one_has() {
    let mut bench = Bench::new();
    bench.pool = Pool::new(Limits { overtaken: 1, ..Limits::default() });
    bench.pool.keep_alive(bench.now, &session("a"), "a", Duration::from_secs(10)).unwrap();
    for (kind, capacity) in [("A", 4), ("B", 2)] {
        bench.create("a", ResourceSpec::new(ResourceClass::Module, kind).capacity(capacity));
    }
    let of = |kind: &str, count| requirement(ResourceOperation::Block, kind, count);
    let first = bench.granted("a", &[of("B", 1)]);
    let both = bench.acquire("a", &[of("B", 2)]);
    let passing = bench.granted("a", &[of("A", 1), of("B", 1)]);
    let large = bench.acquire("a", &[of("A", 4), of("B", 2)]);
    assert!(bench.release(first.id).is_empty());
    // A unit of A is free for it, and would be lacking to the large one, which is before it.
    let small = bench.acquire("a", &[of("A", 1), of("B", 1)]);
    assert_eq!(bench.release(passing.id), [both]);
    let mut served = Vec::new();
    while let Some(lease) = bench.pool.leases().first() {
        served.extend(bench.release(lease.id));
    }
    assert_eq!(served, [large, small]);
}

#[test]
fn a_request_for_a_missing_kind_holds_nobody_up_and_is_granted_when_the_kind_appears() {
    let mut bench = Bench::with(&[("Arm", 1)]);
    let missing = bench.acquire("b", &[block("Arm"), block("Detector")]);
    assert!(matches!(&bench.pool.explain(missing).unwrap().obstacles[..],
        [Obstacle::MissingKind { kind, .. }] if kind == "Detector"));
    let arm = bench.granted("a", &[block("Arm")]);
    bench.pool.release(bench.now, None, arm.id).unwrap();
    bench.notices();
    bench.create("a", ResourceSpec::new(ResourceClass::Process, "Detector"));
    assert_eq!(grants(&bench.notices())[0].0, missing);
}

#[test]
fn a_capacity_of_eight_has_eight_concurrent_holders() {
    let mut bench = Bench::with(&[("WorldModel", 8)]);
    let leases: Vec<Lease> = (0..8).map(|_| bench.granted("b", &[block("WorldModel")])).collect();
    let ninth = bench.acquire("b", &[block("WorldModel")]);
    assert!(grants(&bench.notices()).is_empty());
    assert_eq!(bench.release(leases[3].id), [ninth]);
}

#[test]
fn units_are_moved_between_requirements_so_that_what_can_be_served_is() {
    let mut bench = Bench::new();
    for host in ["a", "b"] {
        let spec = ResourceSpec::new(ResourceClass::Process, "PathPlanner").id(format!("planner@{host}"));
        bench.create("a", spec.attribute("host", Value::String(host.into())));
    }
    let on_a = Requirement {
        attributes: [("host".to_owned(), Value::String("a".into()))].into(),
        ..requirement(ResourceOperation::Block, "PathPlanner", 1)
    };
    let lease = bench.granted("b", &[block("PathPlanner"), on_a]);
    let ids: Vec<&str> = lease.resources.iter().map(|r| r.id.as_str()).collect();
    assert_eq!(ids, ["planner@b", "planner@a"], "in the order of the requirements");
}

#[test]
fn a_session_without_keep_alive_loses_resources_leases_and_place_in_the_queue() {
    let mut bench = Bench::with(&[("Arm", 1)]);
    bench.create("b", ResourceSpec::new(ResourceClass::Module, "Gripper").id("gripper"));
    let held = bench.granted("a", &[block("Gripper")]);
    let waiting = bench.acquire("b", &[block("Gripper")]);
    bench.at(9.0);
    bench.pool.keep_alive(bench.now, &session("a"), "a", Duration::from_secs(10)).unwrap();
    assert_eq!(bench.pool.next_deadline(), Some(Timestamp::from_seconds(10.0)));
    let notices = bench.at(10.0);
    assert!(notices.contains(&Notice::Refused { waiter: waiting, refusal: Refusal::SessionEnded }));
    let changes = changes(&notices);
    assert!(matches!(&changes[..], [
        Change::ResourceLost { lease, resource: lost, .. },
        Change::ResourceDeleted { resource, reason: EndReason::SessionExpired },
    ] if *lease == held.id && lost.id == "gripper" && resource.id == "gripper"));
    assert!(bench.pool.get("gripper").is_none());
}

#[test]
fn a_waiter_whose_session_expired_is_not_granted_however_late_the_pool_is_called() {
    let mut bench = Bench::with(&[("Arm", 1)]);
    let held = bench.granted("a", &[block("Arm")]);
    let waiting = bench.acquire("b", &[block("Arm")]);
    bench.pool.keep_alive(Timestamp::from_seconds(5.0), &session("a"), "a", Duration::from_secs(60)).unwrap();
    // No timer fired in between: the release itself comes after b's time.
    bench.now = Timestamp::from_seconds(12.0);
    bench.pool.release(bench.now, Some(&session("a")), held.id).unwrap();
    let notices = bench.notices();
    assert!(grants(&notices).is_empty());
    assert!(notices.contains(&Notice::Refused { waiter: waiting, refusal: Refusal::SessionEnded }));
    assert_eq!(bench.pool.get("Arm-1").unwrap().free, 1);
}

#[test]
fn a_waiter_past_its_deadline_is_told_what_it_waited_for() {
    let mut bench = Bench::with(&[("Arm", 1)]);
    bench
        .acquire_as(AcquireRequest { purpose: "move".into(), ..AcquireRequest::new(session("a"), vec![block("Arm")]) });
    bench.notices();
    let request = AcquireRequest::new(session("b"), vec![block("Arm")]).deadline(Timestamp::from_seconds(2.0));
    let waiter = bench.acquire_as(request);
    assert_eq!(bench.pool.next_deadline(), Some(Timestamp::from_seconds(2.0)));
    let notices = bench.at(2.0);
    let [Notice::Refused { waiter: refused, refusal: Refusal::Deadline { waited_for } }] = &notices[..] else {
        panic!("{notices:?}")
    };
    assert_eq!(*refused, waiter);
    assert_eq!(waited_for, "`block Arm`: held by lease-1 of session a for move");
}

#[test]
fn what_could_not_be_given_if_nobody_held_anything_is_explained() {
    let mut bench = Bench::with(&[("Arm", 2)]);
    let half = Requirement { count: Quantity::from_thousandths(500), ..block("Arm") };
    let two = || requirement(ResourceOperation::Block, "Arm", 2);
    for (asked, said) in [
        (vec![half], "`block Arm × 0.5`: what fits is given in whole units only"),
        (vec![requirement(ResourceOperation::Block, "Arm", 3)], "`block Arm × 3`: only 2 units that fit exist"),
        (
            vec![two(), block("Arm")],
            "`block Arm`: of the 2 units that fit only 0 can be given beside what else the request asks for",
        ),
        (vec![block("Leg")], "`block Leg`: no resource of kind Leg exists"),
    ] {
        let waiter = bench.acquire("a", &asked);
        let explanation = bench.pool.explain(waiter).unwrap();
        assert_eq!(explanation.to_string(), said);
        assert!(!explanation.is_hopeful(), "{said}");
        bench.pool.cancel(bench.now, waiter).unwrap();
    }
}

#[test]
fn a_lease_ends_when_its_own_time_is_over() {
    let mut bench = Bench::with(&[("Arm", 1)]);
    let request = AcquireRequest::new(session("a"), vec![block("Arm")]);
    bench.acquire_as(AcquireRequest { hold_for: Some(Duration::from_secs(3)), ..request });
    let waiter = bench.acquire("b", &[block("Arm")]);
    bench.notices();
    let notices = bench.at(3.0);
    assert!(matches!(changes(&notices)[0], Change::LeaseEnded { reason: EndReason::HeldTooLong, .. }));
    assert_eq!(grants(&notices)[0].0, waiter);
}

#[test]
fn a_cancelled_waiter_is_not_granted() {
    let mut bench = Bench::with(&[("Arm", 1)]);
    let held = bench.granted("a", &[block("Arm")]);
    let waiter = bench.acquire("b", &[block("Arm")]);
    bench.pool.cancel(bench.now, waiter).unwrap();
    assert_eq!(bench.notices(), [Notice::Refused { waiter, refusal: Refusal::Cancelled }]);
    assert_eq!(bench.release(held.id), []);
    assert_eq!(bench.pool.cancel(bench.now, waiter), Err(PoolError::UnknownWaiter { waiter }));
}

#[test]
fn what_is_consumed_returns_when_the_task_ends() {
    let mut bench = Bench::with(&[("Slot", 3)]);
    let consume = requirement(ResourceOperation::Consume, "Slot", 2);
    let lease = bench.granted("b", std::slice::from_ref(&consume));
    assert!(lease.resources.is_empty(), "what is consumed is not held");
    bench.pool.release(bench.now, None, lease.id).unwrap();
    assert_eq!(bench.pool.get("Slot-1").unwrap().free, 1);
    let refused = bench.pool.consume(bench.now, &session("b"), &consume);
    assert_eq!(refused, Err(PoolError::NotEnough { wanted: "consume Slot × 2".into(), found: 1.into() }));
    bench.pool.end_task(bench.now, &session("b")).unwrap();
    assert_eq!(bench.pool.get("Slot-1").unwrap().free, 3);
}

#[test]
fn what_is_consumed_of_something_not_renewable_is_gone() {
    let mut bench = Bench::new();
    let spec = ResourceSpec { renewable: false, ..ResourceSpec::new(ResourceClass::System, "Battery").capacity(100) };
    let id = bench.create("a", spec);
    bench.granted("b", &[requirement(ResourceOperation::Consume, "Battery", 30)]);
    bench.at(11.0);
    assert!(bench.pool.get(&id).is_none(), "it went with its provider's session");
    let mut bench = Bench::new();
    let spec = ResourceSpec { renewable: false, ..ResourceSpec::new(ResourceClass::System, "Battery").capacity(100) };
    let id = bench.pool.create(bench.now, None, spec).unwrap().id.clone();
    bench.granted("b", &[requirement(ResourceOperation::Consume, "Battery", 30)]);
    bench.at(11.0);
    assert_eq!(bench.pool.get(&id).unwrap().free, 70);
}

#[test]
fn a_resource_is_chosen_by_conditions_on_its_attributes_and_by_its_host() {
    let mut bench = Bench::new();
    for (id, payload, host) in [("small", 1.0, "compute"), ("large", 5.0, "sim")] {
        let spec = ResourceSpec::new(ResourceClass::Module, "Gripper").id(id).host(host);
        bench.create("a", spec.attribute("payload", Value::Float(payload)));
    }
    bench.create("a", ResourceSpec::new(ResourceClass::Module, "Gripper").id("odd"));
    let number = Value::Float;
    let text = |text: &str| Value::String(text.into());
    let cases: [(&str, Comparison, Value, &[&str]); 10] = [
        ("payload", Comparison::Equal, Value::Int(5), &["large"]),
        ("payload", Comparison::NotEqual, Value::Int(5), &["small"]),
        ("payload", Comparison::Less, number(5.0), &["small"]),
        ("payload", Comparison::LessOrEqual, number(5.0), &["large", "small"]),
        ("payload", Comparison::Greater, number(5.0), &[]),
        ("payload", Comparison::GreaterOrEqual, number(1.5), &["large"]),
        ("payload", Comparison::In, Value::List(vec![number(1.0), number(2.0)].into()), &["small"]),
        ("payload", Comparison::Has, Value::Null, &["large", "small"]),
        ("host", Comparison::Equal, text("compute"), &["small"]),
        ("payload", Comparison::Less, text("5"), &[]),
    ];
    for (attribute, comparison, value, expected) in cases {
        let conditions = vec![Condition { attribute: attribute.into(), comparison, value }];
        let wanted = Requirement { conditions, ..block("Gripper") };
        assert_eq!(bench.pool.fitting(&wanted), expected, "{wanted}");
        let waiter = bench.acquire("b", &[wanted]);
        let granted = grants(&bench.notices());
        assert_eq!(granted.is_empty(), expected.is_empty());
        match granted.into_iter().next() {
            Some((_, lease)) => drop(bench.release(lease.id)),
            None => bench.pool.cancel(bench.now, waiter).unwrap(),
        }
    }
    // One that waits is served when one that fits becomes what it wants.
    let heavy = Condition { attribute: "payload".into(), comparison: Comparison::Greater, value: number(5.0) };
    let waiter = bench.acquire("b", &[Requirement { conditions: vec![heavy], ..block("Gripper") }]);
    let spec = ResourceSpec::new(ResourceClass::Module, "Gripper").id("large").host("sim");
    bench.create("a", spec.attribute("payload", number(6.0)));
    assert_eq!(grants(&bench.notices())[0].0, waiter);
}

#[test]
fn who_asks_for_a_kind_may_get_one_of_a_kind_below_it_and_is_told_what_it_is() {
    let hierarchy =
        [("Vacuum".to_owned(), vec!["Gripper".to_owned()]), ("Gripper".to_owned(), vec!["Tool".to_owned()])];
    let mut bench = Bench::new();
    bench.pool = bench.pool.clone().with_kinds(Kinds::new(&hierarchy.into()).unwrap());
    let early = bench.acquire("b", &[block("Tool")]);
    bench.create("a", ResourceSpec::new(ResourceClass::Module, "Vacuum").id("v"));
    let (waiter, lease) = grants(&bench.notices()).remove(0);
    assert_eq!(waiter, early);
    let resource = lease.resource("Tool").unwrap();
    assert_eq!((resource.id.as_str(), resource.kind.as_str()), ("v", "Vacuum"));
    assert_eq!(resource.superclasses, ["Gripper", "Tool"]);
    assert!(lease.resource("Gripper").is_some() && lease.resource("Camera").is_none());
    // Three that want it by different names are served in order.
    let waiters = ["Gripper", "Vacuum", "Tool"].map(|kind| bench.acquire("b", &[block(kind)]));
    assert!(matches!(&bench.pool.explain(waiters[0]).unwrap().obstacles[..], [Obstacle::Held { .. }]));
    let mut held = lease.id;
    for waiter in waiters {
        bench.pool.release(bench.now, None, held).unwrap();
        let granted = grants(&bench.notices());
        assert_eq!(granted.iter().map(|(waiter, _)| *waiter).collect::<Vec<_>>(), [waiter]);
        held = granted[0].1.id;
    }
    assert!(bench.pool.exists(&block("Vacuum")) == 1 && bench.pool.exists(&block("Tool")) == 1);
}

#[test]
fn what_fits_fewer_other_requests_is_given_away_first() {
    let hierarchy = [("Vacuum".to_owned(), vec!["Gripper".to_owned()])];
    let mut bench = Bench::new();
    bench.pool = bench.pool.clone().with_kinds(Kinds::new(&hierarchy.into()).unwrap());
    bench.create("a", ResourceSpec::new(ResourceClass::Module, "Vacuum").id("1"));
    let gripper = || ResourceSpec::new(ResourceClass::Module, "Gripper");
    bench.create("a", gripper().id("2").attribute("camera", Value::Bool(true)));
    bench.create("a", gripper().id("3"));
    let ids = [(); 3].map(|()| bench.granted("b", &[block("Gripper")]).resources.remove(0).id);
    assert_eq!(ids, ["3", "2", "1"], "the plain one, the one with a camera, the one of a kind below");
}

#[test]
fn what_waits_for_more_than_exists_is_in_demand_until_it_does_not_and_is_told_why_there_is_no_more() {
    let mut bench = Bench::new();
    let provided = || {
        let kinds = ["PathPlanner".to_owned()].into();
        std::sync::Arc::new(ratn_resources::Provided { kinds, ..Default::default() })
    };
    let told = |pool: &mut Pool| {
        let demand = pool.take_demand(&provided())?;
        Some(
            demand
                .iter()
                .map(|demand| (demand.requirement.kind.clone(), demand.requirement.count.units()))
                .collect::<Vec<_>>(),
        )
    };
    let planners = |count| requirement(ResourceOperation::Block, "PathPlanner", count);
    assert_eq!(told(&mut bench.pool), Some(vec![]), "it is asked for the first time");
    assert_eq!(told(&mut bench.pool), None);
    let two = bench.acquire("b", &[planners(2)]);
    let three = bench.acquire("b", &[planners(3)]);
    assert_eq!(told(&mut bench.pool), Some(vec![("PathPlanner".into(), 3)]), "the most that one waits for");
    assert_eq!(told(&mut bench.pool), None, "nothing has changed");
    let first = bench.create("a", ResourceSpec::new(ResourceClass::Process, "PathPlanner"));
    assert_eq!(told(&mut bench.pool), Some(vec![("PathPlanner".into(), 2)]));
    bench.pool.report_shortage(bench.now, &session("a"), "PathPlanner", "`planner` crash-loops").unwrap();
    let words = bench.pool.explain(two).unwrap().to_string();
    assert_eq!(words, "`block PathPlanner × 2`: only 1 units that fit exist (a: `planner` crash-loops)");
    bench.create("a", ResourceSpec::new(ResourceClass::Process, "PathPlanner"));
    let (waiter, lease) = grants(&bench.notices()).remove(0);
    assert_eq!(waiter, two);
    let left = bench.pool.take_demand(&provided()).unwrap();
    let mut count = ProvidedCount::new(left[0].requirement.clone());
    bench.pool.count_provided(&mut count, 10);
    assert_eq!((left[0].requirement.count, count.of(&session("a"))), (Quantity::ONE, Quantity::whole(2)));
    // Held or not: what exists is not in demand.
    bench.acquire("b", &[planners(1)]);
    assert_eq!(told(&mut bench.pool), None);
    bench.pool.cancel(bench.now, three).unwrap();
    assert_eq!(told(&mut bench.pool), Some(vec![]), "withdrawn");
    // It comes back where what existed is gone, and what a provider said goes with its session.
    bench.release(lease.id);
    bench.pool.delete(bench.now, None, &first).unwrap();
    bench.acquire("b", &[planners(2)]);
    assert_eq!(told(&mut bench.pool), Some(vec![("PathPlanner".into(), 1)]));
    bench.pool.close_session(bench.now, &session("a")).unwrap();
    let (last, _) = bench.pool.waiters().pop().unwrap();
    assert!(!bench.pool.explain(last).unwrap().to_string().contains("crash-loops"));
}

#[test]
fn exists_waits_for_the_resource_but_does_not_hold_it() {
    let mut bench = Bench::with(&[("Arm", 1)]);
    let level = Requirement {
        attributes: [("charged".to_owned(), Value::Bool(true))].into(),
        ..requirement(ResourceOperation::Exists, "Battery", 1)
    };
    let waiter = bench.acquire("b", &[block("Arm"), level.clone()]);
    let battery = |charged| {
        let spec = ResourceSpec::new(ResourceClass::System, "Battery").id("battery");
        spec.attribute("charged", Value::Bool(charged))
    };
    bench.create("a", battery(false));
    assert!(grants(&bench.notices()).is_empty());
    bench.create("a", battery(true));
    let granted = grants(&bench.notices());
    assert_eq!(granted[0].0, waiter);
    assert_eq!(granted[0].1.resources.len(), 1);
    assert_eq!(bench.pool.exists(&level), 1);
}

#[test]
fn a_deleted_resource_that_does_not_move_is_lost_to_its_holder_and_the_rest_of_the_lease_stays() {
    let mut bench = Bench::with(&[("Arm", 1), ("Gripper", 1)]);
    let lease = bench.granted("b", &[block("Arm"), block("Gripper")]);
    bench.pool.delete(bench.now, Some(&session("a")), "Arm-1").unwrap();
    let notices = bench.notices();
    assert!(matches!(changes(&notices)[0], Change::ResourceLost { lease: l, .. } if *l == lease.id));
    assert_eq!(bench.pool.leases()[0].resources, ["Gripper-2"]);
    assert_eq!(
        bench.pool.delete(bench.now, Some(&session("b")), "Gripper-2").unwrap_err(),
        PoolError::NotYours { what: "resource `Gripper-2`".into(), owner: session("a"), caller: session("b") }
    );
}

#[test]
fn what_else_a_lease_held_is_granted_when_its_providers_have_confirmed_standstill() {
    for its_session_ends in [false, true] {
        let mut bench = Bench::new();
        let bound = Duration::from_secs(5);
        let moving = |kind: &str| ResourceSpec::new(ResourceClass::Module, kind).id(kind).standstill(bound);
        let owner = session("furniture");
        bench.pool.keep_alive(bench.now, &owner, "furniture", Duration::from_secs(10)).unwrap();
        bench.create("a", moving("Arm"));
        bench.create("furniture", moving("Middle"));
        let lease = bench.granted("b", &[block("Arm"), block("Middle")]);
        let waiting = bench.acquire("a", &[block("Arm")]);
        match its_session_ends {
            true => bench.pool.close_session(bench.now, &owner).unwrap(),
            false => bench.pool.delete(bench.now, None, "Middle").unwrap(),
        }
        assert_eq!(grants(&bench.notices()), [], "the arm may still move");
        assert!(bench.pool.get("Middle").is_none());
        assert!(bench.pool.confirm_standstill(bench.now, Some(&session("a")), lease.id, "Arm").unwrap());
        assert_eq!(grants(&bench.notices())[0].0, waiting);
    }
}

#[test]
fn units_are_deleted_all_or_none_and_a_resource_without_units_is_gone() {
    let mut bench = Bench::new();
    let delete = |count| requirement(ResourceOperation::Delete, "box_delivered", count);
    for count in [2, 3] {
        bench.create("b", ResourceSpec::new(ResourceClass::Task, "box_delivered").capacity(count));
    }
    bench.notices();
    let refused = bench.pool.delete_units(bench.now, &session("b"), &delete(6));
    assert_eq!(refused, Err(PoolError::NotEnough { wanted: "delete box_delivered × 6".into(), found: 5.into() }));
    assert!(bench.notices().is_empty() && bench.pool.take_records().len() == 4, "no trace of it");
    assert_eq!(bench.pool.delete_units(bench.now, &session("b"), &delete(2)).unwrap(), ["box_delivered-1"]);
    assert_eq!(bench.pool.exists(&requirement(ResourceOperation::Exists, "box_delivered", 1)), 3);
    assert_eq!(bench.pool.delete_units(bench.now, &session("b"), &delete(3)).unwrap(), ["box_delivered-2"]);
    assert!(bench.pool.list().is_empty(), "a resource without units is gone");
}

#[test]
fn a_delete_by_requirement_takes_the_sessions_own_before_what_is_nobodys() {
    let mut bench = Bench::new();
    let nobodys = bench.pool.create(bench.now, None, ResourceSpec::new(ResourceClass::Task, "Box")).unwrap().id.clone();
    let own = bench.create("b", ResourceSpec::new(ResourceClass::Task, "Box"));
    let delete = requirement(ResourceOperation::Delete, "Box", 1);
    assert_eq!(bench.pool.delete_units(bench.now, &session("b"), &delete).unwrap(), [own]);
    assert_eq!(bench.pool.delete_units(bench.now, &session("b"), &delete).unwrap(), [nobodys]);
}

#[test]
fn a_delete_by_requirement_takes_only_what_the_session_may_delete_by_id() {
    let mut bench = Bench::with(&[("Arm", 1)]);
    let arm = bench.pool.list().remove(0).id.clone();
    let delete = |count| Requirement { count, ..requirement(ResourceOperation::Delete, "Arm", 1) };
    let by_id = bench.pool.delete(bench.now, Some(&session("b")), &arm).unwrap_err();
    let by_requirement = bench.pool.delete_units(bench.now, &session("b"), &delete(1.into())).unwrap_err();
    assert_eq!(by_requirement, by_id);
    assert_eq!(by_id.to_string(), format!("resource `{arm}` belongs to session a, not to session b"));
    // Its own first, and what is nobody's; what is another's stays.
    let own = bench.create("b", ResourceSpec::new(ResourceClass::Task, "Arm"));
    let nobodys = bench.pool.create(bench.now, None, ResourceSpec::new(ResourceClass::Task, "Arm")).unwrap().id.clone();
    let too_many = bench.pool.delete_units(bench.now, &session("b"), &delete(3.into())).unwrap_err();
    assert_eq!(too_many, by_id, "and nothing is deleted in part");
    let mut touched = bench.pool.delete_units(bench.now, &session("b"), &delete(2.into())).unwrap();
    touched.sort();
    assert_eq!(touched, [own, nobodys]);
    assert_eq!(bench.pool.list().len(), 1);
    assert_eq!(bench.pool.delete_units(bench.now, &session("a"), &delete(1.into())).unwrap(), [arm]);
}

#[test]
fn a_request_id_used_again_is_performed_once() {
    let mut bench = Bench::new();
    let create = Request::Create { session: Some(session("a")), spec: ResourceSpec::new(ResourceClass::Module, "Arm") };
    let first = bench.pool.handle(bench.now, "c1", create.clone()).unwrap();
    assert_eq!(bench.pool.handle(bench.now, "c1", create.clone()).unwrap(), first);
    assert_eq!(bench.pool.list().len(), 1);
    let acquire = Request::Acquire(AcquireRequest::new(session("b"), vec![block("Arm")]));
    assert!(matches!(bench.pool.handle(bench.now, "q1", acquire.clone()), Ok(Reply::Queued(_))));
    let granted = grants(&bench.notices()).remove(0).1;
    assert_eq!(bench.pool.handle(bench.now, "q1", acquire.clone()), Ok(Reply::Granted(granted.clone())));
    assert!(grants(&bench.notices()).is_empty());
    let reused = bench.pool.handle(bench.now, "q1", create);
    assert_eq!(reused, Err(PoolError::RequestIdReused { id: "q1".into() }));
    bench.pool.handle(bench.now, "r1", Request::Release { session: None, lease: granted.id, at_rest: true }).unwrap();
    bench.pool.handle(bench.now, "r1", Request::Release { session: None, lease: granted.id, at_rest: true }).unwrap();
    assert_eq!(bench.pool.handle(bench.now, "q1", acquire), Err(PoolError::UnknownLease { lease: granted.id }));
}

#[test]
fn a_grant_that_nobody_heard_of_may_be_asked_for_again_with_its_request_id() {
    let mut bench = Bench::new();
    bench.create("a", ResourceSpec::new(ResourceClass::Module, "Arm"));
    let acquire = Request::Acquire(AcquireRequest::new(session("b"), vec![block("Arm")]));
    bench.pool.handle(bench.now, "q1", acquire.clone()).unwrap();
    let first = grants(&bench.notices()).remove(0).1;
    bench.pool.undo_grant(bench.now, first.id).unwrap();
    bench.pool.check_invariants().unwrap();
    bench.notices();
    assert!(matches!(bench.pool.handle(bench.now, "q1", acquire), Ok(Reply::Queued(_))));
    let again = grants(&bench.notices()).remove(0).1;
    assert!(again.token > first.token);
    assert_eq!(bench.pool.undo_grant(bench.now, first.id), Err(PoolError::UnknownLease { lease: first.id }));
}

#[test]
fn what_was_consumed_with_a_grant_that_is_undone_is_there_again_once() {
    for renewable in [true, false] {
        let mut bench = Bench::new();
        let spec = ResourceSpec::new(ResourceClass::System, "Charge").id("charge").capacity(2).divisible();
        bench.create("a", ResourceSpec { renewable, ..spec });
        let part = Quantity::from_thousandths(750);
        let consume = Requirement { count: part, ..requirement(ResourceOperation::Consume, "Charge", 1) };
        let left = |bench: &Bench| bench.pool.get("charge").unwrap().free.thousandths();
        let acquire = Request::Acquire(AcquireRequest::new(session("b"), vec![consume]));
        for id in ["kept", "undelivered", "withdrawn"] {
            bench.pool.handle(bench.now, id, acquire.clone()).unwrap();
            let lease = grants(&bench.notices()).remove(0).1;
            match id {
                "kept" => drop(bench.release(lease.id)),
                "undelivered" => bench.pool.undo_grant(bench.now, lease.id).unwrap(),
                _ => assert!(bench.pool.withdraw(bench.now, &session("b"), id).unwrap()),
            }
            bench.pool.check_invariants().unwrap();
            assert_eq!(left(&bench), 1_250, "{id}");
        }
        // The end of the task gives back what is renewable; an undone grant gives nothing a second time.
        bench.pool.handle(bench.now, "last", acquire.clone()).unwrap();
        let lease = grants(&bench.notices()).remove(0).1;
        bench.pool.end_task(bench.now, &session("b")).unwrap();
        bench.pool.undo_grant(bench.now, lease.id).unwrap();
        bench.pool.check_invariants().unwrap();
        assert_eq!(left(&bench), if renewable { 2_000 } else { 1_250 });
    }
}

#[test]
fn a_cancelled_acquire_may_be_asked_again_with_its_request_id() {
    let mut bench = Bench::new();
    let acquire = Request::Acquire(AcquireRequest::new(session("b"), vec![block("Arm")]));
    let Ok(Reply::Queued(first)) = bench.pool.handle(bench.now, "q", acquire.clone()) else { panic!() };
    let later = AcquireRequest::new(session("b"), vec![block("Arm")]).deadline(Timestamp(1));
    assert_eq!(bench.pool.handle(bench.now, "q", Request::Acquire(later)), Ok(Reply::Queued(first)));
    assert_eq!(
        bench.pool.handle(bench.now, "q", acquire.clone()),
        Ok(Reply::Queued(first)),
        "it joins the one waiting"
    );
    bench.pool.cancel(bench.now, first).unwrap();
    let Ok(Reply::Queued(second)) = bench.pool.handle(bench.now, "q", acquire) else { panic!() };
    assert_ne!(first, second);
}

#[test]
fn an_acquire_that_arrives_after_its_withdrawal_is_refused() {
    let mut bench = Bench::with(&[("Arm", 1)]);
    let ask = |bench: &mut Bench, owner: &str, id: &str| {
        let request = AcquireRequest::new(session(owner), vec![block("Arm")]);
        bench.pool.handle(bench.now, id, Request::Acquire(request))
    };
    assert_eq!(bench.pool.withdraw(bench.now, &session("b"), "late"), Ok(false));
    for _ in 0..2 {
        let refused = ask(&mut bench, "b", "late");
        assert_eq!(refused, Err(PoolError::Withdrawn { id: "late".into() }), "as often as it arrives");
    }
    assert!(bench.pool.leases().is_empty());
    // One that was heard of is acquired anew.
    for _ in 0..2 {
        ask(&mut bench, "b", "known").unwrap();
        assert_eq!(bench.pool.withdraw(bench.now, &session("b"), "known"), Ok(true));
    }
    assert!(matches!(ask(&mut bench, "b", "known"), Ok(Reply::Queued(_))));
    // So is one that was refused at once, and what another session of the caller has withdrawn.
    let unknown = Request::Acquire(AcquireRequest::new(session("b"), Vec::new()));
    assert!(bench.pool.handle(bench.now, "refused", unknown).is_err());
    assert_eq!(bench.pool.withdraw(bench.now, &session("b"), "refused"), Ok(false));
    assert!(matches!(ask(&mut bench, "b", "refused"), Ok(Reply::Queued(_))));
    assert!(matches!(ask(&mut bench, "a", "late"), Ok(Reply::Queued(_))));
    bench.pool.withdraw(bench.now, &session("a"), "late").unwrap();
    bench.pool.withdraw(bench.now, &session("b"), "later").unwrap();
    assert_eq!(ask(&mut bench, "b", "later"), Err(PoolError::Withdrawn { id: "later".into() }));
    // As long as answers are remembered.
    bench.at(3_601.0);
    for name in ["a", "b"] {
        bench.pool.keep_alive(bench.now, &session(name), name, Duration::from_secs(10)).unwrap();
    }
    bench.pool.withdraw(bench.now, &session("b"), "another").unwrap();
    assert!(matches!(ask(&mut bench, "b", "late"), Ok(Reply::Queued(_))));
}

#[test]
fn a_withdrawn_acquire_leaves_the_queue_or_gives_back_what_it_got() {
    let mut bench = Bench::with(&[("Arm", 1)]);
    let acquire = Request::Acquire(AcquireRequest::new(session("b"), vec![block("Arm")]));
    for id in ["first", "second"] {
        bench.pool.handle(bench.now, id, acquire.clone()).unwrap();
    }
    let stranger = bench.pool.withdraw(bench.now, &session("a"), "first");
    assert!(matches!(stranger, Err(PoolError::NotYours { .. })));
    assert_eq!(bench.pool.withdraw(bench.now, &session("b"), "second"), Ok(true));
    assert_eq!(bench.pool.withdraw(bench.now, &session("b"), "first"), Ok(true));
    assert_eq!(bench.pool.get("Arm-1").unwrap().free, 1);
    assert_eq!(bench.pool.withdraw(bench.now, &session("b"), "first"), Ok(false));
    assert_eq!(bench.pool.withdraw(bench.now, &session("b"), "never asked"), Ok(false));
    let undone = bench.notices();
    for id in ["first", "second"] {
        let again = bench.pool.handle(bench.now, id, acquire.clone());
        assert!(matches!(again, Ok(Reply::Queued(_))), "it is acquired anew: {again:?}");
    }
    assert!(grants(&bench.notices())[0].1.token > grants(&undone)[0].1.token);
}

#[test]
fn the_id_of_another_sessions_resource_is_refused() {
    let mut bench = Bench::new();
    let spec = ResourceSpec::new(ResourceClass::Module, "Arm").id("arm");
    bench.create("a", spec.clone());
    let refused = bench.pool.create(bench.now, Some(&session("b")), spec).unwrap_err();
    assert_eq!(refused.to_string(), "resource `arm` exists already and belongs to session a");
}

#[test]
fn a_full_queue_refuses_only_who_would_have_to_wait() {
    for limits in [Limits { waiters: 2, ..Limits::default() }, Limits { waiters_per_session: 2, ..Limits::default() }] {
        let mut bench = Bench::with(&[("Arm", 1), ("Camera", 1), ("Gripper", 2)]);
        bench.pool.set_limits(limits);
        let held = bench.granted("b", &[block("Arm")]);
        bench.acquire("b", &[block("Arm")]);
        // It has reserved the one gripper that is free.
        bench.granted("b", &[block("Gripper")]);
        let waiting = bench.acquire("b", &[requirement(ResourceOperation::Block, "Gripper", 2)]);
        let ask = |kind: &str, priority| AcquireRequest::new(session("b"), vec![block(kind)]).priority(priority);
        for (kind, priority) in [("Arm", 0), ("Arm", 9), ("Gripper", 0)] {
            let refused = bench.pool.acquire(bench.now, ask(kind, priority)).unwrap_err();
            assert!(matches!(refused, PoolError::TooMany { limit: 2, .. }), "{kind}: {refused}");
            bench.pool.check_invariants().unwrap();
        }
        assert!(bench.notices().is_empty() && bench.pool.waiting() == 2, "who was refused leaves nothing behind");
        // What is free is given, and to the more urgent also what a waiter has reserved.
        let camera = bench.pool.acquire(bench.now, ask("Camera", 0)).unwrap();
        let urgent = bench.pool.acquire(bench.now, ask("Gripper", 9)).unwrap();
        let granted: Vec<WaiterId> = grants(&bench.notices()).into_iter().map(|(waiter, _)| waiter).collect();
        assert_eq!(granted, [camera, urgent]);
        assert!(bench.pool.explain(waiting).is_some());
        bench.pool.check_invariants().unwrap();
        bench.release(held.id);
        assert_eq!(bench.pool.waiting(), 1);
    }
}

#[test]
fn requests_beyond_a_bound_are_refused() {
    let mut pool = Pool::new(Limits { waiters: 1, name_length: 8, ..Limits::default() });
    let now = Timestamp(0);
    pool.keep_alive(now, &session("a"), "a", Duration::from_secs(1)).unwrap();
    let ask = |kind: &str| AcquireRequest::new(session("a"), vec![block(kind)]);
    pool.acquire(now, ask("Arm")).unwrap();
    let refused = pool.acquire(now, ask("Arm")).unwrap_err().to_string();
    assert_eq!(refused, "waiters of all callers: the limit of 1 is reached (limits.waiters): try again later");
    let spec = ResourceSpec::new(ResourceClass::Module, "Line\nfeed");
    let refused = pool.create(now, None, spec).unwrap_err().to_string();
    assert_eq!(
        refused,
        "kind `Line\\nfee`: 1 to 8 characters, none of them a control character or one that is not seen"
    );
    assert!(matches!(
        pool.acquire(now, AcquireRequest::new(session("x"), vec![])),
        Err(PoolError::UnknownSession { .. })
    ));
    let odd = AcquireRequest::new(session("a"), vec![requirement(ResourceOperation::Create, "Arm", 1)]);
    assert!(matches!(pool.acquire(now, odd), Err(PoolError::TooMany { .. } | PoolError::Malformed { .. })));
}

#[test]
fn an_acquire_of_nothing_is_refused() {
    let mut bench = Bench::with(&[("Arm", 1)]);
    bench.granted("a", &[block("Arm")]);
    let refused = bench.pool.acquire(bench.now, AcquireRequest::new(session("a"), vec![])).unwrap_err();
    assert!(refused.to_string().contains("at least one"), "{refused}");
    assert_eq!(bench.pool.leases().len(), 1);
}

#[test]
fn a_name_that_cannot_be_told_from_another_by_reading_it_is_refused() {
    let mut bench = Bench::with(&[("Arm", 1)]);
    for id in ["a\u{200b}rm", "arm\u{a0}1", "\u{202e}mra"] {
        let spec = ResourceSpec::new(ResourceClass::Module, "Arm").id(id);
        let refused = bench.pool.create(bench.now, None, spec).unwrap_err().to_string();
        assert!(refused.contains("one that is not seen") && refused.contains("\\u{"), "{refused}");
    }
}

#[test]
fn tokens_of_a_restarted_pool_are_above_those_of_the_old_one() {
    let mut pool = Pool::new(Limits::default()).above(1_000);
    let now = Timestamp(0);
    pool.keep_alive(now, &session("a"), "a", Duration::from_secs(1)).unwrap();
    pool.create(now, None, ResourceSpec::new(ResourceClass::Module, "Arm")).unwrap();
    pool.acquire(now, AcquireRequest::new(session("a"), vec![block("Arm")])).unwrap();
    assert!(grants(&pool.take_notices())[0].1.token.0 > 1_000);
}

#[test]
fn tokens_do_not_grow_faster_than_the_microseconds_that_they_began_with() {
    const FLOOR: u64 = 1_000_000;
    const AHEAD: u64 = 1_000;
    let mut pool = Pool::new(Limits::default()).above(FLOOR);
    let (start, session) = (Timestamp(5_000_000_000), session("s"));
    pool.keep_alive(start, &session, "s", Duration::from_secs(60)).unwrap();
    pool.create(start, None, ResourceSpec::new(ResourceClass::Module, "Arm").capacity(5_000)).unwrap();
    let arm = || vec![Requirement::new(ResourceOperation::Block, "Arm")];
    for _ in 0..AHEAD + 300 {
        pool.acquire(start, AcquireRequest::new(session.clone(), arm())).unwrap();
    }
    pool.check_invariants().unwrap();
    assert_eq!(pool.leases().last().unwrap().token.0, FLOOR + AHEAD, "no time has passed");
    assert_eq!(pool.waiting(), 300);
    let mut now = start;
    while let Some(later) = pool.next_deadline().filter(|later| *later < start + Duration::from_secs(1)) {
        now = later;
        pool.advance(now);
        let passed_us = (now.0 - start.0) / 1_000;
        assert!(pool.leases().last().unwrap().token.0 <= FLOOR + AHEAD + passed_us);
    }
    assert_eq!(pool.waiting(), 0, "all are served, a little later");
    assert!(now >= start + Duration::from_micros(300) && now < start + Duration::from_micros(400));
    pool.check_invariants().unwrap();
}

#[test]
fn a_session_that_consumed_what_is_not_renewable_any_more_ends_and_what_it_consumed_returns() {
    let mut bench = Bench::new();
    let battery = ResourceSpec::new(ResourceClass::System, "Battery").id("battery").capacity(2);
    bench.create("a", battery.clone());
    let consume = requirement(ResourceOperation::Consume, "Battery", 1);
    bench.pool.consume(bench.now, &session("b"), &consume).unwrap();
    bench.create("a", ResourceSpec { renewable: false, ..battery });
    bench.pool.close_session(bench.now, &session("b")).unwrap();
    assert!(bench.pool.sessions().iter().all(|known| known.id != session("b")), "it is gone");
    assert_eq!(bench.pool.get("battery").unwrap().free, 2);
    bench.pool.check_invariants().unwrap();
}

#[test]
fn a_resource_that_is_created_as_it_is_there_changes_nothing() {
    let mut bench = Bench::new();
    let spec = || ResourceSpec::new(ResourceClass::Module, "Arm").id("arm");
    bench.create("a", spec());
    bench.pool.take_notices();
    let before = (bench.pool.revision(), bench.pool.take_records().len());
    assert!(before.1 > 0);
    bench.create("a", spec());
    assert_eq!((bench.pool.revision(), bench.pool.take_records().len()), (before.0, 0));
    assert!(bench.pool.take_notices().is_empty());
    bench.create("a", spec().capacity(2));
    assert!(bench.pool.revision() > before.0, "another capacity is a change");
}
