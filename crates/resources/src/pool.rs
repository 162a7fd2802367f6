//! The pool: its state, its operations, and what ending a session, a lease or a resource takes with it.

use crate::assignment::{Assignment, Available, Units};
use crate::error::PoolError;
use crate::event::{Change, EndReason, Notice, Refusal, WatchEvent};
use crate::expiry::Timer;
use crate::id::{SessionId, WaiterId};
use crate::lease::{LeaseRecord, LeaseView, Leases};
use crate::limits::Limits;
use crate::queue::{AcquireRequest, Queue, Waiter};
use crate::request::{Reply, Request, RequestMemory};
use crate::resource::{Resource, ResourceSpec, ResourceView, Resources};
use crate::session::{Session, SessionView, Sessions};
use ratn_model::id::{LeaseId, Revision};
use ratn_model::resource::{Requirement, ResourceClass, ResourceOperation};
use ratn_model::time::Timestamp;
use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

/// Every resource, session, lease and waiter. See the crate's documentation.
#[derive(Debug, Clone, Default)]
pub struct Pool {
    pub(crate) limits: Limits,
    pub(crate) now: Timestamp,
    pub(crate) resources: Resources,
    pub(crate) sessions: Sessions,
    pub(crate) leases: Leases,
    pub(crate) queue: Queue,
    pub(crate) timers: BTreeSet<(Timestamp, Timer)>,
    pub(crate) memory: RequestMemory,
    pub(crate) notices: Vec<Notice>,
    pub(crate) revision: Revision,
    pub(crate) next_lease: u64,
    pub(crate) last_token: u64,
    next_waiter: u64,
    next_resource: u64,
}

impl Pool {
    /// An empty pool.
    pub fn new(limits: Limits) -> Pool {
        Pool { limits, ..Pool::default() }
    }

    /// An empty pool whose tokens and ids are all above `floor`: a restarted manager that keeps nothing passes a number
    /// that has grown since (the time), so that its leases are not refused as old ones.
    pub fn starting_above(limits: Limits, floor: u64) -> Pool {
        Pool { limits, next_lease: floor, last_token: floor, next_waiter: floor, ..Pool::default() }
    }

    /// Performs a mutation. With a request id, an equal request of that id answered before is not performed again: its
    /// answer is given once more.
    ///
    /// # Errors
    /// As the method of the same name; nothing has changed then, and the id is not used up.
    pub fn handle(&mut self, now: Timestamp, request_id: &str, request: Request) -> Result<Reply, PoolError> {
        self.advance(now);
        if request_id.is_empty() {
            return self.perform(now, "", request);
        }
        self.check_name("request id", request_id)?;
        match self.memory.recall(request_id, &request)? {
            Some(Reply::Granted(lease)) if !self.leases.contains_key(&lease.id) => {
                Err(PoolError::UnknownLease { lease: lease.id })
            }
            Some(reply) => Ok(reply),
            None => {
                // Remembered first: a grant that happens while it is performed finds it here.
                let limit = self.limits.remembered_requests;
                self.memory.remember(request_id.to_owned(), request.clone(), Reply::Done, limit);
                let result = self.perform(now, request_id, request.clone());
                match &result {
                    Err(_) => self.memory.forget(request_id),
                    Ok(Reply::Queued(waiter)) if self.queue.get(*waiter).is_none() => {}
                    Ok(reply) => self.memory.remember(request_id.to_owned(), request, reply.clone(), limit),
                }
                result
            }
        }
    }

    /// The session lives for `ttl` from now. An unknown or expired one is opened (anew: nothing of an earlier one is left),
    /// and the answer is true. `client` says who that is, for people.
    ///
    /// # Errors
    /// A malformed name, no time to live, or too many sessions.
    pub fn keep_alive(
        &mut self,
        now: Timestamp,
        id: &SessionId,
        client: &str,
        ttl: Duration,
    ) -> Result<bool, PoolError> {
        self.advance(now);
        if ttl.is_zero() {
            return Err(malformed("session time to live 0", "a session lives for more than 0 seconds"));
        }
        let expires = self.now + ttl;
        let created = match self.sessions.get_mut(id) {
            Some(session) => {
                self.timers.remove(&(session.expires, Timer::Session(id.clone())));
                session.ttl = ttl;
                session.expires = expires;
                false
            }
            None => {
                self.check_name("session id", id.as_str())?;
                self.check_name("client name", client)?;
                if self.sessions.len() >= self.limits.sessions {
                    return Err(PoolError::TooMany { what: "sessions", limit: self.limits.sessions });
                }
                self.sessions.insert(id.clone(), Session::new(client.to_owned(), ttl, expires));
                true
            }
        };
        self.timers.insert((expires, Timer::Session(id.clone())));
        Ok(created)
    }

