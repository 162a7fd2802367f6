//! The leases on one provider's resources, as reported by the resource manager. Pure: takes the updates of a watch, checks claims.
//!
//! ```text
//! unheard ─ snapshot ─→ heard ─ watch breaks ─→ interrupted ─ too long ─→ unheard
//!                         └──────── snapshot ────────┘
//! ```
//! While the watch is interrupted, no claim is confirmed, so that no goal begins; and no lease counts as ended, so that goals under way go
//! on. Lease ids grow with the grants: an id beyond every known one may have been granted a moment ago; any other id that holds nothing has
//! ended or never existed.
//!
//! A process that finds its session living took it over from another process. Leases up to the youngest of its first snapshot may be that
//! process's: nobody knows which goals it began under them, so they are refuted for good.

use super::standstill::{Ending, Endings};
use ratn_model::id::{FencingToken, LeaseId};
use ratn_model::resource::ResourceClass;
use ratn_proto::types::{Resource, ResourceEvent, ResourceEventKind, ResourceUpdate};
use std::collections::{BTreeMap, BTreeSet};

/// Why no claim is confirmed before the first update of the manager.
const NEVER_HEARD: &str = "the resource manager has not been heard yet";

/// Why no claim is confirmed until an interrupted watch resumes.
const INTERRUPTED: &str = "the watch of leases was interrupted a moment ago";

/// A goal's claim to hold a lease.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Claim<'a> {
    /// The resource that is to perform the goal.
    pub resource: &'a str,
    /// The lease.
    pub lease: LeaseId,
    /// Its fencing token.
    pub token: FencingToken,
    /// The session that holds the lease; empty if the goal does not name it.
    pub session: &'a str,
}

/// The result of checking a claim.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ClaimStatus {
    /// The claim is true.
    Confirmed,
    /// The lease is unknown: it may have been granted a moment ago.
    NotHeardOf {
        /// The watch is running, so that the grant will be reported if there was one.
        listening: bool,
    },
    /// The claim is false, and why.
    Refuted(String),
    /// The manager is not heard, and why: nothing is known.
    Unheard(String),
    /// The claim is true, but the driver has not reported yet that no motion of an earlier process goes on.
    NotAtRest,
}

/// A resource that a lease does not hold any more.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EndedHolding {
    /// The resource.
    pub resource: String,
    /// The lease.
    pub lease: LeaseId,
    /// Its fencing token: a manager that lost its state may use an id again.
    pub token: FencingToken,
    /// The reason, for people.
    pub reason: String,
}

/// The holders of the resources.
#[derive(Debug)]
pub struct Holdings {
    by_resource: BTreeMap<String, BTreeMap<LeaseId, Holder>>,
    /// Ended leases for which this provider has to confirm standstill.
    endings: Endings,
    /// The largest lease id seen.
    youngest: LeaseId,
    /// The session that provides the resources: resources that another session provides under the same ids are not this provider's. `None`
    /// before a manager is followed, as in tests that send all updates themselves.
    owner: Option<String>,
    /// What was granted before this process.
    before: Before,
    contact: Contact,
}

/// Which leases may be those of a process before this one.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
enum Before {
    /// None: the session is this process's.
    #[default]
    Nothing,
    /// Those of the first snapshot, which has not come.
    FirstSnapshot,
    /// All up to this one.
    UpTo(LeaseId),
}

#[derive(Debug, Clone, PartialEq, Eq)]
struct Holder {
    token: FencingToken,
    session: String,
    /// The caller who opened the session; empty if the manager does not know.
    opened_by: String,
}

#[derive(Debug, PartialEq, Eq)]
enum Contact {
    Heard,
    Interrupted,
    Unheard(String),
}

impl Default for Holdings {
    fn default() -> Holdings {
        Holdings {
            by_resource: BTreeMap::new(),
            endings: Endings::default(),
            youngest: LeaseId(0),
            owner: None,
            before: Before::default(),
            contact: Contact::Unheard(NEVER_HEARD.to_owned()),
        }
    }
}

