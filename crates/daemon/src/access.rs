//! Who may do what: a table of operations and roles, and which roles a caller has.
//!
//! ```text
//!   uid, certificate ──AccessConfig──▶ Caller { name, roles } ──allowed(operation, roles)──▶ yes or no
//!   /ratn.v1.ResourceService/Delete ──Operation::of_path──▶ Operation::Delete
//! ```
//! Pure. What belongs to whom (leases, resources) is decided where that is known; an [`Operation`] that the table allows may still be
//! refused there.

use crate::config::{Check, ConfigError, rule};
use crate::details::status;
use ratn_model::resource::ResourceClass;
use ratn_resources::Speaker;
use ratn_worker::gate::Identity;
use rustls_pki_types::CertificateDer;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::sync::Arc;
use tonic::{Code, Status};
use webpki::EndEntityCert;

/// What a caller is in a system. One may have several.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// Looks.
    Viewer,
    /// Runs tasks: takes resources, gives goals, changes the world.
    Task,
    /// Provides resources: process managers, the world pool, cells and drivers.
    Agent,
    /// Everything, also with what belongs to others.
    Operator,
}

/// What can be done, as far as roles tell it apart.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Operation {
    /// Health and reflection.
    Ask,
    /// Listing, watching, querying, explaining.
    Look,
    /// Opening a session and keeping it alive.
    Session,
    /// Adding resources to the pool; of which class, see [`Caller::may_create`].
    Create,
    /// Using capacity up.
    Consume,
    /// Removing resources from the pool.
    Delete,
    /// Blocking, and taking it back.
    Acquire,
    /// Giving a lease back.
    Release,
    /// Making and dropping projections.
    Project,
    /// Changing the root world.
    Commit,
    /// Giving goals to providers.
    Perform,
    /// Starting and stopping processes, resetting the cell, and everything that has no row of its own.
    Administer,
}

use Operation::{Acquire, Administer, Ask, Commit, Consume, Create, Delete, Look, Perform, Project, Release, Session};
use Role::{Agent, Operator, Task, Viewer};

/// Every operation, and who may.
pub const TABLE: [(Operation, &[Role]); 12] = [
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
];

/// Methods of one service that are the same to roles.
type Row = (Operation, &'static [&'static str]);

/// The methods of the wire, by service and name.
const METHODS: [(&str, &[Row]); 6] = [
    (
        "ratn.v1.ResourceService",
        &[
            (Look, &["Exists", "Explain", "Get", "List", "ListSessions", "Watch"]),
            (Session, &["KeepAlive", "ReportShortage", "Session", "WatchDemand"]),
            (Create, &["Create"]),
            (Consume, &["Consume", "EndTask"]),
            (Delete, &["Delete"]),
            (Acquire, &["Acquire", "Block", "Withdraw"]),
            (Release, &["Release"]),
        ],
    ),
    (
        "ratn.v1.WorldPoolService",
        &[
            (Look, &["Diff", "GetFactHistory", "GetRoot", "GetScene", "Query", "Watch", "WatchProjection"]),
            (Commit, &["Commit"]),
            (Project, &["Project", "Release"]),
        ],
    ),
    (
        "ratn.v1.ProcessService",
        &[(Look, &["ListPools", "ReadLog", "Watch"]), (Administer, &["Drain", "Restart", "Scale", "Spawn", "Stop"])],
    ),
    ("ratn.v1.ActionService", &[(Look, &["Describe"]), (Perform, &["Execute", "Perform", "Cancel"])]),
    ("ratn.v1.CellService", &[(Look, &["GetGroundTruth"]), (Administer, &["InjectFault", "PutBack", "Reset", "Save"])]),
    (
        "ratn.v1.SafetyService",
        &[
            (Look, &["GetSafety"]),
            // Whoever may move it may stop it.
            (Perform, &["EmergencyStop", "Hold"]),
            (Administer, &["ClearEmergencyStop", "GoOn"]),
        ],
    ),
];

impl Operation {
    /// That of a request's path, `/ratn.v1.ResourceService/Create`. Methods of this system without a row are the operator's.
    pub fn of_path(path: &str) -> Operation {
        Operation::listed(path).unwrap_or(if path.starts_with("/ratn.") { Administer } else { Ask })
    }

    fn listed(path: &str) -> Option<Operation> {
        let (service, method) = path.strip_prefix('/')?.split_once('/')?;
        let (_, rows) = METHODS.iter().find(|(name, _)| *name == service)?;
        rows.iter().find(|(_, methods)| methods.contains(&method)).map(|(operation, _)| *operation)
    }
}

