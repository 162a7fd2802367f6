//! Data that the services exchange and that no core owns: resources as the resource manager lists them, facts with their revision, worker processes,
//! goals and their results. Plain data.

use ratn_model::condition::Condition;
use ratn_model::fact::FactKey;
use ratn_model::id::{FencingToken, LeaseId, ProjectionId, Revision};
use ratn_model::measurement::{Certainty, Evidence, Measurement};
use ratn_model::resource::{Lease, OperatedUnits, Quantity, Requirement, ResourceClass};
use ratn_model::value::Value;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

/// The attribute of a resource with the address of its action service.
pub const ENDPOINT_ATTRIBUTE: &str = "endpoint";
/// The kind of the resource that represents a host: its endpoint is that of the host's process manager.
pub const HOST_KIND: &str = "Host";

/// The attribute by which a provider asks for time, in milliseconds, to stop motions when a lease of its resource has ended.
pub const STANDSTILL_ATTRIBUTE: &str = "standstill_ms";

/// The availability of a resource.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum ResourceState {
    /// At least one unit is available.
    #[default]
    Free,
    /// No unit is available now; some return when a lease ends.
    Leased,
    /// Every unit has been consumed.
    Exhausted,
}

/// An amount of a resource under a lease.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Holding {
    /// The lease.
    pub lease: LeaseId,
    /// Its fencing token.
    pub token: FencingToken,
    /// How much.
    pub units: Quantity,
    /// The session of the lease.
    pub session: String,
    /// Description of the holder, for people.
    pub holder: String,
    /// The caller who opened that session, as the connection proved; empty if unknown.
    pub opened_by: String,
}

/// An amount of a resource whose lease has ended, while something may still move for it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EndingUnits {
    /// The lease that has ended.
    pub lease: LeaseId,
    /// Its fencing token.
    pub token: FencingToken,
    /// How much.
    pub units: Quantity,
    /// The session that had the lease.
    pub session: String,
    /// They are free after this many milliseconds at the latest.
    pub within_ms: u64,
}

/// A resource. A provider fills in the first eight fields, the manager the rest.
#[derive(Debug, Clone, PartialEq)]
pub struct Resource {
    /// Unique among all resources, `path-planner-1@compute`; empty in a create lets the manager choose.
    pub id: String,
    /// Its class.
    pub class: ResourceClass,
    /// Its kind, `PathPlanner`.
    pub kind: String,
    /// The attributes that selectors compare.
    pub attributes: BTreeMap<String, Value>,
    /// The total amount, greater than zero; whole units unless the resource is divisible.
    pub capacity: Quantity,
    /// Whether parts of a unit can be acquired.
    pub divisible: bool,
    /// Whether consumed units return when the task ends.
    pub renewable: bool,
    /// The host on which it is; may be empty.
    pub host: String,
    /// The session that owns it.
    pub session: String,
    /// The pool's revision of its last change.
    pub revision: Revision,
    /// Its availability.
    pub state: ResourceState,
    /// The available amount.
    pub free: Quantity,
    /// Who holds units of it.
    pub holdings: Vec<Holding>,
    /// Units that ended leases have left, until the provider has confirmed standstill.
    pub ending: Vec<EndingUnits>,
}

impl Resource {
    /// A resource of one unit without attributes, as a provider offers it.
    pub fn new(id: impl Into<String>, class: ResourceClass, kind: impl Into<String>) -> Resource {
        Resource {
            id: id.into(),
            class,
            kind: kind.into(),
            attributes: BTreeMap::new(),
            capacity: Quantity::ONE,
            divisible: false,
            renewable: true,
            host: String::new(),
            session: String::new(),
            revision: Revision(0),
            state: ResourceState::Free,
            free: Quantity::ONE,
            holdings: Vec::new(),
            ending: Vec::new(),
        }
    }

    /// With an attribute.
    #[must_use]
    pub fn with_attribute(mut self, name: impl Into<String>, value: Value) -> Resource {
        self.attributes.insert(name.into(), value);
        self
    }

