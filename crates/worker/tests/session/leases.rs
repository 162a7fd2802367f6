//! When a provider's watch confirms a lease, and when the provider confirms standstill.

use super::manager::Manager;
use super::{LONG, TTL, arm, channels, place};
use ratn_model::id::{FencingToken, LeaseId, Revision};
use ratn_model::resource::{Lease, LeasedResource, Quantity, ResourceClass};
use ratn_proto::types::{self, Goal, Resource, ResourceUpdate};
use ratn_proto::v1::{EndingUnits, Holding};
use ratn_worker::action::{Action, ActionResult, ActionServer, GoalContext};
use ratn_worker::boot_clock::BootClock;
use ratn_worker::client::ActionClient;
use ratn_worker::endpoint::Endpoint;
use ratn_worker::lease_watch::{Claim, ClaimStatus, LeaseWatch, ManagerLocation};
use ratn_worker::provider::Provider;
use ratn_worker::server::{Services, bind};
use ratn_worker::session::Session;
use std::time::{Duration, Instant};
use tokio_util::sync::CancellationToken;

/// A manager at which session `cell` provides the arm, of which another one holds lease 7.
fn with_lease() -> Manager {
    let manager = Manager::new();
    let holding = Holding { lease_id: 7, token: 70, units: 1.0, session_id: "run".to_owned(), ..Holding::default() };
    let mut arm = ratn_proto::v1::Resource::from(arm());
    (arm.session_id, arm.holdings) = ("cell".to_owned(), vec![holding]);
    {
        let mut pool = manager.pool.lock().unwrap();
        (pool.shows, pool.youngest) = (Some(true), 7);
        pool.resources.insert("arm@sim".to_owned(), arm);
    }
    manager
}

/// Waits until the watch has heard of the lease.
async fn heard(leases: &LeaseWatch) {
    let heard = async {
        while !leases.is_heard() {
            tokio::task::yield_now().await;
        }
    };
    tokio::time::timeout(LONG, heard).await.unwrap();
}

const CLAIM: Claim<'_> = Claim { resource: "arm@sim", lease: LeaseId(7), token: FencingToken(70), session: "run" };

#[tokio::test]
async fn a_driver_begins_nothing_before_it_has_said_that_it_is_at_rest() {
    let (_directory, endpoint) = place();
    let manager = with_lease();
    let _serving = manager.serve(&endpoint).await;
    let channels = channels();
    let session = Session::open_as(&channels, &endpoint, "cell".to_owned(), "cell", LONG);
    let leases = LeaseWatch::of(["arm@sim"]);
    tokio::spawn(leases.follow_session(&channels, &endpoint, &session, LONG).unwrap());
    heard(&leases).await;
    assert_eq!(leases.check(&CLAIM), ClaimStatus::NotAtRest);
    leases.brought_to_rest();
    assert_eq!(leases.check(&CLAIM), ClaimStatus::Confirmed);
}