    /// Ends a session and everything that hangs on it.
    ///
    /// # Errors
    /// An unknown or expired session.
    pub fn close_session(&mut self, now: Timestamp, id: &SessionId) -> Result<(), PoolError> {
        self.advance(now);
        self.session(id)?;
        self.end_session(id, EndReason::SessionClosed);
        self.schedule();
        Ok(())
    }

    /// Adds a resource, bound to a session if one is given. A resource of the same id and owner is updated: the kind
    /// stays, its attributes and capacity are replaced (holders keep what they hold).
    ///
    /// # Errors
    /// An unknown session, an id that another owner's resource has, a malformed or too large description.
    pub fn create(
        &mut self,
        now: Timestamp,
        session: Option<&SessionId>,
        spec: ResourceSpec,
    ) -> Result<ResourceView, PoolError> {
        self.advance(now);
        session.map(|id| self.session(id)).transpose()?;
        self.check_spec(&spec)?;
        let id = match &spec.id {
            Some(id) => id.clone(),
            None => self.new_resource_id(&spec.kind),
        };
        let revision = Revision(self.revision.0 + 1);
        let full = self.resources.len() >= self.limits.resources;
        let view = match self.resources.get_mut(&id) {
            Some(resource) if resource.owner.as_ref() != session || resource.spec.kind != spec.kind => {
                let owner = resource.owner.as_ref().map_or_else(|| "no session".to_owned(), ToString::to_string);
                return Err(PoolError::ResourceTaken { id, owner });
            }
            Some(resource) => {
                resource.spec = ResourceSpec { id: Some(id.clone()), ..spec };
                resource.revision = revision;
                let view = resource.view(&id, &self.leases);
                self.publish(Change::ResourceUpdated(view.clone()));
                view
            }
            None if full => {
                return Err(PoolError::TooMany { what: "resources", limit: self.limits.resources });
            }
            None => {
                let resource = Resource {
                    spec: ResourceSpec { id: Some(id.clone()), ..spec },
                    owner: session.cloned(),
                    revision,
                    holders: BTreeMap::new(),
                    consumers: BTreeMap::new(),
                    spent: 0,
                };
                let view = resource.view(&id, &self.leases);
                self.resources.insert(id.clone(), resource);
                if let Some(session) = session.and_then(|session| self.sessions.get_mut(session)) {
                    session.provides.insert(id.clone());
                }
                self.publish(Change::ResourceCreated(view.clone()));
                view
            }
        };
        self.schedule();
        Ok(self.get(&id).unwrap_or(view))
    }

    /// Removes a resource; holders hear [`Change::ResourceLost`]. `None` as session may delete anything.
    ///
    /// # Errors
    /// An unknown resource, or one that belongs to another session.
    pub fn delete(&mut self, now: Timestamp, session: Option<&SessionId>, id: &str) -> Result<(), PoolError> {
        self.advance(now);
        let resource = self.resources.get(id).ok_or_else(|| PoolError::UnknownResource { id: id.to_owned() })?;
        if let (Some(owner), Some(caller)) = (&resource.owner, session) {
            check_owner(|| format!("resource `{id}`"), owner, caller)?;
        }
        self.remove_resource(id, EndReason::Asked);
        self.schedule();
        Ok(())
    }

    /// Creates and deletes, all or nothing, as a state's annotations say: a create adds one resource with `count` units,
    /// bound to the session; a delete takes `count` free units in all from what fits. Returns the ids created.
    ///
    /// # Errors
    /// Another operation, too little to delete, or as [`Pool::create`].
    pub fn operate(
        &mut self,
        now: Timestamp,
        session: &SessionId,
        operations: &[Requirement],
    ) -> Result<Vec<String>, PoolError> {
        self.advance(now);
        self.session(session)?;
        self.check_requirements(operations, &[ResourceOperation::Create, ResourceOperation::Delete])?;
        // Performed on the side, so that a failure in the middle leaves no trace. Create and delete are rare.
        let mut next = self.clone();
        let mut created = Vec::new();
        for operation in operations {
            if operation.operation == ResourceOperation::Create {
                let mut spec =
                    ResourceSpec::new(operation.class.unwrap_or(ResourceClass::Task), operation.kind.clone())
                        .capacity(operation.count);
                spec.attributes = operation.attributes.clone();
                created.push(next.create(now, Some(session), spec)?.id);
            } else {
                next.take_away(operation)?;
            }
        }
        *self = next;
        self.schedule();
        Ok(created)
    }