    /// With a provider that confirms standstill within `bound` after a lease has ended.
    #[must_use]
    pub fn with_standstill(self, bound: Duration) -> Resource {
        let bound = i64::try_from(bound.as_millis()).unwrap_or(i64::MAX);
        self.with_attribute(STANDSTILL_ATTRIBUTE, Value::Int(bound))
    }

    /// The bound within which its provider confirms standstill after a lease has ended; `None` if nothing moves.
    pub fn standstill(&self) -> Option<Duration> {
        match self.attributes.get(STANDSTILL_ATTRIBUTE) {
            Some(Value::Int(ms)) => u64::try_from(*ms).ok().filter(|ms| *ms > 0).map(Duration::from_millis),
            _ => None,
        }
    }

    /// With its action service at this address.
    #[must_use]
    pub fn with_endpoint(self, endpoint: impl ToString) -> Resource {
        self.with_attribute(ENDPOINT_ATTRIBUTE, Value::String(endpoint.to_string()))
    }

    /// With this total amount.
    #[must_use]
    pub fn with_capacity(mut self, capacity: impl Into<Quantity>) -> Resource {
        self.capacity = capacity.into();
        self.free = self.capacity;
        self
    }

    /// With units that can be acquired in parts.
    #[must_use]
    pub fn divisible(mut self) -> Resource {
        self.divisible = true;
        self
    }

    /// With units that do not return once they are consumed.
    #[must_use]
    pub fn non_renewable(mut self) -> Resource {
        self.renewable = false;
        self
    }

    /// On a host.
    #[must_use]
    pub fn on_host(mut self, host: impl Into<String>) -> Resource {
        self.host = host.into();
        self
    }

    /// The address of its action service; empty if it performs no actions.
    pub fn endpoint(&self) -> &str {
        match self.attributes.get(ENDPOINT_ATTRIBUTE) {
            Some(Value::String(endpoint)) => endpoint,
            _ => "",
        }
    }
}

/// An acquire in the queue.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct WaitingAcquire {
    /// Its request id; may be empty.
    pub request: String,
    /// The session that asks.
    pub session: String,
    /// Description of the future holder, for people.
    pub holder: String,
    /// Larger first.
    pub priority: i64,
    /// Number of requests that are served before it.
    pub ahead: u32,
    /// What is in the way, for people.
    pub obstacles: Vec<String>,
    /// The leases that hold the units that it lacks.
    pub held_by: Vec<LeaseId>,
    /// The share of its session.
    pub share: f64,
    /// In how many milliseconds its session's task is due; `None` if it is never due.
    pub due_in_ms: Option<i64>,
    /// Whether the resources may turn out not to be needed.
    pub speculative: bool,
    /// How long it has waited, including the wait of the request whose place it took.
    pub waiting_ms: u64,
}

/// A session as the resource manager lists it.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct SessionStatus {
    /// Its id.
    pub id: String,
    /// The client's name, for people.
    pub client: String,
    /// How long it lives without a ping, in milliseconds.
    pub ttl_ms: u64,
    /// In how many milliseconds it ends without another ping.
    pub expires_in_ms: u64,
    /// Its leases.
    pub leases: Vec<LeaseId>,
    /// Number of its queued acquires.
    pub waiting: u32,
    /// The resources that it provides.
    pub resources: Vec<String>,
    /// The caller who opened it, as the connection proved: nobody but an operator may also use it. Empty if unknown.
    pub opened_by: String,
    /// Its share of contested resources.
    pub share: f64,
    /// In how many milliseconds its task is due; `None` if it is never due.
    pub due_in_ms: Option<i64>,
}

/// The resources to list; the default is all of them.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ResourceFilter {
    /// Only of these kinds; empty for every kind.
    pub kinds: Vec<String>,
    /// Only of this class.
    pub class: Option<ResourceClass>,
    /// Only on this host; empty for every host.
    pub host: String,
    /// Only those with these attributes.
    pub attributes: BTreeMap<String, Value>,
    /// Only those that this session provides; empty for all sessions.
    pub session: String,
    /// Only those whose attributes satisfy all of these conditions.
    pub conditions: Vec<Condition>,
}