/// Service and method of a path, if it is one of this system's.
pub(crate) fn method_of(path: &str) -> Option<(&'static str, &'static str)> {
    let (service, method) = path.strip_prefix('/')?.split_once('/')?;
    let (service, rows) = METHODS.iter().find(|(name, _)| *name == service)?;
    let method = rows.iter().flat_map(|(_, methods)| *methods).find(|name| **name == method)?;
    Some((service, method))
}

/// Whether one of these roles may.
pub fn allowed(operation: Operation, roles: &[Role]) -> bool {
    TABLE.iter().any(|(row, may)| *row == operation && roles.iter().any(|role| may.contains(role)))
}

/// Which roles callers have. Who runs a daemon, and root, are operators over its Unix socket.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AccessConfig {
    /// Over TCP without TLS, where nobody proves who they are.
    pub anonymous: Vec<Role>,
    /// Users of this machine that are not named below.
    pub others: Vec<Role>,
    /// Users of this machine.
    #[serde(rename = "user")]
    pub users: Vec<UserAccess>,
    /// Holders of certificates; one that is not named may look.
    #[serde(rename = "certificate")]
    pub certificates: Vec<CertificateAccess>,
}

/// Roles of a user.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct UserAccess {
    /// Who.
    pub uid: u32,
    /// What they are.
    pub roles: Vec<Role>,
}

/// Roles of the holder of a certificate: of one certificate, or of any that the authority made for a host.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CertificateAccess {
    /// SHA-256 of the certificate in hex, colons allowed, as `openssl x509 -noout -fingerprint -sha256` prints it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fingerprint: Option<String>,
    /// A host that the certificate is for, by name: a new certificate of the same host needs no new config.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub host: Option<String>,
    /// A name for people and for the audit log; the host's unless given.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// What they are.
    pub roles: Vec<Role>,
}

impl CertificateAccess {
    fn name(&self) -> &str {
        self.name.as_deref().or(self.host.as_deref()).unwrap_or_default()
    }
}

impl Default for AccessConfig {
    fn default() -> Self {
        AccessConfig {
            anonymous: vec![Viewer, Task, Agent],
            others: vec![Viewer],
            users: Vec::new(),
            certificates: Vec::new(),
        }
    }
}

impl Check for AccessConfig {
    fn check(&self) -> Result<(), ConfigError> {
        for (i, certificate) in self.certificates.iter().enumerate() {
            let one = certificate.fingerprint.is_some() != certificate.host.is_some();
            rule(format!("access.certificate[{i}]"), one, "either by `fingerprint` or by `host`")?;
            let digits = certificate.fingerprint.as_deref().map(hex_digits);
            let good = digits.is_none_or(|d| d.len() == 64 && d.bytes().all(|b| b.is_ascii_hexdigit()));
            rule(format!("access.certificate[{i}].fingerprint"), good, "64 hex digits (SHA-256)")?;
            let name = certificate.name();
            let good = !name.is_empty() && !name.chars().any(char::is_control);
            rule(format!("access.certificate[{i}].name"), good, "given, or the host's; no control characters")?;
        }
        Ok(())
    }
}

/// Somebody who was let in.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Caller {
    /// Proven by the connection: `uid 1000`, `control (certificate)`, `anonymous`. The same name is the same caller.
    pub name: Arc<str>,
    /// What they are.
    pub roles: Arc<[Role]>,
}

impl AccessConfig {
    /// Who a connection's other end is to a daemon that runs as `own_uid`.
    pub fn caller(&self, identity: &Identity, own_uid: u32) -> Caller {
        let (name, roles): (String, &[Role]) = match identity {
            Identity::User { uid, .. } => {
                let named = self.users.iter().find(|user| user.uid == *uid).map(|user| user.roles.as_slice());
                let own = (*uid == own_uid || *uid == 0).then_some(&[Operator] as &[Role]);
                (format!("uid {uid}"), named.or(own).unwrap_or(&self.others))
            }
            Identity::Certificate { der } => {
                let (shown, hosts) = (fingerprint(der), hosts(der));
                let same =
                    |known: &&CertificateAccess| known.fingerprint.as_deref().map(hex_digits) == Some(shown.clone());
                let of_host = |known: &&CertificateAccess| known.host.as_ref().is_some_and(|host| hosts.contains(host));
                let known = self.certificates.iter().find(same).or_else(|| self.certificates.iter().find(of_host));
                match known {
                    Some(known) => (format!("{} (certificate)", known.name()), &known.roles),
                    None => (format!("certificate {shown}"), &[Viewer]),
                }
            }
            Identity::Anonymous => ("anonymous".to_owned(), &self.anonymous),
        };
        Caller { name: name.into(), roles: roles.into() }
    }
}

