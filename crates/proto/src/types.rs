//! What the services speak of and no core owns: resources as the resource manager lists them, facts with their revision,
//! worker processes, goals and their results. Plain data.

use ratn_model::condition::Condition;
use ratn_model::fact::FactKey;
use ratn_model::id::{FencingToken, LeaseId, ProjectionId, Revision};
use ratn_model::measurement::{Certainty, Evidence, Measurement};
use ratn_model::resource::{Lease, OperatedUnits, Quantity, Requirement, ResourceClass};
use ratn_model::value::Value;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

/// The attribute of a resource that says where its action service is.
pub const ENDPOINT_ATTRIBUTE: &str = "endpoint";
/// The kind of the resource that a host is: by its endpoint the host's process manager is found.
pub const HOST_KIND: &str = "Host";

/// The attribute by which a provider asks for time to stop what moves when a lease of its resource has ended, in milliseconds.
pub const STANDSTILL_ATTRIBUTE: &str = "standstill_ms";

/// What a resource is doing.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum ResourceState {
    /// At least one unit can be had.
    #[default]
    Free,
    /// No unit can be had now; some come back when a lease ends.
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
    /// What the holder said it is, for people.
    pub holder: String,
    /// Who opened that session, as the connection proved it; empty where nobody knows.
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
    /// The session that the lease was of.
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
    /// What selectors compare with.
    pub attributes: BTreeMap<String, Value>,
    /// How much of it there is in all, more than nothing; whole units unless it is divisible.
    pub capacity: Quantity,
    /// Parts of a unit can be had.
    pub divisible: bool,
    /// What a task consumed returns when the task ends.
    pub renewable: bool,
    /// The host that it is on; may be empty.
    pub host: String,
    /// The session that owns it.
    pub session: String,
    /// The revision of the pool that changed it last.
    pub revision: Revision,
    /// What it is doing.
    pub state: ResourceState,
    /// How much can be had now.
    pub free: Quantity,
    /// Who has some of it.
    pub holdings: Vec<Holding>,
    /// What leases that have ended have left, until its provider has confirmed standstill.
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

    /// With a provider that confirms within `bound` that nothing moves any more for a lease that has ended.
    #[must_use]
    pub fn with_standstill(self, bound: Duration) -> Resource {
        let bound = i64::try_from(bound.as_millis()).unwrap_or(i64::MAX);
        self.with_attribute(STANDSTILL_ATTRIBUTE, Value::Int(bound))
    }

    /// Within which its provider confirms that nothing moves any more for a lease that has ended; nothing where nothing moves.
    pub fn standstill(&self) -> Option<Duration> {
        match self.attributes.get(STANDSTILL_ATTRIBUTE) {
            Some(Value::Int(ms)) => u64::try_from(*ms).ok().filter(|ms| *ms > 0).map(Duration::from_millis),
            _ => None,
        }
    }

    /// With its action service at `endpoint`.
    #[must_use]
    pub fn with_endpoint(self, endpoint: impl ToString) -> Resource {
        self.with_attribute(ENDPOINT_ATTRIBUTE, Value::String(endpoint.to_string()))
    }

    /// With so much of it.
    #[must_use]
    pub fn with_capacity(mut self, capacity: impl Into<Quantity>) -> Resource {
        self.capacity = capacity.into();
        self.free = self.capacity;
        self
    }

    /// Of which parts of a unit can be had.
    #[must_use]
    pub fn divisible(mut self) -> Resource {
        self.divisible = true;
        self
    }

    /// Of which what is consumed is gone for good.
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

    /// Where its action service is; empty where it performs nothing.
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
    /// Who asks.
    pub session: String,
    /// What the holder is to be, for people.
    pub holder: String,
    /// Larger first.
    pub priority: i64,
    /// How many are served before it.
    pub ahead: u32,
    /// What is in the way, for people.
    pub obstacles: Vec<String>,
    /// The leases that hold what it lacks.
    pub held_by: Vec<LeaseId>,
    /// The share of its session.
    pub share: f64,
    /// In how many milliseconds the task of its session is due, if it is.
    pub due_in_ms: Option<i64>,
    /// It may turn out not to be needed.
    pub speculative: bool,
    /// For how long it has waited, with what it took the place of.
    pub waiting_ms: u64,
}