    /// Removes `count` free units in all from what fits, for good; a resource without units left vanishes. Returns the
    /// ids of the resources touched.
    ///
    /// # Errors
    /// An unknown session, another operation than delete, or too little to delete.
    pub fn delete_units(
        &mut self,
        now: Timestamp,
        session: &SessionId,
        requirement: &Requirement,
    ) -> Result<Vec<String>, PoolError> {
        self.advance(now);
        self.session(session)?;
        self.check_requirements(std::slice::from_ref(requirement), &[ResourceOperation::Delete])?;
        let touched = self.take_away(requirement)?;
        self.schedule();
        Ok(touched)
    }

    /// Uses units up for the rest of the session's task, now or not at all; what waiters have reserved is not taken.
    /// Returns the ids of the resources consumed from.
    ///
    /// # Errors
    /// An unknown session, another operation than consume, or too little to consume.
    pub fn consume(
        &mut self,
        now: Timestamp,
        session: &SessionId,
        requirement: &Requirement,
    ) -> Result<Vec<String>, PoolError> {
        self.advance(now);
        self.session(session)?;
        let requirement = std::slice::from_ref(requirement);
        self.check_requirements(requirement, &[ResourceOperation::Consume])?;
        let assignment = Assignment::of(&self.resources, Available::Free(&self.reserved()), requirement);
        let [missing] = assignment.missing[..] else { return Ok(Vec::new()) };
        if missing > 0 {
            let found = u64::from(requirement[0].count - missing);
            return Err(PoolError::NotEnough { wanted: requirement[0].to_string(), found });
        }
        let taken = assignment.taken.into_iter().flatten().collect();
        Ok(self.take_consumed(session, taken))
    }

    /// Asks for several resources, all or nothing. How it ends comes as a [`Notice`], at once where it can be granted.
    ///
    /// # Errors
    /// An unknown session, other operations than block, consume and exists, a passed deadline, a full queue.
    pub fn acquire(&mut self, now: Timestamp, request: AcquireRequest) -> Result<WaiterId, PoolError> {
        self.advance(now);
        self.enqueue(request, "")
    }

    /// Takes a waiter out of the queue.
    ///
    /// # Errors
    /// A waiter that has been answered already.
    pub fn cancel(&mut self, now: Timestamp, id: WaiterId) -> Result<(), PoolError> {
        self.advance(now);
        self.queue.get(id).ok_or(PoolError::UnknownWaiter { waiter: id })?;
        self.refuse(id, Refusal::Cancelled);
        self.schedule();
        Ok(())
    }

    /// Undoes an acquire by its request id: takes it out of the queue, or ends the lease that it was granted. False when
    /// there is nothing to undo.
    ///
    /// # Errors
    /// An acquire of another session.
    pub fn withdraw(&mut self, now: Timestamp, caller: &SessionId, request_id: &str) -> Result<bool, PoolError> {
        self.advance(now);
        match self.memory.reply(request_id) {
            Some(Reply::Queued(id)) => {
                let Some(waiter) = self.queue.get(id) else { return Ok(false) };
                check_owner(|| id.to_string(), &waiter.request.session, caller)?;
                self.refuse(id, Refusal::Cancelled);
            }
            Some(Reply::Granted(lease)) => {
                let Some(record) = self.leases.get(&lease.id) else { return Ok(false) };
                check_owner(|| lease.id.to_string(), &record.session, caller)?;
                self.end_lease(lease.id, EndReason::Asked);
            }
            _ => return Ok(false),
        }
        self.schedule();
        Ok(true)
    }

    /// Ends a lease. `None` as session may release anything.
    ///
    /// # Errors
    /// An unknown or ended lease, or one of another session.
    pub fn release(&mut self, now: Timestamp, session: Option<&SessionId>, id: LeaseId) -> Result<(), PoolError> {
        self.advance(now);
        let record = self.leases.get(&id).ok_or(PoolError::UnknownLease { lease: id })?;
        if let Some(caller) = session {
            check_owner(|| id.to_string(), &record.session, caller)?;
        }
        self.end_lease(id, EndReason::Asked);
        self.schedule();
        Ok(())
    }

