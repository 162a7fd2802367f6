//! The cell over real sockets, with a real resource manager and the real detector.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_cell::config::CellConfig;
use ratn_daemon::resource_manager::{self, ResourceManagerConfig};
use ratn_model::id::{FencingToken, LeaseId};
use ratn_model::pose::Pose;
use ratn_model::resource::{Lease, LeasedResource, Requirement, ResourceOperation};
use ratn_model::value::Value;
use ratn_motion::aimm;
use ratn_motion::collision::distance;
use ratn_motion::joint_vector::JointVector;
use ratn_proto::types::{Goal, GoalOutcome, ResourceEventKind, ResourceUpdate};
use ratn_proto::v1;
use ratn_proto::v1::cell_service_client::CellServiceClient;
use ratn_worker::client::{AcquireOptions, ActionClient, CallError, Channels, ResourceClient, fresh_id};
use ratn_worker::endpoint::{Endpoint, connect};
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::safety::{SafetyClient, SafetyState};
use ratn_worker::session::Session;
use ratn_worker::tls::ClientTls;
use ratn_worker::worker::WorkerOptions;
use std::path::{Path, PathBuf};
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::unix::{OwnedReadHalf, OwnedWriteHalf};
use tokio::net::{UnixListener, UnixStream};
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

const DEADLINE: Duration = Duration::from_secs(30);
const TTL: Duration = Duration::from_secs(5);

struct System {
    manager: Endpoint,
    cell: Endpoint,
    channels: Channels,
    resources: ResourceClient,
    cell_end: CancellationToken,
    end: CancellationToken,
    _session: Session,
    _directory: tempfile::TempDir,
}

/// A resource manager, a cell and a detector, with every resource there.
async fn system(speed: f64, boxes: usize) -> System {
    let temporary = tempfile::tempdir().unwrap();
    let directory = RuntimeDirectory::create(temporary.path()).unwrap();
    let end = CancellationToken::new();
    let config = CellConfig { speed, boxes, seed: 3, ..CellConfig::default() };
    let cell_end = end.child_token();
    tokio::spawn(ratn_cell::run(config, directory.clone(), cell_end.clone()));
    tokio::spawn(resource_manager::run(ResourceManagerConfig::default(), directory.clone(), end.clone()));
    let manager = directory.wait_for(resource_manager::ROLE, DEADLINE).await.unwrap();
    let cell = directory.wait_for(ratn_cell::ROLE, DEADLINE).await.unwrap();
    let options = WorkerOptions {
        id: "detector-1@here".to_owned(),
        kind: "Detector".to_owned(),
        resource_manager: Some(manager.clone()),
        ..WorkerOptions::default()
    };
    tokio::spawn(
        ratn_workers::detector::worker(options, ratn_motion::robot::Robot::aimm(), None).shutdown(end.clone()).run(),
    );
    let channels = Channels::new(&ClientTls::none());
    let session = Session::open(&channels, &manager, "test", TTL);
    session.alive(DEADLINE).await.unwrap();
    let resources = ResourceClient::new(&channels, &manager, session.id()).unwrap();
    System { manager, cell, channels, resources, cell_end, end, _session: session, _directory: temporary }
}

fn block(kind: &str) -> Requirement {
    let (operation, kind) = (ResourceOperation::Block, kind.to_owned());
    Requirement::new(operation, kind)
}

impl System {
    /// Waits until the resources are there, too.
    async fn acquire(&self, kinds: &[&str]) -> Lease {
        let options = AcquireOptions { deadline: DEADLINE, ..AcquireOptions::default() };
        self.resources.acquire(kinds.iter().map(|k| block(k)).collect(), options).await.unwrap()
    }

    async fn execute<const N: usize>(
        &self,
        lease: &Lease,
        kind: &str,
        action: &str,
        inputs: [(&str, Value); N],
    ) -> Result<GoalOutcome, CallError> {
        let endpoint: Endpoint = lease.resource(kind).unwrap().endpoint.parse().unwrap();
        let inputs = inputs.into_iter().map(|(port, value)| (port.to_owned(), value)).collect();
        let goal =
            Goal { id: fresh_id("goal"), action: action.to_owned(), inputs, lease: Some(lease.clone()), ..goal() };
        ActionClient::new(self.channels.clone()).execute(&endpoint, goal, |_, _| {}).await
    }

