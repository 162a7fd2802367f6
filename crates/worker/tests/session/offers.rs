//! What a provider offers, updates and withdraws, whatever becomes of its session and of answers.

use super::manager::Manager;
use super::{LONG, TTL, arm, channels, place};
use ratn_model::resource::ResourceClass;
use ratn_model::value::Value;
use ratn_proto::types::Resource;
use ratn_worker::provider::Provider;
use ratn_worker::session::Session;
use std::collections::BTreeMap;
use std::time::{Duration, Instant};

#[tokio::test]
async fn a_creation_that_is_not_answered_is_asked_for_again() {
    let (_directory, endpoint) = place();
    let manager = Manager::new();
    manager.pool.lock().unwrap().unanswered = 1;
    let _serving = manager.serve(&endpoint).await;
    let channels = channels();
    let session = Session::open(&channels, &endpoint, "cell", LONG);
    let provider = Provider::start(&channels, &endpoint, &session).unwrap();
    session.alive(LONG).await.unwrap();
    let offered = tokio::time::timeout(LONG, provider.offer(arm())).await.expect("the creation is waited for for ever");
    assert!(!offered.unwrap(), "not yet");
    manager.until(|pool| pool.resources.contains_key("arm@sim")).await;
    assert!(provider.withdraw("arm@sim").await.unwrap(), "and nobody is held up");
}

#[tokio::test]
async fn resources_are_offered_updated_and_withdrawn() {
    let (_directory, endpoint) = place();
    let manager = Manager::new();
    let channels = channels();
    let session = Session::open(&channels, &endpoint, "cell", LONG);
    let provider = Provider::start(&channels, &endpoint, &session).unwrap();
    // Before there is a manager: later, by itself.
    assert!(!provider.offer(arm()).await.unwrap());
    let _serving = manager.serve(&endpoint).await;
    manager.until(|pool| pool.resources.contains_key("arm@sim")).await;
    session.alive(LONG).await.unwrap();

    assert!(provider.offer(arm().with_attribute("level", Value::Float(0.5))).await.unwrap());
    assert!(manager.pool.lock().unwrap().resources["arm@sim"].attributes.contains_key("level"));
    let refused = provider.offer(Resource::new("x", ResourceClass::Module, "Forbidden")).await.unwrap_err();
    assert_eq!(refused.to_string(), "not here");
    assert_eq!(provider.offered().await.len(), 1);
    provider.withdraw("arm@sim").await.unwrap();
    provider.withdraw("arm@sim").await.unwrap();
    assert!(manager.pool.lock().unwrap().resources.is_empty());
}

#[tokio::test]
async fn what_was_withdrawn_while_nobody_answered_is_gone_once_somebody_does() {
    let (_directory, endpoint) = place();
    let manager = Manager::new();
    let (stop, serving) = manager.serve(&endpoint).await;
    let channels = channels();
    let session = Session::open(&channels, &endpoint, "cell", LONG);
    let provider = Provider::start(&channels, &endpoint, &session).unwrap();
    session.alive(LONG).await.unwrap();
    assert!(provider.offer(arm()).await.unwrap());

    stop.cancel();
    serving.await.unwrap();
    let _ = provider.withdraw("arm@sim").await;
    // It was away for a moment and has forgotten nothing.
    let _serving = manager.serve(&endpoint).await;
    manager.until(|pool| pool.resources.is_empty()).await;
}

#[tokio::test]
async fn a_resource_that_another_session_still_has_is_offered_until_that_one_is_over() {
    let (_directory, endpoint) = place();
    let manager = Manager::new();
    manager.pool.lock().unwrap().taken.insert("arm@sim".to_owned());
    let _serving = manager.serve(&endpoint).await;
    let channels = channels();
    let session = Session::open(&channels, &endpoint, "cell", LONG);
    let provider = Provider::start(&channels, &endpoint, &session).unwrap();
    session.alive(LONG).await.unwrap();
    assert!(!provider.offer(arm()).await.unwrap());
    manager.pool.lock().unwrap().taken.clear();
    manager.until(|pool| pool.resources.contains_key("arm@sim")).await;
}

#[tokio::test]
async fn a_resource_that_went_with_its_session_before_its_creation_was_answered_is_offered_again() {
    let (_directory, endpoint) = place();
    let manager = Manager::new();
    manager.pool.lock().unwrap().short_lived = 2;
    let _serving = manager.serve(&endpoint).await;
    let channels = channels();
    let session = Session::open(&channels, &endpoint, "cell", LONG);
    let provider = Provider::start(&channels, &endpoint, &session).unwrap();
    session.alive(LONG).await.unwrap();
    assert!(!provider.offer(arm()).await.unwrap());
    manager.until(|pool| pool.resources.contains_key("arm@sim")).await;
}