    /// The session's task is over: what it consumed of renewable resources returns.
    ///
    /// # Errors
    /// An unknown or expired session.
    pub fn end_task(&mut self, now: Timestamp, session: &SessionId) -> Result<(), PoolError> {
        self.advance(now);
        self.session(session)?;
        self.return_consumed(session);
        self.schedule();
        Ok(())
    }

    /// How many units of what fits exist and are not consumed, held or not (the paper's `exists`).
    pub fn exists(&self, requirement: &Requirement) -> u64 {
        self.resources.quantity(requirement)
    }

    /// The ids of what fits a requirement, in order.
    pub fn fitting(&self, requirement: &Requirement) -> Vec<String> {
        self.resources.fitting(requirement).map(|(id, _)| id.to_owned()).collect()
    }

    /// One resource.
    pub fn get(&self, id: &str) -> Option<ResourceView> {
        self.resources.get(id).map(|resource| resource.view(id, &self.leases))
    }

    /// Every resource, in the order of ids.
    pub fn list(&self) -> Vec<ResourceView> {
        self.resources.iter().map(|(id, resource)| resource.view(id, &self.leases)).collect()
    }

    /// Every live lease, in the order of ids.
    pub fn leases(&self) -> Vec<LeaseView> {
        self.leases.iter().map(|(id, record)| record.view(*id)).collect()
    }

    /// The lease that was granted last, living or not; ids grow.
    pub fn youngest_lease(&self) -> LeaseId {
        LeaseId(self.next_lease)
    }

    /// Every session, in the order of ids.
    pub fn sessions(&self) -> Vec<SessionView> {
        self.sessions.iter().map(|(id, session)| session.view(id)).collect()
    }

    /// The queue, in the order in which it is served.
    pub fn waiters(&self) -> Vec<(WaiterId, AcquireRequest)> {
        self.queue.iter().map(|(id, waiter)| (id, waiter.request.clone())).collect()
    }

    /// How many events there were so far; the next one has this revision plus one.
    pub fn revision(&self) -> Revision {
        self.revision
    }

    /// What happened since the last call, in order.
    pub fn take_notices(&mut self) -> Vec<Notice> {
        std::mem::take(&mut self.notices)
    }

    fn perform(&mut self, now: Timestamp, request_id: &str, request: Request) -> Result<Reply, PoolError> {
        Ok(match request {
            Request::Create { session, spec } => Reply::Created(self.create(now, session.as_ref(), spec)?),
            Request::Delete { session, id } => self.delete(now, session.as_ref(), &id).map(|()| Reply::Done)?,
            Request::DeleteUnits { session, requirement } => {
                Reply::Touched(self.delete_units(now, &session, &requirement)?)
            }
            Request::Consume { session, requirement } => Reply::Touched(self.consume(now, &session, &requirement)?),
            Request::Operate { session, operations } => Reply::Operated(self.operate(now, &session, &operations)?),
            Request::Acquire(request) => Reply::Queued(self.enqueue(request, request_id)?),
            Request::Release { session, lease } => self.release(now, session.as_ref(), lease).map(|()| Reply::Done)?,
            Request::EndTask { session } => self.end_task(now, &session).map(|()| Reply::Done)?,
        })
    }

    fn enqueue(&mut self, request: AcquireRequest, request_id: &str) -> Result<WaiterId, PoolError> {
        use ResourceOperation::{Block, Consume, Exists};
        let session = self.session(&request.session)?;
        if session.waiters.len() >= self.limits.waiters_per_session {
            return Err(PoolError::TooMany { what: "waiters of one session", limit: self.limits.waiters_per_session });
        }
        if self.queue.len() >= self.limits.waiters {
            return Err(PoolError::TooMany { what: "waiters", limit: self.limits.waiters });
        }
        self.check_requirements(&request.requirements, &[Block, Consume, Exists])?;
        if request.purpose.chars().count() > self.limits.name_length {
            return Err(malformed("purpose", &format!("at most {} characters", self.limits.name_length)));
        }
        if request.deadline.is_some_and(|deadline| deadline <= self.now) {
            return Err(malformed("deadline", "it lies in the future"));
        }
        self.next_waiter += 1;
        let id = WaiterId(self.next_waiter);
        if let Some(deadline) = request.deadline {
            self.timers.insert((deadline, Timer::Waiter(id)));
        }
        if let Some(session) = self.sessions.get_mut(&request.session) {
            session.waiters.insert(id);
        }
        // Nothing became free: only the new one can be served, and only if there is enough for it beside what is held.
        let available = Available::Free(&Units::new());
        let may_be_served = Assignment::of(&self.resources, available, &request.requirements).is_complete();
        self.queue.insert(id, Waiter { request, request_id: request_id.to_owned() });
        if may_be_served {
            self.schedule();
        }
        Ok(id)
    }

