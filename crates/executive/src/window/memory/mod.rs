//! Memory renaming: the world as it will be at a place of the program.
//!
//! An instance sees the root plus the effects of the older instances of its path that have not retired. Nothing is copied: a
//! lookup follows the chain of older writers of a predicate, youngest first, as far as needed (`walk`, `view`). The changes
//! by a writer, predicted or measured, are computed once and kept (`forecast`), like a memo of incremental computation.
//!
//! A reader is registered with every writer that it *visited*, even if that writer wrote nothing relevant: the absence of a
//! fact is read, too. When the changes by a writer deviate beyond the tolerances of the facts, its users are told
//! (`difference`); otherwise nobody is.
//!
//! | | |
//! |---|---|
//! | `walk` | the older writers of some facts, youngest first |
//! | `forecast` | the changes by a writer, as far as they are known |
//! | `view` | the variables, ports and facts that an instance sees |
//! | `overlay` | changes over a world |
//! | `difference` | the facts in which two lists of changes differ |
//! | `seen`, `digests` | the inputs of a result, to tell whether they are still the same |
//! | `settled` | results that cannot change any more |

mod difference;
mod digests;
mod forecast;
mod outside;
mod overlay;
mod seen;
pub(crate) mod settled;
mod view;
mod walk;

use super::graph::Graph;
use crate::plan::Plan;
pub(crate) use difference::{Deviation, Difference};
use digests::Digests;
use forecast::Forecast;
use outside::Outside;
use ratn_model::id::InstanceId;
use ratn_model::program::Program;
use ratn_world::world::World;
pub(crate) use seen::Seen;
use serde::{Deserialize, Serialize};
use smallvec::SmallVec;
use std::cell::{Cell, RefCell};
use std::collections::BTreeSet;
pub(crate) use view::{Blocked, View, facts_of};
pub(crate) use walk::Looked;

/// The place of an instance in memory renaming: part of the instance, private to this module.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(crate) struct MemoryCell {
    /// The instances that have used its outputs or looked at its changes.
    users: RefCell<SmallVec<[User; 2]>>,
    /// Its changes, along each arm from which a reader has looked.
    forecasts: RefCell<SmallVec<[Forecast; 1]>>,
}

/// An instance whose result or effects depend on the outputs or changes of an older instance.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub(crate) struct User {
    pub(crate) id: InstanceId,
    pub(crate) of: Source,
    pub(crate) purpose: Purpose,
}

/// What a user depends on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub(crate) enum Source {
    /// Outputs, or values of variables.
    Outputs,
    /// Changes of the world, even if there are none.
    World,
}

/// Which part of the user depends on it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub(crate) enum Purpose {
    /// The user's own result.
    Result,
    /// The forecast of the user's effects.
    Effects,
}

/// The state of memory renaming beside the instances.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(crate) struct Memory {
    #[serde(skip)]
    deep: Deep,
    /// Derived from the root, so not part of a checkpoint.
    #[serde(skip)]
    digests: RefCell<Digests>,
    /// Instances whose outputs or effects may differ from what their users know.
    stale: BTreeSet<InstanceId>,
    outside: Outside,
}

/// For long chains of forecasts that depend on each other: beyond a depth, the innermost is made first.
#[derive(Debug, Default)]
struct Deep {
    depth: Cell<u32>,
    suspended: Cell<Option<(InstanceId, usize, bool)>>,
}

/// References to everything that a view needs.
#[derive(Clone, Copy)]
pub(crate) struct Sight<'a> {
    pub(crate) program: &'a Program,
    pub(crate) plan: &'a Plan,
    pub(crate) root: &'a World,
    pub(crate) graph: &'a Graph,
    memory: &'a Memory,
}

impl MemoryCell {
    fn add_user(&self, user: User) {
        let mut users = self.users.borrow_mut();
        users.push(user);
        // The same user may be added often; duplicates are removed now and then.
        if users.len() >= 16 && users.len().is_power_of_two() {
            users.sort_unstable();
            users.dedup();
        }
    }

    /// Its users, without duplicates.
    pub(crate) fn users(&self) -> SmallVec<[User; 2]> {
        let mut users = self.users.borrow_mut();
        users.sort_unstable();
        users.dedup();
        users.clone()
    }

    pub(crate) fn has_users(&self) -> bool {
        !self.users.borrow().is_empty()
    }

    pub(crate) fn forget_users(&self) {
        self.users.borrow_mut().clear();
    }

    /// Drops the forecasts; the next reader makes them again.
    pub(crate) fn forget_forecasts(&self) {
        self.forecasts.borrow_mut().clear();
    }

    fn has_readers(&self) -> bool {
        self.users.borrow().iter().any(|user| user.of == Source::World)
    }
}

impl Memory {
    /// The references for views.
    pub(crate) fn sight<'a>(
        &'a self,
        program: &'a Program,
        plan: &'a Plan,
        root: &'a World,
        graph: &'a Graph,
    ) -> Sight<'a> {
        Sight { program, plan, root, graph, memory: self }
    }

    /// Marks an instance: its outputs or changes may differ now.
    pub(crate) fn mark(&mut self, id: InstanceId) {
        self.stale.insert(id);
    }

    /// Unmarks an instance that was examined or has left the window.
    pub(crate) fn unmark(&mut self, id: InstanceId) {
        self.stale.remove(&id);
    }

    /// Takes the oldest marked instance; everything that depends on it is younger.
    pub(crate) fn next_stale(&mut self) -> Option<InstanceId> {
        self.stale.pop_first()
    }

    /// Whether no instance is marked.
    pub(crate) fn is_fresh(&self) -> bool {
        self.stale.is_empty()
    }

    /// The root has changed in these patterns.
    pub(crate) fn root_changed<'c>(
        &self,
        root: &World,
        changes: impl Iterator<Item = ratn_model::fact::FactPattern> + 'c,
    ) {
        self.digests.borrow_mut().update(root, changes);
    }
}

impl<'a> Sight<'a> {
    /// Calls `look`; if it needs forecasts at the end of a deep chain, makes these first and repeats the call.
    pub(crate) fn with<T>(self, look: impl Fn(Sight<'a>) -> T) -> T {
        loop {
            let looked = look(self);
            match self.memory.deep.suspended.take() {
                None => return looked,
                Some(first) => self.forecast_from_far(first),
            }
        }
    }

    /// Makes a forecast after the ones that it depends on, with an explicit stack, so that the chain may have any length.
    fn forecast_from_far(self, first: (InstanceId, usize, bool)) {
        let deep = &self.memory.deep;
        let depth = deep.depth.replace(0);
        let mut stack = vec![first];
        while let Some((id, outcome, vague)) = stack.last().copied() {
            if let Some(writer) = self.graph.get(id) {
                self.complete(writer, outcome, vague);
            }
            match deep.suspended.take() {
                Some(before) => stack.push(before),
                None => drop(stack.pop()),
            }
        }
        deep.depth.set(depth);
    }
}