#[tokio::test]
async fn what_a_new_watch_does_not_show_is_offered_again_although_nobody_said_that_the_session_was_made_anew() {
    let (_directory, endpoint) = place();
    let manager = Manager::new();
    // The watch has begun before the arm is offered, and shows nothing yet.
    manager.pool.lock().unwrap().shows = Some(false);
    let _serving = manager.serve(&endpoint).await;
    let channels = channels();
    let session = Session::open(&channels, &endpoint, "cell", LONG);
    let provider = Provider::start(&channels, &endpoint, &session).unwrap();
    session.alive(LONG).await.unwrap();
    assert!(provider.offer(Resource::new("spare@sim", ResourceClass::Module, "Arm")).await.unwrap());
    manager.until(|pool| pool.watches == 1).await;
    assert!(provider.withdraw("spare@sim").await.unwrap());
    assert!(provider.offer(arm()).await.unwrap());
    // The session ended and was made anew by a ping whose answer was lost. The first question for the arm is not answered either.
    {
        let mut pool = manager.pool.lock().unwrap();
        pool.resources.clear();
        (pool.shows, pool.busy) = (Some(true), 1);
    }
    manager.changed.send_replace(());
    manager.until(|pool| pool.resources.contains_key("arm@sim")).await;
    assert_eq!(session.state().borrow().generation, 1);
}

/// A process manager's drivers: it does not follow the leases of what it offers.
#[tokio::test]
async fn what_may_still_move_for_who_held_it_under_a_lapsed_session_is_offered_again_when_its_bound_has_passed() {
    let (_directory, endpoint) = place();
    let manager = Manager::new();
    let _serving = manager.serve(&endpoint).await;
    let channels = channels();
    let session = Session::open(&channels, &endpoint, "pools", TTL);
    let provider = Provider::start(&channels, &endpoint, &session).unwrap();
    session.alive(LONG).await.unwrap();
    let bound = Duration::from_millis(1_500);
    let began = Instant::now();
    let planner = Resource::new("planner@sim", ResourceClass::Process, "Planner");
    for new in [arm().with_standstill(bound), planner.clone()] {
        assert!(provider.offer(new).await.unwrap());
    }
    assert!(began.elapsed() < bound, "what is new has moved for nobody");
    let began = Instant::now();
    {
        let mut pool = manager.pool.lock().unwrap();
        pool.sessions.clear();
        pool.resources.clear();
    }
    manager.until(|pool| pool.resources.contains_key("planner@sim")).await;
    // Not by an update either.
    let updated = arm().with_standstill(bound).with_attribute("level", Value::Float(0.5));
    assert!(!provider.offer(updated).await.unwrap() || began.elapsed() >= bound);
    assert!(!manager.pool.lock().unwrap().resources.contains_key("arm@sim") || began.elapsed() >= bound);
    manager.until(|pool| pool.resources.contains_key("arm@sim")).await;
    assert!(began.elapsed() >= bound, "after {:?}", began.elapsed());
    // What a process before this one has offered.
    let provider = Provider::start(&channels, &endpoint, &session).unwrap();
    let other = Resource::new("other@sim", ResourceClass::Module, "Arm").with_standstill(bound);
    let began = Instant::now();
    provider.may_move(&[other.clone(), planner]).await;
    assert!(!provider.offer(other).await.unwrap() || began.elapsed() >= bound);
    manager.until(|pool| pool.resources.contains_key("other@sim")).await;
    assert!(began.elapsed() >= bound, "after {:?}", began.elapsed());
}

#[tokio::test]
async fn what_was_offered_with_an_answer_that_was_lost_is_offered_again_when_its_bound_has_passed() {
    let (_directory, endpoint) = place();
    let manager = Manager::new();
    let _serving = manager.serve(&endpoint).await;
    let channels = channels();
    let session = Session::open(&channels, &endpoint, "pools", TTL);
    let provider = Provider::start(&channels, &endpoint, &session).unwrap();
    session.alive(LONG).await.unwrap();
    let bound = Duration::from_millis(1_500);
    manager.pool.lock().unwrap().loses_answers = true;
    let lost = async {
        manager.until(|pool| pool.resources.contains_key("arm@sim")).await;
        // Somebody may hold it by now. The session ends and is made anew before the answer is known to be lost.
        {
            let mut pool = manager.pool.lock().unwrap();
            pool.sessions.clear();
            pool.resources.clear();
        }
        session.state().wait_for(|state| state.generation == 2).await.unwrap();
        manager.pool.lock().unwrap().loses_answers = false;
        manager.changed.send_replace(());
        Instant::now()
    };
    let (offered, began) = tokio::join!(provider.offer(arm().with_standstill(bound)), lost);
    assert!(!offered.unwrap());
    manager.until(|pool| pool.resources.contains_key("arm@sim")).await;
    assert!(began.elapsed() >= bound, "after {:?}", began.elapsed());
}

