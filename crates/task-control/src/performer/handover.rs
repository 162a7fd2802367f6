//! Leases that go from one node to the next without the resource manager: if a goal ends well and the next node wants exactly what it had, a release
//! and an acquire would cost two calls and have the same result.
//!
//! The resource manager sees one lease that lives longer. So that others get their turn, the lease goes back after [`TURN`], and nothing is handed
//! over beside other runs, whose nodes may come first. Within the run the order is the resource manager's: the first of those that want any of its
//! resources takes the lease over. If that one waits at the manager already, its request is withdrawn ([`super::acquiring`]); if it wants something
//! else, too, nothing is handed over. What depends on the state of a resource (attributes, conditions, existence, consumption) is requested anew
//! every time.
//!
//! When a lease goes back, the manager grants one to the first waiting node, so that node is left to the manager. If another lease were handed to it
//! meanwhile, it would withdraw its request; the manager would grant the next node, which has a lease by then, too; and so on, with a resource that
//! nobody works with.

use super::waiting::Waiting;
use ratn_executive::protocol::{CERTAIN, Command, Event};
use ratn_model::id::{InstanceId, LeaseId};
use ratn_model::program::SUCCESS;
use ratn_model::resource::{Lease, Requirement, ResourceOperation};
use std::collections::BTreeMap;
use std::time::{Duration, Instant};

/// How long after its grant a lease may be handed over; somebody outside this run may wait so much longer.
const TURN: Duration = Duration::from_millis(100);

/// How long the manager's grant for a returned lease is expected: another client may have got it. For so long the first waiting node may be passed over.
const EXPECTED: Duration = TURN;

/// The leases of a run, with what was asked for.
#[derive(Debug, Default)]
pub(super) struct Leases {
    held: BTreeMap<LeaseId, Held>,
    /// Returned leases: what was requested for each, and when it went back. For each, the manager has a grant for the first that wants exactly the same.
    went_back: Vec<(Vec<Requirement>, Instant)>,
}

#[derive(Debug)]
struct Held {
    lease: Lease,
    requirements: Vec<Requirement>,
    granted: Instant,
    /// The instance that has it now,
    holder: InstanceId,
    /// and whether that instance asked for it speculatively.
    is_speculative: bool,
}

/// A lease to hand over.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Handover {
    pub(super) to: InstanceId,
    pub(super) lease: Lease,
    /// Whether that instance waits already; else it asks in this very step.
    pub(super) waits: bool,
}

impl Leases {
    /// A lease was granted or handed over; the time of a handed-over lease counts from its grant.
    pub(super) fn granted(&mut self, to: InstanceId, lease: &Lease, asked: (Vec<Requirement>, i64), now: Instant) {
        let (requirements, priority) = asked;
        let is_speculative = priority < CERTAIN;
        if !self.held.contains_key(&lease.id)
            && let Some(expected) = self.went_back.iter().position(|(returned, _)| *returned == requirements)
        {
            self.went_back.remove(expected);
        }
        let new = || Held { lease: lease.clone(), requirements, granted: now, holder: to, is_speculative };
        let held = self.held.entry(lease.id).or_insert_with(new);
        (held.holder, held.is_speculative) = (to, is_speculative);
    }

    /// Whether any lease was requested speculatively.
    pub(super) fn has_speculative(&self) -> bool {
        self.held.values().any(|held| held.is_speculative)
    }

    /// The holder of a lease that was requested speculatively.
    pub(super) fn speculative_holder(&self, lease: LeaseId) -> Option<InstanceId> {
        self.held.get(&lease).filter(|held| held.is_speculative).map(|held| held.holder)
    }

    /// A lease goes back.
    pub(super) fn given_back(&mut self, lease: LeaseId, now: Instant) {
        self.went_back.retain(|(_, at)| now.duration_since(*at) < EXPECTED);
        if let Some(held) = self.held.remove(&lease) {
            self.went_back.push((held.requirements, now));
        }
    }

    /// Number of expected grants by the manager for exactly these requirements, because such leases went back.
    fn expected(&self, requirements: &[Requirement], now: Instant) -> usize {
        let is_expected = |at: &Instant| now.duration_since(*at) < EXPECTED;
        self.went_back.iter().filter(|(returned, at)| returned == requirements && is_expected(at)).count()
    }

