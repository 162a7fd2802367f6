//! Scenes for planners: each is sent as the difference from a scene that the planner has.
//!
//! A projection's scene is that of its base with the moves of its effects, and the base's scene is that of an earlier revision with the facts
//! written since. So a scene costs as much as its difference from a known one. Scenes that were sent are kept for a while, by digest; a planner
//! that has none of them is sent the whole scene.

use super::core::{QueryError, WorldPool};
use super::history::History;
use ratn_model::fact::{Change, FactPattern, Footprint, SCENE_PREDICATES};
use ratn_model::id::{ProjectionId, Revision};
use ratn_world::digest::Digest;
use ratn_world::scene::delta::SceneDelta;
use ratn_world::scene::live::LiveScene;
use ratn_world::world::World;
use std::collections::{BTreeMap, VecDeque};

/// Maximum number of sent scenes that are kept; they share their common parts.
const MAX_SENT: usize = 64;
/// Maximum number of revisions whose scenes are kept, to derive later scenes from.
const MAX_FOLLOWED: usize = 16;

/// The scenes that are kept.
#[derive(Debug, Default)]
pub(super) struct Scenes {
    /// The scene that was sent last is at the end.
    sent: VecDeque<(Digest, LiveScene)>,
    followed: BTreeMap<Revision, LiveScene>,
}

impl WorldPool {
    /// The scene of a projection or of the root, as a difference from the first of `bases` that is kept here, else the whole scene.
    pub(super) fn scene(&mut self, id: Option<ProjectionId>, bases: &[Digest]) -> Result<SceneDelta, QueryError> {
        let scene = match id {
            None => {
                let root = self.root().revision();
                self.scenes.follow(&self.history, root)?
            }
            Some(id) => {
                let unknown = self.missing(id);
                let projection = self.projections.get(&id).ok_or(unknown)?;
                if shows_all(&projection.reads) {
                    let mut scene = self.scenes.follow(&self.history, projection.base)?;
                    scene.update(self.history.at(projection.base)?, &projection.world, &projection.moves)?;
                    scene
                } else {
                    LiveScene::of(&shown(&projection.world, &projection.reads))?
                }
            }
        };
        Ok(self.scenes.delta(scene, bases))
    }
}

impl Scenes {
    /// Forgets the revisions of another history.
    pub(super) fn forget(&mut self) {
        self.followed.clear();
    }

    /// The scene of a revision, derived from the latest earlier one that is kept. All changes between the two are applied as one, so a revision
    /// of which no scene can be made does not affect later ones.
    fn follow(&mut self, history: &History, revision: Revision) -> Result<LiveScene, QueryError> {
        let world = history.at(revision)?;
        let known = self.followed.range(..=revision).next_back();
        let scene = match known.filter(|(known, _)| history.at(**known).is_ok()) {
            Some((known, scene)) => {
                let mut scene = scene.clone();
                let since = history.after(*known)?.take_while(|kept| kept.world.revision() <= revision);
                let changes: Vec<Change> = since.flat_map(|kept| kept.changes()).collect();
                scene.update(history.at(*known)?, world, &changes)?;
                scene
            }
            None => LiveScene::of(world)?,
        };
        self.followed.insert(revision, scene.clone());
        if self.followed.len() > MAX_FOLLOWED {
            self.followed.pop_first();
        }
        Ok(scene)
    }

    fn delta(&mut self, scene: LiveScene, bases: &[Digest]) -> SceneDelta {
        let kept = |base: &Digest| self.sent.iter().find(|(digest, _)| digest == base);
        let delta = match bases.iter().find_map(kept) {
            Some((_, base)) => SceneDelta::between(base, &scene),
            None => SceneDelta::whole(&scene),
        };
        self.sent.retain(|(digest, _)| *digest != delta.to);
        self.sent.push_back((delta.to, scene));
        if self.sent.len() > MAX_SENT {
            self.sent.pop_front();
        }
        delta
    }
}