#[tokio::test]
async fn what_an_earlier_process_offered_in_a_session_that_has_ended_since_is_offered_when_the_bound_of_then_has_passed()
 {
    let (_directory, endpoint) = place();
    let manager = Manager::new();
    let _serving = manager.serve(&endpoint).await;
    let channels = channels();
    let session = Session::open(&channels, &endpoint, "pools", TTL);
    let provider = Provider::start(&channels, &endpoint, &session).unwrap();
    session.alive(LONG).await.unwrap();
    let bound = Duration::from_millis(1_500);
    let wanted = arm().with_standstill(Duration::from_millis(1));
    provider.offered_before(vec![(wanted.clone(), Some(bound))]).await;
    let began = Instant::now();
    {
        let mut pool = manager.pool.lock().unwrap();
        pool.sessions.clear();
        pool.resources.clear();
    }
    session.state().wait_for(|state| state.generation == 2).await.unwrap();
    assert!(!provider.offer(wanted).await.unwrap() || began.elapsed() >= bound);
    manager.until(|pool| pool.resources.contains_key("arm@sim")).await;
    assert!(began.elapsed() >= bound, "after {:?}", began.elapsed());
}

#[tokio::test]
async fn what_the_manager_has_confirmed_is_not_asked_for_while_another_resource_waits() {
    let (_directory, endpoint) = place();
    let manager = Manager::new();
    let _serving = manager.serve(&endpoint).await;
    let channels = channels();
    let session = Session::open(&channels, &endpoint, "pools", LONG);
    let provider = Provider::start(&channels, &endpoint, &session).unwrap();
    session.alive(LONG).await.unwrap();
    let moving = arm().with_standstill(Duration::from_millis(700));
    let planner = Resource::new("planner@sim", ResourceClass::Process, "Planner");
    assert!(provider.offer(planner.clone()).await.unwrap());
    provider.may_move(std::slice::from_ref(&moving)).await;
    assert!(!provider.offer(moving).await.unwrap());
    manager.until(|pool| pool.resources.contains_key("arm@sim")).await;
    assert_eq!(manager.pool.lock().unwrap().creations["planner@sim"], 1);
    assert!(
        provider.offer(planner.with_attribute("level", Value::Float(0.5))).await.unwrap(),
        "an update is asked for"
    );
    assert_eq!(manager.pool.lock().unwrap().creations["planner@sim"], 2);
}

#[tokio::test]
async fn what_the_manager_had_and_refuses_is_offered_again_when_it_does_not_any_more() {
    let (_directory, endpoint) = place();
    let manager = Manager::new();
    let _serving = manager.serve(&endpoint).await;
    let channels = channels();
    let session = Session::open(&channels, &endpoint, "pools", TTL);
    let provider = Provider::start(&channels, &endpoint, &session).unwrap();
    session.alive(LONG).await.unwrap();
    assert!(provider.offer(arm()).await.unwrap());
    {
        let mut pool = manager.pool.lock().unwrap();
        pool.sessions.clear();
        pool.resources.clear();
        (pool.forbids, pool.creations) = (true, BTreeMap::new());
    }
    manager.until(|pool| pool.creations.contains_key("arm@sim")).await;
    manager.pool.lock().unwrap().forbids = false;
    manager.until(|pool| pool.resources.contains_key("arm@sim")).await;
}

#[tokio::test]
async fn an_update_that_is_refused_is_asked_for_again_when_it_is_not_refused_any_more() {
    let (_directory, endpoint) = place();
    let manager = Manager::new();
    let _serving = manager.serve(&endpoint).await;
    let channels = channels();
    let session = Session::open(&channels, &endpoint, "pools", LONG);
    let provider = Provider::start(&channels, &endpoint, &session).unwrap();
    session.alive(LONG).await.unwrap();
    assert!(provider.offer(arm()).await.unwrap());
    manager.pool.lock().unwrap().forbids = true;
    assert!(provider.offer(arm().with_attribute("level", Value::Float(0.5))).await.is_err());
    manager.pool.lock().unwrap().forbids = false;
    manager.until(|pool| pool.resources["arm@sim"].attributes.contains_key("level")).await;
}

#[tokio::test]
async fn a_bound_for_standstill_stays_where_the_resource_is_withdrawn_and_wanted_again() {
    let (_directory, endpoint) = place();
    let manager = Manager::new();
    let _serving = manager.serve(&endpoint).await;
    let channels = channels();
    let session = Session::open(&channels, &endpoint, "pools", LONG);
    let provider = Provider::start(&channels, &endpoint, &session).unwrap();
    session.alive(LONG).await.unwrap();
    let bound = Duration::from_millis(700);
    let moving = arm().with_standstill(bound);
    let began = Instant::now();
    provider.may_move(std::slice::from_ref(&moving)).await;
    assert!(provider.withdraw("arm@sim").await.unwrap());
    assert!(!provider.offer(moving.clone()).await.unwrap() || began.elapsed() >= bound);
    manager.until(|pool| pool.resources.contains_key("arm@sim")).await;
    assert!(began.elapsed() >= bound, "after {:?}", began.elapsed());
    // Whoever held it when it was withdrawn has lost it as well.
    let began = Instant::now();
    assert!(provider.withdraw("arm@sim").await.unwrap());
    assert!(!provider.offer(moving).await.unwrap() || began.elapsed() >= bound);
    manager.until(|pool| pool.resources.contains_key("arm@sim")).await;
    assert!(began.elapsed() >= bound, "after {:?}", began.elapsed());
}
