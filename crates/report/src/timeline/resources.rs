//! Holders and queues in a run: which instance holds which resource since when, and which has requested what and waits behind whom.
//!
//! It knows only what the log says: the leases of this run, and the number of resources per kind if the log gives it at the start. For
//! resources that other runs hold, ask the resource manager (`ratn resource list`).

use super::instance::{Behind, Wait};
use ratn_model::id::{InstanceId, LeaseId};
use ratn_model::program::WORLD_MODEL;
use ratn_model::resource::{Lease, LeasedResource, Quantity, Requirement, ResourceOperation};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;

/// Maximum number of holders per kind that are considered for a wait: those that released last, and the first of those that still hold.
const MOST_BEHIND: usize = 64;

/// A resource held by an instance.
#[derive(Debug, Clone, PartialEq)]
pub struct Holding {
    /// The resource's id.
    pub resource: Arc<str>,
    /// Its kind.
    pub kind: Arc<str>,
    /// The kinds that its kind is one of.
    superclasses: Arc<[String]>,
    /// The instance that holds it.
    pub instance: InstanceId,
    /// The path of that instance.
    pub holder: Arc<str>,
    /// Start.
    pub from_s: f64,
    /// End; infinite while it is held.
    pub to_s: f64,
}

impl Holding {
    /// Whether its kind is `kind`, or a subclass of that.
    pub fn is_a(&self, kind: &str) -> bool {
        *self.kind == *kind || self.superclasses.iter().any(|superclass| superclass == kind)
    }
}

/// A request without an answer.
#[derive(Debug, Clone, PartialEq)]
pub struct Asked {
    /// The instance.
    pub instance: InstanceId,
    /// Time of the request.
    pub from_s: f64,
    /// Larger priorities are served first.
    pub priority: i64,
    /// The kinds requested, without room for projections.
    pub kinds: Vec<String>,
}

/// The holders of one kind, and those that released last.
#[derive(Debug, Clone, Default)]
struct History {
    held: BTreeMap<(InstanceId, Arc<str>), Holding>,
    released: VecDeque<Holding>,
}

impl History {
    fn takes(&mut self, holding: Holding) {
        self.held.insert((holding.instance, holding.resource.clone()), holding);
    }

    fn releases(&mut self, over: &Holding) {
        let Some(one) = self.held.remove(&(over.instance, over.resource.clone())) else { return };
        if self.released.len() == MOST_BEHIND {
            self.released.pop_front();
        }
        self.released.push_back(Holding { to_s: over.to_s, ..one });
    }

    fn is_a(&self, kind: &str) -> bool {
        self.looked_at().next().is_some_and(|(one, _)| one.is_a(kind))
    }

    /// The holdings to consider, each with whether it was released.
    fn looked_at(&self) -> impl Iterator<Item = (&Holding, bool)> {
        let held = self.held.values().take(MOST_BEHIND).map(|one| (one, false));
        self.released.iter().map(|one| (one, true)).chain(held)
    }
}

/// Holders and queues of a run.
#[derive(Debug, Clone, Default)]
pub struct Resources {
    capacity: BTreeMap<String, Quantity>,
    /// Every resource that was ever held, by id.
    seen: BTreeMap<Arc<str>, Holding>,
    held: BTreeMap<LeaseId, Vec<Holding>>,
    /// By kind.
    history: BTreeMap<Arc<str>, History>,
    queue: BTreeMap<InstanceId, Asked>,
}

impl Resources {
    pub(super) fn begin(&mut self, capacity: &BTreeMap<String, Quantity>) {
        self.capacity.clone_from(capacity);
    }

    /// The present holdings, without room for projections.
    pub fn held(&self) -> impl Iterator<Item = &Holding> {
        self.held.values().flatten().filter(|holding| *holding.kind != *WORLD_MODEL)
    }

    /// The requests without an answer, in the order in which requests for the same resource are served.
    pub fn queue(&self) -> Vec<&Asked> {
        let mut queue: Vec<&Asked> = self.queue.values().collect();
        queue.sort_by(|a, b| {
            b.priority.cmp(&a.priority).then(a.from_s.total_cmp(&b.from_s)).then(a.instance.cmp(&b.instance))
        });
        queue
    }

    /// The request of an instance, if it has no answer.
    pub fn asked(&self, instance: InstanceId) -> Option<&Asked> {
        self.queue.get(&instance)
    }

    /// Ids and kinds of all resources held so far, without room for projections.
    pub fn known(&self) -> impl Iterator<Item = (&str, &str)> {
        self.seen.iter().filter(|(_, one)| *one.kind != *WORLD_MODEL).map(|(id, one)| (&**id, &*one.kind))
    }

