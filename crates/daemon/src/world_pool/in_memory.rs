//! Memory of projections: what each has of its own, and the facts that the root and the kept revisions no longer have.
//!
//! A projection shares everything that it does not change with its base. So it has no facts of its own except those that it writes, until a
//! revision is forgotten: then the facts that the next revision replaced exist for projections of older bases alone. They are counted once,
//! for the youngest of these bases. When the last projection of a base ends, the facts are counted for the base before if that one has them,
//! too; otherwise they are freed.
//!
//! ```text
//!   kept revisions            7 ── 8 ── 9 (root)
//!   forgotten   3 ── 4 ── 5 ──┘
//!               │         └ base of a projection: has what 6 and 7 replaced and was written up to 5
//!               └ base of a projection: has what 4 and 5 replaced, too, and was written up to 3
//! ```
//! A fact is replaced once, so counting costs as much as writing, and nothing while every base is kept.

use super::history::Kept;
use super::size;
use ratn_model::id::Revision;
use std::collections::BTreeMap;
use std::sync::Arc;

/// Maximum bytes of projections.
#[derive(Debug, Clone, Copy)]
pub(super) struct Most {
    pub(super) in_all: usize,
    pub(super) per_caller: usize,
}

impl Most {
    /// Without the part that is kept for operators.
    pub(super) fn for_all(self) -> usize {
        self.in_all - self.in_all / OPERATORS_PART
    }
}

/// See the module.
#[derive(Debug, Default)]
pub(super) struct InMemory {
    callers: BTreeMap<Arc<str>, OfCaller>,
    bases: BTreeMap<Revision, Base>,
    /// Bytes of their own of all projections.
    own: usize,
    /// Bytes of facts of forgotten revisions.
    left: usize,
}

#[derive(Debug, Default)]
struct OfCaller {
    projections: usize,
    own: usize,
    /// Number of its projections by base.
    bases: BTreeMap<Revision, usize>,
}

#[derive(Debug, Default)]
struct Base {
    projections: usize,
    /// Bytes of facts that are counted for this base, by the revision that wrote them.
    left: BTreeMap<Revision, usize>,
}

/// Why there is no room for a projection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum NoRoom {
    OfCaller,
    InAll,
    ForOperators,
}

/// Operators have one part in this many of all bytes for themselves.
const OPERATORS_PART: usize = 4;

impl InMemory {
    /// Number of projections of a caller.
    pub(super) fn projections(&self, caller: &str) -> usize {
        self.callers.get(caller).map_or(0, |of| of.projections)
    }

    /// Whether there is room for a projection of `own` bytes.
    pub(super) fn check(&self, caller: &str, is_operator: bool, own: usize, most: Most) -> Result<(), NoRoom> {
        let there = self.own + self.left + own;
        if there > most.in_all {
            return Err(NoRoom::InAll);
        }
        if is_operator {
            return Ok(());
        }
        if self.of(caller) + own > most.per_caller {
            return Err(NoRoom::OfCaller);
        }
        if there > most.for_all() { Err(NoRoom::ForOperators) } else { Ok(()) }
    }

    /// Bytes of a caller's projections; facts of forgotten revisions count in full for each caller of their base.
    fn of(&self, caller: &str) -> usize {
        let Some(of) = self.callers.get(caller) else { return 0 };
        // Usually no base has any.
        let bases = of.bases.keys().take(if self.left == 0 { 0 } else { usize::MAX });
        of.own + bases.filter_map(|base| self.bases.get(base)).flat_map(|base| base.left.values()).sum::<usize>()
    }

    /// Adds a projection.
    pub(super) fn begin(&mut self, caller: &Arc<str>, base: Revision, own: usize) {
        let of = self.callers.entry(caller.clone()).or_default();
        of.projections += 1;
        of.own += own;
        *of.bases.entry(base).or_default() += 1;
        self.own += own;
        self.bases.entry(base).or_default().projections += 1;
    }

    /// Removes a projection.
    pub(super) fn end(&mut self, caller: &str, base: Revision, own: usize) {
        if let Some(of) = self.callers.get_mut(caller) {
            of.projections -= 1;
            of.own -= own;
            if let Some(count) = of.bases.get_mut(&base) {
                *count -= 1;
                if *count == 0 {
                    of.bases.remove(&base);
                }
            }
            if of.projections == 0 {
                self.callers.remove(caller);
            }
        }
        self.own -= own;
        let Some(ending) = self.bases.get_mut(&base) else { return };
        ending.projections -= 1;
        if ending.projections > 0 {
            return;
        }
        let left = self.bases.remove(&base).unwrap_or_default().left;
        let mut before = self.bases.range_mut(..base).next_back();
        for (written, bytes) in left {
            match &mut before {
                Some((before, other)) if written <= **before => *other.left.entry(written).or_default() += bytes,
                _ => self.left -= bytes,
            }
        }
    }

    /// A revision was dropped; `next` is its successor.
    pub(super) fn forgotten(&mut self, revision: &Kept, next: &Kept) {
        let Some((base, of)) = self.bases.range_mut(..=revision.world.revision()).next_back() else { return };
        for key in next.written.keys() {
            if let Some(fact) = revision.world.fact(key).filter(|fact| fact.revision <= *base) {
                let bytes = size::of_fact(key, fact);
                *of.left.entry(fact.revision).or_default() += bytes;
                self.left += bytes;
            }
        }
    }

    #[cfg(test)]
    pub(super) fn is_empty(&self) -> bool {
        self.callers.is_empty() && self.bases.is_empty() && self.own == 0 && self.left == 0
    }

    /// Bytes of all projections.
    #[cfg(test)]
    pub(super) fn bytes(&self) -> usize {
        self.own + self.left
    }
}