/// A session as the resource manager lists it.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct SessionStatus {
    /// Its id.
    pub id: String,
    /// Who that is, for people.
    pub client: String,
    /// How long it lives without a ping, in milliseconds.
    pub ttl_ms: u64,
    /// In how many milliseconds it ends unless pinged.
    pub expires_in_ms: u64,
    /// Its leases.
    pub leases: Vec<LeaseId>,
    /// How many of its acquires wait.
    pub waiting: u32,
    /// The resources that it provides.
    pub resources: Vec<String>,
    /// Who opened it, as the connection proved it: nobody else speaks for it, except an operator. Empty where nobody knows.
    pub opened_by: String,
    /// Its share of what several want.
    pub share: f64,
    /// In how many milliseconds its task is due, if it is.
    pub due_in_ms: Option<i64>,
}

/// Which resources a list is of; the default is all of them.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ResourceFilter {
    /// Only of these kinds; empty for every kind.
    pub kinds: Vec<String>,
    /// Only of this class.
    pub class: Option<ResourceClass>,
    /// Only on this host; empty for every host.
    pub host: String,
    /// Only those that have these attributes.
    pub attributes: BTreeMap<String, Value>,
    /// Only those that this session provides; empty for everybody's.
    pub session: String,
    /// Only those whose attributes are like this; all of them.
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
    /// Units of it went to a lease.
    Leased,
    /// A lease of it ended: released, expired, or lost.
    Released,
}

/// One change of one resource.
#[derive(Debug, Clone, PartialEq)]
pub struct ResourceEvent {
    /// The pool's revision with it.
    pub revision: Revision,
    /// What happened.
    pub kind: ResourceEventKind,
    /// The resource after it (before it, when deleted).
    pub resource: Resource,
    /// The lease, when leased or released.
    pub lease: Option<(LeaseId, FencingToken)>,
    /// Why, where there is something to say.
    pub reason: String,
    /// Which of the events of its revision it is, from 0.
    pub part: u32,
}

/// How a provider provides a kind.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Provision {
    /// At most so many of it.
    pub most: u32,
    /// It starts more of it as well for requests that wait for what exists and is held.
    pub grows: bool,
}

/// What a request of before came to. Of one that an earlier version of the resource manager performed nothing is known but that.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Recalled {
    /// The id of what it created.
    pub created: Option<String>,
    /// What it deleted or used up.
    pub operated: Vec<OperatedUnits>,
}

/// What waits for more than exists, or has waited for long for what is held.
#[derive(Debug, Clone, PartialEq)]
pub struct Demand {
    /// What is selected; its count is how much is to come beside those that the provider's session provides.
    pub requirement: Requirement,
    /// The kinds that would do: its kind, and those below it.
    pub kinds: Vec<String>,
    /// How much of it the provider's session provides already.
    pub provided: Quantity,
    /// How much of the count is for requests that wait for what exists and is held.
    pub queued: Quantity,
}

/// From where a watch goes on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WatchPosition {
    /// After this revision.
    pub revision: Revision,
    /// And of the events of that revision after this one; `None` after all of them.
    pub part: Option<u32>,
}

impl ResourceEvent {
    /// Where a watch goes on that has seen this event last.
    pub fn position(&self) -> WatchPosition {
        WatchPosition { revision: self.revision, part: Some(self.part) }
    }
}

impl From<Revision> for WatchPosition {
    fn from(revision: Revision) -> WatchPosition {
        WatchPosition { revision, part: None }
    }
}

