//! Looks for an order of concurrent calls that a model explains (Wing and Gong, 1993; with the memory of Lowe, 2017).
//!
//! Every thread of calls is sequential, so how far each thread is, together with the model, says everything about what can follow: that
//! is what the memory holds. What happens without an answer (a call whose answer was lost, a session that expires) is a step of the
//! model's own.

use std::collections::BTreeSet;
use std::hash::{DefaultHasher, Hash, Hasher};

/// A call with its answer, and when it began and was answered.
#[derive(Debug, Clone)]
pub(crate) struct Timed<C> {
    pub(crate) begin: u64,
    pub(crate) end: u64,
    pub(crate) call: C,
}

/// What the calls are compared with.
pub(crate) trait Model: Clone + Hash {
    type Call;

    /// The model after a call, if it could have been answered so.
    fn after(&self, timed: &Timed<Self::Call>) -> Option<Self>;

    /// The models after something that nobody heard of, at some time from `earliest` to `latest`.
    fn unheard(&self, earliest: u64, latest: u64) -> Vec<Self>;
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Verdict {
    /// There is an order; so many states were looked at.
    Explained { states: usize },
    /// There is none. The most calls of each thread that could be explained.
    Impossible { furthest: Vec<usize> },
    /// The bound on states was reached.
    Undecided,
}

/// Whether there is an order of all calls, looking at no more than `most` states.
pub(crate) fn search<M: Model>(threads: &[Vec<Timed<M::Call>>], start: M, most: usize) -> Verdict {
    let mut seen = BTreeSet::new();
    let mut furthest = vec![0; threads.len()];
    let mut open = vec![(furthest.clone(), start)];
    while let Some((at, model)) = open.pop() {
        if at.iter().sum::<usize>() > furthest.iter().sum() {
            furthest.clone_from(&at);
        }
        let next = |thread: usize| threads[thread].get(at[thread]);
        // A call that has ended comes before every call that begins after that.
        let Some(first_end) = (0..threads.len()).filter_map(|thread| Some(next(thread)?.end)).min() else {
            return Verdict::Explained { states: seen.len() };
        };
        if seen.len() >= most {
            return Verdict::Undecided;
        }
        let done = |thread: usize| threads[thread][..at[thread]].last().map(|call| call.begin);
        let earliest = (0..threads.len()).filter_map(done).max().unwrap_or(0);
        let mut steps: Vec<(Vec<usize>, M)> =
            model.unheard(earliest, first_end).into_iter().map(|after| (at.clone(), after)).collect();
        let mut possible: Vec<(u64, usize)> = (0..threads.len())
            .filter_map(|thread| next(thread).filter(|call| call.begin <= first_end).map(|call| (call.end, thread)))
            .collect();
        possible.sort_unstable_by(|one, other| other.cmp(one));
        for (_, thread) in possible {
            let Some(after) = model.after(&threads[thread][at[thread]]) else { continue };
            let mut at = at.clone();
            at[thread] += 1;
            steps.push((at, after));
        }
        // The last one is looked at first: the call that ended first.
        open.extend(steps.into_iter().filter(|step| seen.insert(print(step))));
    }
    Verdict::Impossible { furthest }
}

/// Two hashes of 64 bits: two states with the same are taken for one.
fn print(state: &impl Hash) -> (u64, u64) {
    let (mut one, mut other) = (DefaultHasher::new(), DefaultHasher::new());
    other.write_u8(1);
    state.hash(&mut one);
    state.hash(&mut other);
    (one.finish(), other.finish())
}
