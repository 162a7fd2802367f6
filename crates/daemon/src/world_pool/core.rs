//! The root's history and its projections: a pure state machine.
//!
//! A projection is a clone of a kept revision with its changes applied, so it costs as much as its effects, whatever the size of the world. It
//! shows only its declared reads, and it ends with its lease. Its creator or an operator can release it. The history is durable, projections
//! are not: they end with the process, and no later projection gets the id of an earlier one.

use super::WorldPoolConfig;
use super::expiry::Expiry;
use super::fingerprint::Fingerprint;
use super::history::{Commit, CommitError, History, RevisionError};
use super::in_memory::{InMemory, NoRoom};
use super::looks::{self, TooManyLooks};
use super::memory::{Memory, Reused};
use super::promised::Promised;
use super::query::View;
use super::scenes::{Scenes, moves};
use super::size;
use crate::access::Caller;
use ratn_model::fact::{Change, FactPattern, Footprint};
use ratn_model::id::{LeaseId, ProjectionId, Revision};
use ratn_model::ontology::Ontology;
use ratn_model::time::Timestamp;
use ratn_model::tolerance::{Tolerance, Tolerances};
use ratn_proto::types::Contradiction;
use ratn_world::reads::{Effect, Live};
use ratn_world::scene::SceneError;
use ratn_world::world::{ChangeError, World};
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
    pub(super) projections: BTreeMap<ProjectionId, Projection>,
    /// The scenes that were sent to planners.
    pub(super) scenes: Scenes,
    /// Projections that nothing has contradicted yet, to compare with commits.
    live: Live<ProjectionId>,
    /// Contradictions since the last [`WorldPool::take_contradictions`].
    contradictions: Vec<Contradiction>,
    projected: Memory<ProjectionId>,
    by_lease: BTreeMap<LeaseId, BTreeSet<ProjectionId>>,
    /// Memory of each caller's projections.
    in_memory: InMemory,
    last_projection: u64,
    promised: Promised,
}

#[derive(Debug)]
pub(super) struct Projection {
    pub(super) world: World,
    pub(super) base: Revision,
    /// Its changes that move something in the scene.
    pub(super) moves: Vec<Change>,
    pub(super) reads: Footprint,
    held_by: HeldBy,
    made_by: Arc<str>,
    request_id: String,
    /// Bytes of its own.
    bytes: usize,
    /// A projection with a contradiction is not compared with further commits.
    contradiction: Option<Contradiction>,
}

/// What keeps a projection alive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum HeldBy {
    /// A live lease of the resource manager.
    Lease(LeaseId),
    /// No lease: it ends at this time.
    Until(Timestamp),
}

/// A projection to be made.
#[derive(Debug)]
pub(super) struct ProjectRequest {
    pub(super) by: Caller,
    pub(super) request_id: String,
    /// An id that was promised to the caller; `None` lets the pool choose.
    pub(super) id: Option<ProjectionId>,
    /// A commit of the caller: the base is the revision that this commit made, or a later one.
    pub(super) after: Option<String>,
    pub(super) base: Revision,
    pub(super) changes: Vec<Change>,
    /// The node that will make the change at the same index; empty or missing for no node.
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

/// Why a projection was not made.
#[derive(Debug, PartialEq, thiserror::Error)]
pub(super) enum ProjectError {
    #[error(transparent)]
    Revision(#[from] RevisionError),
    #[error(transparent)]
    Reused(#[from] Reused),
    #[error(transparent)]
    Change(#[from] ChangeError),
    #[error(transparent)]
    TooManyLooks(#[from] TooManyLooks),
    #[error("{limit} projections exist: release some")]
    TooMany { limit: usize },
    #[error("{limit} projections exist, and the rest is kept for operators: release some")]
    KeptForOperators { limit: usize },
    #[error("projections of {whose}: the quota of {limit} is reached (projections_per_caller): release some")]
    Quota { whose: Arc<str>, limit: usize },
    #[error(
        "projections of {whose} would have more than {limit} bytes (projection_bytes_per_caller): release some, those of the oldest \
         revisions first, or change less in one"
    )]
    QuotaOfBytes { whose: Arc<str>, limit: usize },
    #[error(
        "all projections would have more than {limit} bytes (projection_bytes): release some, or change less in one"
    )]
    TooManyBytes { limit: usize },
    #[error(
        "all projections would have more than {limit} bytes, and the rest of projection_bytes is kept for operators: release some, or \
         change less in one"
    )]
    BytesKeptForOperators { limit: usize },
    #[error("the projection of request `{request_id}` has ended; ask with another request id")]
    Ended { request_id: String },
    #[error("{id} is not promised to {caller}, or not any more: ask without an id (projection_id: 0)")]
    NotPromised { id: ProjectionId, caller: Arc<str> },
    #[error("no commit `{id}` of {caller} is known: it has not come yet, was refused, or was long ago")]
    NoSuchCommit { id: String, caller: Arc<str> },
}

