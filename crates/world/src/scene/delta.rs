//! Differences between two scenes: a planner that has a scene of a thousand objects is sent the two that moved.
//!
//! A delta names the digest of the scene that it starts from and of the one it leads to. Applied to another it is refused, and what
//! comes out is compared with what it should be; a reader without the base asks for [`SceneDelta::whole`]. [`Scenes`] keeps the last few
//! by digest.

use super::live::LiveScene;
use super::{Scene, SceneObject};
use crate::digest::Digest;
use imbl::ordmap::DiffItem;
use ratn_model::fact::Term;
use ratn_model::pose::Pose;
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;
use std::sync::Arc;

/// The way from one scene to another.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SceneDelta {
    /// What it starts from; `None`: from nothing.
    pub from: Option<Digest>,
    /// What it leads to.
    pub to: Digest,
    /// Where the robot's base stands.
    pub base: Pose,
    /// Individuals that are no objects any more, in order.
    pub gone: Vec<Term>,
    /// Objects that are new or otherwise than before, in the order of individuals.
    pub changed: Vec<(Term, SceneObject)>,
}

/// A delta that does not lead where it should.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum DeltaError {
    /// It starts from another scene.
    #[error("the delta starts from scene {from}, and this is scene {found}; ask for the whole scene")]
    OtherBase {
        /// What it starts from.
        from: Digest,
        /// What it was applied to.
        found: Digest,
    },
    /// What comes out is not what was meant.
    #[error("the delta leads to scene {found} instead of {to}; ask for the whole scene")]
    OtherResult {
        /// What it should lead to.
        to: Digest,
        /// What it leads to.
        found: Digest,
    },
}

impl SceneDelta {
    /// From one scene to another; costs what they do not share.
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

    /// A scene from nothing.
    pub fn whole(scene: &LiveScene) -> SceneDelta {
        let all = scene.objects.iter().map(|(individual, object)| (individual.clone(), object.as_ref().clone()));
        SceneDelta { changed: all.collect(), ..SceneDelta::empty(scene) }
    }

    /// The scene that it leads to.
    ///
    /// # Errors
    /// [`DeltaError`]: the caller asks for the whole scene then.
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

    /// How many objects it speaks of.
    pub fn len(&self) -> usize {
        self.gone.len() + self.changed.len()
    }

    /// Whether it changes nothing but, perhaps, the base.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    fn empty(to: &LiveScene) -> SceneDelta {
        SceneDelta { from: None, to: to.digest(), base: to.base, gone: Vec::new(), changed: Vec::new() }
    }
}

/// The scenes used last, by digest; each shares with the others what they have in common.
#[derive(Debug, Clone)]
pub struct Scenes {
    /// The one used last comes last.
    kept: VecDeque<(Digest, LiveScene, Arc<Scene>)>,
    limit: usize,
}

impl Scenes {
    /// Keeps so many, at least one.
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

    /// The digests kept, that used last first: what a delta may start from.
    pub fn digests(&self) -> impl Iterator<Item = Digest> {
        self.kept.iter().rev().map(|(digest, ..)| *digest)
    }

    /// The scene that a delta leads to, kept from now on.
    ///
    /// # Errors
    /// [`DeltaError`] also where the scene that it starts from is not kept.
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
