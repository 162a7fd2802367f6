//! The root's history and the projections of it: a pure state machine.
//!
//! A projection is a clone of a kept revision with its changes applied, so it costs its effects, whatever the size of the
//! world. It shows its declared reads and nothing else, and it ends with its lease. The history is durable, projections are not: they
//! end with the process, and no later one has the id of an earlier one.

use super::WorldPoolConfig;
use super::expiry::Expiry;
use super::history::{Commit, CommitError, History, RevisionError};
use super::memory::{Memory, Reused, fingerprint};
use ratn_model::fact::{Change, FactKey, FactPattern, Footprint};
use ratn_model::id::{LeaseId, ProjectionId, Revision};
use ratn_model::ontology::Ontology;
use ratn_model::time::Timestamp;
use ratn_model::tolerance::{Tolerance, Tolerances};
use ratn_proto::types::Contradiction;
use ratn_world::reads::{Effect, Live};
use ratn_world::world::{ChangeError, Fact, World};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

/// The pool's whole state.
#[derive(Debug)]
pub(super) struct WorldPool {
    config: WorldPoolConfig,
    pub(super) history: History,
    ontology: Option<Ontology>,
    expiry: Expiry,
    tolerances: Tolerances,
    projections: BTreeMap<ProjectionId, Projection>,
    /// What they show, to compare with what is committed.
    live: Live<ProjectionId>,
    /// Since [`WorldPool::take_contradictions`].
    contradictions: Vec<Contradiction>,
    projected: Memory<ProjectionId>,
    by_lease: BTreeMap<LeaseId, BTreeSet<ProjectionId>>,
    last_projection: u64,
}

#[derive(Debug)]
struct Projection {
    world: World,
    base: Revision,
    reads: Footprint,
    held_by: HeldBy,
    request_id: String,
    /// The first that there was.
    contradiction: Option<Contradiction>,
}

/// What a projection lives as long as.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum HeldBy {
    /// A live lease of the resource manager.
    Lease(LeaseId),
    /// Nothing but time.
    Until(Timestamp),
}

/// A projection to be made.
#[derive(Debug)]
pub(super) struct ProjectRequest {
    pub(super) request_id: String,
    pub(super) base: Revision,
    pub(super) changes: Vec<Change>,
    /// Who will make the change at the same place; empty or missing: nobody.
    pub(super) writers: Vec<Arc<str>>,
    pub(super) reads: Footprint,
    pub(super) held_by: HeldBy,
}

impl ProjectRequest {
    fn effects(&self) -> impl Iterator<Item = Effect> {
        self.changes.iter().enumerate().map(|(place, change)| {
            let writer = self.writers.get(place).filter(|writer| !writer.is_empty());
            Effect { writer: writer.cloned(), change: change.clone() }
        })
    }
}

fn wire(found: ratn_world::reads::Contradiction<ProjectionId>, revision: Revision) -> Contradiction {
    let ratn_world::reads::Contradiction { projection, fact, was, is } = found;
    Contradiction { projection, fact, was, is, revision }
}