/// What a watch of resources tells: the snapshot first, once.
#[expect(clippy::large_enum_variant, reason = "most are events, and each is handled where it arrives")]
#[derive(Debug, Clone, PartialEq)]
pub enum ResourceUpdate {
    /// What is there; events follow from the next revision on.
    Snapshot {
        /// The pool's revision.
        revision: Revision,
        /// In the order of ids.
        resources: Vec<Resource>,
        /// The lease that was granted last, living or not.
        youngest: LeaseId,
    },
    /// What happened since.
    Event(ResourceEvent),
}

/// A fact with the revision of the world that wrote it (0 for a measured one), who wrote it and what measured it.
#[derive(Debug, Clone, PartialEq)]
pub struct FactRecord {
    /// Which fact.
    pub key: FactKey,
    /// What it says.
    pub value: Value,
    /// When it was written.
    pub revision: Revision,
    /// The node that wrote it, by the path of its instance.
    pub writer: Option<Arc<str>>,
    /// What measured it.
    pub measured: Option<Arc<Measurement>>,
}

/// What watchers of the root world are told.
#[derive(Debug, Clone, PartialEq)]
pub enum WorldUpdate {
    /// What holds; changes follow from the next revision on.
    Snapshot {
        /// The root's revision.
        revision: Revision,
        /// In the order of keys.
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
    /// The commit's id; empty where facts were too old.
    pub commit: String,
    /// In the order of keys.
    pub written: Vec<FactRecord>,
    /// What is gone, in the order of keys.
    pub gone: Vec<FactKey>,
    /// The node that committed it, by the path of its instance.
    pub writer: Option<Arc<str>>,
}

/// A fact in two revisions; `None` where it does not hold.
#[derive(Debug, Clone, PartialEq)]
pub struct FactDifference {
    /// Which fact.
    pub key: FactKey,
    /// In the one.
    pub before: Option<FactRecord>,
    /// In the other.
    pub after: Option<FactRecord>,
}

/// A projection that a revision of the root world contradicts.
#[derive(Debug, Clone, PartialEq)]
pub struct Contradiction {
    /// Which.
    pub projection: ProjectionId,
    /// The first fact, in the order of keys, that it showed and that is otherwise.
    pub fact: FactKey,
    /// What it showed; `None`: that there is no such fact.
    pub was: Option<Value>,
    /// What it would show now.
    pub is: Option<Value>,
    /// The revision that made it so.
    pub revision: Revision,
}

/// What a fact was from one revision on.
#[derive(Debug, Clone, PartialEq)]
pub struct FactVersion {
    /// The revision that wrote or deleted it.
    pub revision: Revision,
    /// The commit's id; empty where it was too old, or is not kept any more.
    pub commit: String,
    /// `None` where it does not hold.
    pub fact: Option<FactRecord>,
    /// The node that wrote or deleted it, by the path of its instance.
    pub writer: Option<Arc<str>>,
}

/// What a worker process is doing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WorkerState {
    /// It was spawned and is not serving yet.
    Starting,
    /// Its health is SERVING and its resource exists.
    Ready,
    /// It is to end: once nobody holds it, or right now.
    Stopping,
    /// The process is gone.
    Exited,
}

/// A worker process.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WorkerStatus {
    /// Its id, also that of its resource.
    pub id: String,
    /// The template that it was started from.
    pub template: String,
    /// What it is doing.
    pub state: WorkerState,
    /// The process id.
    pub pid: u32,
    /// Where its action service is; empty before it is ready.
    pub endpoint: String,
    /// Why it exited, else empty.
    pub reason: String,
    /// Resident memory, in bytes; only where pools are listed.
    pub resident_bytes: u64,
    /// Processor use since the last listing, in thousandths of a core; only where pools are listed.
    pub cpu_millicores: u32,
    /// What it may use of the machine, and what keeps it to that; empty without limits.
    pub limits: String,
    /// How long its process has been there, in seconds; only where pools are listed.
    pub age_s: u64,
    /// Whether somebody holds its resource.
    pub held: bool,
}