impl Holdings {
    /// Checks a claim against the manager's updates.
    pub fn check(&self, claim: &Claim<'_>) -> ClaimStatus {
        if let Contact::Unheard(reason) = &self.contact {
            return ClaimStatus::Unheard(reason.clone());
        }
        let Claim { resource, lease, token, session } = *claim;
        if matches!(self.before, Before::UpTo(youngest) if lease <= youngest) {
            return ClaimStatus::Refuted(format!(
                "{lease} of {resource} was granted before the provider's process was started again, which does not know what was begun under it: \
                 acquire it anew"
            ));
        }
        let holders = self.by_resource.get(resource);
        match holders.and_then(|holders| holders.get(&lease)) {
            Some(holder) if holder.token != token => ClaimStatus::Refuted(format!(
                "{lease} of {resource} has {}, and the goal says {token}: send the lease as it was granted",
                holder.token
            )),
            Some(holder) if !session.is_empty() && holder.session != session => ClaimStatus::Refuted(format!(
                "{lease} of {resource} is held by session `{}`, and the goal says `{session}`: acquire a lease of your own",
                holder.session
            )),
            // The lease may have ended since.
            Some(_) if self.contact == Contact::Interrupted => ClaimStatus::Unheard(INTERRUPTED.to_owned()),
            Some(_) => ClaimStatus::Confirmed,
            None if lease > self.youngest => ClaimStatus::NotHeardOf { listening: self.contact == Contact::Heard },
            None => ClaimStatus::Refuted(self.not_held(claim)),
        }
    }

    /// The caller who opened the session of a lease that holds a resource; empty if unknown.
    pub fn opened_by(&self, resource: &str, lease: LeaseId) -> &str {
        let holder = self.by_resource.get(resource).and_then(|holders| holders.get(&lease));
        holder.map_or("", |holder| &holder.opened_by)
    }

    /// The reason why a lease that does not hold the resource is refused.
    pub fn not_held(&self, claim: &Claim<'_>) -> String {
        let Claim { resource, lease, token, .. } = claim;
        let holders = self.by_resource.get(*resource).into_iter().flatten();
        let held = match holders.map(|(lease, holder)| format!("{lease} ({})", holder.token)).next_back() {
            Some(holder) => format!("{holder} holds it"),
            None => "no lease holds it".to_owned(),
        };
        format!(
            "{lease} ({token}) of {resource} is over, or never was one: {held}, says the resource manager; acquire it anew"
        )
    }

    /// Begins a new watch of resources that the session `owner` provides. `found` says that it is the session that lived when this process opened
    /// it: what was granted in another one is this process's.
    pub fn begin(&mut self, owner: &str, found: bool) {
        let is_first = self.owner.replace(owner.to_owned()).is_none();
        match found {
            true if is_first => self.before = Before::FirstSnapshot,
            true => {}
            false => self.before = Before::Nothing,
        }
    }

    /// Applies an update of the watch; returns the holdings that ended by it.
    pub fn tell(&mut self, update: &ResourceUpdate) -> Vec<EndedHolding> {
        self.endings.tell(update, self.owner.as_deref());
        match update {
            ResourceUpdate::Snapshot { resources, youngest, .. } => {
                let gone: Vec<String> = self.by_resource.keys().cloned().collect();
                let gone = gone.iter().filter(|id| resources.iter().all(|resource| resource.id != **id));
                let reason = "it ended while the resource manager was not heard";
                let mut ended: Vec<EndedHolding> = gone.flat_map(|id| self.set(id, BTreeMap::new(), reason)).collect();
                for resource in resources {
                    let holders = self.holders(resource);
                    ended.extend(self.set(&resource.id, holders, reason));
                }
                self.youngest = *youngest;
                if self.before == Before::FirstSnapshot {
                    self.before = Before::UpTo(*youngest);
                }
                self.contact = Contact::Heard;
                ended
            }
            ResourceUpdate::Event(event) => self.happened(event),
        }
    }

