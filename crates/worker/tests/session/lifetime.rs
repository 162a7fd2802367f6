//! How a session begins, is lost, comes back and ends.

use super::manager::Manager;
use super::{LONG, TTL, arm, channels, place};
use ratn_worker::boot_clock::BootClock;
use ratn_worker::protocol::{NEWEST, OLDEST};
use ratn_worker::provider::Provider;
use ratn_worker::session::Session;
use std::time::Duration;

#[tokio::test]
async fn a_session_lives_until_it_is_closed() {
    let (_directory, endpoint) = place();
    let manager = Manager::new();
    let _serving = manager.serve(&endpoint).await;
    let session = Session::open(&channels(), &endpoint, "test", TTL);
    session.alive(LONG).await.unwrap();
    let id = session.id().to_owned();
    manager.until(|pool| pool.sessions.contains_key(&id)).await;
    session.close().await;
    manager.until(|pool| pool.sessions.is_empty()).await;
    let spoken = Some(format!("{OLDEST}-{NEWEST} {}", env!("CARGO_PKG_VERSION")));
    assert_eq!(manager.pool.lock().unwrap().protocols, [spoken.clone(), spoken], "the farewell says it, too");
}

#[tokio::test]
async fn a_session_without_its_manager_is_not_alive() {
    let (_directory, endpoint) = place();
    let session = Session::open(&channels(), &endpoint, "test", TTL);
    let error = session.alive(Duration::from_millis(1)).await.unwrap_err().to_string();
    assert!(error.contains("rm.sock") && error.contains("is it running?"), "{error}");
}

#[tokio::test]
async fn a_session_whose_id_is_another_callers_says_so_and_is_itself_again_when_it_is_not() {
    let (_directory, endpoint) = place();
    let manager = Manager::new();
    let _serving = manager.serve(&endpoint).await;
    let session = Session::open_as(&channels(), &endpoint, "mine".to_owned(), "test", TTL);
    session.alive(LONG).await.unwrap();
    assert!(!session.state().borrow().taken);
    {
        // It has ended, and another opened the next one of its id.
        let mut pool = manager.pool.lock().unwrap();
        pool.sessions.remove("mine");
        pool.anothers.insert("mine".to_owned());
    }
    tokio::time::timeout(LONG, session.taken()).await.expect("nobody says so");
    tokio::time::timeout(LONG, session.lost()).await.expect("it is believed in");
    let refused = session.alive(TTL).await.unwrap_err().to_string();
    assert!(refused.contains("the id `mine` is another caller's"), "{refused}");
    manager.pool.lock().unwrap().anothers.clear();
    session.alive(LONG).await.unwrap();
    let state = *session.state().borrow();
    assert_eq!((state.taken, state.generation), (false, 2));
}

#[tokio::test]
async fn a_lost_session_says_so_and_comes_back_with_its_resources() {
    let (_directory, endpoint) = place();
    let manager = Manager::new();
    let (stop, serving) = manager.serve(&endpoint).await;
    let channels = channels();
    let session = Session::open(&channels, &endpoint, "cell", TTL);
    let provider = Provider::start(&channels, &endpoint, &session).unwrap();
    session.alive(LONG).await.unwrap();
    assert!(provider.offer(arm()).await.unwrap());
    let lost = session.lost();

    stop.cancel();
    serving.await.unwrap();
    // A manager without a memory comes back at the same place.
    manager.forget_everything();
    tokio::time::timeout(LONG, lost).await.expect("nobody said that the session was lost");
    let _serving = manager.serve(&endpoint).await;
    manager.until(|pool| pool.resources.contains_key("arm@sim")).await;
    assert_eq!(session.state().borrow().generation, 2);
}

#[tokio::test]
async fn a_session_that_was_made_anew_is_known_by_its_number_when_the_answer_that_said_so_was_lost() {
    let (_directory, endpoint) = place();
    let manager = Manager::new();
    let _serving = manager.serve(&endpoint).await;
    let session = Session::open(&channels(), &endpoint, "cell", LONG / 10);
    session.alive(LONG).await.unwrap();
    let first = *session.state().borrow();
    // A connection that breaks changes nothing.
    manager.pool.lock().unwrap().broken = 1;
    manager.until(|pool| pool.broken == 0 && pool.protocols.len() == 2).await;
    let pinged = manager.pool.lock().unwrap().pings;
    manager.until(|pool| pool.pings > pinged + 1).await;
    assert_eq!(*session.state().borrow(), first);

    manager.forget_everything();
    manager.pool.lock().unwrap().lost_answers = 1;
    let mut state = session.state();
    let anew = tokio::time::timeout(LONG, state.wait_for(|state| state.generation == 2)).await;
    assert!(anew.expect("nobody noticed that the session was made anew").unwrap().alive);
    let pool = manager.pool.lock().unwrap();
    assert_eq!((pool.made, pool.lost_answers), (2, 0));
}

#[tokio::test]
async fn a_session_with_a_new_id_is_no_earlier_process_s_though_the_answer_that_said_so_was_lost() {
    let (_directory, endpoint) = place();
    let manager = Manager::new();
    let _serving = manager.serve(&endpoint).await;
    for (of_a_new_id, found) in [(true, false), (false, true)] {
        manager.pool.lock().unwrap().lost_answers = 1;
        let session = match of_a_new_id {
            true => Session::open(&channels(), &endpoint, "cell", LONG / 10),
            // Nobody knows whether a process before it had this session.
            false => Session::open_as(&channels(), &endpoint, "known".to_owned(), "cell", LONG / 10),
        };
        session.alive(LONG).await.unwrap();
        assert_eq!(manager.pool.lock().unwrap().lost_answers, 0);
        assert_eq!(session.state().borrow().found, found, "a new id: {of_a_new_id}");
    }
}

#[tokio::test]
async fn a_session_is_over_when_the_machine_wakes_up_after_its_time_to_live_and_goes_on_where_the_manager_knows_it() {
    let (_directory, endpoint) = place();
    let manager = Manager::new();
    let (stop, serving) = manager.serve(&endpoint).await;
    let clock = BootClock::suspendable();
    let hour = Duration::from_secs(3_600);
    let session = Session::open_by(clock.clone(), &channels(), &endpoint, "cell".to_owned(), "cell", hour);
    session.alive(LONG).await.unwrap();
    stop.cancel();
    serving.await.unwrap();
    assert!(session.state().borrow().alive, "the manager may come back");
    let nearly_lost = session.nearly_lost(Duration::ZERO);
    clock.suspend(hour);
    tokio::time::timeout(LONG, session.lost()).await.expect("it is believed in for another hour");
    tokio::time::timeout(LONG, nearly_lost).await.expect("it is believed in for another hour");
    let _serving = manager.serve(&endpoint).await;
    session.alive(LONG).await.unwrap();
    assert_eq!(session.state().borrow().generation, 1);
}