/// What happened to a resource.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ResourceEventKind {
    /// It is new.
    Created,
    /// Its attributes or its capacity changed, or units were consumed.
    Updated,
    /// It is gone; a lease of it has ended.
    Deleted,
    /// Units of it were granted to a lease.
    Leased,
    /// A lease of it ended: released, expired, or lost.
    Released,
}

/// One change of one resource.
#[derive(Debug, Clone, PartialEq)]
pub struct ResourceEvent {
    /// The pool's revision after it.
    pub revision: Revision,
    /// What happened.
    pub kind: ResourceEventKind,
    /// The resource after it (before it, when deleted).
    pub resource: Resource,
    /// The lease, when leased or released.
    pub lease: Option<(LeaseId, FencingToken)>,
    /// The reason, if there is one.
    pub reason: String,
    /// Its number among the events of its revision, from 0.
    pub part: u32,
}

/// How a provider provides a kind.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Provision {
    /// Maximum amount of it.
    pub most: u32,
    /// Whether the provider also starts more of it for requests that wait for existing units held by others.
    pub grows: bool,
}

/// The result of an earlier request. If an earlier version of the resource manager performed it, only that it was performed is known.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Recalled {
    /// The id of what it created.
    pub created: Option<String>,
    /// What it deleted or used up.
    pub operated: Vec<OperatedUnits>,
}

/// Resources that are missing, or held by others while requests have waited for long.
#[derive(Debug, Clone, PartialEq)]
pub struct Demand {
    /// The selector; its count is the amount needed in addition to what the provider's session provides.
    pub requirement: Requirement,
    /// The kinds that satisfy it: its kind, and the subclasses.
    pub kinds: Vec<String>,
    /// The amount that the provider's session already provides.
    pub provided: Quantity,
    /// The part of the count for requests that wait for existing units held by others.
    pub queued: Quantity,
}

/// The position from which a watch continues.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WatchPosition {
    /// After this revision.
    pub revision: Revision,
    /// And after this event of that revision; `None`: after all its events.
    pub part: Option<u32>,
}

impl ResourceEvent {
    /// The position of a watch that has seen this event last.
    pub fn position(&self) -> WatchPosition {
        WatchPosition { revision: self.revision, part: Some(self.part) }
    }
}

impl From<Revision> for WatchPosition {
    fn from(revision: Revision) -> WatchPosition {
        WatchPosition { revision, part: None }
    }
}

/// A message of a watch of resources: first one snapshot, then events.
#[expect(clippy::large_enum_variant, reason = "most are events, and each is handled where it arrives")]
#[derive(Debug, Clone, PartialEq)]
pub enum ResourceUpdate {
    /// The present resources; events follow from the next revision on.
    Snapshot {
        /// The pool's revision.
        revision: Revision,
        /// Sorted by id.
        resources: Vec<Resource>,
        /// The lease that was granted last, live or ended.
        youngest: LeaseId,
    },
    /// A change since then.
    Event(ResourceEvent),
}

/// A fact with the revision of the world that wrote it (0 for a measured fact), its writer and its measurement.
#[derive(Debug, Clone, PartialEq)]
pub struct FactRecord {
    /// Which fact.
    pub key: FactKey,
    /// Its value.
    pub value: Value,
    /// The revision that wrote it.
    pub revision: Revision,
    /// The node that wrote it, by the path of its instance.
    pub writer: Option<Arc<str>>,
    /// Its measurement, if it was measured.
    pub measured: Option<Arc<Measurement>>,
}

/// A message to watchers of the root world.
#[derive(Debug, Clone, PartialEq)]
pub enum WorldUpdate {
    /// The present facts; changes follow from the next revision on.
    Snapshot {
        /// The root's revision.
        revision: Revision,
        /// Sorted by key.
        facts: Vec<FactRecord>,
    },
    /// What a revision changed.
    Changed(WorldChange),
}

/// What one revision of the root world changed.
#[derive(Debug, Clone, PartialEq)]
pub struct WorldChange {
    /// The revision.
    pub revision: Revision,
    /// The commit's id; empty if facts have expired.
    pub commit: String,
    /// Written facts, sorted by key.
    pub written: Vec<FactRecord>,
    /// Deleted facts, sorted by key.
    pub gone: Vec<FactKey>,
    /// The node that committed it, by the path of its instance.
    pub writer: Option<Arc<str>>,
}