    fn happened(&mut self, event: &ResourceEvent) -> Vec<EndedHolding> {
        let or = |reason: &'static str| if event.reason.is_empty() { reason } else { event.reason.as_str() };
        if let Some((lease, _)) = event.lease {
            // A lease of several resources is reported one resource at a time: the reports for the others are still on their way.
            let known = if event.kind == ResourceEventKind::Leased { lease.0.saturating_sub(1) } else { lease.0 };
            self.youngest = self.youngest.max(LeaseId(known));
        }
        match event.kind {
            ResourceEventKind::Deleted => self.set(&event.resource.id, BTreeMap::new(), or("its resource is gone")),
            _ => {
                let holders = self.holders(&event.resource);
                self.set(&event.resource.id, holders, or("it was released"))
            }
        }
    }

    /// The watch broke: leases still count as held until the next update, and no claim is confirmed.
    pub fn interrupted(&mut self) {
        if self.contact == Contact::Heard {
            self.contact = Contact::Interrupted;
        }
    }

    /// Every lease may have ended; the next snapshot shows which.
    pub fn unheard(&mut self, reason: &str) {
        self.endings.clear();
        self.contact = Contact::Unheard(reason.to_owned());
    }

    /// Forgets everything: the next snapshot is not compared with earlier leases.
    pub fn lost(&mut self, reason: &str) {
        self.unheard(reason);
        self.by_resource.clear();
    }

    /// Ended leases whose standstill the manager waits for this provider to confirm.
    pub(super) fn endings(&self) -> BTreeSet<Ending> {
        self.endings.all()
    }

    /// Whether the manager is heard, or was until the watch was interrupted.
    pub fn is_heard(&self) -> bool {
        !matches!(self.contact, Contact::Unheard(_))
    }

    fn holders(&self, resource: &Resource) -> BTreeMap<LeaseId, Holder> {
        let is_anothers = self.owner.as_ref().is_some_and(|owner| *owner != resource.session);
        // The resource of a task is no provider's, whatever its session is called: a manager that lost its state gives that id to anybody.
        if is_anothers || resource.class == ResourceClass::Task {
            return BTreeMap::new();
        }
        let holder = |holding: &ratn_proto::types::Holding| {
            let (session, opened_by) = (holding.session.clone(), holding.opened_by.clone());
            (holding.lease, Holder { token: holding.token, session, opened_by })
        };
        resource.holdings.iter().map(holder).collect()
    }

    fn set(&mut self, resource: &str, holders: BTreeMap<LeaseId, Holder>, reason: &str) -> Vec<EndedHolding> {
        let before = self.by_resource.insert(resource.to_owned(), holders).unwrap_or_default();
        let now = &self.by_resource[resource];
        // The same id with another token, or of another session, is another lease.
        let ended = before.into_iter().filter(|(lease, holder)| now.get(lease) != Some(holder));
        let ended = ended.map(|(lease, Holder { token, .. })| EndedHolding {
            resource: resource.to_owned(),
            lease,
            token,
            reason: reason.to_owned(),
        });
        let ended = ended.collect();
        if now.is_empty() {
            self.by_resource.remove(resource);
        }
        ended
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ratn_model::id::Revision;
    use ratn_model::resource::Quantity;
    use ratn_proto::types::Holding;

    fn arm(leases: &[u64]) -> Resource {
        let holding = |&lease: &u64| Holding {
            lease: LeaseId(lease),
            token: FencingToken(10 * lease),
            units: Quantity::ONE,
            session: format!("s{lease}"),
            holder: String::new(),
            opened_by: String::new(),
        };
        let mut arm = Resource::new("arm", ResourceClass::Module, "Arm");
        (arm.session, arm.holdings) = ("cell".to_owned(), leases.iter().map(holding).collect());
        arm
    }

    fn snapshot(resources: &[Resource], youngest: u64) -> ResourceUpdate {
        let (revision, youngest) = (Revision(1), LeaseId(youngest));
        ResourceUpdate::Snapshot { revision, resources: resources.to_vec(), youngest }
    }

    fn event(kind: ResourceEventKind, resource: Resource, lease: u64) -> ResourceUpdate {
        ResourceUpdate::Event(ResourceEvent {
            revision: Revision(2),
            kind,
            resource,
            lease: (lease > 0).then_some((LeaseId(lease), FencingToken(10 * lease))),
            reason: String::new(),
            part: 0,
        })
    }

    fn claim(lease: u64) -> Claim<'static> {
        Claim { resource: "arm", lease: LeaseId(lease), token: FencingToken(10 * lease), session: "" }
    }