    pub(crate) fn publish(&mut self, change: Change) {
        self.revision.0 += 1;
        self.notices.push(Notice::Event(WatchEvent { revision: self.revision, change }));
    }

    pub(crate) fn refuse(&mut self, id: WaiterId, refusal: Refusal) {
        let Some(waiter) = self.queue.remove(id) else { return };
        if let Some(deadline) = waiter.request.deadline {
            self.timers.remove(&(deadline, Timer::Waiter(id)));
        }
        if let Some(session) = self.sessions.get_mut(&waiter.request.session) {
            session.waiters.remove(&id);
        }
        self.memory.forget(&waiter.request_id);
        self.notices.push(Notice::Refused { waiter: id, refusal });
    }

    pub(crate) fn end_lease(&mut self, id: LeaseId, reason: EndReason) {
        let Some(record) = self.leases.remove(&id) else { return };
        if let Some(expires) = record.expires {
            self.timers.remove(&(expires, Timer::Lease(id)));
        }
        for resource in &record.resources {
            if let Some(resource) = self.resources.get_mut(resource) {
                resource.holders.remove(&id);
            }
        }
        if let Some(session) = self.sessions.get_mut(&record.session) {
            session.leases.remove(&id);
        }
        let LeaseRecord { token, session, resources, .. } = record;
        let resources = resources.iter().filter_map(|id| self.get(id)).collect();
        self.publish(Change::LeaseEnded { lease: id, token, session, resources, reason });
    }

    pub(crate) fn end_session(&mut self, id: &SessionId, reason: EndReason) {
        let Some(session) = self.sessions.get(id).cloned() else { return };
        for waiter in session.waiters {
            self.refuse(waiter, Refusal::SessionEnded);
        }
        for lease in session.leases {
            self.end_lease(lease, reason);
        }
        self.return_consumed(id);
        for resource in session.provides {
            self.remove_resource(&resource, reason);
        }
        self.timers.remove(&(session.expires, Timer::Session(id.clone())));
        self.sessions.remove(id);
    }

    /// Books units as consumed and tells watchers.
    pub(crate) fn take_consumed(&mut self, id: &SessionId, taken: Units) -> Vec<String> {
        for (resource_id, units) in &taken {
            let Some(resource) = self.resources.get_mut(resource_id) else { continue };
            if resource.spec.renewable {
                *resource.consumers.entry(id.clone()).or_insert(0) += units;
                if let Some(session) = self.sessions.get_mut(id) {
                    session.consumed.insert(resource_id.clone());
                }
            } else {
                resource.spent += units;
            }
            let view = resource.view(resource_id, &self.leases);
            self.publish(Change::ResourceUpdated(view));
        }
        taken.into_keys().collect()
    }

    fn return_consumed(&mut self, id: &SessionId) {
        let Some(session) = self.sessions.get_mut(id) else { return };
        for resource_id in std::mem::take(&mut session.consumed) {
            if let Some(resource) = self.resources.get_mut(&resource_id) {
                resource.consumers.remove(id);
                let view = resource.view(&resource_id, &self.leases);
                self.publish(Change::ResourceUpdated(view));
            }
        }
    }

    fn remove_resource(&mut self, id: &str, reason: EndReason) {
        let Some(view) = self.get(id) else { return };
        let Some(resource) = self.resources.remove(id) else { return };
        if let Some(owner) = resource.owner.and_then(|owner| self.sessions.get_mut(&owner)) {
            owner.provides.remove(id);
        }
        for session in resource.consumers.keys() {
            if let Some(session) = self.sessions.get_mut(session) {
                session.consumed.remove(id);
            }
        }
        for lease in resource.holders.into_keys() {
            if let Some(record) = self.leases.get_mut(&lease) {
                record.resources.retain(|held| held != id);
                let (token, session) = (record.token, record.session.clone());
                self.publish(Change::ResourceLost { lease, token, session, resource: view.clone() });
            }
        }
        self.publish(Change::ResourceDeleted { resource: view, reason });
    }

