//! Whose goals a provider performs, over real sockets: the resource manager's word counts, and no goal is begun twice.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use common::{Provider, RESOURCE, begin, goal, lease, provider_built};
use ratn_model::id::{FencingToken, LeaseId, Revision};
use ratn_model::resource::{Quantity, ResourceClass};
use ratn_proto::types::{Goal, GoalOutcome, Holding, Resource, ResourceEvent, ResourceEventKind, ResourceUpdate};
use ratn_worker::action::{Action, ActionResult, ActionServerBuilder, GoalContext};
use ratn_worker::client::CallError;
use ratn_worker::lease_watch::{GRANT_WAIT, LeaseWatch};
use ratn_worker::server::DRAIN_DEADLINE;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Instant;
use tonic::Code;

/// A provider and what a resource manager would tell it.
struct Watched {
    provider: Provider,
    watch: LeaseWatch,
}

async fn watched(build: impl FnOnce(ActionServerBuilder) -> ActionServerBuilder) -> Watched {
    let watch = LeaseWatch::of([RESOURCE]);
    let provider = provider_built(None, DRAIN_DEADLINE, |builder| build(builder.leases(&watch))).await;
    Watched { provider, watch }
}

fn resource(leases: &[u64]) -> Resource {
    let holding = |&lease: &u64| Holding {
        lease: LeaseId(lease),
        token: FencingToken(lease),
        units: Quantity::ONE,
        session: format!("session-{lease}"),
        holder: String::new(),
        opened_by: String::new(),
    };
    let mut resource = Resource::new(RESOURCE, ResourceClass::Process, "Tester");
    resource.holdings = leases.iter().map(holding).collect();
    resource
}

impl Watched {
    /// All that is held, and the youngest lease of all resources.
    fn holds(&self, leases: &[u64], youngest: u64) {
        let (revision, youngest) = (Revision(1), LeaseId(youngest));
        self.watch.tell(&ResourceUpdate::Snapshot { revision, resources: vec![resource(leases)], youngest });
    }

    fn happened(&self, kind: ResourceEventKind, lease: u64, leases: &[u64]) {
        let (revision, resource) = (Revision(2), resource(leases));
        let lease = Some((LeaseId(lease), FencingToken(lease)));
        let event = ResourceEvent { revision, kind, resource, lease, reason: String::new(), part: 0 };
        self.watch.tell(&ResourceUpdate::Event(event));
    }

    async fn run(&self, goal: Goal) -> Result<GoalOutcome, CallError> {
        self.provider.client.execute(&self.provider.endpoint, goal, |_, _| {}).await
    }

    async fn refused(&self, goal: Goal, why: &str) {
        let error = self.run(goal).await.unwrap_err();
        assert_eq!(error.code(), Some(Code::FailedPrecondition), "{error}");
        assert!(error.to_string().contains(why), "{error}");
    }

    fn runs(&self) -> usize {
        self.provider.runs.load(Ordering::SeqCst)
    }
}

#[tokio::test]
async fn a_forged_lease_is_refused_and_its_true_holder_is_not() {
    let watched = watched(|builder| builder).await;
    watched.holds(&[7], 9);
    let most = |id: u64| {
        let mut lease = lease(id, &[(RESOURCE, "Tester", "")]);
        lease.token = FencingToken(u64::MAX);
        Goal { lease: Some(lease), ..goal("forged", "double", 1) }
    };
    watched.refused(most(u64::MAX), "told of no such grant within 1 s").await;
    watched.refused(most(9), "lease-7 (token-7) holds it").await;
    watched.refused(most(7), "has token-7, and the goal says token-18446744073709551615").await;
    let another = Goal { session: "session-8".to_owned(), ..goal("another", "double", 7) };
    watched.refused(another, "is held by session `session-7`").await;
    assert_eq!(watched.runs(), 0);
    let own = Goal { session: "session-7".to_owned(), ..goal("own", "double", 7) };
    assert!(watched.run(own).await.unwrap().is_success());
}