    fn heard(leases: &[u64], youngest: u64) -> Holdings {
        let mut holdings = Holdings::default();
        assert_eq!(holdings.tell(&snapshot(&[arm(leases)], youngest)), []);
        holdings
    }

    fn refuted(holdings: &Holdings, claim: Claim<'_>, why: &str) {
        let standing = holdings.check(&claim);
        assert!(matches!(&standing, ClaimStatus::Refuted(reason) if reason.contains(why)), "{standing:?}");
    }

    #[test]
    fn only_what_the_manager_says_is_confirmed() {
        let holdings = heard(&[7], 9);
        assert_eq!(holdings.check(&claim(7)), ClaimStatus::Confirmed);
        assert_eq!(holdings.check(&Claim { session: "s7", ..claim(7) }), ClaimStatus::Confirmed);
        refuted(&holdings, Claim { token: FencingToken(u64::MAX), ..claim(7) }, "has token-70, and the goal says");
        refuted(&holdings, Claim { session: "s8", ..claim(7) }, "is held by session `s7`, and the goal says `s8`");
        refuted(&holdings, Claim { resource: "camera", ..claim(7) }, "no lease holds it");
        for over in [0, 6, 8, 9] {
            refuted(&holdings, claim(over), "lease-7 (token-70) holds it");
        }
        assert_eq!(holdings.check(&claim(10)), ClaimStatus::NotHeardOf { listening: true });
    }

    #[test]
    fn a_lease_is_confirmed_from_its_grant_to_its_end() {
        let mut holdings = heard(&[], 9);
        assert_eq!(holdings.tell(&event(ResourceEventKind::Leased, arm(&[12]), 12)), []);
        assert_eq!(holdings.check(&claim(12)), ClaimStatus::Confirmed);
        refuted(&holdings, claim(11), "is over");
        let ended = holdings.tell(&event(ResourceEventKind::Released, arm(&[]), 12));
        let reason = "it was released".to_owned();
        let (resource, lease, token) = ("arm".to_owned(), LeaseId(12), FencingToken(120));
        assert_eq!(ended, [EndedHolding { resource, lease, token, reason }]);
        refuted(&holdings, claim(12), "no lease holds it");
    }

    #[test]
    fn a_lease_of_several_resources_is_awaited_for_those_not_told_of_yet() {
        let mut holdings = heard(&[], 9);
        let camera = Resource { id: "camera".to_owned(), ..arm(&[12]) };
        holdings.tell(&event(ResourceEventKind::Leased, camera, 12));
        assert_eq!(holdings.check(&claim(12)), ClaimStatus::NotHeardOf { listening: true });
        holdings.tell(&event(ResourceEventKind::Leased, arm(&[12]), 12));
        assert_eq!(holdings.check(&claim(12)), ClaimStatus::Confirmed);
    }

    #[test]
    fn what_ended_unheard_ends_with_the_next_snapshot_and_a_resource_that_is_gone_ends_its_leases() {
        let mut holdings = heard(&[7], 7);
        let leases = |ended: Vec<EndedHolding>| ended.iter().map(|ended| ended.lease.0).collect::<Vec<_>>();
        assert_eq!(leases(holdings.tell(&snapshot(&[arm(&[8])], 8))), [7]);
        assert_eq!(leases(holdings.tell(&event(ResourceEventKind::Deleted, arm(&[8]), 0))), [8]);
        assert_eq!(leases(holdings.tell(&event(ResourceEventKind::Created, arm(&[]), 0))), [0; 0]);
        holdings.tell(&event(ResourceEventKind::Leased, arm(&[9]), 9));
        assert_eq!(leases(holdings.tell(&snapshot(&[], 9))), [9]);
    }