/// A projection that another caller made.
#[derive(Debug, PartialEq, thiserror::Error)]
#[error("{id} is of {made_by}: only they and operators release it, not {caller}")]
pub(super) struct MadeByAnother {
    id: ProjectionId,
    made_by: Arc<str>,
    caller: Arc<str>,
}

/// Why a query has no answer.
#[derive(Debug, PartialEq, thiserror::Error)]
pub(super) enum QueryError {
    #[error("{id} is unknown or has ended (its lease ended, or it was released)")]
    Unknown { id: ProjectionId },
    #[error("{id} is promised and not there yet: ask again")]
    NotYet { id: ProjectionId },
    #[error("{id} does not show {pattern}: it is not among the reads declared for it; declare it (reads: […])")]
    Hidden { id: ProjectionId, pattern: FactPattern },
    #[error(transparent)]
    Revision(#[from] RevisionError),
    #[error(transparent)]
    Scene(#[from] SceneError),
}

impl WorldPool {
    /// Projections get ids above `floor`. With an ontology only conforming commits are accepted, and its times to live apply where the config
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
            scenes: Scenes::default(),
            projected: Memory::new(config.remembered()),
            by_lease: BTreeMap::new(),
            in_memory: InMemory::default(),
            last_projection: floor,
            promised: Promised::default(),
            config,
        };
        pool.all_begin(Timestamp(0));
        pool
    }

    pub(super) fn root(&self) -> &World {
        self.history.root()
    }

    /// Commits all changes as the next revision, or none of them. A repeated id gets its first answer again.
    pub(super) fn commit(&mut self, now: Timestamp, commit: &Commit) -> Result<Revision, CommitError> {
        let before = self.root().clone();
        let revision = self.history.commit(commit, self.ontology.as_ref())?;
        for (forgotten, next) in self.history.take_forgotten() {
            self.in_memory.forgotten(&forgotten, &next);
        }
        // A repeated answer has written nothing now.
        if let Some(kept) = self.history.newest().filter(|kept| kept.world.revision() > before.revision()) {
            self.expiry.written(now, &kept.written);
            let tolerance = |predicate: &str| self.tolerances.of(predicate, Tolerance::EXACT);
            let (writer, changes) = (commit.writer.as_deref(), &commit.changes);
            let found = self.live.contradicted(&before, &kept.world, writer, changes, &tolerance);
            for found in found {
                let contradiction = wire(found, revision);
                self.live.remove(contradiction.projection);
                if let Some(projection) = self.projections.get_mut(&contradiction.projection) {
                    projection.contradiction = Some(contradiction.clone());
                }
                self.contradictions.push(contradiction);
            }
        }
        Ok(revision)
    }

    /// The contradictions that the revisions since the last call have caused.
    pub(super) fn take_contradictions(&mut self) -> Vec<Contradiction> {
        std::mem::take(&mut self.contradictions)
    }

    /// The contradiction of a projection, if there is one.
    pub(super) fn contradiction(&self, id: ProjectionId) -> Result<Option<&Contradiction>, QueryError> {
        Ok(self.projection(id)?.contradiction.as_ref())
    }

    /// Whether a projection exists.
    pub(super) fn has(&self, id: ProjectionId) -> bool {
        self.projections.contains_key(&id)
    }