#[tokio::test]
async fn a_lease_is_good_from_the_word_of_its_grant_to_the_word_of_its_end() {
    let watched = watched(|builder| builder).await;
    watched.holds(&[], 6);
    // The goal comes before the word: it waits, and not longer.
    let began = Instant::now();
    let (outcome, ()) = tokio::join!(watched.run(goal("a", "double", 7)), async {
        while watched.provider.server.waiting() == 0 {
            tokio::task::yield_now().await;
        }
        watched.happened(ResourceEventKind::Leased, 7, &[7]);
    });
    assert!(outcome.unwrap().is_success() && began.elapsed() < GRANT_WAIT);

    let waiting = begin(&watched.provider, goal("b", "wait", 7)).await;
    watched.happened(ResourceEventKind::Released, 7, &[]);
    assert_eq!(waiting.await.unwrap().unwrap(), GoalOutcome::aborted("the lease ended: it was released"));
    watched.refused(goal("c", "double", 7), "is over").await;
}

#[tokio::test]
async fn without_the_manager_nothing_begins_and_what_is_under_way_ends() {
    let watched = watched(|builder| builder).await;
    watched.holds(&[7], 7);
    let waiting = begin(&watched.provider, goal("a", "wait", 7)).await;
    watched.watch.lost("silence");
    assert_eq!(waiting.await.unwrap().unwrap(), GoalOutcome::aborted("the lease may have ended: silence"));
    let (outcome, ()) = tokio::join!(watched.run(goal("b", "double", 7)), async {
        while watched.provider.server.waiting() == 0 {
            tokio::task::yield_now().await;
        }
        tokio::time::sleep(2 * GRANT_WAIT).await;
        assert_eq!(watched.runs(), 0);
        watched.holds(&[7], 7);
    });
    // Refused meanwhile, and given again: nothing had begun.
    assert!(outcome.unwrap().is_success());
    assert_eq!(watched.runs(), 1);
}

/// `step`: takes steps until it is told to stop, and none while it is suspended.
struct Step(Arc<AtomicUsize>);

#[tonic::async_trait]
impl Action for Step {
    fn name(&self) -> &str {
        "step"
    }

    fn can_be_suspended(&self) -> bool {
        true
    }

    async fn execute(&self, goal: GoalContext) -> ActionResult {
        goal.progress("stepping");
        loop {
            goal.while_held().await?;
            goal.checkpoint()?;
            self.0.fetch_add(1, Ordering::SeqCst);
            tokio::task::yield_now().await;
        }
    }
}

#[tokio::test]
async fn a_suspended_goal_stands_still_until_the_manager_is_heard_and_goes_on_only_under_a_lease_that_lives() {
    for lives in [true, false] {
        let steps = Arc::new(AtomicUsize::new(0));
        let watched = watched(|builder| builder.action(Step(Arc::clone(&steps)))).await;
        watched.holds(&[7], 7);
        let stepping = begin(&watched.provider, goal("a", "step", 7)).await;
        watched.watch.unheard("silence");
        // At most the step that it was at.
        tokio::task::yield_now().await;
        let stood = steps.load(Ordering::SeqCst);
        for _ in 0..1_000 {
            tokio::task::yield_now().await;
        }
        assert_eq!(steps.load(Ordering::SeqCst), stood);
        let refused = watched.provider.client.execute(&watched.provider.endpoint, goal("b", "double", 7), |_, _| {});
        assert!(tokio::time::timeout(2 * GRANT_WAIT, refused).await.is_err(), "it is tried again and again");
        assert_eq!((watched.runs(), steps.load(Ordering::SeqCst)), (0, stood));
        let reason = if lives {
            watched.holds(&[7], 7);
            while steps.load(Ordering::SeqCst) == stood {
                tokio::task::yield_now().await;
            }
            watched.watch.unheard("silence");
            watched.watch.lost("silence for too long");
            "the lease may have ended: silence for too long"
        } else {
            watched.holds(&[8], 8);
            "the lease ended: it ended while the resource manager was not heard"
        };
        assert_eq!(stepping.await.unwrap().unwrap(), GoalOutcome::aborted(reason));
    }
}