impl Caller {
    /// Where a server has no gate, inside a process.
    pub fn trusted() -> Caller {
        Caller { name: "this process".into(), roles: [Operator].as_slice().into() }
    }

    /// Who made a request.
    pub fn of<T>(request: &tonic::Request<T>) -> Caller {
        request.extensions().get::<Caller>().cloned().unwrap_or_else(Caller::trusted)
    }

    /// A request of theirs, made inside the process.
    pub(crate) fn request<T>(&self, message: T) -> tonic::Request<T> {
        let mut request = tonic::Request::new(message);
        request.extensions_mut().insert(self.clone());
        request
    }

    /// Whether they may, by the table.
    ///
    /// # Errors
    /// `PERMISSION_DENIED`, which says what they are.
    pub fn admit(&self, operation: Operation) -> Result<(), Status> {
        if allowed(operation, &self.roles) {
            return Ok(());
        }
        tracing::warn!(who = %self, ?operation, "refused");
        let message = format!(
            "{self} may not {operation:?}: has the roles {:?}; an operator grants them in [service.access]",
            self.roles
        );
        Err(status(Code::PermissionDenied, "ROLE_MISSING", message))
    }

    /// Who they are to the resource pool.
    pub(crate) fn speaker(&self) -> Speaker {
        Speaker { name: self.name.clone(), for_anybody: self.is_operator() }
    }

    /// Whether what belongs to others is theirs to end.
    pub fn is_operator(&self) -> bool {
        self.roles.contains(&Operator)
    }

