//! Emergency stop and hold of a driver whose brakes fail, hang, or lose the caller who asked for them.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use common::RESOURCE;
use ratn_worker::client::{Channels, wait_until_serving};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::safety::{Brakes, Safety, SafetyClient, SafetyError, SafetyState};
use ratn_worker::tls::ClientTls;
use ratn_worker::worker::{Worker, WorkerOptions};
use std::collections::VecDeque;
use std::sync::{Arc, Mutex};
use std::time::Duration;
use tokio::sync::{Semaphore, watch};
use tokio::time::timeout;
use tokio_util::sync::CancellationToken;

/// Longer than anything takes here.
const LONG: Duration = Duration::from_secs(20);

/// What the brakes do when they are asked.
#[derive(Clone)]
enum Reaction {
    Fail,
    Hang,
    /// Confirm as soon as there is a permit.
    WaitFor(Arc<Semaphore>),
}

/// Brakes that do as they are told, one reaction a time, and confirm at once when nothing more is said.
#[derive(Clone)]
struct Rig {
    reactions: Arc<Mutex<VecDeque<Reaction>>>,
    /// The states that they were asked for.
    asked: Arc<watch::Sender<Vec<SafetyState>>>,
    /// The states that they have confirmed.
    confirmed: Arc<watch::Sender<Vec<SafetyState>>>,
}

impl Rig {
    fn new(reactions: impl IntoIterator<Item = Reaction>) -> Rig {
        let reactions = Arc::new(Mutex::new(reactions.into_iter().collect()));
        Rig { reactions, asked: Arc::default(), confirmed: Arc::default() }
    }

    async fn is_asked_for(&self, state: &SafetyState) {
        timeout(LONG, self.asked.subscribe().wait_for(|asked| asked.contains(state))).await.unwrap().unwrap();
    }

    async fn has_confirmed(&self, state: &SafetyState) {
        timeout(LONG, self.confirmed.subscribe().wait_for(|confirmed| confirmed.contains(state)))
            .await
            .unwrap()
            .unwrap();
    }
}

#[tonic::async_trait]
impl Brakes for Rig {
    async fn apply(&self, state: &SafetyState) -> Result<(), String> {
        self.asked.send_modify(|asked| asked.push(state.clone()));
        let reaction = self.reactions.lock().unwrap().pop_front();
        match reaction {
            Some(Reaction::Fail) => return Err("the brakes do not answer".to_owned()),
            Some(Reaction::Hang) => std::future::pending().await,
            Some(Reaction::WaitFor(permits)) => permits.acquire().await.unwrap().forget(),
            None => {}
        }
        self.confirmed.send_modify(|confirmed| confirmed.push(state.clone()));
        Ok(())
    }
}

fn stopped(reason: &str) -> SafetyState {
    SafetyState::Stopped { reason: reason.to_owned() }
}

fn held(reason: &str) -> SafetyState {
    SafetyState::Held { reason: reason.to_owned() }
}

#[tokio::test]
async fn a_stop_that_was_not_confirmed_has_the_brakes_asked_again_until_they_confirm() {
    let rig = Rig::new([Reaction::Fail, Reaction::Fail]);
    let safety = Safety::new(rig.clone());
    for _ in 0..2 {
        assert!(matches!(safety.stop("a hand").await, Err(SafetyError::Brakes(_))));
        assert_eq!(safety.state(), stopped("a hand"));
    }
    assert_eq!(safety.stop("again").await, Ok(stopped("a hand")));
    assert_eq!(*rig.confirmed.borrow(), [stopped("a hand")]);
    // What is confirmed is not asked for again.
    assert_eq!(safety.stop("again").await, Ok(stopped("a hand")));
    assert_eq!(rig.asked.borrow().len(), 3);
}

#[tokio::test]
async fn a_hold_that_was_not_confirmed_has_the_brakes_asked_again_until_they_confirm() {
    let rig = Rig::new([Reaction::Fail]);
    let safety = Safety::new(rig.clone());
    assert!(matches!(safety.hold("a look").await, Err(SafetyError::Brakes(_))));
    assert_eq!(safety.state(), held("a look"));
    assert_eq!(safety.hold("a look").await, Ok(held("a look")));
    assert_eq!(*rig.confirmed.borrow(), [held("a look")]);
}