    async fn truth(&self) -> v1::GetGroundTruthResponse {
        let mut client = CellServiceClient::new(self.channels.get(&self.cell).unwrap());
        client.get_ground_truth(v1::GetGroundTruthRequest {}).await.unwrap().into_inner()
    }

    async fn arm(&self) -> JointVector {
        JointVector::read(&self.truth().await.arm.unwrap().positions).unwrap()
    }

    /// Returns once the arm is on its way.
    async fn under_way(&self) {
        while distance(&self.arm().await, &aimm::HOME) < 0.02 {
            tokio::task::yield_now().await;
        }
    }
}

fn goal() -> Goal {
    Goal::default()
}

fn to_observation() -> [(&'static str, Value); 2] {
    [("joints", Value::Joints(aimm::OBSERVATION.to_vec())), ("speed", Value::Float(0.3))]
}

#[tokio::test(flavor = "multi_thread")]
async fn the_cell_offers_its_modules_and_its_battery() {
    let system = system(1.0, 1).await;
    for kind in ["Base", "Arm", "Gripper", "PanTilt", "Camera"] {
        let lease = system.acquire(&[kind]).await;
        assert_eq!(lease.resource(kind).unwrap().endpoint, system.cell.to_string());
    }
    let exists = Requirement { operation: ResourceOperation::Exists, ..block("Battery") };
    let options = AcquireOptions { deadline: DEADLINE, ..AcquireOptions::default() };
    system.resources.acquire(vec![exists], options).await.unwrap();
    let battery = system.resources.list(&["Battery"]).await.unwrap();
    assert!(matches!(battery[0].attributes["level"], Value::Float(level) if level > 0.9));
    system.end.cancel();
}

#[tokio::test(flavor = "multi_thread")]
async fn arm_and_base_say_where_they_are_and_the_gripper_what_it_feels() {
    let system = system(20.0, 1).await;
    let lease = system.acquire(&["Base", "Arm", "Gripper"]).await;
    let stands = system.execute(&lease, "Base", "localise", []).await.unwrap();
    assert_eq!(stands.outputs["pose"], Value::Pose(Pose::IDENTITY));
    // A robot with one arm does not look at the input `arm`.
    let another = ("arm", Value::String("another".to_owned()));
    let here = system.execute(&lease, "Arm", "where", [another]).await.unwrap();
    assert_eq!(here.outputs["joints"], Value::Joints(aimm::HOME.to_vec()));
    // What is misspelt is not passed over.
    let typo = ("sped", Value::Float(0.1));
    let wrong = system.execute(&lease, "Arm", "move_to", [to_observation()[0].clone(), typo]).await.unwrap();
    assert_eq!(wrong.outcome, "aborted");
    assert_eq!(wrong.reason, "`move_to` has no input `sped`; it has joints, arm, speed");
    let felt = system.execute(&lease, "Gripper", "feel", []).await.unwrap();
    assert_eq!(felt.outputs["holding"], Value::Bool(false));
    system.end.cancel();
}

#[tokio::test(flavor = "multi_thread")]
async fn the_detector_finds_the_boxes_through_the_leased_camera() {
    let system = system(20.0, 3).await;
    let lease = system.acquire(&["Arm", "PanTilt", "Camera", "Detector"]).await;
    assert!(system.execute(&lease, "Arm", "move_to", to_observation()).await.unwrap().is_success());
    let [x, y, _] = aimm::TABLE_CENTRE;
    let table = Pose::at(x, y, aimm::TABLE_HEIGHT_M);
    let looked = system.execute(&lease, "PanTilt", "look_at", [("target", Value::Pose(table))]).await.unwrap();
    assert!(looked.is_success(), "{looked:?}");
    let size = Value::List(vec![Value::Float(0.6), Value::Float(1.2)].into());
    let region = Value::map([("pose", Value::Pose(table)), ("size", size)]);
    let measures = Value::List(["at", "shape"].map(|name| Value::String(name.to_owned())).to_vec().into());
    let inputs = [("region", region), ("measures", measures)];
    let outcome = system.execute(&lease, "Detector", "segment", inputs).await.unwrap();
    assert!(outcome.is_success(), "{outcome:?}");
    let Value::List(boxes) = &outcome.outputs["boxes"] else { panic!() };
    let truth = system.truth().await.objects;
    assert_eq!(boxes.len(), truth.len());
    assert_eq!((outcome.measured.len(), outcome.evidence.len()), (2 * boxes.len(), 2 * boxes.len()));
    for found in boxes {
        let Some(Value::Pose(pose)) = found.field("pose") else { panic!() };
        let off = |t: &v1::TrueObject| {
            let p = &t.pose.as_ref().unwrap().position_m;
            pose.distance(&Pose::at(p[0], p[1], p[2]))
        };
        assert!(truth.iter().map(off).fold(f64::INFINITY, f64::min) < 0.008);
        let located = system.execute(&lease, "Detector", "locate", [("object", found.clone())]).await.unwrap();
        assert!(matches!(&located.outputs["pose"], Value::Pose(again) if again.distance(pose) < 0.003));
        let confirmed = system.execute(&lease, "Detector", "confirm", [("object", found.clone())]).await.unwrap();
        assert!(matches!(&confirmed.outputs["pose"], Value::Pose(again) if again.distance(pose) < 0.005));
    }
    // Where none stands: above the edge of the table.
    let missing = Value::map([
        ("id", Value::String("box_9".to_owned())),
        ("pose", Value::Pose(Pose::at(x, y + 0.56, aimm::TABLE_HEIGHT_M + 0.05))),
        ("size", boxes.iter().next().unwrap().field("size").unwrap().clone()),
    ]);
    let located = system.execute(&lease, "Detector", "locate", [("object", missing.clone())]).await.unwrap();
    let confirmed = system.execute(&lease, "Detector", "confirm", [("object", missing)]).await.unwrap();
    assert_eq!([&located.outcome, &confirmed.outcome], ["aborted", "gone"]);
    assert_eq!(located.reason, confirmed.reason);
    assert!(confirmed.reason.starts_with("box_9 is not near"), "{confirmed:?}");
    system.end.cancel();
}

#[tokio::test(flavor = "multi_thread")]
async fn an_arm_whose_lease_or_session_ends_in_mid_motion_stops_and_holds() {
    for whole_session in [false, true] {
        let system = system(1.0, 1).await;
        let session = Session::open(&system.channels, &system.manager, "another", TTL);
        session.alive(DEADLINE).await.unwrap();
        let resources = ResourceClient::new(&system.channels, &system.manager, session.id()).unwrap();
        let options = AcquireOptions { deadline: DEADLINE, ..AcquireOptions::default() };
        let lease = resources.acquire(vec![block("Arm")], options).await.unwrap();
        let moving = system.execute(&lease, "Arm", "move_to", to_observation());
        let ending = async {
            system.under_way().await;
            if whole_session {
                session.close().await;
            } else {
                resources.release(lease.id).await.unwrap();
            }
        };
        let (outcome, ()) = tokio::join!(moving, ending);
        let outcome = outcome.unwrap();
        assert_eq!(outcome.outcome, "aborted");
        assert!(outcome.reason.contains("lease"), "{}", outcome.reason);
        let held = system.arm().await;
        assert!(distance(&held, &aimm::OBSERVATION) > 0.1);
        assert_eq!(system.arm().await, held);
        system.end.cancel();
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn an_arm_whose_client_is_gone_stops_and_holds() {
    let system = system(1.0, 1).await;
    let lease = system.acquire(&["Arm"]).await;
    tokio::select! {
        outcome = system.execute(&lease, "Arm", "move_to", to_observation()) => panic!("{outcome:?}"),
        () = system.under_way() => {}
    }
    // The next goal is taken as soon as the abandoned one holds.
    let here = loop {
        let here = system.arm().await;
        if here == system.arm().await {
            break here;
        }
    };
    assert!(distance(&here, &aimm::OBSERVATION) > 0.1);
    let back = [("joints", Value::Joints(aimm::HOME.to_vec()))];
    assert!(system.execute(&lease, "Arm", "move_to", back).await.unwrap().is_success());
    system.end.cancel();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_goal_with_an_older_lease_or_without_one_is_refused() {
    let system = system(20.0, 1).await;
    let old = system.acquire(&["Arm"]).await;
    system.resources.release(old.id).await.unwrap();
    let new = system.acquire(&["Arm"]).await;
    assert!(new.token > old.token);
    assert!(system.execute(&new, "Arm", "move_to", to_observation()).await.unwrap().is_success());
    let refused = system.execute(&old, "Arm", "move_to", to_observation()).await.unwrap_err();
    assert!(!refused.is_crash() && refused.to_string().contains("is over"), "{refused}");
    let none = Goal { id: fresh_id("goal"), action: "release".to_owned(), ..goal() };
    let refused = ActionClient::new(system.channels.clone()).execute(&system.cell, none, |_, _| {}).await;
    assert!(refused.unwrap_err().to_string().contains("no lease"));
    system.end.cancel();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_reset_lays_the_same_table_again() {
    let system = system(1.0, 4).await;
    let first = system.truth().await.objects;
    let mut client = CellServiceClient::new(system.channels.get(&system.cell).unwrap());
    let other = client
        .reset(v1::ResetRequest { seed: 8, boxes: 2, ..v1::ResetRequest::default() })
        .await
        .unwrap()
        .into_inner()
        .objects;
    assert_eq!(other.len(), 2);
    let again = client
        .reset(v1::ResetRequest { seed: 3, boxes: 4, ..v1::ResetRequest::default() })
        .await
        .unwrap()
        .into_inner()
        .objects;
    assert_eq!(first, again);
    assert!(client.reset(v1::ResetRequest { seed: 3, boxes: 10, ..v1::ResetRequest::default() }).await.is_err());
    system.end.cancel();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_fault_that_is_none_is_refused_and_says_what_one_looks_like() {
    let system = system(1.0, 1).await;
    let mut client = CellServiceClient::new(system.channels.get(&system.cell).unwrap());
    for (text, said) in [
        ("grasp_slips:1\u{1b}[31m", "fault: holds control characters"),
        (&*"a".repeat(2_000), "fault: has 2000 bytes"),
        ("", "fault: is empty"),
        ("grasp_slips:0", "grasp_slips"),
    ] {
        let refused = client.inject_fault(v1::InjectFaultRequest { fault: text.to_owned() }).await.unwrap_err();
        assert!(refused.code() == tonic::Code::InvalidArgument && refused.message().contains(said), "{refused:?}");
    }
    client.inject_fault(v1::InjectFaultRequest { fault: "grasp_slips:1".to_owned() }).await.unwrap();
    system.end.cancel();
}

#[tokio::test(flavor = "multi_thread")]
async fn the_modules_vanish_when_the_cell_ends() {
    let system = system(1.0, 1).await;
    system.acquire(&["Arm"]).await;
    let mut watch = system.resources.watch(&["Arm"]).await.unwrap();
    system.cell_end.cancel();
    loop {
        if let Some(ResourceUpdate::Event(event)) = watch.next().await.unwrap()
            && event.kind == ResourceEventKind::Deleted
        {
            break;
        }
    }
    assert_eq!(system.resources.list(&["Arm", "Gripper", "PanTilt", "Camera", "Battery"]).await.unwrap().len(), 0);
    system.end.cancel();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_cell_that_ends_in_mid_motion_stops_it_and_then_takes_its_modules_back() {
    let system = system(1.0, 1).await;
    let lease = system.acquire(&["Arm"]).await;
    let mut watch = system.resources.watch(&["Arm"]).await.unwrap();
    let moving = system.execute(&lease, "Arm", "move_to", to_observation());
    let ending = async {
        system.under_way().await;
        let ended = std::time::Instant::now();
        system.cell_end.cancel();
        loop {
            if let Some(ResourceUpdate::Event(event)) = watch.next().await.unwrap()
                && event.kind == ResourceEventKind::Deleted
            {
                break ended.elapsed();
            }
        }
    };
    let (outcome, took) = tokio::join!(moving, ending);
    assert!(outcome.as_ref().is_err_and(CallError::is_crash), "{outcome:?}");
    let session = Duration::from_millis(CellConfig::default().session_ttl_ms);
    assert!(took < session, "{took:?}: its session ran out by itself");
    system.end.cancel();
}

/// Where the arm is.
async fn arm(cell: &Endpoint) -> v1::Joints {
    let mut client = CellServiceClient::new(connect(cell, &ClientTls::none()).await.unwrap());
    client.get_ground_truth(v1::GetGroundTruthRequest {}).await.unwrap().into_inner().arm.unwrap()
}

/// A line to a socket that can hang: what is written waits, and no connection breaks.
async fn line(from: &Endpoint, to: &Endpoint) -> watch::Sender<bool> {
    let (Endpoint::Unix(from), Endpoint::Unix(to)) = (from.clone(), to.clone()) else { panic!("Unix sockets only") };
    let listener = UnixListener::bind(from).unwrap();
    let (hang, hangs) = watch::channel(false);
    tokio::spawn(async move {
        loop {
            let (near_in, near_out) = listener.accept().await.unwrap().0.into_split();
            let (far_in, far_out) = UnixStream::connect(&to).await.unwrap().into_split();
            tokio::spawn(carry(near_in, far_out, hangs.clone()));
            tokio::spawn(carry(far_in, near_out, hangs.clone()));
        }
    });
    hang
}

async fn carry(mut from: OwnedReadHalf, mut to: OwnedWriteHalf, mut hangs: watch::Receiver<bool>) {
    let mut bytes = [0; 4096];
    while let Ok(length @ 1..) = from.read(&mut bytes).await {
        if hangs.wait_for(|hangs| !hangs).await.is_err() || to.write_all(&bytes[..length]).await.is_err() {
            return;
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn an_arm_stands_still_each_time_that_the_line_to_the_manager_hangs() {
    let temporary = tempfile::tempdir().unwrap();
    let directory = RuntimeDirectory::create(temporary.path()).unwrap();
    let end = CancellationToken::new();
    let (manager, over_the_line) = (directory.socket("rm"), directory.socket("line"));
    let config = ResourceManagerConfig { listen: manager.clone(), ..ResourceManagerConfig::default() };
    tokio::spawn(resource_manager::run(config, directory.clone(), end.clone()));
    directory.wait_for(resource_manager::ROLE, DEADLINE).await.unwrap();
    let hang = line(&over_the_line, &manager).await;
    let config = CellConfig { resource_manager: Some(over_the_line), session_ttl_ms: 500, ..CellConfig::default() };
    tokio::spawn(ratn_cell::run(config, directory.clone(), end.clone()));
    let cell = directory.wait_for(ratn_cell::ROLE, DEADLINE).await.unwrap();

    let channels = Channels::new(&ClientTls::none());
    let session = Session::open(&channels, &manager, "test", TTL);
    session.alive(DEADLINE).await.unwrap();
    let resources = ResourceClient::new(&channels, &manager, session.id()).unwrap();
    for _ in 0..2 {
        let options = AcquireOptions { deadline: DEADLINE, ..AcquireOptions::default() };
        let lease = resources.acquire(vec![block("Arm")], options).await.unwrap();
        let slowly = [("joints", Value::Joints(aimm::OBSERVATION.to_vec())), ("speed", Value::Float(0.02))];
        let inputs = slowly.map(|(port, value)| (port.to_owned(), value)).into();
        let goal =
            Goal { id: fresh_id("goal"), action: "move_to".to_owned(), inputs, lease: Some(lease.clone()), ..goal() };
        let client = ActionClient::new(channels.clone());
        let before = arm(&cell).await;
        let outcome = client.execute(&cell, goal, |_, _| {});
        let hanging = async {
            // What the manager said of the lease has come over the line.
            while arm(&cell).await == before {}
            hang.send_replace(true);
            // It moves in every step of some milliseconds, or stands.
            loop {
                let here = arm(&cell).await;
                tokio::time::sleep(Duration::from_millis(100)).await;
                if here == arm(&cell).await {
                    break;
                }
            }
            // The cell's session is over at the manager, and every lease of its modules.
            while resources.list(&["Arm"]).await.unwrap().iter().any(|arm| !arm.holdings.is_empty()) {}
            hang.send_replace(false);
        };
        let outcome = async { tokio::join!(outcome, hanging).0 };
        let outcome = tokio::time::timeout(DEADLINE, outcome).await.expect("soon").unwrap();
        assert_eq!(outcome.outcome, "aborted", "{outcome:?}");
        resources.release(lease.id).await.unwrap();
    }
    end.cancel();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_goal_under_a_lease_that_has_ended_is_refused_though_nobody_has_a_newer_one() {
    let system = system(20.0, 1).await;
    let lease = system.acquire(&["Arm"]).await;
    let mut watch = system.resources.watch(&["Arm"]).await.unwrap();
    system.resources.release(lease.id).await.unwrap();
    // The cell hears it when everybody does; were it a moment later, the goal would be aborted instead.
    loop {
        if let Some(ResourceUpdate::Event(event)) = watch.next().await.unwrap()
            && event.kind == ResourceEventKind::Released
        {
            break;
        }
    }
    let outcome = system.execute(&lease, "Arm", "move_to", to_observation()).await;
    assert!(!outcome.is_ok_and(|outcome| outcome.is_success()));
    system.end.cancel();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_motion_is_held_and_goes_on_and_an_emergency_stop_ends_it_also_for_a_cell_that_is_started_again() {
    let system = system(1.0, 1).await;
    let lease = system.acquire(&["Arm"]).await;
    let driver = SafetyClient::new(&system.channels, &system.cell).unwrap();
    let moving = system.execute(&lease, "Arm", "move_to", to_observation());
    let holding = async {
        system.under_way().await;
        assert!(matches!(driver.hold("a look").await.unwrap(), SafetyState::Held { .. }));
        let here = system.arm().await;
        assert!(distance(&here, &aimm::OBSERVATION) > 0.1);
        tokio::time::sleep(Duration::from_millis(300)).await;
        assert_eq!(system.arm().await, here);
        assert_eq!(driver.go_on().await.unwrap(), SafetyState::Ready);
    };
    let (outcome, ()) = tokio::join!(moving, holding);
    assert!(outcome.unwrap().is_success());

    let back = [("joints", Value::Joints(aimm::HOME.to_vec())), ("speed", Value::Float(0.3))];
    let moving = system.execute(&lease, "Arm", "move_to", back);
    let stopping = async {
        while distance(&system.arm().await, &aimm::OBSERVATION) < 0.02 {
            tokio::task::yield_now().await;
        }
        driver.stop("a hand").await.unwrap();
        system.arm().await
    };
    let (outcome, here) = tokio::join!(moving, stopping);
    let outcome = outcome.unwrap();
    assert_eq!((outcome.outcome.as_str(), outcome.reason.as_str()), ("stopped", "emergency stop: a hand"));
    assert_eq!(system.arm().await, here);
    let refused = system.execute(&lease, "Arm", "move_to", to_observation()).await.unwrap();
    assert_eq!(refused.outcome, "stopped");
    assert!(driver.go_on().await.is_err_and(|error| !error.is_crash()));

    // Another process of the same cell.
    system.cell_end.cancel();
    let directory = RuntimeDirectory::at(system._directory.path());
    while directory.find(ratn_cell::ROLE).is_ok() {
        tokio::task::yield_now().await;
    }
    tokio::spawn(ratn_cell::run(CellConfig::default(), directory.clone(), system.end.clone()));
    let cell = directory.wait_for(ratn_cell::ROLE, DEADLINE).await.unwrap();
    let driver = SafetyClient::new(&system.channels, &cell).unwrap();
    assert_eq!(driver.state().await.unwrap(), SafetyState::Stopped { reason: "a hand".to_owned() });
    assert_eq!(driver.clear().await.unwrap(), SafetyState::Ready);
    system.end.cancel();
}

/// A cell that serves without a resource manager; its driver's safety, and what ends it.
async fn cell_alone(runtime: &Path, state_dir: Option<PathBuf>) -> (SafetyClient, CancellationToken) {
    let (directory, end) = (RuntimeDirectory::create(runtime).unwrap(), CancellationToken::new());
    tokio::spawn(ratn_cell::run(CellConfig { state_dir, ..CellConfig::default() }, directory.clone(), end.clone()));
    let cell = directory.wait_for(ratn_cell::ROLE, DEADLINE).await.unwrap();
    (SafetyClient::new(&Channels::new(&ClientTls::none()), &cell).unwrap(), end)
}

#[tokio::test(flavor = "multi_thread")]
async fn a_stop_outlasts_a_reboot_which_leaves_nothing_of_the_runtime_directory() {
    let [state, before, after] = [(); 3].map(|()| tempfile::tempdir().unwrap());
    let state_dir = Some(state.path().join("cell"));
    let (driver, end) = cell_alone(before.path(), state_dir.clone()).await;
    driver.stop("a hand").await.unwrap();
    end.cancel();
    drop(before);
    let (driver, end) = cell_alone(after.path(), state_dir).await;
    assert_eq!(driver.state().await.unwrap(), SafetyState::Stopped { reason: "a hand".to_owned() });
    assert_eq!(driver.clear().await.unwrap(), SafetyState::Ready);
    end.cancel();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_stop_that_an_earlier_version_kept_in_the_runtime_directory_is_taken_over() {
    let [state, runtime] = [(); 2].map(|()| tempfile::tempdir().unwrap());
    let earlier = runtime.path().join("cell.stopped");
    std::fs::write(&earlier, "a hand").unwrap();
    let (driver, end) = cell_alone(runtime.path(), Some(state.path().to_owned())).await;
    assert_eq!(driver.state().await.unwrap(), SafetyState::Stopped { reason: "a hand".to_owned() });
    assert_eq!(std::fs::read_to_string(state.path().join("stopped")).unwrap(), "a hand");
    assert!(!earlier.exists());
    end.cancel();
}

/// As [`System::execute`], with a lease that may be anything; refusals are statuses.
async fn claim(system: &System, lease: Lease) -> Result<GoalOutcome, CallError> {
    let inputs = to_observation().map(|(port, value)| (port.to_owned(), value)).into();
    let goal = Goal { id: fresh_id("goal"), action: "move_to".to_owned(), inputs, lease: Some(lease), ..goal() };
    ActionClient::new(system.channels.clone()).execute(&system.cell, goal, |_, _| {}).await
}

#[tokio::test(flavor = "multi_thread")]
async fn a_forged_lease_neither_moves_the_arm_nor_keeps_its_next_holder_from_it() {
    let system = system(20.0, 1).await;
    let camera = system.acquire(&["Camera"]).await;
    let released = system.acquire(&["Arm"]).await;
    system.resources.release(released.id).await.unwrap();
    let arm = LeasedResource {
        id: "arm@sim".to_owned(),
        kind: "Arm".to_owned(),
        endpoint: system.cell.to_string(),
        superclasses: Vec::new(),
    };
    let forged =
        |id: LeaseId, token: FencingToken| Lease { id, token, resources: vec![arm.clone()], consumed: Vec::new() };
    let most = FencingToken(u64::MAX);
    for (what, lease) in [
        ("made up", forged(LeaseId(u64::MAX), most)),
        ("made up, small", forged(LeaseId(1), most)),
        ("of another resource", forged(camera.id, camera.token)),
        ("released a moment ago", released.clone()),
        ("released, with another token", forged(released.id, most)),
    ] {
        let refused = claim(&system, lease).await.unwrap_err();
        assert!(!refused.is_crash() && refused.code() == Some(tonic::Code::FailedPrecondition), "{what}: {refused}");
    }
    assert_eq!(system.arm().await, aimm::HOME);

    let holder = system.acquire(&["Arm"]).await;
    let copied = forged(holder.id, most);
    assert!(claim(&system, copied).await.is_err_and(|error| error.to_string().contains("token")));
    assert_eq!(system.arm().await, aimm::HOME);
    let moved = claim(&system, holder).await.unwrap();
    assert!(moved.is_success(), "{moved:?}");
    system.end.cancel();
}