    /// Whether they may add resources of a class: a task its own, agents what the system consists of (the paper's Section V-B).
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

/// SHA-256 in lower-case hex.
fn fingerprint(der: &[u8]) -> String {
    use std::fmt::Write;
    let digest = ring::digest::digest(&ring::digest::SHA256, der);
    digest.as_ref().iter().fold(String::with_capacity(64), |mut text, byte| {
        // Writing to a string does not fail.
        let _ = write!(text, "{byte:02x}");
        text
    })
}

/// The names of hosts that a certificate is for; the connection has checked who signed it.
fn hosts(der: &[u8]) -> Vec<String> {
    let der = CertificateDer::from(der);
    let Ok(certificate) = EndEntityCert::try_from(&der) else { return Vec::new() };
    certificate.valid_dns_names().map(str::to_owned).collect()
}

fn hex_digits(fingerprint: &str) -> String {
    fingerprint.chars().filter(|c| *c != ':').map(|c| c.to_ascii_lowercase()).collect()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use prost::Message;
    use std::collections::BTreeSet;

    fn may(role: Role) -> Vec<Operation> {
        TABLE.iter().map(|(operation, _)| *operation).filter(|operation| allowed(*operation, &[role])).collect()
    }

    #[test]
    fn a_viewer_changes_nothing_and_an_operator_may_everything() {
        assert_eq!(may(Viewer), [Ask, Look]);
        assert_eq!(may(Operator).len(), TABLE.len());
        assert_eq!(may(Agent), [Ask, Look, Session, Create, Delete, Release, Perform]);
        assert!(!may(Task).contains(&Administer));
        assert!(!allowed(Ask, &[]));
    }

    #[test]
    fn every_method_of_the_wire_has_a_row_and_every_row_a_method() {
        let set = prost_types::FileDescriptorSet::decode(ratn_proto::FILE_DESCRIPTOR_SET).unwrap();
        let mut there = BTreeSet::new();
        for file in set.file.iter().filter(|file| file.package().starts_with("ratn.")) {
            for service in &file.service {
                for method in &service.method {
                    there.insert(format!("/{}.{}/{}", file.package(), service.name(), method.name()));
                }
            }
        }
        let listed = METHODS.iter().flat_map(|(service, rows)| {
            rows.iter().flat_map(move |(_, methods)| methods.iter().map(move |method| format!("/{service}/{method}")))
        });
        let listed: BTreeSet<String> = listed.collect();
        let unlisted: Vec<_> = there.difference(&listed).collect();
        assert!(unlisted.is_empty(), "METHODS in access.rs says nothing of {unlisted:?}");
        let gone: Vec<_> = listed.difference(&there).collect();
        assert!(gone.is_empty(), "METHODS in access.rs still names {gone:?}");
    }

    #[test]
    fn what_has_no_row_is_the_operators() {
        assert_eq!(Operation::of_path("/ratn.v1.ResourceService/Forget"), Administer);
        assert_eq!(Operation::of_path("/ratn.v2.ResourceService/List"), Administer);
        assert_eq!(Operation::of_path("/grpc.health.v1.Health/Check"), Ask);
    }

    #[test]
    fn callers_have_the_roles_of_what_they_prove() {
        let der: Arc<[u8]> = b"a certificate".as_slice().into();
        let colons = fingerprint(&der)
            .to_ascii_uppercase()
            .as_bytes()
            .chunks(2)
            .map(|pair| String::from_utf8_lossy(pair).into_owned())
            .collect::<Vec<_>>()
            .join(":");
        let access = AccessConfig {
            users: vec![UserAccess { uid: 7, roles: vec![Task] }],
            certificates: vec![CertificateAccess {
                fingerprint: Some(colons),
                host: None,
                name: Some("control".to_owned()),
                roles: vec![Agent],
            }],
            ..AccessConfig::default()
        };
        access.check().unwrap();
        let of = |identity| access.caller(&identity, 1000);
        let user = |uid| of(Identity::User { uid, pid: None });
        assert_eq!((&*user(1000).name, &*user(1000).roles), ("uid 1000", &[Operator] as &[Role]));
        assert_eq!(&*user(0).roles, [Operator]);
        assert_eq!(&*user(7).roles, [Task]);
        assert_eq!(&*user(8).roles, [Viewer]);
        let known = of(Identity::Certificate { der });
        assert_eq!((&*known.name, &*known.roles), ("control (certificate)", &[Agent] as &[Role]));
        assert_eq!(&*of(Identity::Certificate { der: b"another".as_slice().into() }).roles, [Viewer]);
        assert!(!of(Identity::Anonymous).is_operator());
    }

    #[test]
    fn a_task_creates_only_task_resources_and_an_agent_none() {
        let one = |role: Role| Caller { name: "x".into(), roles: [role].as_slice().into() };
        for class in [ResourceClass::System, ResourceClass::Process, ResourceClass::Module, ResourceClass::World] {
            assert!(one(Agent).may_create(class) && one(Operator).may_create(class) && !one(Task).may_create(class));
        }
        assert!(one(Task).may_create(ResourceClass::Task) && !one(Agent).may_create(ResourceClass::Task));
        assert!(one(Operator).may_create(ResourceClass::Task) && !one(Viewer).may_create(ResourceClass::Task));
    }

    #[test]
    fn a_certificate_is_named_by_its_fingerprint_or_its_host_else_it_is_refused_with_its_place() {
        let refused = |certificate: &str| {
            let text = format!("[[certificate]]\nroles = [\"viewer\"]\n{certificate}");
            let access: AccessConfig = toml::from_str(&text).unwrap();
            access.check().err().map(|error| error.to_string())
        };
        let says = |certificate: &str, what: &str| {
            let said = refused(certificate).unwrap_or_default();
            assert!(said.contains(what), "{said}");
        };
        says("fingerprint = \"12:34\"\nname = \"x\"", "access.certificate[0].fingerprint");
        says("name = \"x\"", "either by `fingerprint` or by `host`");
        says("host = \"control\"\nfingerprint = \"12\"", "either by");
        says(&format!("fingerprint = \"{}\"", "ab".repeat(32)), "access.certificate[0].name");
        assert_eq!(refused("host = \"control\""), None);
    }

    #[test]
    fn a_certificate_has_the_roles_of_the_host_it_is_for() {
        let sign = |names: &[&str]| {
            let key = rcgen::KeyPair::generate().unwrap();
            let names: Vec<String> = names.iter().map(|name| (*name).to_owned()).collect();
            let signed = rcgen::CertificateParams::new(names).unwrap().self_signed(&key).unwrap();
            Identity::Certificate { der: signed.der().to_vec().into() }
        };
        let access: AccessConfig = toml::from_str("[[certificate]]\nhost = \"control\"\nroles = [\"task\"]").unwrap();
        let control = access.caller(&sign(&["elsewhere", "control"]), 0);
        assert_eq!((&*control.name, &*control.roles), ("control (certificate)", &[Task] as &[Role]));
        assert_eq!(&*access.caller(&sign(&["control.example"]), 0).roles, [Viewer]);
    }
}
