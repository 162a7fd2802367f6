//! Access control: a table of operations and roles, the roles of callers, and the gate of every server that compares the two.
//!
//! ```text
//!   uid, certificate ──AccessConfig──▶ Caller { name, roles } ──allowed(operation, roles)──▶ yes or no
//!   /ratn.v1.ResourceService/Delete ──option (access) of the proto──▶ Operation::Delete
//! ```
//! A method without this option, and a service of another system, is refused to every caller. Ownership (of leases, of resources) is
//! checked where the owner is known; a call that the table allows may still be refused there.

mod config;
mod gate;
mod refusals;

pub use config::{AccessConfig, CertificateAccess, UserAccess};
pub use gate::{ACCESS_VARIABLE, AccessError, LiveAccess, RoleGate};
pub use ratn_proto::access::Operation;

use ratn_model::resource::ResourceClass;
use ratn_proto::access::method_of;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::sync::Arc;
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt};

/// A role of a caller in a system. A caller may have several.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// May read.
    Viewer,
    /// May run tasks: take resources, give goals, change the world.
    Task,
    /// May provide resources: process managers, the world pool, cells and drivers.
    Agent,
    /// May do everything, also with what belongs to others.
    Operator,
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Role::Viewer => "viewer",
            Role::Task => "task",
            Role::Agent => "agent",
            Role::Operator => "operator",
        })
    }
}

use Operation::{
    Acquire, Administer, Ask, Commit, Consume, Create, Delete, Look, Perform, Project, Provide, Release, Session,
};
use Role::{Agent, Operator, Task, Viewer};

/// The permission table: each operation with the roles that may do it. Every role that may move a robot may also stop it; only an operator
/// may clear the stop.
pub const TABLE: [(Operation, &[Role]); 13] = [
    (Ask, &[Viewer, Task, Agent, Operator]),
    (Look, &[Viewer, Task, Agent, Operator]),
    (Session, &[Task, Agent, Operator]),
    (Create, &[Task, Agent, Operator]),
    (Consume, &[Task, Operator]),
    (Delete, &[Task, Agent, Operator]),
    (Acquire, &[Task, Operator]),
    (Release, &[Task, Agent, Operator]),
    (Project, &[Task, Operator]),
    (Commit, &[Task, Operator]),
    (Perform, &[Task, Agent, Operator]),
    (Administer, &[Operator]),
    (Provide, &[Agent, Operator]),
];

/// The gRPC method by which a process is asked whether it serves.
pub const HEALTH_CHECK: &str = "/grpc.health.v1.Health/Check";

/// Standard gRPC methods that every server has.
const OF_GRPC: [&str; 4] = [
    HEALTH_CHECK,
    "/grpc.health.v1.Health/List",
    "/grpc.health.v1.Health/Watch",
    "/grpc.reflection.v1.ServerReflection/ServerReflectionInfo",
];

/// The operation of a method, by the path of its request (`/ratn.v1.ResourceService/Create`). `None` for an unknown method, or one whose
/// proto has no access option: nobody may call such a method.
pub fn operation_of(path: &str) -> Option<Operation> {
    if OF_GRPC.contains(&path) { Some(Ask) } else { method_of(path)?.operation }
}

/// Whether one of these roles may do the operation.
pub fn allowed(operation: Operation, roles: &[Role]) -> bool {
    TABLE.iter().any(|(row, may)| *row == operation && roles.iter().any(|role| may.contains(role)))
}

/// An authenticated caller.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Caller {
    /// The name that the connection proves: `uid 1000`, `control (certificate)`, `anonymous`. Equal names mean the same caller.
    pub name: Arc<str>,
    /// The caller's roles.
    pub roles: Arc<[Role]>,
}

impl Caller {
    /// The caller of a request, as the gate identified it. A request that passed no gate gets the caller `nobody`, without roles.
    pub fn of<T>(request: &tonic::Request<T>) -> Caller {
        let nobody = || Caller { name: "nobody".into(), roles: [].as_slice().into() };
        request.extensions().get::<Caller>().cloned().unwrap_or_else(nobody)
    }

    /// A request by this caller, made inside the process.
    pub fn request<T>(&self, message: T) -> tonic::Request<T> {
        let mut request = tonic::Request::new(message);
        request.extensions_mut().insert(self.clone());
        request
    }

    /// Checks whether the caller may call a method, by its operation.
    ///
    /// # Errors
    /// `PERMISSION_DENIED`, with the caller's roles, or with the reason why nobody may call it.
    pub fn admit(&self, path: &str) -> Result<(), Status> {
        let Some(operation) = operation_of(path) else {
            let message = format!("nobody may call {path}: no method of this version, or its proto says no `(access)`");
            return Err(denied("METHOD_CLOSED", message));
        };
        if allowed(operation, &self.roles) {
            return Ok(());
        }
        let message = format!(
            "{self} may not {operation:?}: has the roles {}; an operator grants them in [service.access]",
            self.written_roles()
        );
        Err(denied("ROLE_MISSING", message))
    }

    /// Checks whether this caller's call to `path`, begun when the caller's roles were those of `then`, may go on. The call may not go on
    /// if the caller has lost any permission since: the call could use that permission at any time.
    ///
    /// # Errors
    /// `PERMISSION_DENIED` if the caller may not call the method any more, `UNAVAILABLE` if the caller may call it again with the present
    /// roles.
    pub(crate) fn goes_on(&self, then: &Caller, path: &str) -> Result<(), Status> {
        let lost = |(_, may): &(Operation, &[Role])| {
            let may = |caller: &Caller| caller.roles.iter().any(|role| may.contains(role));
            may(then) && !may(self)
        };
        if self.name == then.name && !TABLE.iter().any(lost) {
            return Ok(());
        }
        self.admit(path)?;
        let message = format!("{then} is {self} with the roles {} now: call again", self.written_roles());
        Err(Status::with_error_details(
            Code::Unavailable,
            message,
            ErrorDetails::with_error_info("ROLES_CHANGED", "ratn", []),
        ))
    }

