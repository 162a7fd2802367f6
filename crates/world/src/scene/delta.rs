//! Differences between two scenes: a planner that has a scene of a thousand objects gets only the two that moved.
//!
//! A delta contains the digests of its start scene and of its target scene. It is refused for another start scene, and its result is
//! checked; a reader without the start scene asks for [`SceneDelta::whole`]. [`Scenes`] keeps the last few scenes by digest.

use super::live::LiveScene;
use super::{Scene, SceneObject};
use crate::digest::Digest;
use imbl::ordmap::DiffItem;
use ratn_model::fact::Term;
use ratn_model::pose::Pose;
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;
use std::sync::Arc;

/// The difference between two scenes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SceneDelta {
    /// The digest of the start scene; `None`: the empty scene.
    pub from: Option<Digest>,
    /// The digest of the target scene.
    pub to: Digest,
    /// Pose of the robot's base.
    pub base: Pose,
    /// Individuals that are no longer objects, in order.
    pub gone: Vec<Term>,
    /// New or changed objects, in the order of individuals.
    pub changed: Vec<(Term, SceneObject)>,
}

/// Error: a delta does not lead to its target scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum DeltaError {
    /// It starts from another scene.
    #[error("the delta starts from scene {from}, and this is scene {found}; ask for the whole scene")]
    OtherBase {
        /// Digest of its start scene.
        from: Digest,
        /// Digest of the scene to which it was applied.
        found: Digest,
    },
    /// The result is another scene than the target.
    #[error("the delta leads to scene {found} instead of {to}; ask for the whole scene")]
    OtherResult {
        /// Digest of its target scene.
        to: Digest,
        /// Digest of the result.
        found: Digest,
    },
}

impl SceneDelta {
    /// The delta between two scenes; costs what they do not share.
    pub fn between(from: &LiveScene, to: &LiveScene) -> SceneDelta {
        let mut delta = SceneDelta { from: Some(from.digest()), ..SceneDelta::empty(to) };
        for item in from.objects.diff(&to.objects) {
            match item {
                DiffItem::Remove(individual, _) => delta.gone.push(individual.clone()),
                DiffItem::Add(individual, object) => delta.changed.push((individual.clone(), object.as_ref().clone())),
                DiffItem::Update { old: (_, old), new: (individual, object) } => {
                    if old != object {
                        delta.changed.push((individual.clone(), object.as_ref().clone()));
                    }
                }
            }
        }
        delta
    }

    /// The delta from the empty scene.
    pub fn whole(scene: &LiveScene) -> SceneDelta {
        let all = scene.objects.iter().map(|(individual, object)| (individual.clone(), object.as_ref().clone()));
        SceneDelta { changed: all.collect(), ..SceneDelta::empty(scene) }
    }

    /// Applies the delta to a scene.
    ///
    /// # Errors
    /// [`DeltaError`]: the caller then asks for the whole scene.
    pub fn apply(&self, scene: &LiveScene) -> Result<LiveScene, DeltaError> {
        let mut next = match self.from {
            None => LiveScene::default(),
            Some(from) => {
                let found = scene.digest();
                if found != from {
                    return Err(DeltaError::OtherBase { from, found });
                }
                scene.clone()
            }
        };
        next.base = self.base;
        self.gone.iter().for_each(|individual| next.put(individual, None));
        for (individual, object) in &self.changed {
            next.put(individual, Some(object.clone()));
        }
        let found = next.digest();
        if found == self.to { Ok(next) } else { Err(DeltaError::OtherResult { to: self.to, found }) }
    }

    /// Number of objects in it.
    pub fn len(&self) -> usize {
        self.gone.len() + self.changed.len()
    }

    /// Whether it contains no objects; the base may still differ.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    fn empty(to: &LiveScene) -> SceneDelta {
        SceneDelta { from: None, to: to.digest(), base: to.base, gone: Vec::new(), changed: Vec::new() }
    }
}

/// The most recently used scenes, by digest; they share what they have in common.
#[derive(Debug, Clone)]
pub struct Scenes {
    /// The most recently used scene is last.
    kept: VecDeque<(Digest, LiveScene, Arc<Scene>)>,
    limit: usize,
}

impl Scenes {
    /// A cache for `limit` scenes, at least one.
    pub fn new(limit: usize) -> Scenes {
        Scenes { kept: VecDeque::new(), limit: limit.max(1) }
    }

    /// A scene by its digest.
    pub fn get(&mut self, digest: Digest) -> Option<Arc<Scene>> {
        let at = self.kept.iter().position(|(kept, ..)| *kept == digest)?;
        let found = self.kept.remove(at)?;
        let scene = Arc::clone(&found.2);
        self.kept.push_back(found);
        Some(scene)
    }

    /// The digests in the cache, most recently used first: possible start scenes of a delta.
    pub fn digests(&self) -> impl Iterator<Item = Digest> {
        self.kept.iter().rev().map(|(digest, ..)| *digest)
    }

    /// Applies a delta to its start scene and keeps the result.
    ///
    /// # Errors
    /// [`DeltaError`], also if the start scene is not in the cache.
    pub fn apply(&mut self, delta: &SceneDelta) -> Result<Arc<Scene>, DeltaError> {
        if let Some(scene) = self.get(delta.to) {
            return Ok(scene);
        }
        let nothing = LiveScene::default();
        let from = self.kept.iter().find(|(digest, ..)| Some(*digest) == delta.from);
        let next = delta.apply(from.map_or(&nothing, |(_, scene, _)| scene))?;
        let scene = Arc::new(next.scene());
        if self.kept.len() >= self.limit {
            self.kept.pop_front();
        }
        self.kept.push_back((delta.to, next, Arc::clone(&scene)));
        Ok(scene)
    }
}
