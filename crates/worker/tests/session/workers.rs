//! Workers that stand alone and move something: they are offered when they are at rest.

use super::manager::{Manager, Pool};
use super::{TTL, place};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::safety::{Brakes, Safety, SafetyState};
use ratn_worker::worker::{Worker, WorkerOptions};
use std::sync::Arc;
use tokio::sync::Semaphore;
use tokio_util::sync::CancellationToken;

/// A worker that stands alone and moves something: its session's id is another caller's from one moment on.
#[tokio::test]
async fn a_worker_whose_session_id_is_taken_goes_on_with_another_one_and_offers_nothing_before_it_is_at_rest() {
    let (directory, endpoint) = place();
    let manager = Manager::new();
    manager.pool.lock().unwrap().shows = Some(true);
    let _serving = manager.serve(&endpoint).await;
    let stands = Arc::new(Semaphore::new(0));
    let options = WorkerOptions {
        id: "arm@sim".to_owned(),
        kind: "Arm".to_owned(),
        listen: Endpoint::Unix(directory.path().join("arm.sock")),
        resource_manager: Some(endpoint),
        ..WorkerOptions::default()
    };
    let shutdown = CancellationToken::new();
    let worker = Worker::new(options).safety(Safety::new(SlowBrakes(Arc::clone(&stands)))).shutdown(shutdown.clone());
    let running = tokio::spawn(worker.run());
    let take = |pool: &mut Pool| {
        let ids: Vec<String> = std::mem::take(&mut pool.sessions).into_keys().collect();
        pool.resources.clear();
        pool.anothers.extend(ids);
    };
    manager.until(|pool| pool.watches > 1).await;
    take(&mut manager.pool.lock().unwrap());
    // A session of another id, and still nobody has said that nothing moves.
    manager.until(|pool| pool.sessions.len() == 1 && pool.watches > 3).await;
    tokio::time::sleep(3 * TTL).await;
    assert!(manager.pool.lock().unwrap().resources.is_empty());
    stands.add_permits(1);
    manager.until(|pool| pool.resources.contains_key("arm@sim")).await;
    take(&mut manager.pool.lock().unwrap());
    manager.until(|pool| pool.resources.contains_key("arm@sim")).await;
    {
        let pool = manager.pool.lock().unwrap();
        assert!(pool.sessions.contains_key(&pool.resources["arm@sim"].session_id));
        assert_eq!(pool.anothers.len(), 2, "each time another id");
    }
    shutdown.cancel();
    running.await.unwrap().unwrap();
}

/// Stands still when there is room to.
struct SlowBrakes(Arc<Semaphore>);

#[tonic::async_trait]
impl Brakes for SlowBrakes {
    async fn apply(&self, state: &SafetyState) -> Result<(), String> {
        if *state != SafetyState::Ready {
            self.0.acquire().await.unwrap().forget();
        }
        Ok(())
    }
}

#[tokio::test]
async fn a_worker_that_moves_something_is_offered_when_its_brakes_have_brought_it_to_rest() {
    let (directory, endpoint) = place();
    let manager = Manager::new();
    manager.pool.lock().unwrap().shows = Some(true);
    let _serving = manager.serve(&endpoint).await;
    let stands = Arc::new(Semaphore::new(0));
    let options = WorkerOptions {
        id: "arm@sim".to_owned(),
        kind: "Arm".to_owned(),
        listen: Endpoint::Unix(directory.path().join("arm.sock")),
        resource_manager: Some(endpoint),
        ..WorkerOptions::default()
    };
    let shutdown = CancellationToken::new();
    let worker = Worker::new(options).safety(Safety::new(SlowBrakes(Arc::clone(&stands)))).shutdown(shutdown.clone());
    let running = tokio::spawn(worker.run());
    manager.until(|pool| pool.watches > 1).await;
    tokio::time::sleep(3 * TTL).await;
    assert!(manager.pool.lock().unwrap().resources.is_empty());
    stands.add_permits(1);
    manager.until(|pool| pool.resources.contains_key("arm@sim")).await;
    shutdown.cancel();
    running.await.unwrap().unwrap();
}
