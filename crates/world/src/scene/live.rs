//! A scene that follows its world: each change costs only the objects that it moves.
//!
//! A fact about an individual moves that individual and everything that stands on it. The objects are in a persistent map: clones cost
//! nothing, and two versions are compared by what they do not share. The digest is the sum of the objects' digests, so it is updated as
//! cheaply. It distinguishes scenes, but does not protect against a caller that constructs two scenes with equal digests on purpose.

use super::{BASE, Placement, Scene, SceneError, SceneObject, Shape, base, object};
use crate::digest::{Digest, Digester};
use crate::world::{World, written};
use imbl::OrdMap;
use ratn_model::fact::{Change, FactKey, FactPattern, Term};
use ratn_model::pose::Pose;
use ratn_model::value::Value;
use std::collections::BTreeSet;
use std::sync::Arc;

/// A scene with the data to update it.
#[derive(Debug, Clone)]
pub struct LiveScene {
    pub(super) base: Pose,
    pub(super) objects: OrdMap<Term, Arc<SceneObject>>,
    /// The sum of the objects' digests, in four lanes.
    sum: [u64; 4],
}

impl Default for LiveScene {
    fn default() -> LiveScene {
        LiveScene { base: Pose::IDENTITY, objects: OrdMap::new(), sum: [0; 4] }
    }
}

/// Equal if the same objects are in the same places.
impl PartialEq for LiveScene {
    fn eq(&self, other: &LiveScene) -> bool {
        self.base == other.base && self.objects == other.objects
    }
}

impl LiveScene {
    /// The scene of a world; costs the scene.
    ///
    /// # Errors
    /// As [`Scene::of`].
    pub fn of(world: &World) -> Result<LiveScene, SceneError> {
        let mut scene = LiveScene { base: base(world)?, ..LiveScene::default() };
        let shapes = FactPattern { predicate: "shape".to_owned(), arguments: vec![None] };
        for (key, _) in world.matching(&shapes) {
            scene.put(&key.arguments[0], object(world, &key.arguments[0])?);
        }
        Ok(scene)
    }

    /// Follows the world from `before` to `after`, which is `before` with the changes; returns the number of individuals examined.
    /// Costs the changes, and the objects on what they move.
    ///
    /// # Errors
    /// As [`Scene::of`]; the scene is then unchanged.
    pub fn update(&mut self, before: &World, after: &World, changes: &[Change]) -> Result<usize, SceneError> {
        let is_geometric = |change: &&Change| {
            let pattern = change.pattern();
            let of =
                |(predicate, arity): (&str, usize)| pattern.predicate == predicate && pattern.arguments.len() == arity;
            ratn_model::fact::SCENE_PREDICATES.into_iter().any(of)
        };
        let geometric: Vec<Change> = changes.iter().filter(is_geometric).cloned().collect();
        let moved: BTreeSet<Term> = written(before, &geometric).into_iter().map(|key| first(&key)).collect();
        let mut todo: Vec<Term> = moved.iter().cloned().collect();
        let mut all = moved;
        while let Some(carrier) = todo.pop() {
            let on = FactPattern { predicate: "on".to_owned(), arguments: vec![None, Some(carrier)] };
            for (key, _) in after.matching(&on) {
                let carried = first(key);
                if all.insert(carried.clone()) {
                    todo.push(carried);
                }
            }
        }
        let mut next = self.clone();
        for individual in &all {
            next.put(individual, object(after, individual)?);
        }
        if all.contains(&Term::Name(BASE.to_owned())) {
            next.base = base(after)?;
        }
        *self = next;
        Ok(all.len())
    }

    /// Number of objects.
    pub fn len(&self) -> usize {
        self.objects.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.objects.is_empty()
    }

    /// A digest that is equal for scenes with the same objects in the same places.
    pub fn digest(&self) -> Digest {
        let mut digester = Digester::default();
        digester.value(&Value::Pose(self.base));
        digester.number(self.objects.len() as u64);
        self.sum.iter().for_each(|lane| digester.number(*lane));
        digester.finish()
    }

    /// The present scene as a [`Scene`], for planners; costs the scene.
    pub fn scene(&self) -> Scene {
        Scene { base: self.base, objects: self.objects.values().map(|object| object.as_ref().clone()).collect() }
    }

    /// Replaces an object, or removes it.
    pub(super) fn put(&mut self, individual: &Term, object: Option<SceneObject>) {
        let old = match object {
            Some(object) => {
                self.add(&object, u64::wrapping_add);
                self.objects.insert(individual.clone(), Arc::new(object))
            }
            None => self.objects.remove(individual),
        };
        if let Some(old) = old {
            self.add(&old, u64::wrapping_sub);
        }
    }

    fn add(&mut self, object: &SceneObject, how: fn(u64, u64) -> u64) {
        let digest = digest_of(object);
        let (lanes, _) = digest.as_bytes().as_chunks::<8>();
        for (sum, lane) in self.sum.iter_mut().zip(lanes) {
            *sum = how(*sum, u64::from_le_bytes(*lane));
        }
    }
}

fn first(key: &FactKey) -> Term {
    key.arguments[0].clone()
}

fn digest_of(object: &SceneObject) -> Digest {
    let mut digester = Digester::default();
    digester.text(&object.name);
    let numbers: &[f64] = match &object.shape {
        Shape::Box { size } => size,
        Shape::Cylinder { radius, length } => &[*radius, *length],
    };
    digester.number(numbers.len() as u64);
    numbers.iter().for_each(|x| digester.number(x.to_bits()));
    let (place, pose) = match &object.placement {
        Placement::World(pose) => (0, pose),
        Placement::Gripper(pose) => (1, pose),
        Placement::Hand { pose, .. } => (2, pose),
    };
    digester.number(place);
    if let Placement::Hand { arm, .. } = &object.placement {
        digester.text(arm);
    }
    digester.value(&Value::Pose(*pose));
    digester.finish()
}