#[tokio::test]
async fn a_stop_does_not_wait_for_a_hold_whose_brakes_hang() {
    let rig = Rig::new([Reaction::Hang]);
    let safety = Safety::new(rig.clone());
    let hold = tokio::spawn({
        let safety = safety.clone();
        async move { safety.hold("a look").await }
    });
    rig.is_asked_for(&held("a look")).await;
    assert_eq!(timeout(LONG, safety.stop("a hand")).await.unwrap(), Ok(stopped("a hand")));
    rig.has_confirmed(&stopped("a hand")).await;
    assert_eq!(timeout(LONG, hold).await.unwrap().unwrap(), Ok(stopped("a hand")), "nothing moves, which it asked for");
}

#[tokio::test]
async fn a_stop_does_not_wait_for_going_on_or_clearing_whose_brakes_hang() {
    for first in [held("first"), stopped("first")] {
        let rig = Rig::new([]);
        let safety = Safety::new(rig.clone());
        let ending = match first {
            SafetyState::Held { .. } => safety.hold("first").await.unwrap(),
            _ => safety.stop("first").await.unwrap(),
        };
        rig.reactions.lock().unwrap().push_back(Reaction::Hang);
        let release = tokio::spawn({
            let safety = safety.clone();
            async move { if let SafetyState::Held { .. } = ending { safety.go_on().await } else { safety.clear().await } }
        });
        rig.is_asked_for(&SafetyState::Ready).await;
        let now = timeout(LONG, safety.stop("a hand")).await.unwrap().unwrap();
        assert!(matches!(&now, SafetyState::Stopped { .. }), "{now:?}");
        assert_eq!(rig.asked.borrow().last(), Some(&now), "the brakes had been told to let go");
        assert!(matches!(timeout(LONG, release).await.unwrap().unwrap(), Err(SafetyError::Stopped { .. })));
        assert_eq!(safety.state(), now);
    }
}

#[tokio::test]
async fn a_stop_outlives_its_caller() {
    let place = tempfile::tempdir().unwrap();
    let (listen, file) = (Endpoint::Unix(place.path().join("one.sock")), place.path().join("state").join("stopped"));
    let permits = Arc::new(Semaphore::new(0));
    let rig = Rig::new([Reaction::WaitFor(permits.clone())]);
    let safety = Safety::kept_in(file.clone(), rig.clone()).await.unwrap();
    let options = WorkerOptions { id: RESOURCE.to_owned(), listen: listen.clone(), ..WorkerOptions::default() };
    let shutdown = CancellationToken::new();
    let worker = Worker::new(options).dangerously_believe_every_lease().safety(safety.clone());
    let running = tokio::spawn(worker.shutdown(shutdown.clone()).run());
    wait_until_serving(&listen, &ClientTls::none(), LONG).await.unwrap();

    let calling = tokio::spawn({
        let listen = listen.clone();
        async move { SafetyClient::new(&Channels::new(&ClientTls::none()), &listen).unwrap().stop("a hand").await }
    });
    rig.is_asked_for(&stopped("a hand")).await;
    assert_eq!(safety.state(), stopped("a hand"), "in force before the brakes have confirmed");
    calling.abort();
    assert!(calling.await.unwrap_err().is_cancelled());
    // Another call over another connection: by then the driver has seen the end of the first one, or never needs to.
    let client = SafetyClient::new(&Channels::new(&ClientTls::none()), &listen).unwrap();
    assert_eq!(client.state().await.unwrap(), stopped("a hand"));
    permits.add_permits(1);
    rig.has_confirmed(&stopped("a hand")).await;
    assert_eq!(client.stop("again").await.unwrap(), stopped("a hand"));
    assert_eq!(*rig.asked.borrow(), [stopped("a hand")], "the brakes were asked once, and not cancelled halfway");
    assert_eq!(std::fs::read_to_string(&file).unwrap(), "a hand");
    assert_eq!(client.clear().await.unwrap(), SafetyState::Ready);
    assert_eq!(rig.asked.borrow().last(), Some(&SafetyState::Ready));
    shutdown.cancel();
    running.await.unwrap().unwrap();
}