#[tokio::test]
async fn a_driver_that_finds_its_session_living_refuses_the_leases_of_the_process_before_it_for_good() {
    let (_directory, endpoint) = place();
    let manager = with_lease();
    manager.pool.lock().unwrap().sessions.insert("cell".to_owned(), 1);
    let (stop, serving) = manager.serve(&endpoint).await;
    let channels = channels();
    let session = Session::open_as(&channels, &endpoint, "cell".to_owned(), "cell", LONG);
    let leases = LeaseWatch::of(["arm@sim"]);
    leases.brought_to_rest();
    tokio::spawn(leases.follow_session(&channels, &endpoint, &session, LONG).unwrap());
    heard(&leases).await;
    let refused = leases.check(&CLAIM);
    assert!(matches!(&refused, ClaimStatus::Refuted(why) if why.contains("acquire it anew")), "{refused:?}");
    // The next watch begins with the lease after it as well.
    stop.cancel();
    serving.await.unwrap();
    {
        let mut pool = manager.pool.lock().unwrap();
        let next = Holding { lease_id: 8, token: 80, units: 1.0, session_id: "run".to_owned(), ..Holding::default() };
        pool.resources.get_mut("arm@sim").unwrap().holdings.push(next);
        pool.youngest = 8;
    }
    let _serving = manager.serve(&endpoint).await;
    let confirmed = async {
        while leases.check(&Claim { lease: LeaseId(8), token: FencingToken(80), ..CLAIM }) != ClaimStatus::Confirmed {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    };
    tokio::time::timeout(LONG, confirmed).await.unwrap();
    assert!(matches!(leases.check(&CLAIM), ClaimStatus::Refuted(_)));
}

#[tokio::test]
async fn a_lease_is_not_confirmed_when_the_machine_wakes_up_until_the_manager_is_heard_again() {
    let hour = Duration::from_secs(3_600);
    for by_session in [true, false] {
        let (_directory, endpoint) = place();
        let manager = with_lease();
        let (stop, serving) = manager.serve(&endpoint).await;
        let (channels, clock) = (channels(), BootClock::suspendable());
        let leases = LeaseWatch::by(clock.clone(), ["arm@sim"]);
        leases.brought_to_rest();
        let session = Session::open_by(clock.clone(), &channels, &endpoint, "cell".to_owned(), "cell", hour);
        let following = if by_session {
            tokio::spawn(leases.follow_session(&channels, &endpoint, &session, hour).unwrap())
        } else {
            tokio::spawn(leases.follow_location(&channels, ManagerLocation::At(endpoint.clone()), "cell", hour))
        };
        heard(&leases).await;
        assert_eq!(leases.check(&CLAIM), ClaimStatus::Confirmed);
        stop.cancel();
        serving.await.unwrap();
        assert_eq!(leases.check(&CLAIM), ClaimStatus::Confirmed, "the manager may come back");
        // Nothing else has run when the next goal is looked at.
        clock.suspend(hour);
        assert!(matches!(leases.check(&CLAIM), ClaimStatus::Unheard(_)), "{by_session}");
        let unheard = async {
            while leases.is_heard() {
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
        };
        tokio::time::timeout(LONG, unheard).await.expect("what is under way goes on for another hour");
        let _serving = manager.serve(&endpoint).await;
        let again = async {
            while leases.check(&CLAIM) != ClaimStatus::Confirmed {
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
        };
        tokio::time::timeout(LONG, again).await.expect("the lease lives, and the manager says so");
        following.abort();
    }
}

#[tokio::test]
async fn standstill_is_confirmed_when_the_driver_has_said_that_it_is_at_rest_and_again_where_no_answer_comes() {
    let (_directory, endpoint) = place();
    let manager = Manager::new();
    {
        // What the process before this one has left: its session still lives, and a lease of the arm has ended.
        let mut pool = manager.pool.lock().unwrap();
        (pool.shows, pool.swallowed) = (Some(true), 1);
        pool.sessions.insert("cell".to_owned(), 1);
        let ending = EndingUnits { lease_id: 7, token: 70, units: 1.0, ..EndingUnits::default() };
        let mut arm = ratn_proto::v1::Resource::from(arm());
        (arm.session_id, arm.ending) = ("cell".to_owned(), vec![ending]);
        pool.resources.insert("arm@sim".to_owned(), arm);
    }
    let _serving = manager.serve(&endpoint).await;
    let channels = channels();
    let session = Session::open_as(&channels, &endpoint, "cell".to_owned(), "cell", LONG);
    let leases = LeaseWatch::of(["arm@sim"]);
    let _server = ActionServer::builder("arm@sim").leases(&leases).build();
    let provider = Provider::start_at_rest(&channels, &endpoint, &session, &leases).unwrap();
    tokio::spawn(leases.follow_session(&channels, &endpoint, &session, LONG).unwrap());
    session.alive(LONG).await.unwrap();
    manager.until(|pool| pool.watches > 0).await;
    let heard = async {
        while !leases.is_heard() {
            tokio::task::yield_now().await;
        }
    };
    tokio::time::timeout(LONG, heard).await.unwrap();
    // Nothing runs here, but nobody knows what the hardware does.
    assert!(!leases.is_at_rest("arm@sim") && !provider.offer(arm()).await.unwrap());
    tokio::time::sleep(3 * TTL).await;
    assert_eq!(manager.pool.lock().unwrap().confirmations, 0);
    leases.brought_to_rest();
    // Far less than the watch was told to be patient.
    let again = manager.until(|pool| pool.confirmations == 2);
    tokio::time::timeout(LONG / 2, again).await.expect("no second confirmation");
    manager.until(|pool| pool.resources["arm@sim"].ending.is_empty()).await;
}

#[tokio::test]
async fn what_moves_beside_the_goals_is_offered_by_the_next_provider_of_the_process_when_its_bound_has_passed() {
    let channels = channels();
    let leases = LeaseWatch::of(["arm@sim"]);
    leases.brought_to_rest();
    let bound = Duration::from_millis(400);
    let middle = Resource::new("middle@sim", ResourceClass::System, "Middle").with_standstill(bound);
    let mut places = Vec::new();
    // The manager comes back at another address, with nothing of before.
    for is_next in [false, true] {
        let (directory, endpoint) = place();
        let manager = Manager::new();
        let serving = manager.serve(&endpoint).await;
        places.push((directory, serving));
        let session = Session::open(&channels, &endpoint, "cell", LONG);
        session.alive(LONG).await.unwrap();
        let begun = std::time::Instant::now();
        let provider = Provider::start_at_rest(&channels, &endpoint, &session, &leases).unwrap();
        assert_eq!(provider.offer(middle.clone()).await.unwrap(), !is_next);
        manager.until(|pool| pool.resources.contains_key("middle@sim")).await;
        assert!(!is_next || begun.elapsed() >= bound, "{:?}", begun.elapsed());
        session.close().await;
    }
}

/// Begins a motion, and panics.
struct Panics;

#[tonic::async_trait]
impl Action for Panics {
    fn name(&self) -> &str {
        "move"
    }

    async fn execute(&self, _: GoalContext) -> ActionResult {
        panic!("on purpose")
    }
}

#[tokio::test]
async fn what_an_action_that_panicked_moved_is_offered_again_when_its_bound_has_passed() {
    let (directory, endpoint) = place();
    let manager = Manager::new();
    let _serving = manager.serve(&endpoint).await;
    let (channels, leases) = (channels(), LeaseWatch::of(["arm@sim"]));
    leases.brought_to_rest();
    let server = ActionServer::builder("arm@sim").action(Panics).leases(&leases).build();
    let driver = bind(&Endpoint::Unix(directory.path().join("driver.sock"))).await.unwrap();
    let at = driver.endpoint().clone();
    tokio::spawn(driver.serve(Services::new().with(server.into_service()), CancellationToken::new()));
    let session = Session::open(&channels, &endpoint, "cell", TTL);
    session.alive(LONG).await.unwrap();
    let provider = Provider::start_at_rest(&channels, &endpoint, &session, &leases).unwrap();
    let bound = Duration::from_millis(700);
    let mut arm = arm().with_standstill(bound);
    assert!(provider.offer(arm.clone()).await.unwrap());
    let (lease, token, session) = (LeaseId(7), FencingToken(70), "run".to_owned());
    let (holder, opened_by, units) = (String::new(), String::new(), Quantity::ONE);
    arm.holdings = vec![types::Holding { lease, token, units, session: session.clone(), holder, opened_by }];
    leases.tell(&ResourceUpdate::Snapshot { revision: Revision(1), resources: vec![arm], youngest: lease });
    let (id, kind, superclasses) = ("arm@sim".to_owned(), "Arm".to_owned(), Vec::new());
    let resources = vec![LeasedResource { id, kind, endpoint: at.to_string(), superclasses }];
    let lease = Some(Lease { id: lease, token, resources, consumed: Vec::new() });
    let goal = Goal { id: "g".to_owned(), action: "move".to_owned(), lease, session, ..Goal::default() };
    let outcome = ActionClient::new(channels).execute(&at, goal, |_, _| {}).await.unwrap();
    assert!(outcome.reason.contains("panicked"), "{outcome:?}");
    {
        let mut pool = manager.pool.lock().unwrap();
        pool.sessions.clear();
        pool.resources.clear();
    }
    let lost = Instant::now();
    manager.until(|pool| pool.resources.contains_key("arm@sim")).await;
    assert!(lost.elapsed() >= bound, "after {:?}", lost.elapsed());
}