/// A pool of workers of one template.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PoolStatus {
    /// The template's name.
    pub template: String,
    /// The kind of resource that its workers are.
    pub kind: String,
    /// At least so many workers are kept.
    pub min: u32,
    /// At most so many are started.
    pub max: u32,
    /// The oldest first.
    pub workers: Vec<WorkerStatus>,
    /// Why no more workers are started; empty while all is well.
    pub failure: String,
    /// So many more than are held are kept ready.
    pub spares: u32,
    /// Workers that ended without being asked to, since the process manager began.
    pub crashes: u64,
    /// How the last worker ended that did; empty while none has.
    pub last_exit: String,
}

/// The pools of a host.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct HostPools {
    /// The host's name.
    pub host: String,
    /// It takes no new work.
    pub draining: bool,
    /// What the clock of the host's wall showed when it answered, in microseconds since 1970.
    pub clock_us: u64,
    /// How the processes of workers are tracked; `None` where the process manager does not tell.
    pub tracking: Option<TrackingMode>,
    /// In the order of templates.
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

/// How many workers a template is to have; what is `None` stays as it is.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Scale {
    /// At least so many are kept.
    pub min: Option<u32>,
    /// At most so many are started.
    pub max: Option<u32>,
    /// So many more than are held are kept ready.
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
    /// What the action's random choices are derived from.
    pub seed: u64,
    /// What the action may use; the provider is in it.
    pub lease: Option<Lease>,
    /// The session that holds the lease; empty where that is not said.
    pub session: String,
    /// The world that it works on.
    pub projection: Option<ProjectionId>,
    /// Where the world pool is; empty where the action needs none.
    pub world_pool: String,
    /// Cancelled this long after its arrival, in milliseconds of wall time; 0 never.
    pub deadline_ms: u64,
    /// How long it may go on when nobody listens to it, in milliseconds of wall time; 0 not at all.
    pub grace_ms: u64,
    /// Where it may give a result, go on and give better ones: the outputs that stay as they were in the first.
    pub improves: Option<Vec<String>>,
}

/// A result that can be used, of a goal that goes on for a better one.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct GoalImproved {
    /// The output ports, as of a goal that ends with success.
    pub outputs: BTreeMap<String, Value>,
    /// What it costs whoever uses it, in seconds of the robot's time.
    pub cost_s: f64,
}

/// How a goal has ended.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct GoalOutcome {
    /// `success`, `aborted`, `preempted`, or one of the action's own.
    pub outcome: String,
    /// The output ports.
    pub outputs: BTreeMap<String, Value>,
    /// Facts as measured.
    pub measured: Vec<(FactKey, Value)>,
    /// What measured them and how sure that is, of those of which it is said.
    pub evidence: Evidence,
    /// Why, when the outcome is not success; else empty.
    pub reason: String,
}

impl GoalOutcome {
    /// It did what it should.
    pub fn success() -> GoalOutcome {
        GoalOutcome::named(ratn_model::program::SUCCESS)
    }

    /// It failed.
    pub fn aborted(reason: impl Into<String>) -> GoalOutcome {
        GoalOutcome { reason: reason.into(), ..GoalOutcome::named(ratn_model::program::ABORTED) }
    }

    /// It was told to stop.
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

    /// With a fact as measured.
    #[must_use]
    pub fn with_measured(mut self, fact: FactKey, value: Value) -> GoalOutcome {
        self.measured.push((fact, value));
        self
    }

    /// With a fact as measured, and how sure that is. What measured it is whoever says so.
    #[must_use]
    pub fn with_certain(mut self, fact: FactKey, value: Value, certainty: Certainty) -> GoalOutcome {
        self.evidence.push((fact.clone(), Measurement { source: String::new(), certainty: Some(certainty) }));
        self.with_measured(fact, value)
    }

    /// Whether it did what it should.
    pub fn is_success(&self) -> bool {
        self.outcome == ratn_model::program::SUCCESS
    }
}