    /// Takes free units away for good; a resource without units left vanishes.
    fn take_away(&mut self, operation: &Requirement) -> Result<Vec<String>, PoolError> {
        let fitting: Vec<(String, u32)> =
            self.resources.fitting(operation).map(|(id, resource)| (id.to_owned(), resource.free())).collect();
        let found: u64 = fitting.iter().map(|(_, free)| u64::from(*free)).sum();
        if found < u64::from(operation.count) {
            return Err(PoolError::NotEnough { wanted: operation.to_string(), found });
        }
        let mut wanted = operation.count;
        let mut touched = Vec::new();
        for (id, free) in fitting {
            let units = free.min(wanted);
            wanted -= units;
            let Some(resource) = self.resources.get_mut(&id).filter(|_| units > 0) else { continue };
            resource.spec.capacity -= units;
            if resource.spec.capacity == 0 {
                self.remove_resource(&id, EndReason::UsedUp);
            } else {
                let view = resource.view(&id, &self.leases);
                self.publish(Change::ResourceUpdated(view));
            }
            touched.push(id);
        }
        Ok(touched)
    }

    fn new_resource_id(&mut self, kind: &str) -> String {
        loop {
            self.next_resource += 1;
            let id = format!("{kind}-{}", self.next_resource);
            if self.resources.get(&id).is_none() {
                return id;
            }
        }
    }

    fn session(&self, id: &SessionId) -> Result<&Session, PoolError> {
        self.sessions.get(id).ok_or_else(|| PoolError::UnknownSession { session: id.clone() })
    }

    fn check_spec(&self, spec: &ResourceSpec) -> Result<(), PoolError> {
        self.check_name("kind", &spec.kind)?;
        if let Some(id) = &spec.id {
            self.check_name("resource id", id)?;
        }
        if spec.capacity == 0 {
            return Err(malformed(&format!("capacity 0 of {}", spec.kind), "a resource has at least one unit"));
        }
        self.check_attributes(spec.attributes.keys())
    }

    fn check_requirements(&self, requirements: &[Requirement], allowed: &[ResourceOperation]) -> Result<(), PoolError> {
        if requirements.len() > self.limits.requirements {
            let rule = format!("at most {}", self.limits.requirements);
            return Err(malformed(&format!("{} requirements", requirements.len()), &rule));
        }
        for requirement in requirements {
            if !allowed.contains(&requirement.operation) {
                let names: Vec<String> = allowed.iter().map(ToString::to_string).collect();
                return Err(malformed(&requirement.to_string(), &format!("only {} here", names.join(", "))));
            }
            self.check_name("kind", &requirement.kind)?;
            if requirement.count == 0 || requirement.count > self.limits.units {
                return Err(malformed(&requirement.to_string(), &format!("1 to {} units", self.limits.units)));
            }
            self.check_attributes(requirement.attributes.keys())?;
        }
        Ok(())
    }

    fn check_attributes<'a>(&self, mut names: impl ExactSizeIterator<Item = &'a String>) -> Result<(), PoolError> {
        if names.len() > self.limits.attributes {
            let rule = format!("at most {}", self.limits.attributes);
            return Err(malformed(&format!("{} attributes", names.len()), &rule));
        }
        names.try_for_each(|name| self.check_name("attribute name", name))
    }

    fn check_name(&self, what: &str, name: &str) -> Result<(), PoolError> {
        if name.is_empty() || name.chars().count() > self.limits.name_length || name.chars().any(char::is_control) {
            let rule = format!("1 to {} characters, none of them a control character", self.limits.name_length);
            let shown: String = name.chars().take(self.limits.name_length).flat_map(char::escape_debug).collect();
            return Err(malformed(&format!("{what} `{shown}`"), &rule));
        }
        Ok(())
    }
}

fn check_owner(what: impl FnOnce() -> String, owner: &SessionId, caller: &SessionId) -> Result<(), PoolError> {
    if owner == caller {
        return Ok(());
    }
    Err(PoolError::NotYours { what: what(), owner: owner.clone(), caller: caller.clone() })
}

fn malformed(what: &str, rule: &str) -> PoolError {
    PoolError::Malformed { what: what.to_owned(), rule: rule.to_owned() }
}