    /// The handover of the lease that this event gives back, if there is one: to the first of those that wait already and those that ask now.
    pub(super) fn handover(
        &self,
        event: &Event,
        commands: &[Command],
        waiting: &Waiting,
        now: Instant,
    ) -> Option<Handover> {
        let Event::Finished { instance: ended, outcome, .. } = event else { return None };
        let given_back = commands.iter().find_map(|command| match command {
            Command::Release { instance, lease, .. } if instance == ended => *lease,
            _ => None,
        });
        let held = self.held.get(&given_back?)?;
        if outcome != SUCCESS || now.duration_since(held.granted) >= TURN {
            return None;
        }
        let is_withdrawn = |instance: InstanceId| {
            commands.iter().any(|command| matches!(command, Command::Withdraw { instance: one } if *one == instance))
        };
        // An instance that asks again with another priority is withdrawn before.
        let mut waits =
            waiting.in_order().map(|(id, asking)| (id, asking.requirements.as_slice(), true, asking.priority));
        let mut expected = self.expected(&held.requirements, now);
        let mut left_is_certain = false;
        let waits = waits.find(|(id, requirements, _, priority)| {
            let is_first = held.is_wanted(requirements) && !is_withdrawn(*id);
            let is_left_to_the_manager = is_first && expected > 0 && held.serves(requirements);
            expected -= usize::from(is_left_to_the_manager);
            left_is_certain |= is_left_to_the_manager && *priority >= CERTAIN;
            is_first && !is_left_to_the_manager
        });
        let asks = commands.iter().rev().filter_map(|command| match command {
            Command::Acquire { instance, requirements, priority } => {
                Some((*instance, requirements.as_slice(), false, *priority))
            }
            _ => None,
        });
        // Of equal priorities the first; those that wait already come before those that ask now.
        let first = asks.filter(|(_, requirements, ..)| held.is_wanted(requirements)).chain(waits);
        let (to, requirements, waits, priority) = first.max_by_key(|(.., priority)| *priority)?;
        // A certain node that was left to the manager is not passed over for a speculative one: the manager may have nothing for it after all.
        if left_is_certain && priority < CERTAIN {
            return None;
        }
        held.serves(requirements).then(|| Handover { to, lease: held.lease.clone(), waits })
    }
}

impl Held {
    /// Whether the requirements include the kind of any of its resources.
    fn is_wanted(&self, requirements: &[Requirement]) -> bool {
        requirements.iter().any(|wanted| self.lease.resources.iter().any(|resource| resource.is_a(&wanted.kind)))
    }

