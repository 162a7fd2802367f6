//! Both arms of a cell over real sockets, with a real resource manager: a resource for each arm and each gripper, and no goal moves an arm
//! whose lease it does not have.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_cell::config::CellConfig;
use ratn_daemon::resource_manager::{self, ResourceManagerConfig};
use ratn_model::resource::{Lease, Requirement, ResourceOperation};
use ratn_model::value::Value;
use ratn_proto::types::{Goal, GoalOutcome};
use ratn_worker::client::{AcquireOptions, ActionClient, CallError, Channels, ResourceClient, fresh_id};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::session::Session;
use ratn_worker::tls::ClientTls;
use std::time::Duration;
use tokio_util::sync::CancellationToken;
use tonic::Code;

mod duo;

const DEADLINE: Duration = Duration::from_secs(30);
const HOME: [f64; 7] = [0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785];

struct System {
    cell: Endpoint,
    channels: Channels,
    resources: ResourceClient,
    end: CancellationToken,
    _session: Session,
    _folder: tempfile::TempDir,
}

async fn system() -> System {
    let folder = tempfile::tempdir().unwrap();
    let directory = RuntimeDirectory::create(folder.path().join("run")).unwrap();
    let end = CancellationToken::new();
    let robot = duo::write(folder.path()).display().to_string();
    let config = CellConfig { robot, speed: 20.0, boxes: 1, seed: 2, ..CellConfig::default() };
    tokio::spawn(ratn_cell::run(config, directory.clone(), end.child_token()));
    tokio::spawn(resource_manager::run(ResourceManagerConfig::default(), directory.clone(), end.clone()));
    let manager = directory.wait_for(resource_manager::ROLE, DEADLINE).await.unwrap();
    let cell = directory.wait_for(ratn_cell::ROLE, DEADLINE).await.unwrap();
    let channels = Channels::new(&ClientTls::none());
    let session = Session::open(&channels, &manager, "test", Duration::from_secs(5));
    session.alive(DEADLINE).await.unwrap();
    let resources = ResourceClient::new(&channels, &manager, session.id()).unwrap();
    System { cell, channels, resources, end, _session: session, _folder: folder }
}

/// As `{ block: Arm, where: { arm: right } }` of a task says it.
fn block(kind: &str, arm: &str) -> Requirement {
    let mut requirement = Requirement::new(ResourceOperation::Block, kind.to_owned());
    requirement.attributes.insert("arm".to_owned(), Value::String(arm.to_owned()));
    requirement
}

fn swung(by: f64) -> [(&'static str, Value); 2] {
    let mut joints = HOME.to_vec();
    joints[0] += by;
    [("joints", Value::Joints(joints)), ("speed", Value::Float(0.5))]
}

impl System {
    async fn acquire(&self, wanted: &[(&str, &str)]) -> Lease {
        let options = AcquireOptions { deadline: DEADLINE, ..AcquireOptions::default() };
        let wanted = wanted.iter().map(|(kind, arm)| block(kind, arm)).collect();
        self.resources.acquire(wanted, options).await.unwrap()
    }

    async fn execute<const N: usize>(
        &self,
        lease: &Lease,
        action: &str,
        inputs: [(&str, Value); N],
    ) -> Result<GoalOutcome, CallError> {
        let inputs = inputs.into_iter().map(|(port, value)| (port.to_owned(), value)).collect();
        let (action, lease) = (action.to_owned(), Some(lease.clone()));
        let goal = Goal { id: fresh_id("goal"), action, inputs, lease, ..Goal::default() };
        ActionClient::new(self.channels.clone()).execute(&self.cell, goal, |_, _| {}).await
    }

    /// The first joint of the arm that a lease holds.
    async fn turned(&self, lease: &Lease) -> f64 {
        let outcome = self.execute(lease, "where", []).await.unwrap();
        let Value::Joints(joints) = &outcome.outputs["joints"] else { panic!("{outcome:?}") };
        joints[0]
    }
}

fn named(arm: &str) -> (&'static str, Value) {
    ("arm", Value::String(arm.to_owned()))
}

#[tokio::test(flavor = "multi_thread")]
async fn each_arm_has_resources_of_its_own_and_a_lease_of_one_moves_that_one_alone() {
    let system = system().await;
    let left = system.acquire(&[("Arm", "left"), ("Gripper", "left")]).await;
    let right = system.acquire(&[("Arm", "right"), ("Gripper", "right")]).await;
    let ids = |lease: &Lease| {
        let mut ids: Vec<String> = lease.resources.iter().map(|resource| resource.id.clone()).collect();
        ids.sort();
        ids
    };
    assert_eq!(ids(&left), ["arm_left@sim", "gripper_left@sim"]);
    assert_eq!(ids(&right), ["arm_right@sim", "gripper_right@sim"]);

    // At once, each under its own lease and without a word of which arm.
    let (a, b) =
        tokio::join!(system.execute(&left, "move_to", swung(0.5)), system.execute(&right, "move_to", swung(-0.5)));
    assert!(
        a.as_ref().is_ok_and(GoalOutcome::is_success) && b.as_ref().is_ok_and(GoalOutcome::is_success),
        "{a:?} {b:?}"
    );
    assert_eq!((system.turned(&left).await, system.turned(&right).await), (0.5, -0.5));

    // The other arm's lease does not do, nor does one that has ended.
    let [joints, speed] = swung(0.0);
    let refused = system.execute(&right, "move_to", [joints, speed, named("left")]).await.unwrap_err().to_string();
    assert!(refused.contains("no lease of arm_left@sim"), "{refused}");
    system.resources.release(right.id).await.unwrap();
    let newer = system.acquire(&[("Arm", "right")]).await;
    let stale = system.execute(&right, "move_to", swung(0.0)).await.unwrap_err().to_string();
    assert!(stale.contains("is over"), "{stale}");
    let mut forged = right.clone();
    forged.resources.iter_mut().filter(|one| one.kind == "Arm").for_each(|one| one.id = "arm_left@sim".to_owned());
    let stale = system.execute(&forged, "move_to", swung(0.0)).await.unwrap_err().to_string();
    assert!(stale.contains("arm_left@sim"), "{stale}");
    assert_eq!((system.turned(&left).await, system.turned(&newer).await), (0.5, -0.5), "nothing of that moved an arm");
    system.end.cancel();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_lease_of_both_arms_needs_the_name_of_the_one_that_moves() {
    let system = system().await;
    let both = system.acquire(&[("Arm", "left"), ("Arm", "right")]).await;
    let unsaid = system.execute(&both, "move_to", swung(0.3)).await.unwrap_err().to_string();
    assert!(unsaid.contains("arm_left@sim and arm_right@sim") && unsaid.contains("`left`, `right`"), "{unsaid}");
    let [joints, speed] = swung(-0.3);
    let moved = system.execute(&both, "move_to", [joints, speed, named("right")]).await.unwrap();
    assert!(moved.is_success(), "{moved:?}");
    let there = system.execute(&both, "where", [named("right")]).await.unwrap();
    assert!(matches!(&there.outputs["joints"], Value::Joints(joints) if joints[0] == -0.3), "{there:?}");
    let nobody = system.execute(&both, "where", [named("middle")]).await.unwrap_err();
    assert_eq!(nobody.code(), Some(Code::InvalidArgument));
    let nobody = nobody.to_string();
    assert!(nobody.contains("input `arm` is `middle`: `where` is for the arms `left`, `right`"), "{nobody}");
    system.end.cancel();
}