    /// The roles in the notation of a config: `["viewer", "task"]`.
    fn written_roles(&self) -> String {
        format!("{:?}", self.roles.iter().map(ToString::to_string).collect::<Vec<_>>())
    }

    /// Whether the caller may end what belongs to others.
    pub fn is_operator(&self) -> bool {
        self.roles.contains(&Operator)
    }

    /// Whether the caller may give goals, and make projections, under a lease of a session that `opener` opened. Everybody may under leases
    /// of their own; agents and operators also under those of others, because one provider calls another that way.
    pub fn may_act_for(&self, opener: &str) -> bool {
        *self.name == *opener || self.is_operator() || self.roles.contains(&Agent)
    }

    /// Whether the caller may stop, or listen to, a goal that `giver` gave.
    pub(crate) fn may_end_for(&self, giver: &str) -> bool {
        *self.name == *giver || self.is_operator()
    }

    /// Whether the caller may create resources of a class: the role `task` its own, the role `agent` those that the system consists of (the
    /// paper's Section V-B).
    pub fn may_create(&self, class: ResourceClass) -> bool {
        let creator = if class == ResourceClass::Task { Task } else { Agent };
        self.is_operator() || self.roles.contains(&creator)
    }
}

impl fmt::Display for Caller {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.name)
    }
}

fn denied(reason: &str, message: String) -> Status {
    Status::with_error_details(Code::PermissionDenied, message, ErrorDetails::with_error_info(reason, "ratn", []))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    fn may(role: Role) -> Vec<Operation> {
        TABLE.iter().map(|(operation, _)| *operation).filter(|operation| allowed(*operation, &[role])).collect()
    }

    fn one(role: Role) -> Caller {
        Caller { name: "x".into(), roles: [role].as_slice().into() }
    }

    #[test]
    fn a_viewer_changes_nothing_and_an_operator_may_everything() {
        assert_eq!(may(Viewer), [Ask, Look]);
        assert_eq!(may(Operator).len(), TABLE.len());
        assert_eq!(may(Agent), [Ask, Look, Session, Create, Delete, Release, Perform, Provide]);
        assert!(!may(Task).contains(&Administer));
        assert!(!allowed(Ask, &[]));
    }

    #[test]
    fn what_says_no_access_is_closed_to_everybody() {
        for path in
            ["/ratn.v1.ResourceService/Forget", "/ratn.v2.ResourceService/List", "/my.Service/Do", "/grpc.x/Y", ""]
        {
            let refused = one(Operator).admit(path).unwrap_err();
            assert_eq!(refused.code(), Code::PermissionDenied, "{path}");
            assert!(refused.message().contains("nobody may call"), "{refused}");
        }
        one(Viewer).admit("/grpc.health.v1.Health/Check").unwrap();
        let refused = one(Viewer).admit("/ratn.v1.ActionService/Execute").unwrap_err();
        assert!(
            refused.message().starts_with("x may not Perform: has the roles [\"viewer\"]; an operator"),
            "{refused}"
        );
    }

    #[test]
    fn a_call_goes_on_as_long_as_its_caller_may_do_what_it_could_when_it_began() {
        const KEEP_ALIVE: &str = "/ratn.v1.ResourceService/KeepAlive";
        let as_role = |then: &[Role], now: &[Role]| {
            let caller = |roles: &[Role]| Caller { name: "x".into(), roles: roles.into() };
            caller(now).goes_on(&caller(then), KEEP_ALIVE).map_err(|ended| ended.code())
        };
        assert_eq!(as_role(&[Task], &[Operator]), Ok(()));
        assert_eq!(as_role(&[Viewer, Task], &[Task]), Ok(()), "a task may all that a viewer may");
        assert_eq!(as_role(&[Task], &[Viewer]), Err(Code::PermissionDenied));
        assert_eq!(as_role(&[Task], &[]), Err(Code::PermissionDenied));
        assert_eq!(as_role(&[Task], &[Agent]), Err(Code::Unavailable), "its stream could acquire");
        assert_eq!(as_role(&[Operator], &[Task]), Err(Code::Unavailable));
        let renamed = Caller { name: "y".into(), ..one(Task) };
        assert_eq!(renamed.goes_on(&one(Task), KEEP_ALIVE).unwrap_err().code(), Code::Unavailable);
    }

    #[test]
    fn a_request_that_passed_no_gate_is_nobodys() {
        let caller = Caller::of(&tonic::Request::new(()));
        assert!(caller.roles.is_empty() && !caller.is_operator());
        assert!(caller.admit("/grpc.health.v1.Health/Check").is_err());
    }

    #[test]
    fn a_task_creates_only_task_resources_and_an_agent_none() {
        for class in [ResourceClass::System, ResourceClass::Process, ResourceClass::Module, ResourceClass::World] {
            assert!(one(Agent).may_create(class) && one(Operator).may_create(class) && !one(Task).may_create(class));
        }
        assert!(one(Task).may_create(ResourceClass::Task) && !one(Agent).may_create(ResourceClass::Task));
        assert!(one(Operator).may_create(ResourceClass::Task) && !one(Viewer).may_create(ResourceClass::Task));
    }
}