    fn serves(&self, requirements: &[Requirement]) -> bool {
        let plain = |wanted: &Requirement| {
            wanted.operation == ResourceOperation::Block && wanted.attributes.is_empty() && wanted.conditions.is_empty()
        };
        requirements == self.requirements && requirements.iter().all(plain)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ratn_model::id::FencingToken;
    use ratn_model::resource::LeasedResource;
    use ratn_model::value::Value;
    use tokio::sync::oneshot;

    const FIRST: InstanceId = InstanceId(1);

    fn planner() -> Vec<Requirement> {
        vec![Requirement::new(ResourceOperation::Block, "PathPlanner")]
    }

    fn ended(outcome: &str) -> Event {
        ended_of(FIRST, outcome)
    }

    fn ended_of(instance: InstanceId, outcome: &str) -> Event {
        Event::Finished {
            instance,
            attempt: 1,
            outcome: outcome.to_owned(),
            outputs: BTreeMap::new(),
            measured: Vec::new(),
            evidence: Vec::new(),
            reason: String::new(),
            at_rest: true,
        }
    }

    fn asks(instance: u64, requirements: Vec<Requirement>, priority: i64) -> Command {
        Command::Acquire { instance: InstanceId(instance), requirements, priority }
    }

    fn ask(
        waiting: &mut Waiting,
        instance: InstanceId,
        number: u64,
        requirements: Vec<Requirement>,
        priority: i64,
    ) -> oneshot::Receiver<Lease> {
        waiting.begin(instance, number, format!("r/{number}"), requirements, priority).handed
    }

    /// Waiting acquires with their priorities; the first has the id 11.
    fn waiting(all: &[(Vec<Requirement>, i64)]) -> Waiting {
        let mut waiting = Waiting::default();
        for ((requirements, priority), number) in all.iter().zip(1..) {
            ask(&mut waiting, InstanceId(10 + number), number, requirements.clone(), *priority);
        }
        waiting
    }

    /// The handover of a planner's lease that is given back after so many milliseconds, in a step with these acquires.
    fn handover(
        event: &Event,
        asks: &[Command],
        waits: &[(Vec<Requirement>, i64)],
        after_ms: u64,
    ) -> Option<InstanceId> {
        let resource = LeasedResource {
            id: "path-planner-1".to_owned(),
            kind: "PathPlanner".to_owned(),
            endpoint: String::new(),
            superclasses: vec!["Planner".to_owned()],
        };
        let lease = Lease { id: LeaseId(7), token: FencingToken(7), resources: vec![resource], consumed: Vec::new() };
        let (mut leases, now) = (Leases::default(), Instant::now());
        leases.granted(FIRST, &lease, (planner(), 0), now);
        let mut commands = asks.to_vec();
        commands.push(Command::Release { instance: FIRST, lease: Some(lease.id), projection: None });
        let handover = leases.handover(event, &commands, &waiting(waits), now + Duration::from_millis(after_ms))?;
        assert_eq!(handover.lease, lease);
        Some(handover.to)
    }

    #[test]
    fn the_next_that_wants_exactly_the_same_takes_the_lease_over_for_a_while() {
        let next = [asks(2, planner(), 5)];
        assert_eq!(handover(&ended(SUCCESS), &next, &[], 1), Some(InstanceId(2)));
        assert_eq!(handover(&ended(SUCCESS), &next, &[], 100), None, "its turn is over");
        assert_eq!(handover(&ended("aborted"), &next, &[], 1), None, "nobody knows how its provider is");
        assert_eq!(handover(&Event::Woken, &next, &[], 1), None);
        assert_eq!(handover(&ended(SUCCESS), &[], &[], 1), None);
    }

    #[test]
    fn who_waits_already_or_has_a_higher_priority_comes_first() {
        let arm = vec![Requirement::new(ResourceOperation::Block, "Arm")];
        let any_planner = vec![Requirement::new(ResourceOperation::Block, "Planner")];
        let both = vec![planner().remove(0), arm[0].clone()];
        let next = asks(2, planner(), 5);
        let one = [next.clone()];
        assert_eq!(handover(&ended(SUCCESS), &one, &[(arm.clone(), 9)], 1), Some(InstanceId(2)));
        for wanted in [&any_planner, &both] {
            assert_eq!(handover(&ended(SUCCESS), &one, &[(wanted.clone(), 4)], 1), Some(InstanceId(2)));
            assert_eq!(
                handover(&ended(SUCCESS), &one, &[(wanted.clone(), 5)], 1),
                None,
                "it comes first, and wants another thing"
            );
        }
        let others = [asks(3, arm, 9), next.clone(), asks(4, any_planner.clone(), 5)];
        assert_eq!(handover(&ended(SUCCESS), &others, &[], 1), Some(InstanceId(2)), "of equals the first");
        assert_eq!(handover(&ended(SUCCESS), &[next, asks(4, any_planner, 6)], &[], 1), None);
    }

    #[test]
    fn one_that_waits_already_takes_the_lease_over() {
        let queue = [(planner(), 3), (planner(), 7), (planner(), 7)];
        assert_eq!(handover(&ended(SUCCESS), &[], &queue, 1), Some(InstanceId(12)), "the first of the most urgent");
        assert_eq!(handover(&ended(SUCCESS), &[asks(2, planner(), 7)], &queue, 1), Some(InstanceId(12)));
        assert_eq!(handover(&ended(SUCCESS), &[asks(2, planner(), 8)], &queue, 1), Some(InstanceId(2)));
        let withdrawn = Command::Withdraw { instance: InstanceId(12) };
        assert_eq!(handover(&ended(SUCCESS), std::slice::from_ref(&withdrawn), &queue, 1), Some(InstanceId(13)));
        let again = [withdrawn, asks(12, planner(), 9)];
        assert_eq!(handover(&ended(SUCCESS), &again, &queue, 1), Some(InstanceId(12)), "what it asks for now");
        assert_eq!(handover(&ended(SUCCESS), &[], &queue, 100), None, "its turn is over");
    }

    #[test]
    fn the_first_that_waits_is_left_to_the_manager_for_a_lease_that_went_back() {
        let lease = |id: u64| {
            let resource = LeasedResource {
                id: format!("path-planner-{id}"),
                kind: "PathPlanner".to_owned(),
                endpoint: String::new(),
                superclasses: Vec::new(),
            };
            Lease { id: LeaseId(id), token: FencingToken(id), resources: vec![resource], consumed: Vec::new() }
        };
        let begin = Instant::now();
        let after = |ms: u64| begin + Duration::from_millis(ms);
        let mut leases = Leases::default();
        for id in [7, 8] {
            leases.granted(InstanceId(id), &lease(id), (planner(), 0), begin);
        }
        let next = |leases: &Leases, ms: u64| {
            let ended = ended_of(InstanceId(8), SUCCESS);
            let commands = [Command::Release { instance: InstanceId(8), lease: Some(LeaseId(8)), projection: None }];
            let queue = waiting(&[(planner(), 9), (planner(), 5), (planner(), 5)]);
            leases.handover(&ended, &commands, &queue, after(ms)).map(|handover| handover.to)
        };
        assert_eq!(next(&leases, 50), Some(InstanceId(11)));
        leases.given_back(LeaseId(7), after(50));
        assert_eq!(next(&leases, 50), Some(InstanceId(12)), "the manager has one for the first");
        let ended = ended_of(InstanceId(8), SUCCESS);
        let commands = [Command::Release { instance: InstanceId(8), lease: Some(LeaseId(8)), projection: None }];
        let queue = waiting(&[(planner(), CERTAIN), (planner(), 5)]);
        let passed = leases.handover(&ended, &commands, &queue, after(50));
        assert!(passed.is_none(), "what is needed for certain is not passed over for what may not be");
        leases.granted(InstanceId(11), &lease(9), (planner(), 9), after(51));
        assert_eq!(next(&leases, 51), Some(InstanceId(11)), "it has come");

        leases.given_back(LeaseId(9), after(60));
        let other = vec![Requirement::new(ResourceOperation::Block, "Arm")];
        leases.granted(InstanceId(2), &lease(10), (other, 0), after(61));
        assert_eq!(next(&leases, 61), Some(InstanceId(12)), "another grant is not that");
        let mut later = Leases::default();
        later.granted(InstanceId(8), &lease(8), (planner(), 0), after(150));
        later.went_back.push((planner(), after(60)));
        assert_eq!(next(&later, 159), Some(InstanceId(12)));
        assert_eq!(next(&later, 160), Some(InstanceId(11)), "another client has it");
    }

    #[test]
    fn nothing_is_handed_to_one_that_has_its_answer() {
        let lease = Lease { id: LeaseId(7), token: FencingToken(7), resources: Vec::new(), consumed: Vec::new() };
        let mut waiting = Waiting::default();
        let handed = ask(&mut waiting, FIRST, 1, planner(), 1);
        assert_eq!(waiting.hand(InstanceId(2), &lease), None, "it does not wait");
        drop(handed);
        assert_eq!(waiting.hand(FIRST, &lease), Some(Err(())));
        let mut handed = ask(&mut waiting, FIRST, 2, planner(), 1);
        assert_eq!(waiting.hand(FIRST, &lease), Some(Ok(())));
        assert_eq!(waiting.hand(FIRST, &lease), Some(Err(())), "it has one");
        assert_eq!(handed.try_recv(), Ok(lease));
    }

    #[test]
    fn what_depends_on_how_a_resource_is_now_is_asked_anew() {
        let mut two = planner();
        two[0].count = 2.into();
        assert_eq!(handover(&ended(SUCCESS), &[asks(2, two, 5)], &[], 1), None);
        let held = |change: &dyn Fn(&mut Requirement)| {
            let mut requirements = planner();
            requirements.iter_mut().for_each(change);
            let lease = Lease { id: LeaseId(7), token: FencingToken(7), resources: Vec::new(), consumed: Vec::new() };
            Held {
                lease,
                requirements: requirements.clone(),
                granted: Instant::now(),
                holder: FIRST,
                is_speculative: false,
            }
            .serves(&requirements)
        };
        assert!(held(&|_| {}));
        assert!(!held(&|one| drop(one.attributes.insert("gpu".to_owned(), Value::Bool(true)))));
        assert!(!held(&|one| one.operation = ResourceOperation::Exists));
    }
}