/// A projection that was not made.
#[derive(Debug, PartialEq, thiserror::Error)]
pub(super) enum ProjectError {
    #[error(transparent)]
    Revision(#[from] RevisionError),
    #[error(transparent)]
    Reused(#[from] Reused),
    #[error(transparent)]
    Change(#[from] ChangeError),
    #[error("{limit} projections exist: release some")]
    TooMany { limit: usize },
    #[error("the projection of request `{request_id}` has ended; ask with another request id")]
    Ended { request_id: String },
}

/// A question without an answer.
#[derive(Debug, PartialEq, thiserror::Error)]
pub(super) enum QueryError {
    #[error("{id} is unknown or has ended (its lease ended, or it was released)")]
    Unknown { id: ProjectionId },
    #[error("{id} does not show {pattern}: it is not among the reads declared for it; declare it (reads: […])")]
    Hidden { id: ProjectionId, pattern: FactPattern },
    #[error(transparent)]
    Revision(#[from] RevisionError),
}

impl WorldPool {
    /// Projections get ids above `floor`. With an ontology only what fits it is committed, and its times to live hold where the config
    /// has none.
    pub(super) fn new(config: WorldPoolConfig, ontology: Option<Ontology>, history: History, floor: u64) -> WorldPool {
        let declared = ontology.iter().flat_map(Ontology::predicates);
        let declared = declared.filter_map(|(name, predicate)| Some((name.to_owned(), predicate.ttl_s?)));
        let configured = config.ttl_s.iter().map(|(name, ttl_s)| (name.clone(), *ttl_s));
        let ttl = declared.chain(configured).map(|(name, ttl_s)| (name, Duration::from_secs_f64(ttl_s)));
        let mut pool = WorldPool {
            expiry: Expiry::new(ttl.collect()),
            tolerances: ontology.as_ref().map(|known| known.tolerances(Tolerances::default())).unwrap_or_default(),
            live: Live::default(),
            contradictions: Vec::new(),
            ontology,
            history,
            projections: BTreeMap::new(),
            projected: Memory::new(config.remembered_requests),
            by_lease: BTreeMap::new(),
            last_projection: floor,
            config,
        };
        pool.all_begin(Timestamp(0));
        pool
    }

    pub(super) fn root(&self) -> &World {
        self.history.root()
    }

    /// All changes as the next revision, or none. An id committed before gets its answer again.
    pub(super) fn commit(&mut self, now: Timestamp, commit: &Commit) -> Result<Revision, CommitError> {
        let before = self.root().clone();
        let revision = self.history.commit(commit, self.ontology.as_ref())?;
        // An answer of before has written nothing now.
        if let Some(kept) = self.history.newest().filter(|kept| kept.world.revision() > before.revision()) {
            self.expiry.written(now, &kept.written);
            let tolerance = |predicate: &str| self.tolerances.of(predicate, Tolerance::EXACT);
            let (writer, changes) = (commit.writer.as_deref(), &commit.changes);
            let found = self.live.contradicted(&before, &kept.world, writer, changes, &tolerance);
            for found in found {
                let contradiction = wire(found, revision);
                if let Some(projection) = self.projections.get_mut(&contradiction.projection) {
                    projection.contradiction.get_or_insert_with(|| contradiction.clone());
                }
                self.contradictions.push(contradiction);
            }
        }
        Ok(revision)
    }

    /// The projections that the revisions since the last call contradict.
    pub(super) fn take_contradictions(&mut self) -> Vec<Contradiction> {
        std::mem::take(&mut self.contradictions)
    }

    /// The first contradiction of a projection, if there was one.
    pub(super) fn contradiction(&self, id: ProjectionId) -> Result<Option<&Contradiction>, QueryError> {
        let projection = self.projections.get(&id).ok_or(QueryError::Unknown { id })?;
        Ok(projection.contradiction.as_ref())
    }

    /// Whether a projection is there.
    pub(super) fn has(&self, id: ProjectionId) -> bool {
        self.projections.contains_key(&id)
    }

    /// What the revisions after its base have contradicted already, and which of its effects have not come true yet.
    fn catch_up(
        &self,
        id: ProjectionId,
        world: &World,
        request: &ProjectRequest,
    ) -> (Option<Contradiction>, Vec<Effect>) {
        let mut effects: Vec<Effect> = request.effects().collect();
        if request.base == self.root().revision() {
            return (None, effects);
        }
        let mut alone: Live<ProjectionId> = Live::default();
        alone.insert(id, request.base, world.clone(), effects.clone(), request.reads.clone());
        let tolerance = |predicate: &str| self.tolerances.of(predicate, Tolerance::EXACT);
        let mut first = None;
        let Ok(mut before) = self.history.at(request.base) else { return (None, effects) };
        let Ok(since) = self.history.after(request.base) else { return (None, effects) };
        for kept in since {
            let changes: Vec<Change> = kept.changes().collect();
            let writer = kept.writer();
            let found = alone.contradicted(before, &kept.world, writer, &changes, &tolerance);
            let found = found.into_iter().map(|found| wire(found, kept.world.revision()));
            first = first.or(found.into_iter().next());
            effects.retain(|effect| writer.is_none() || effect.writer.as_deref() != writer);
            before = &kept.world;
        }
        (first, effects)
    }

    /// When [`WorldPool::expire_facts`] has something to do.
    pub(super) fn next_expiry(&self) -> Option<Timestamp> {
        self.expiry.next()
    }

    /// The facts whose time is over are gone, all as one revision.
    pub(super) fn expire_facts(&mut self, now: Timestamp) {
        let changes = self.expiry.due(now);
        if changes.is_empty() {
            return;
        }
        let commit = Commit { changes, ..Commit::default() };
        if let Err(error) = self.commit(now, &commit) {
            debug_assert!(false, "facts that hold can be deleted: {error}");
        }
    }

    /// Every fact has its whole time from now on.
    fn all_begin(&mut self, now: Timestamp) {
        self.expiry.clear();
        if !self.expiry.is_empty() {
            for (key, _) in self.history.root().iter() {
                self.expiry.begin(now, &Arc::new(key.clone()));
            }
        }
    }

    /// Another history instead, which may be behind: what was projected from later revisions ends.
    pub(super) fn replace_history(&mut self, now: Timestamp, history: History) {
        self.history = history;
        self.all_begin(now);
        let root = self.root().revision();
        let ahead = self.projections.iter().filter(|(_, projection)| projection.base > root);
        let ahead: Vec<ProjectionId> = ahead.map(|(id, _)| *id).collect();
        for id in ahead {
            self.release(id);
        }
    }

    /// The world at a revision with changes applied. A request made before gets its answer again, as long as it lives.
    pub(super) fn project(&mut self, request: ProjectRequest) -> Result<ProjectionId, ProjectError> {
        let fingerprint = fingerprint(&(request.base, &request.changes, &request.reads, &request.writers));
        if let Some(id) = self.projected.recall(&request.request_id, fingerprint)? {
            let ended = || ProjectError::Ended { request_id: request.request_id.clone() };
            return self.projections.contains_key(&id).then_some(id).ok_or_else(ended);
        }
        if self.projections.len() >= self.config.max_projections {
            return Err(ProjectError::TooMany { limit: self.config.max_projections });
        }
        let world = self.history.at(request.base)?.project_as(&request.writers, &request.changes)?;
        self.last_projection += 1;
        let id = ProjectionId(self.last_projection);
        let (contradiction, effects) = self.catch_up(id, &world, &request);
        self.live.insert(id, request.base, world.clone(), effects, request.reads.clone());
        if let HeldBy::Lease(lease) = request.held_by {
            self.by_lease.entry(lease).or_default().insert(id);
        }
        self.projected.insert(&request.request_id, fingerprint, id);
        let projection = Projection {
            world,
            base: request.base,
            reads: request.reads,
            held_by: request.held_by,
            request_id: request.request_id,
            contradiction,
        };
        self.projections.insert(id, projection);
        Ok(id)
    }

    /// What matches any of the patterns, in the order of keys, of the root (now or at a revision) or of a projection; without a pattern everything
    /// that it shows.
    pub(super) fn query(
        &self,
        id: Option<ProjectionId>,
        at: Option<Revision>,
        patterns: &[FactPattern],
    ) -> Result<(Vec<(FactKey, Fact)>, Revision), QueryError> {
        let (world, revision, shown) = match (id, at) {
            (None, None) => (self.root(), self.root().revision(), &Footprint::Everything),
            (None, Some(at)) => (self.history.at(at)?, at, &Footprint::Everything),
            (Some(id), _) => {
                let projection = self.projections.get(&id).ok_or(QueryError::Unknown { id })?;
                let hidden = |pattern: &&FactPattern| match &projection.reads {
                    Footprint::Everything => false,
                    Footprint::Patterns(reads) => !reads.iter().any(|read| read.covers(pattern)),
                };
                if let Some(pattern) = patterns.iter().find(hidden) {
                    return Err(QueryError::Hidden { id, pattern: pattern.clone() });
                }
                (&projection.world, projection.base, &projection.reads)
            }
        };
        let copy = |(key, fact): (&FactKey, &Fact)| (key.clone(), fact.clone());
        if patterns.is_empty() {
            let all = world.iter().filter(|(key, _)| shown.contains(key)).map(copy).collect();
            return Ok((all, revision));
        }
        let facts: BTreeMap<FactKey, Fact> = patterns.iter().flat_map(|p| world.matching(p)).map(copy).collect();
        Ok((facts.into_iter().collect(), revision))
    }

    /// Ends a projection; false when it had ended before.
    pub(super) fn release(&mut self, id: ProjectionId) -> bool {
        let Some(projection) = self.projections.remove(&id) else { return false };
        self.live.remove(id);
        tracing::trace!(%id, request = projection.request_id, "projection ended");
        if let HeldBy::Lease(lease) = projection.held_by
            && let Some(ids) = self.by_lease.get_mut(&lease)
        {
            ids.remove(&id);
            if ids.is_empty() {
                self.by_lease.remove(&lease);
            }
        }
        true
    }

    /// Ends what the lease held; how many projections that were.
    pub(super) fn end_lease(&mut self, lease: LeaseId) -> usize {
        let ids = self.by_lease.get(&lease).cloned().unwrap_or_default();
        ids.into_iter().filter(|id| self.release(*id)).count()
    }

    /// Ends what leases held that live no more.
    pub(super) fn keep_leases(&mut self, live: impl Fn(LeaseId) -> bool) -> usize {
        let ended: Vec<LeaseId> = self.by_lease.keys().copied().filter(|lease| !live(*lease)).collect();
        ended.into_iter().map(|lease| self.end_lease(lease)).sum()
    }

    /// Ends what is held by nothing but time that has passed.
    pub(super) fn expire(&mut self, now: Timestamp) {
        let over = |projection: &Projection| matches!(projection.held_by, HeldBy::Until(end) if end <= now);
        let ids: Vec<ProjectionId> = self.projections.iter().filter(|(_, p)| over(p)).map(|(id, _)| *id).collect();
        for id in ids {
            self.release(id);
        }
    }

    pub(super) fn unbound_ttl(&self) -> Duration {
        Duration::from_secs_f64(self.config.unbound_ttl_s)
    }

    pub(super) fn projections(&self) -> usize {
        self.projections.len()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use ratn_model::fact::Term;
    use ratn_model::measurement::{Certainty, Measurement};
    use ratn_model::value::Value;

    fn key(name: &str) -> FactKey {
        FactKey { predicate: "at".to_owned(), arguments: vec![Term::Name(name.to_owned())] }
    }

    fn set(name: &str, value: i64) -> Change {
        Change::Set { fact: key(name), value: Value::Int(value) }
    }

    fn pool() -> WorldPool {
        let config = WorldPoolConfig { revisions_kept: 3, max_projections: 2, ..WorldPoolConfig::default() };
        let history = History::new(&config);
        WorldPool::new(config, None, history, 0)
    }

    fn commit(
        pool: &mut WorldPool,
        id: &str,
        changes: &[Change],
        expected: Option<Revision>,
    ) -> Result<Revision, CommitError> {
        let commit = Commit { id: id.to_owned(), changes: changes.to_vec(), expected, ..Commit::default() };
        pool.commit(Timestamp(0), &commit)
    }

    fn project(pool: &mut WorldPool, request: &str, base: u64, lease: u64) -> Result<ProjectionId, ProjectError> {
        pool.project(ProjectRequest {
            request_id: request.to_owned(),
            base: Revision(base),
            changes: vec![set("box", 7)],
            writers: Vec::new(),
            reads: Footprint::Patterns(vec![FactPattern::of(&key("box"))]),
            held_by: HeldBy::Lease(LeaseId(lease)),
        })
    }

    fn value(pool: &WorldPool, id: Option<ProjectionId>, name: &str) -> Result<Option<Value>, QueryError> {
        let (facts, _) = pool.query(id, None, &[FactPattern::of(&key(name))])?;
        Ok(facts.into_iter().next().map(|(_, fact)| fact.value))
    }

    #[test]
    fn a_commit_is_made_once_and_only_as_the_revision_expected() {
        let mut pool = pool();
        assert_eq!(commit(&mut pool, "a", &[set("box", 1)], Some(Revision(1))), Ok(Revision(1)));
        assert_eq!(commit(&mut pool, "a", &[set("box", 1)], Some(Revision(1))), Ok(Revision(1)));
        let wrong = commit(&mut pool, "b", &[set("box", 2)], Some(Revision(3)));
        assert_eq!(wrong, Err(CommitError::Revision { root: 1, next: 2, expected: 3 }));
        assert_eq!(value(&pool, None, "box"), Ok(Some(Value::Int(1))));
        assert_eq!(commit(&mut pool, "b", &[set("box", 2)], None), Ok(Revision(2)));
    }

    #[test]
    fn a_projection_is_of_its_base_whatever_was_committed_since() {
        let mut pool = pool();
        commit(&mut pool, "a", &[set("box", 1), set("cup", 1)], None).unwrap();
        commit(&mut pool, "b", &[set("box", 2), set("cup", 2)], None).unwrap();
        let all = Footprint::Everything;
        let request = ProjectRequest {
            request_id: "p".to_owned(),
            base: Revision(1),
            changes: vec![set("box", 7)],
            writers: Vec::new(),
            reads: all,
            held_by: HeldBy::Until(Timestamp(5)),
        };
        let id = pool.project(request).unwrap();
        assert_eq!(value(&pool, Some(id), "box"), Ok(Some(Value::Int(7))));
        assert_eq!(value(&pool, Some(id), "cup"), Ok(Some(Value::Int(1))));
        assert_eq!(value(&pool, None, "box"), Ok(Some(Value::Int(2))), "the root is as it was");
        pool.expire(Timestamp(4));
        assert_eq!(pool.projections(), 1);
        pool.expire(Timestamp(5));
        assert_eq!(pool.projections(), 0);
    }

    #[test]
    fn a_projection_shows_its_declared_reads_and_nothing_else() {
        let mut pool = pool();
        commit(&mut pool, "a", &[set("cup", 1)], None).unwrap();
        let id = project(&mut pool, "p", 1, 1).unwrap();
        assert_eq!(value(&pool, Some(id), "box"), Ok(Some(Value::Int(7))));
        let hidden = value(&pool, Some(id), "cup").unwrap_err();
        assert_eq!(
            hidden.to_string(),
            "projection-1 does not show at(cup): it is not among the reads declared for it; declare it (reads: […])"
        );
        let wider = FactPattern { predicate: "at".to_owned(), arguments: vec![None] };
        assert!(matches!(pool.query(Some(id), None, &[wider]), Err(QueryError::Hidden { .. })));
        let (all, _) = pool.query(Some(id), None, &[]).unwrap();
        assert_eq!(all.iter().map(|(key, _)| key.to_string()).collect::<Vec<_>>(), ["at(box)"]);
    }

    #[test]
    fn revisions_outside_those_kept_are_refused() {
        let mut pool = pool();
        for i in 1..=4 {
            commit(&mut pool, &i.to_string(), &[set("box", i)], None).unwrap();
        }
        assert_eq!(
            project(&mut pool, "p", 1, 1),
            Err(RevisionError::Forgotten { wanted: 1, oldest: 2, root: 4 }.into())
        );
        assert_eq!(project(&mut pool, "p", 5, 1), Err(RevisionError::Future { root: 4, wanted: 5 }.into()));
        assert!(project(&mut pool, "p", 2, 1).is_ok(), "a refused request can be asked again");
    }

    #[test]
    fn projections_end_with_their_lease_and_are_bounded() {
        let mut pool = pool();
        let first = project(&mut pool, "p", 0, 1).unwrap();
        assert_eq!(project(&mut pool, "p", 0, 1), Ok(first), "asked twice, made once");
        project(&mut pool, "q", 0, 2).unwrap();
        assert_eq!(project(&mut pool, "r", 0, 2), Err(ProjectError::TooMany { limit: 2 }));
        assert_eq!(pool.end_lease(LeaseId(1)), 1);
        assert_eq!(value(&pool, Some(first), "box"), Err(QueryError::Unknown { id: first }));
        assert_eq!(project(&mut pool, "p", 0, 1), Err(ProjectError::Ended { request_id: "p".to_owned() }));
        assert_eq!(pool.keep_leases(|lease| lease == LeaseId(2)), 0);
        assert_eq!(pool.keep_leases(|_| false), 1);
        assert_eq!(pool.projections(), 0);
        assert!(pool.by_lease.is_empty());
    }

    #[test]
    fn a_fact_with_a_time_to_live_is_gone_after_it_unless_it_was_written_again() {
        let second = |n: f64| Timestamp::from_seconds(n);
        let config = WorldPoolConfig { ttl_s: [("at".to_owned(), 2.0)].into(), ..WorldPoolConfig::default() };
        let history = History::new(&config);
        let mut pool = WorldPool::new(config, None, history, 0);
        let of = |id: &str, changes: Vec<Change>| Commit { id: id.to_owned(), changes, ..Commit::default() };
        let full = Change::Set { fact: FactKey { predicate: "full".to_owned(), ..key("box") }, value: Value::Int(1) };
        pool.commit(second(0.0), &of("a", vec![set("box", 1), set("cup", 1), full])).unwrap();
        pool.commit(second(1.0), &of("b", vec![set("cup", 1)])).unwrap();
        // Asked again: it is as old as it was.
        pool.commit(second(1.5), &of("a", vec![set("box", 1), set("cup", 1)])).unwrap_err();
        assert_eq!(pool.next_expiry(), Some(second(2.0)));
        pool.expire_facts(second(1.9));
        assert_eq!(pool.root().revision(), Revision(2));
        pool.expire_facts(second(2.0));
        assert_eq!(pool.root().revision(), Revision(3), "a revision as any other");
        let names: Vec<String> = pool.root().iter().map(|(key, _)| key.to_string()).collect();
        assert_eq!(names, ["at(cup)", "full(box)"]);
        let news: Vec<u64> = pool.history.take_news().iter().map(|kept| kept.world.revision().0).collect();
        assert_eq!(news, [1, 2, 3], "watchers hear of it");
        pool.commit(second(2.5), &of("c", vec![Change::Delete { pattern: FactPattern::of(&key("cup")) }])).unwrap();
        assert_eq!(pool.next_expiry(), None);
    }

    #[test]
    fn what_does_not_fit_the_ontology_is_not_committed() {
        let text = "
            @prefix ratn: <urn:ratn:ontology#> .
            @prefix owl: <http://www.w3.org/2002/07/owl#> .
            @prefix : <urn:robot#> .
            :full a ratn:Predicate ; ratn:arguments ( owl:Thing ) ; ratn:value \"int\" .";
        let ontology = ratn_model::ontology::turtle::read(text).unwrap();
        let config = WorldPoolConfig::default();
        let history = History::new(&config);
        let mut pool = WorldPool::new(config, Some(ontology), history, 0);
        let refused = commit(&mut pool, "a", &[set("box", 1)], None).unwrap_err();
        assert!(matches!(refused, CommitError::Violation(_)), "{refused}");
        // Sure in a way that the predicate does not declare.
        let fact = FactKey { predicate: "full".to_owned(), ..key("box") };
        let changes = vec![Change::Set { fact: fact.clone(), value: Value::Int(1) }];
        let measured = Measurement { source: "scale".to_owned(), certainty: Some(Certainty::Confidence(0.9)) };
        let with = Commit { id: "m".to_owned(), changes, evidence: vec![(fact, measured)], ..Commit::default() };
        let refused = pool.commit(Timestamp(0), &with).unwrap_err();
        assert!(refused.to_string().contains("[other-uncertainty]"), "{refused}");
        assert_eq!(pool.root().revision(), Revision(0));
    }

    #[test]
    fn a_fact_says_who_wrote_it_and_what_measured_it() {
        let mut pool = pool();
        let measured = Measurement { source: "camera".to_owned(), certainty: Some(Certainty::Confidence(0.9)) };
        let evidence = vec![(key("box"), measured.clone())];
        let commit = Commit {
            id: "a".to_owned(),
            changes: vec![set("box", 1), set("cup", 2)],
            writer: Some("detect[1]".to_owned()),
            evidence,
            ..Commit::default()
        };
        pool.commit(Timestamp(0), &commit).unwrap();
        let (facts, _) = pool.query(None, None, &[]).unwrap();
        assert!(facts.iter().all(|(_, fact)| fact.writer.as_deref() == Some("detect[1]")));
        assert_eq!(facts[0].1.measured.as_deref(), Some(&measured));
        assert_eq!(facts[1].1.measured, None);
        // In a projection each fact says who will have written it.
        let request = ProjectRequest {
            request_id: "p".to_owned(),
            base: Revision(1),
            changes: vec![set("box", 7), set("cup", 8)],
            writers: vec!["place[1]".into(), "".into()],
            reads: Footprint::Everything,
            held_by: HeldBy::Until(Timestamp(9)),
        };
        let id = pool.project(request).unwrap();
        let (facts, _) = pool.query(Some(id), None, &[]).unwrap();
        let writers: Vec<_> = facts.iter().map(|(_, fact)| fact.writer.as_deref()).collect();
        assert_eq!(writers, [Some("place[1]"), None]);
        assert!(facts.iter().all(|(_, fact)| fact.measured.is_none()), "it is predicted");
        let none = Commit { id: "b".to_owned(), changes: vec![set("cup", 3)], ..commit };
        assert_eq!(pool.commit(Timestamp(0), &none), Err(CommitError::Evidence { fact: key("box") }));
    }

    #[test]
    fn a_commit_says_which_projections_it_contradicts_in_which_fact() {
        let mut pool = WorldPool::new(WorldPoolConfig::default(), None, History::new(&WorldPoolConfig::default()), 0);
        commit(&mut pool, "a", &[set("box", 1), set("cup", 1)], None).unwrap();
        let project = |pool: &mut WorldPool, base: u64, reads: &str| {
            let request = ProjectRequest {
                request_id: format!("{base}/{reads}"),
                base: Revision(base),
                changes: vec![set("box", 7)],
                writers: vec!["place[1]".into()],
                reads: Footprint::Patterns(vec![FactPattern::of(&key(reads))]),
                held_by: HeldBy::Until(Timestamp(9)),
            };
            pool.project(request).unwrap()
        };
        let (of_cup, of_box) = (project(&mut pool, 1, "cup"), project(&mut pool, 1, "box"));
        commit(&mut pool, "b", &[set("cup", 2)], None).unwrap();
        let found = pool.take_contradictions();
        let expected = Contradiction {
            projection: of_cup,
            fact: key("cup"),
            was: Some(Value::Int(1)),
            is: Some(Value::Int(2)),
            revision: Revision(2),
        };
        assert_eq!(found, vec![expected.clone()]);
        assert_eq!(pool.contradiction(of_cup), Ok(Some(&expected)));
        assert_eq!(pool.contradiction(of_box), Ok(None), "what it did not read is nothing to it");
        // Made of a revision that is not the newest: what has happened since counts.
        let of_all = ProjectRequest {
            request_id: "late".to_owned(),
            base: Revision(1),
            changes: vec![set("box", 7)],
            writers: vec!["place[1]".into()],
            reads: Footprint::Everything,
            held_by: HeldBy::Until(Timestamp(9)),
        };
        let late = pool.project(of_all).unwrap();
        assert_eq!(pool.contradiction(late), Ok(Some(&Contradiction { projection: late, ..expected })));
        // What was predicted of a writer comes true, or otherwise.
        let of = |id: &str, value| Commit {
            id: id.to_owned(),
            changes: vec![set("box", value)],
            writer: Some("place[1]".to_owned()),
            ..Commit::default()
        };
        pool.commit(Timestamp(0), &of("c", 7)).unwrap();
        assert_eq!(pool.take_contradictions(), []);
        commit(&mut pool, "d", &[set("box", 8)], None).unwrap();
        let found: Vec<_> = pool.take_contradictions().into_iter().map(|found| (found.projection, found.is)).collect();
        assert_eq!(found, [(of_box, Some(Value::Int(8))), (late, Some(Value::Int(8)))]);
        assert!(pool.release(of_box));
        commit(&mut pool, "e", &[set("box", 9)], None).unwrap();
        assert!(pool.take_contradictions().iter().all(|found| found.projection == late), "the other has ended");
    }
}