    /// The contradiction that the revisions after its base have caused already, and the effects that have not come true yet.
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
        let Ok(mut before) = self.history.at(request.base) else { return (None, effects) };
        let Ok(since) = self.history.after(request.base) else { return (None, effects) };
        for kept in since {
            let changes: Vec<Change> = kept.changes().collect();
            let writer = kept.writer.as_deref();
            let found = alone.contradicted(before, &kept.world, writer, &changes, &tolerance);
            if let Some(found) = found.into_iter().next() {
                return (Some(wire(found, kept.world.revision())), effects);
            }
            effects.retain(|effect| writer.is_none() || effect.writer.as_deref() != writer);
            before = &kept.world;
        }
        (None, effects)
    }

    /// When [`WorldPool::expire_facts`] has something to do.
    pub(super) fn next_expiry(&self) -> Option<Timestamp> {
        self.expiry.next()
    }

    /// Deletes the facts whose time to live is over, all in one revision.
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

    /// Restarts the time to live of every fact.
    fn all_begin(&mut self, now: Timestamp) {
        self.expiry.clear();
        if !self.expiry.is_empty() {
            for (key, _) in self.history.root().iter() {
                self.expiry.begin(now, &Arc::new(key.clone()));
            }
        }
    }

    /// Replaces the history by one that may be behind: projections of later revisions end.
    pub(super) fn replace_history(&mut self, now: Timestamp, history: History) {
        self.history = history;
        self.scenes.forget();
        self.all_begin(now);
        let root = self.root().revision();
        let ahead = self.projections.iter().filter(|(_, projection)| projection.base > root);
        let ahead: Vec<ProjectionId> = ahead.map(|(id, _)| *id).collect();
        for id in ahead {
            self.release(id);
        }
    }

    /// Promises a caller as many ids as there is room for.
    pub(super) fn promise(&mut self, now: Timestamp, caller: &Arc<str>, wanted: u32) -> Vec<ProjectionId> {
        let ids = (0..self.promised.room(wanted)).map(|_| {
            self.last_projection += 1;
            ProjectionId(self.last_projection)
        });
        let ids: Vec<ProjectionId> = ids.collect();
        ids.iter().for_each(|id| self.promised.promise(now, caller, *id));
        ids
    }

    fn projection(&self, id: ProjectionId) -> Result<&Projection, QueryError> {
        self.projections.get(&id).ok_or_else(|| self.missing(id))
    }

    /// The error for a projection that does not exist.
    pub(super) fn missing(&self, id: ProjectionId) -> QueryError {
        if self.promised.has(id) { QueryError::NotYet { id } } else { QueryError::Unknown { id } }
    }

    /// Whether a commit of the caller is known.
    pub(super) fn has_commit(&self, caller: &Caller, id: &str) -> bool {
        self.history.commit_of(&caller.name, id).is_some()
    }

    /// Whether the projection is promised and does not exist yet.
    pub(super) fn is_promised(&self, id: ProjectionId) -> bool {
        self.promised.has(id)
    }

    /// Whether a caller may make a projection with this id.
    pub(super) fn is_promised_to(&self, caller: &Caller, id: ProjectionId) -> bool {
        self.promised.whose(id) == Some(&caller.name)
    }

    /// The world at a revision with changes applied. A repeated request gets its first answer again, as long as that projection lives. A
    /// promised id is used up even where the projection fails, so that nobody waits for it longer; it stays promised only where its commit is
    /// still missing.
    pub(super) fn project(&mut self, request: ProjectRequest) -> Result<ProjectionId, ProjectError> {
        let (id, by) = (request.id, request.by.name.clone());
        let made = self.make(request);
        let is_over = !matches!(made, Err(ProjectError::NoSuchCommit { .. }));
        if let Some(id) = id.filter(|id| is_over && self.promised.whose(*id) == Some(&by)) {
            self.promised.end(id);
        }
        made
    }

    fn make(&mut self, mut request: ProjectRequest) -> Result<ProjectionId, ProjectError> {
        let fingerprint = Fingerprint::of_projection(&request.changes, &request.reads, &request.writers);
        if let Some(id) = self.projected.recall(&request.by.name, &request.request_id, fingerprint)? {
            let ended = || ProjectError::Ended { request_id: request.request_id.clone() };
            return self.projections.contains_key(&id).then_some(id).ok_or_else(ended);
        }
        let of_another = |id: &ProjectionId| self.promised.whose(*id) != Some(&request.by.name);
        if let Some(id) = request.id.filter(of_another) {
            return Err(ProjectError::NotPromised { id, caller: request.by.name });
        }
        self.check_room(&request.by)?;
        if let Some(id) = &request.after {
            let made = self.history.commit_of(&request.by.name, id);
            let missing = || ProjectError::NoSuchCommit { id: id.clone(), caller: request.by.name.clone() };
            request.base = made.ok_or_else(missing)?.max(request.base);
        }
        let moves = moves(&request.changes);
        // The changes are stored again for comparison with commits, and the reads again to find the projections to compare.
        let mut bytes =
            size::of_changes(&request.changes) + size::of_changes(&moves) + 3 * size::of_footprint(&request.reads);
        let base = self.history.at(request.base)?;
        looks::check(base, &request.changes)?;
        let world = base.project_looking(&request.writers, &request.changes, |written| {
            bytes += size::of_written(written);
        })?;
        self.check_bytes(&request.by, bytes)?;
        let id = request.id.unwrap_or_else(|| {
            self.last_projection += 1;
            ProjectionId(self.last_projection)
        });
        let (contradiction, effects) = self.catch_up(id, &world, &request);
        if contradiction.is_none() {
            self.live.insert(id, request.base, world.clone(), effects, request.reads.clone());
        }
        if let HeldBy::Lease(lease) = request.held_by {
            self.by_lease.entry(lease).or_default().insert(id);
        }
        self.projected.insert(&request.by.name, &request.request_id, fingerprint, id);
        self.in_memory.begin(&request.by.name, request.base, bytes);
        let projection = Projection {
            world,
            base: request.base,
            moves,
            reads: request.reads,
            held_by: request.held_by,
            made_by: request.by.name,
            request_id: request.request_id,
            bytes,
            contradiction,
        };
        self.projections.insert(id, projection);
        Ok(id)
    }

    /// Whether a caller may make another projection.
    fn check_room(&self, caller: &Caller) -> Result<(), ProjectError> {
        let WorldPoolConfig { max_projections, projections_per_caller, projections_for_operators, .. } = self.config;
        if self.projections.len() >= max_projections {
            return Err(ProjectError::TooMany { limit: max_projections });
        }
        if caller.is_operator() {
            return Ok(());
        }
        if self.in_memory.projections(&caller.name) >= projections_per_caller {
            return Err(ProjectError::Quota { whose: caller.name.clone(), limit: projections_per_caller });
        }
        let limit = max_projections - projections_for_operators.min(max_projections / 2);
        if self.projections.len() >= limit {
            return Err(ProjectError::KeptForOperators { limit });
        }
        Ok(())
    }

    /// Whether a caller may make a projection of this many bytes.
    fn check_bytes(&self, caller: &Caller, bytes: usize) -> Result<(), ProjectError> {
        let most = self.config.most_in_memory();
        let room = self.in_memory.check(&caller.name, caller.is_operator(), bytes, most);
        room.map_err(|no_room| match no_room {
            NoRoom::OfCaller => ProjectError::QuotaOfBytes { whose: caller.name.clone(), limit: most.per_caller },
            NoRoom::InAll => ProjectError::TooManyBytes { limit: most.in_all },
            NoRoom::ForOperators => ProjectError::BytesKeptForOperators { limit: most.for_all() },
        })
    }

    /// What a query of these patterns may look at: the root (now or at a revision) or a projection, and its visible facts.
    pub(super) fn view(
        &self,
        id: Option<ProjectionId>,
        at: Option<Revision>,
        patterns: &[FactPattern],
    ) -> Result<View, QueryError> {
        let of_root = |world: &World, revision| View { world: world.clone(), revision, shown: Footprint::Everything };
        match (id, at) {
            (None, None) => Ok(of_root(self.root(), self.root().revision())),
            (None, Some(at)) => Ok(of_root(self.history.at(at)?, at)),
            (Some(id), _) => {
                let projection = self.projection(id)?;
                let hidden = |pattern: &&FactPattern| match &projection.reads {
                    Footprint::Everything => false,
                    Footprint::Patterns(reads) => !reads.iter().any(|read| read.covers(pattern)),
                };
                if let Some(pattern) = patterns.iter().find(hidden) {
                    return Err(QueryError::Hidden { id, pattern: pattern.clone() });
                }
                let (world, shown) = (projection.world.clone(), projection.reads.clone());
                Ok(View { world, revision: projection.base, shown })
            }
        }
    }

    /// Ends a projection for a caller; false when it had ended before.
    pub(super) fn release_for(&mut self, caller: &Caller, id: ProjectionId) -> Result<bool, MadeByAnother> {
        match self.projections.get(&id) {
            Some(projection) if projection.made_by != caller.name && !caller.is_operator() => {
                Err(MadeByAnother { id, made_by: projection.made_by.clone(), caller: caller.name.clone() })
            }
            Some(_) => Ok(self.release(id)),
            None => match self.promised.whose(id) {
                Some(whose) if *whose != caller.name && !caller.is_operator() => {
                    Err(MadeByAnother { id, made_by: whose.clone(), caller: caller.name.clone() })
                }
                promised => {
                    let is_promised = promised.is_some();
                    self.promised.end(id);
                    Ok(is_promised)
                }
            },
        }
    }

    /// Ends a projection; false when it had ended before.
    pub(super) fn release(&mut self, id: ProjectionId) -> bool {
        let Some(projection) = self.projections.remove(&id) else { return false };
        self.live.remove(id);
        self.in_memory.end(&projection.made_by, projection.base, projection.bytes);
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

    /// Ends the projections of the lease; returns their number.
    pub(super) fn end_lease(&mut self, lease: LeaseId) -> usize {
        let ids = self.by_lease.get(&lease).cloned().unwrap_or_default();
        ids.into_iter().filter(|id| self.release(*id)).count()
    }

    /// Ends the projections of leases that are no longer live.
    pub(super) fn keep_leases(&mut self, live: impl Fn(LeaseId) -> bool) -> usize {
        let ended: Vec<LeaseId> = self.by_lease.keys().copied().filter(|lease| !live(*lease)).collect();
        ended.into_iter().map(|lease| self.end_lease(lease)).sum()
    }

    /// Ends the projections without a lease, and the promises, whose time is over.
    pub(super) fn expire(&mut self, now: Timestamp) {
        self.promised.expire(now);
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
mod tests;
