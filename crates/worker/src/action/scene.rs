//! The scene of a goal's projection, fetched as the difference from a scene that the worker has.

use super::GoalContext;
use super::context::WorldFailure;
use crate::client::retry_unanswered;
use ratn_world::digest::Digest;
use ratn_world::scene::Scene;
use ratn_world::scene::delta::Scenes;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Number of scenes that a worker keeps as bases of such differences.
const MAX_KEPT: usize = 8;

/// The scenes that an action used last; an action keeps one cache for its whole lifetime.
#[derive(Debug)]
pub struct SceneCache(Mutex<Scenes>);

impl Default for SceneCache {
    fn default() -> SceneCache {
        SceneCache(Mutex::new(Scenes::new(MAX_KEPT)))
    }
}

impl SceneCache {
    fn kept(&self) -> MutexGuard<'_, Scenes> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl GoalContext {
    /// The geometric scene of the goal's projection (without a projection: of the root), derived from its facts.
    ///
    /// # Errors
    /// [`WorldFailure`]; also if a geometric fact yields no geometry.
    pub async fn scene(&self, cache: &SceneCache) -> Result<Arc<Scene>, WorldFailure> {
        let client = self.world_client()?;
        let bases: Vec<Digest> = cache.kept().digests().collect();
        let delta = retry_unanswered(|| client.scene(self.projection, &bases)).await?;
        if let Ok(scene) = cache.kept().apply(&delta) {
            return Ok(scene);
        }
        // Other goals may have evicted the base meanwhile.
        let whole = retry_unanswered(|| client.scene(self.projection, &[])).await?;
        Ok(cache.kept().apply(&whole)?)
    }
}