/// The changes that move something in the scene.
pub(super) fn moves(changes: &[Change]) -> Vec<Change> {
    let is_geometric = |change: &&Change| {
        let pattern = change.pattern();
        SCENE_PREDICATES.contains(&(pattern.predicate.as_str(), pattern.arguments.len()))
    };
    changes.iter().filter(is_geometric).cloned().collect()
}

/// Whether a projection with these reads shows the whole scene.
fn shows_all(reads: &Footprint) -> bool {
    let Footprint::Patterns(reads) = reads else { return true };
    SCENE_PREDICATES.into_iter().all(|(predicate, arity)| {
        let all = FactPattern { predicate: predicate.to_owned(), arguments: vec![None; arity] };
        reads.iter().any(|read| read.covers(&all))
    })
}

/// The visible part of a world.
fn shown(world: &World, reads: &Footprint) -> World {
    let Footprint::Patterns(reads) = reads else { return world.clone() };
    let facts = reads.iter().flat_map(|read| world.matching(read));
    World::from_facts(facts.map(|(key, fact)| (key.clone(), fact.value.clone())), world.revision())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use crate::world_pool::WorldPoolConfig;
    use crate::world_pool::core::{HeldBy, ProjectRequest};
    use crate::world_pool::history::Commit;
    use prost::Message;
    use ratn_model::fact::{FactKey, Term};
    use ratn_model::pose::Pose;
    use ratn_model::time::Timestamp;
    use ratn_model::value::Value;
    use ratn_proto::v1;
    use ratn_world::scene::{Scene, Shape};

    /// Maximum bytes sent to a planner that has a scene of this many objects when one of them has moved.
    const OBJECTS: usize = 1_000;
    const MOST_BYTES: usize = 512;

    fn fact(predicate: &str, object: usize) -> FactKey {
        FactKey { predicate: predicate.to_owned(), arguments: vec![Term::Name(format!("box_{object}"))] }
    }

    fn at(object: usize, x: f64) -> Change {
        let pose = Pose { position: [x, 0.5, 0.0], ..Pose::IDENTITY };
        Change::Set { fact: fact("at", object), value: Value::Pose(pose) }
    }

    fn pool() -> WorldPool {
        let config = WorldPoolConfig::default();
        let history = History::new(&config);
        let mut pool = WorldPool::new(config, None, history, 0);
        let shape = Shape::Box { size: [0.1, 0.2, 0.3] }.to_value();
        let of = |object| [at(object, 0.0), Change::Set { fact: fact("shape", object), value: shape.clone() }];
        commit(&mut pool, "all", (0..OBJECTS).flat_map(of).collect());
        pool
    }

    fn commit(pool: &mut WorldPool, id: &str, changes: Vec<Change>) {
        pool.commit(Timestamp(0), &Commit { id: id.to_owned(), changes, ..Commit::default() }).unwrap();
    }

    fn project(pool: &mut WorldPool, base: u64, changes: Vec<Change>, reads: Footprint) -> ProjectionId {
        let request = ProjectRequest {
            by: crate::access::Caller::default(),
            request_id: format!("{base} {changes:?} {reads:?}"),
            id: None,
            after: None,
            base: Revision(base),
            changes,
            writers: Vec::new(),
            reads,
            held_by: HeldBy::Until(Timestamp(9)),
        };
        pool.project(request).unwrap()
    }

    fn bytes(delta: &SceneDelta) -> usize {
        v1::GetSceneResponse::from(delta.clone()).encoded_len()
    }

    #[test]
    fn of_a_thousand_objects_only_what_moved_is_sent() {
        let mut pool = pool();
        let mut planner = ratn_world::scene::delta::Scenes::new(4);
        let whole = pool.scene(None, &[]).unwrap();
        assert_eq!((whole.from, whole.len()), (None, OBJECTS));
        assert!(bytes(&whole) > 50_000, "{}", bytes(&whole));
        planner.apply(&whole).unwrap();
        commit(&mut pool, "one", vec![at(3, 1.0)]);
        for (number, changes) in [vec![at(5, 2.0)], vec![at(5, 3.0), at(7, 3.0)], Vec::new()].into_iter().enumerate() {
            let id = project(&mut pool, 2, changes, Footprint::Everything);
            let bases: Vec<Digest> = planner.digests().collect();
            let delta = pool.scene(Some(id), &bases).unwrap();
            assert_eq!(delta.from, Some(bases[0]), "{number}: from the scene used last");
            assert!(delta.len() <= 3 && bytes(&delta) <= MOST_BYTES, "{number}: {} bytes", bytes(&delta));
            let expected = Scene::of(&pool.projections[&id].world).unwrap();
            assert_eq!(*planner.apply(&delta).unwrap(), expected, "{number}");
        }
    }

    #[test]
    fn who_has_no_scene_that_is_kept_is_sent_all_of_it() {
        let mut pool = pool();
        let first = pool.scene(None, &[]).unwrap().to;
        for number in 0..MAX_SENT {
            commit(&mut pool, &number.to_string(), vec![at(0, 1.0 + number as f64)]);
            pool.scene(None, &[first]).unwrap();
        }
        let late = pool.scene(None, &[first]).unwrap();
        assert_eq!((late.from, late.len()), (None, OBJECTS));
        assert!(pool.scenes.sent.len() <= MAX_SENT && pool.scenes.followed.len() <= MAX_FOLLOWED);
        let unknown = pool.scene(None, &[Digest::default()]).unwrap();
        assert_eq!(unknown.from, None);
    }

    #[test]
    fn a_scene_is_made_of_what_is_shown_and_of_nothing_else() {
        let mut pool = pool();
        let reads = Footprint::Patterns(vec![FactPattern::of(&fact("at", 1)), FactPattern::of(&fact("shape", 1))]);
        let id = project(&mut pool, 1, vec![at(1, 4.0), at(2, 4.0)], reads);
        let delta = pool.scene(Some(id), &[]).unwrap();
        assert_eq!(delta.changed.len(), 1);
        assert_eq!(delta.changed[0].1.name, "box_1");
        assert!(pool.release(id));
        assert_eq!(pool.scene(Some(id), &[]), Err(QueryError::Unknown { id }));
        commit(&mut pool, "bad", vec![Change::Set { fact: fact("at", 1), value: Value::Int(1) }]);
        assert!(matches!(pool.scene(None, &[]), Err(QueryError::Scene(_))));
    }

    #[test]
    fn a_bad_fact_that_is_gone_spoils_no_scene_behind_it() {
        let set = |predicate: &str, value: Value| Change::Set { fact: fact(predicate, 1), value };
        let (text, far) = (Value::String("tray".to_owned()), Pose { position: [1e30, 0.0, 0.0], ..Pose::IDENTITY });
        let huge = Shape::Box { size: [1e30; 3] }.to_value();
        for bad in [set("at", text), set("shape", huge), set("at", Value::Pose(far))] {
            let mut pool = pool();
            let good = pool.scene(None, &[]).unwrap();
            commit(&mut pool, "bad", vec![bad, at(2, 7.0)]);
            assert!(matches!(pool.scene(None, &[]), Err(QueryError::Scene(_))));
            let shape = Shape::Box { size: [0.1, 0.2, 0.3] }.to_value();
            commit(&mut pool, "mended", vec![at(1, 0.0), set("shape", shape)]);
            let delta = pool.scene(None, &[good.to]).unwrap();
            assert_eq!((delta.from, delta.len()), (Some(good.to), 1), "one box is elsewhere");
            commit(&mut pool, "gone", vec![Change::Delete { pattern: FactPattern::of(&fact("at", 1)) }]);
            let mut planner = ratn_world::scene::delta::Scenes::new(4);
            let whole = pool.scene(None, &[]).unwrap();
            assert_eq!(*planner.apply(&whole).unwrap(), Scene::of(pool.root()).unwrap());
        }
    }
}