/// A fact in two revisions; `None` if it does not exist there.
#[derive(Debug, Clone, PartialEq)]
pub struct FactDifference {
    /// Which fact.
    pub key: FactKey,
    /// In the first revision.
    pub before: Option<FactRecord>,
    /// In the second revision.
    pub after: Option<FactRecord>,
}

/// A projection that a revision of the root world contradicts.
#[derive(Debug, Clone, PartialEq)]
pub struct Contradiction {
    /// The projection.
    pub projection: ProjectionId,
    /// The first fact, sorted by key, whose shown value is wrong.
    pub fact: FactKey,
    /// The value that it showed; `None`: no such fact.
    pub was: Option<Value>,
    /// The value that it would show now.
    pub is: Option<Value>,
    /// The revision that contradicts it.
    pub revision: Revision,
}

/// The value of a fact from one revision on.
#[derive(Debug, Clone, PartialEq)]
pub struct FactVersion {
    /// The revision that wrote or deleted it.
    pub revision: Revision,
    /// The commit's id; empty if the fact expired, or if the id is not kept any more.
    pub commit: String,
    /// `None` if the fact does not exist from then on.
    pub fact: Option<FactRecord>,
    /// The node that wrote or deleted it, by the path of its instance.
    pub writer: Option<Arc<str>>,
}

/// The state of a worker process.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WorkerState {
    /// It was spawned and is not serving yet.
    Starting,
    /// Its health is SERVING and its resource exists.
    Ready,
    /// It is to end: when nobody holds it any more, or at once.
    Stopping,
    /// The process is gone.
    Exited,
}

/// A worker process.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WorkerStatus {
    /// Its id, which is also the id of its resource.
    pub id: String,
    /// The template that it was started from.
    pub template: String,
    /// Its state.
    pub state: WorkerState,
    /// The process id.
    pub pid: u32,
    /// The address of its action service; empty before it is ready.
    pub endpoint: String,
    /// The reason of its exit; else empty.
    pub reason: String,
    /// Resident memory, in bytes; only where pools are listed.
    pub resident_bytes: u64,
    /// Processor use since the last listing, in thousandths of a core; only where pools are listed.
    pub cpu_millicores: u32,
    /// Its limits on the machine, and how they are enforced; empty without limits.
    pub limits: String,
    /// The age of its process in seconds; only where pools are listed.
    pub age_s: u64,
    /// Whether somebody holds its resource.
    pub held: bool,
}

/// A pool of workers of one template.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PoolStatus {
    /// The template's name.
    pub template: String,
    /// The kind of resource of its workers.
    pub kind: String,
    /// Minimum number of workers.
    pub min: u32,
    /// Maximum number of workers.
    pub max: u32,
    /// Oldest first.
    pub workers: Vec<WorkerStatus>,
    /// Why no more workers are started; empty if nothing is wrong.
    pub failure: String,
    /// Number of workers that are kept ready beyond those that are held.
    pub spares: u32,
    /// Number of workers that ended unasked since the process manager began.
    pub crashes: u64,
    /// How the last of these workers ended; empty if there was none.
    pub last_exit: String,
}

/// The pools of a host.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct HostPools {
    /// The host's name.
    pub host: String,
    /// Whether it takes no new work.
    pub draining: bool,
    /// The wall clock of the host when it answered, in microseconds since 1970.
    pub clock_us: u64,
    /// How the processes of workers are tracked; `None` if the process manager does not report it.
    pub tracking: Option<TrackingMode>,
    /// Sorted by template.
    pub pools: Vec<PoolStatus>,
}

/// How a process manager knows which processes belong to which worker.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TrackingMode {
    /// Each worker has a group of cgroup v2.
    Cgroup,
    /// By a marker in the environment of processes; orphans become children of the process manager (`PR_SET_CHILD_SUBREAPER`), which
    /// ends them when it stops.
    Subreaper,
    /// By the marker alone.
    Marker,
}