    /// Number of resources of a kind: as given at the start, or more if more were held.
    pub fn total(&self, kind: &str) -> usize {
        let seen = self.seen.values().filter(|one| one.is_a(kind)).count();
        seen.max(self.capacity.get(kind).map_or(0, |count| count.units() as usize))
    }

    pub(super) fn asks(&mut self, instance: InstanceId, at_s: f64, requirements: &[Requirement], priority: i64) {
        let mut kinds = BTreeSet::new();
        for one in requirements {
            let takes = matches!(one.operation, ResourceOperation::Block | ResourceOperation::Consume);
            if takes && one.kind != WORLD_MODEL {
                kinds.insert(one.kind.clone());
            }
        }
        let kinds: Vec<String> = kinds.into_iter().collect();
        self.queue.insert(instance, Asked { instance, from_s: at_s, priority, kinds });
    }

    /// Withdraws an instance's request.
    pub(super) fn withdraws(&mut self, instance: InstanceId) {
        self.queue.remove(&instance);
    }

    /// Records a grant. Earlier holdings under the same lease end.
    pub(super) fn grants(
        &mut self,
        instance: InstanceId,
        holder: &Arc<str>,
        at_s: f64,
        lease: &Lease,
    ) -> (Option<Wait>, Vec<Holding>) {
        let over = self.releases(lease.id, at_s);
        let wait = self.queue.remove(&instance).map(|asked| self.wait(asked, at_s, &lease.resources));
        let holdings: Vec<Holding> =
            lease.resources.iter().map(|one| self.held_by(one, instance, holder, at_s)).collect();
        for holding in &holdings {
            self.history.entry(holding.kind.clone()).or_default().takes(holding.clone());
        }
        self.held.insert(lease.id, holdings);
        (wait, over)
    }

    /// The holdings under a lease.
    pub(super) fn held_under(&self, lease: LeaseId) -> &[Holding] {
        self.held.get(&lease).map_or(&[], Vec::as_slice)
    }

    /// Ends the holdings under a lease, and returns them.
    pub(super) fn releases(&mut self, lease: LeaseId, at_s: f64) -> Vec<Holding> {
        let mut over = self.held.remove(&lease).unwrap_or_default();
        for holding in &mut over {
            holding.to_s = at_s;
            if let Some(history) = self.history.get_mut(&holding.kind) {
                history.releases(holding);
            }
        }
        over
    }

    /// Ends and returns all holdings at the end of the log.
    pub(super) fn close(&mut self, at_s: f64) -> Vec<Holding> {
        let leases: Vec<LeaseId> = self.held.keys().copied().collect();
        leases.into_iter().flat_map(|lease| self.releases(lease, at_s)).collect()
    }

    /// The wait of an instance that got its resources, with the holders it waited for, the longest first.
    fn wait(&self, asked: Asked, at_s: f64, granted: &[LeasedResource]) -> Wait {
        let wanted = self.history.values().filter(|history| asked.kinds.iter().any(|kind| history.is_a(kind)));
        let behind = wanted.flat_map(History::looked_at).map(|(one, released)| Behind {
            instance: one.instance,
            holder: one.holder.clone(),
            resource: one.resource.clone(),
            from_s: one.from_s,
            to_s: one.to_s.min(at_s),
            released,
        });
        // A holder that released before the request, or at that moment, delayed nobody.
        let mut behind: Vec<Behind> = behind.filter(|one| one.to_s > asked.from_s).collect();
        let overlap_s = |one: &Behind| one.to_s - one.from_s.max(asked.from_s);
        behind.sort_by(|a, b| overlap_s(b).total_cmp(&overlap_s(a)).then(a.instance.cmp(&b.instance)));
        behind.truncate(MOST_BEHIND);
        Wait { from_s: asked.from_s, to_s: at_s, kinds: asked.kinds, resources: named(granted.iter()), behind }
    }

    fn held_by(&mut self, one: &LeasedResource, instance: InstanceId, holder: &Arc<str>, at_s: f64) -> Holding {
        let (from_s, to_s, holder) = (at_s, f64::INFINITY, holder.clone());
        if let Some(known) = self.seen.get(one.id.as_str()) {
            return Holding { instance, holder, from_s, to_s, ..known.clone() };
        }
        let (resource, kind) = (Arc::from(one.id.as_str()), Arc::from(one.kind.as_str()));
        let holding =
            Holding { resource, kind, superclasses: one.superclasses.clone().into(), instance, holder, from_s, to_s };
        self.seen.insert(holding.resource.clone(), holding.clone());
        holding
    }
}

/// Ids of resources, without room for projections, which is not a place of work.
pub(super) fn named<'a>(resources: impl Iterator<Item = &'a LeasedResource>) -> Vec<String> {
    resources.filter(|one| one.kind != WORLD_MODEL).map(|one| one.id.clone()).collect()
}