#[tokio::test]
async fn a_provider_that_was_given_no_watch_refuses_what_needs_a_lease() {
    let provider = provider_built(None, DRAIN_DEADLINE, |builder| builder).await;
    let refused = provider.client.execute(&provider.endpoint, goal("a", "double", 7), |_, _| {}).await.unwrap_err();
    assert!(refused.to_string().contains("give its ActionServer a LeaseWatch"), "{refused}");
}

#[tokio::test]
async fn a_goal_is_never_begun_twice_however_many_were_given_since() {
    let watched = watched(|builder| builder).await;
    watched.holds(&[7], 7);
    let id = |i: usize| format!("run/{i}/1");
    for i in 0..70 {
        watched.run(goal(&id(i), "double", 7)).await.unwrap();
    }
    assert!(watched.run(goal(&id(69), "double", 7)).await.unwrap().is_success());
    watched.refused(goal(&id(0), "double", 7), "was begun under lease-7 and has ended").await;
    // Whoever comes back after a crash must not take it for one that was never given.
    let provider = &watched.provider;
    let asked = async |i| provider.client.attach(&provider.endpoint, goal(&id(i), "double", 7), |_, _| {}).await;
    assert_eq!(asked(0).await.unwrap_err().code(), Some(Code::FailedPrecondition));
    assert_eq!(asked(70).await.unwrap_err().code(), Some(Code::NotFound));
    assert_eq!(watched.runs(), 70);

    // Under another lease, the first one's goals cannot be given again at all.
    watched.happened(ResourceEventKind::Released, 7, &[]);
    watched.happened(ResourceEventKind::Leased, 8, &[8]);
    watched.run(goal("run/70/1", "double", 8)).await.unwrap();
    watched.refused(goal(&id(0), "double", 7), "is over").await;
    assert_eq!(watched.runs(), 71);
}

#[tokio::test]
async fn a_lease_has_room_for_so_many_goals_and_says_so() {
    let watched = watched(|builder| builder.goals_per_lease(3)).await;
    watched.holds(&[7], 7);
    for i in 0..3 {
        watched.run(goal(&format!("a{i}"), "double", 7)).await.unwrap();
    }
    let refused = watched.run(goal("a3", "double", 7)).await.unwrap_err();
    assert_eq!(refused.code(), Some(Code::ResourceExhausted));
    assert!(refused.to_string().contains("3 goals of tester-1@here were begun under lease-7"), "{refused}");
    watched.run(goal("a2", "double", 7)).await.unwrap();
    watched.happened(ResourceEventKind::Released, 7, &[]);
    watched.happened(ResourceEventKind::Leased, 8, &[8]);
    watched.run(goal("b", "double", 8)).await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "a measurement: cargo test --release -p ratn-worker --test leases -- --ignored --nocapture"]
async fn what_the_confirmation_of_a_lease_adds_to_a_goal() {
    const GOALS: usize = 2_000;
    let watched = watched(|builder| builder).await;
    watched.holds(&[7], 7);
    let believing = common::provider(None).await;
    let mut took = [Vec::new(), Vec::new()];
    for i in 0..GOALS {
        // In turns, so that whatever else the machine does happens to both.
        for (provider, took) in [&watched.provider, &believing].into_iter().zip(&mut took) {
            let began = Instant::now();
            let goal = goal(&format!("run/{i}/1"), "double", 7);
            let outcome = provider.client.execute(&provider.endpoint, goal, |_, _| {}).await.unwrap();
            took.push(began.elapsed());
            assert!(outcome.is_success(), "a refusal is no goal: {outcome:?}");
        }
    }
    took.iter_mut().for_each(|took| took.sort());
    let [confirmed, believed] = took.map(|took| took[GOALS / 2]);
    println!("median of a goal: confirmed {confirmed:?}, believed {believed:?}");
}