    #[test]
    fn while_the_watch_is_interrupted_nothing_is_confirmed_and_nothing_ends() {
        let mut holdings = Holdings::default();
        assert_eq!(holdings.check(&claim(7)), ClaimStatus::Unheard(NEVER_HEARD.to_owned()));
        holdings.interrupted();
        assert!(!holdings.is_heard());
        holdings.tell(&snapshot(&[arm(&[7])], 7));
        holdings.interrupted();
        assert_eq!(holdings.check(&claim(7)), ClaimStatus::Unheard(INTERRUPTED.to_owned()));
        assert_eq!(holdings.check(&claim(8)), ClaimStatus::NotHeardOf { listening: false });
        refuted(&holdings, claim(6), "is over");
        assert_eq!(holdings.tell(&snapshot(&[arm(&[7])], 7)), []);
        assert_eq!(holdings.check(&claim(7)), ClaimStatus::Confirmed);
        holdings.unheard("silence");
        assert_eq!(holdings.check(&claim(7)), ClaimStatus::Unheard("silence".to_owned()));
        let ended = holdings.tell(&snapshot(&[arm(&[8])], 8));
        assert_eq!(ended.iter().map(|ended| ended.lease).collect::<Vec<_>>(), [LeaseId(7)], "it ended meanwhile");
        holdings.tell(&snapshot(&[arm(&[7])], 8));
        holdings.lost("silence");
        assert_eq!(holdings.check(&claim(7)), ClaimStatus::Unheard("silence".to_owned()));
        holdings.tell(&snapshot(&[arm(&[7])], 7));
        assert_eq!(holdings.check(&claim(7)), ClaimStatus::Confirmed);
    }

    #[test]
    fn a_lease_of_the_same_id_with_another_token_or_session_is_another_one() {
        let ended = |change: fn(&mut Holding)| {
            let (mut holdings, mut again) = (heard(&[7], 9), arm(&[7]));
            change(&mut again.holdings[0]);
            let ended = holdings.tell(&snapshot(&[again], 7));
            assert_eq!(holdings.check(&claim(8)), ClaimStatus::NotHeardOf { listening: true }, "of the new count");
            ended.iter().map(|ended| (ended.lease.0, ended.token.0)).collect::<Vec<_>>()
        };
        assert_eq!(ended(|holding| holding.token = FencingToken(71)), [(7, 70)]);
        assert_eq!(ended(|holding| holding.session = "another".to_owned()), [(7, 70)]);
        assert_eq!(ended(|_| {}), []);
    }

    #[test]
    fn what_was_granted_before_this_process_is_refuted_only_as_long_as_its_session_lives() {
        let mut holdings = Holdings::default();
        holdings.begin("cell", true);
        holdings.tell(&snapshot(&[arm(&[7])], 9));
        refuted(&holdings, claim(7), "before the provider's process was started again");
        // Another watch of the same session.
        holdings.begin("cell", true);
        holdings.tell(&snapshot(&[arm(&[7])], 9));
        refuted(&holdings, claim(7), "before the provider's process was started again");
        // The manager has lost its state, and its clock was set back: it makes the session again, and grants begin below.
        holdings.begin("cell", false);
        holdings.tell(&snapshot(&[arm(&[3])], 3));
        assert_eq!(holdings.check(&claim(3)), ClaimStatus::Confirmed);
    }

    #[test]
    fn a_resource_that_another_session_provides_under_the_same_id_is_not_this_provider() {
        let mut holdings = Holdings::default();
        holdings.begin("another cell", false);
        holdings.tell(&snapshot(&[arm(&[7])], 7));
        refuted(&holdings, claim(7), "no lease holds it");
        holdings.begin("cell", true);
        holdings.tell(&snapshot(&[arm(&[8])], 8));
        assert_eq!(holdings.check(&claim(8)), ClaimStatus::Confirmed);
    }

    #[test]
    fn what_a_task_creates_under_the_id_of_this_provider_and_its_session_is_not_this_provider() {
        let mut holdings = Holdings::default();
        holdings.begin("cell", false);
        let of_class = |class| Resource { class, ..arm(&[7]) };
        holdings.tell(&snapshot(&[of_class(ResourceClass::Task)], 7));
        refuted(&holdings, claim(7), "no lease holds it");
        holdings.tell(&event(ResourceEventKind::Leased, of_class(ResourceClass::Task), 7));
        refuted(&holdings, claim(7), "no lease holds it");
        holdings.tell(&snapshot(&[of_class(ResourceClass::Process)], 7));
        assert_eq!(holdings.check(&claim(7)), ClaimStatus::Confirmed);
    }
}
