//! The keys that a state writes: the index of memory renaming.
//!
//! Most effects name the key of their fact by literals and loop variables, so the key is known when the state is expanded, and never
//! changes. Such a writer is in the chain of that key, and a reader of another key never meets it. Writers whose keys are not known
//! then are in one chain of their predicate, which every reader of the predicate visits.

use super::{Names, Plan, Predicate};
use ratn_model::expression::{EffectExpr, FactExpr, Scope};
use ratn_model::fact::{FactPattern, Term};

/// A chain of writers, as an index into tables of writers: all writers of a predicate, the writers of a predicate with unknown keys,
/// or the writers of keys that share a bucket.
pub(crate) type Chain = usize;

/// Limits of the number of buckets for keys.
const MOST_BUCKETS: usize = 1 << 16;
const FEWEST_BUCKETS: usize = 64;

/// The keys that a state writes of one predicate.
#[derive(Debug)]
pub(crate) struct Written {
    pub(crate) predicate: Predicate,
    /// The facts, if each is named by an effect of its own: not in a quantifier, and without `?`.
    facts: Option<Vec<FactExpr>>,
}

/// The keys that effects write, by predicate.
pub(super) fn written<'e>(effects: impl IntoIterator<Item = &'e EffectExpr>, names: &mut Names) -> Vec<Written> {
    let mut all: Vec<Written> = Vec::new();
    let mut add = |fact: &FactExpr, is_alone: bool, names: &mut Names| {
        let predicate = names.of_predicate(&fact.predicate);
        let at = all.iter().position(|written| written.predicate == predicate).unwrap_or_else(|| {
            all.push(Written { predicate, facts: Some(Vec::new()) });
            all.len() - 1
        });
        let is_alone = is_alone && fact.arguments.iter().all(Option::is_some);
        match &mut all[at].facts {
            Some(facts) if is_alone => facts.push(fact.clone()),
            facts => *facts = None,
        }
    };
    for effect in effects {
        match effect {
            EffectExpr::Set(fact, _) | EffectExpr::Delete(fact) | EffectExpr::Increase(fact, _) => {
                add(fact, true, names)
            }
            EffectExpr::ForEach { .. } => effect.written().into_iter().for_each(|fact| add(fact, false, names)),
        }
    }
    all
}

impl Plan {
    /// Number of buckets for keys in a window with this horizon.
    pub(super) fn buckets(horizon: usize) -> usize {
        horizon.next_power_of_two().clamp(FEWEST_BUCKETS, MOST_BUCKETS)
    }

    pub(crate) fn chains(&self) -> usize {
        2 * self.width + self.buckets
    }

    /// The chain of all writers of a predicate.
    pub(crate) fn chain_of(&self, predicate: Predicate) -> Chain {
        predicate
    }

    /// The chains with the possible writers of a pattern; none if nothing writes its predicate.
    pub(crate) fn chains_of(&self, pattern: &FactPattern) -> [Option<Chain>; 2] {
        let Some(predicate) = self.predicate(&pattern.predicate) else { return [None; 2] };
        match self.bucket(predicate, pattern) {
            Some(bucket) => [Some(self.width + predicate), Some(bucket)],
            None => [Some(self.chain_of(predicate)), None],
        }
    }

    /// The chains that a writer joins for a predicate, besides that of all its writers; `scope` has what is known when the writer is
    /// expanded.
    pub(crate) fn chains_written(&self, written: &Written, scope: &dyn Scope, into: &mut dyn FnMut(Chain)) {
        let buckets = written.facts.as_ref().and_then(|facts| {
            let bucket = |fact: &FactExpr| self.bucket(written.predicate, &fact.bind(scope).ok()?);
            facts.iter().map(bucket).collect::<Option<Vec<Chain>>>()
        });
        match buckets {
            Some(buckets) => buckets.into_iter().for_each(into),
            None => into(self.width + written.predicate),
        }
    }

    /// The bucket of a key; `None` for a pattern with `?`.
    fn bucket(&self, predicate: Predicate, pattern: &FactPattern) -> Option<Chain> {
        // FNV-1a: the same on every machine.
        let mut hash: u64 = 0xcbf2_9ce4_8422_2325;
        let mut add = |byte: u8| hash = (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3);
        predicate.to_le_bytes().into_iter().for_each(&mut add);
        for argument in &pattern.arguments {
            match argument.as_ref()? {
                Term::Int(number) => number.to_le_bytes().into_iter().for_each(&mut add),
                Term::Name(name) => name.bytes().chain([0xff]).for_each(&mut add),
            }
        }
        // Mixing is needed: the low bits of a product depend only on the low bits of its factors.
        let mixed = hash ^ (hash >> 32);
        Some(2 * self.width + (mixed as usize & (self.buckets - 1)))
    }
}