/// The desired number of workers of a template; `None` leaves a value unchanged.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Scale {
    /// Minimum number of workers.
    pub min: Option<u32>,
    /// Maximum number of workers.
    pub max: Option<u32>,
    /// Number of workers to keep ready beyond those that are held.
    pub spares: Option<u32>,
}

/// A goal as a provider gets it.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Goal {
    /// Unique to the attempt, `run/instance/attempt`.
    pub id: String,
    /// The action's name, `plan`.
    pub action: String,
    /// The input ports.
    pub inputs: BTreeMap<String, Value>,
    /// Seed of the action's random choices.
    pub seed: u64,
    /// The lease of the resources that the action may use; it contains the provider.
    pub lease: Option<Lease>,
    /// The session that holds the lease; empty if not named.
    pub session: String,
    /// The projection that it works on.
    pub projection: Option<ProjectionId>,
    /// The address of the world pool; empty if the action needs none.
    pub world_pool: String,
    /// Cancelled this long after its arrival, in milliseconds of wall time; 0 never.
    pub deadline_ms: u64,
    /// How long it goes on when nobody listens to it, in milliseconds of wall time; 0: not at all.
    pub grace_ms: u64,
    /// If the goal may give a result and then better ones: the outputs that stay as in the first result.
    pub improves: Option<Vec<String>>,
}

/// A usable result of a goal that goes on for a better one.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct GoalImproved {
    /// The output ports, as for a goal that ends with success.
    pub outputs: BTreeMap<String, Value>,
    /// The cost of the result for its user, in seconds of the robot's time.
    pub cost_s: f64,
}

/// The end of a goal.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct GoalOutcome {
    /// `success`, `aborted`, `preempted`, or one of the action's own.
    pub outcome: String,
    /// The output ports.
    pub outputs: BTreeMap<String, Value>,
    /// Measured facts.
    pub measured: Vec<(FactKey, Value)>,
    /// What measured them, and with which certainty, as far as this is reported.
    pub evidence: Evidence,
    /// The reason, if the outcome is not success; else empty.
    pub reason: String,
}

impl GoalOutcome {
    /// The goal was achieved.
    pub fn success() -> GoalOutcome {
        GoalOutcome::named(ratn_model::program::SUCCESS)
    }

    /// It failed.
    pub fn aborted(reason: impl Into<String>) -> GoalOutcome {
        GoalOutcome { reason: reason.into(), ..GoalOutcome::named(ratn_model::program::ABORTED) }
    }

    /// The goal was cancelled.
    pub fn preempted(reason: impl Into<String>) -> GoalOutcome {
        GoalOutcome { reason: reason.into(), ..GoalOutcome::named(ratn_model::program::PREEMPTED) }
    }

    /// An emergency stop ended it.
    pub fn stopped(reason: impl Into<String>) -> GoalOutcome {
        GoalOutcome { reason: reason.into(), ..GoalOutcome::named(ratn_model::program::STOPPED) }
    }

    /// An outcome of the action's own.
    pub fn named(outcome: &str) -> GoalOutcome {
        GoalOutcome { outcome: outcome.to_owned(), ..GoalOutcome::default() }
    }

    /// With an output port.
    #[must_use]
    pub fn with_output(mut self, port: &str, value: Value) -> GoalOutcome {
        self.outputs.insert(port.to_owned(), value);
        self
    }

    /// With a measured fact.
    #[must_use]
    pub fn with_measured(mut self, fact: FactKey, value: Value) -> GoalOutcome {
        self.measured.push((fact, value));
        self
    }

    /// With a measured fact and its certainty. The source of the measurement is the provider that reports it.
    #[must_use]
    pub fn with_certain(mut self, fact: FactKey, value: Value, certainty: Certainty) -> GoalOutcome {
        self.evidence.push((fact.clone(), Measurement { source: String::new(), certainty: Some(certainty) }));
        self.with_measured(fact, value)
    }

    /// Whether the goal was achieved.
    pub fn is_success(&self) -> bool {
        self.outcome == ratn_model::program::SUCCESS
    }
}
