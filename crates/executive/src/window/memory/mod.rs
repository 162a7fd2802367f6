//! Memory renaming: what the world is at a place of the program, before it is so.
//!
//! An instance sees the root with the effects of the older instances of its path that have not retired. Nothing is copied: a
//! lookup walks the chain of older writers of a predicate, youngest first, as far as it must (`walk`, `view`). What a writer
//! changes, predicted or measured, is worked out once and kept (`forecast`), as a memo of incremental computation is.
//!
//! A reader is registered with every writer that was *visited*, also where that one had nothing to write: absence is read,
//! too. When what a writer changes comes out otherwise, beyond the tolerances of the facts, its users are told
//! (`difference`); where it comes out the same, nobody is.
//!
//! | | |
//! |---|---|
//! | `walk` | the older writers of some facts, youngest first |
//! | `forecast` | what a writer changes, as far as is known |
//! | `view` | what an instance sees: variables, ports, facts |
//! | `overlay` | changes over a world |
//! | `difference` | in which facts two lists of changes differ |
//! | `seen`, `digests` | what a result was made of, for telling whether the same would come of it again |
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

/// What an instance's place in memory renaming is: part of the instance, private to this module.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(crate) struct MemoryCell {
    /// Who has used its outputs or looked at what it changes.
    users: RefCell<SmallVec<[User; 2]>>,
    /// What it changes, along each arm that somebody has looked from.
    forecasts: RefCell<SmallVec<[Forecast; 1]>>,
}

/// Somebody whose result, or whose effects, are made of what an older instance puts out or changes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub(crate) struct User {
    pub(crate) id: InstanceId,
    pub(crate) of: Source,
    pub(crate) purpose: Purpose,
}

/// What is used.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub(crate) enum Source {
    /// Outputs, or values of variables.
    Outputs,
    /// What it changes of the world, be it nothing.
    World,
}

/// What it is used for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub(crate) enum Purpose {
    /// The user's own result.
    Result,
    /// The forecast of the user's effects.
    Effects,
}

/// What memory renaming keeps beside the instances.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(crate) struct Memory {
    #[serde(skip)]
    deep: Deep,
    /// What anybody would find in the root: no part of a checkpoint.
    #[serde(skip)]
    digests: RefCell<Digests>,
    /// Instances whose outputs or effects may be otherwise than their users know.
    stale: BTreeSet<InstanceId>,
    outside: Outside,
}

/// Forecasts that are made of forecasts that are made of forecasts: beyond a depth, the innermost is made first.
#[derive(Debug, Default)]
struct Deep {
    depth: Cell<u32>,
    suspended: Cell<Option<(InstanceId, usize, bool)>>,
}

/// Where everything that a view needs stands.
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
        // Who asks often stands there often; now and then that is tidied up.
        if users.len() >= 16 && users.len().is_power_of_two() {
            users.sort_unstable();
            users.dedup();
        }
    }

    /// Its users, each once.
    pub(crate) fn users(&self) -> SmallVec<[User; 2]> {
        let mut users = self.users.borrow_mut();
        users.sort_unstable();
        users.dedup();
        users.clone()
    }

    pub(crate) fn has_users(&self) -> bool {
        !self.users.borrow().is_empty()
    }

    /// Nobody uses it any more.
    pub(crate) fn forget_users(&self) {
        self.users.borrow_mut().clear();
    }

    /// What it changes is worked out anew for whoever looks next.
    pub(crate) fn forget_forecasts(&self) {
        self.forecasts.borrow_mut().clear();
    }

    fn has_readers(&self) -> bool {
        self.users.borrow().iter().any(|user| user.of == Source::World)
    }
}

impl Memory {
    /// Where a view looks from.
    pub(crate) fn sight<'a>(
        &'a self,
        program: &'a Program,
        plan: &'a Plan,
        root: &'a World,
        graph: &'a Graph,
    ) -> Sight<'a> {
        Sight { program, plan, root, graph, memory: self }
    }

    /// What it puts out or changes may be otherwise now.
    pub(crate) fn mark(&mut self, id: InstanceId) {
        self.stale.insert(id);
    }

    /// It has been looked at, or is gone.
    pub(crate) fn unmark(&mut self, id: InstanceId) {
        self.stale.remove(&id);
    }

    /// The oldest that may be otherwise: what is made of it is younger.
    pub(crate) fn next_stale(&mut self) -> Option<InstanceId> {
        self.stale.pop_first()
    }

    /// Whether there is none.
    pub(crate) fn is_fresh(&self) -> bool {
        self.stale.is_empty()
    }

    /// The root has changed so.
    pub(crate) fn root_changed<'c>(
        &self,
        root: &World,
        changes: impl Iterator<Item = ratn_model::fact::FactPattern> + 'c,
    ) {
        self.digests.borrow_mut().update(root, changes);
    }
}

impl<'a> Sight<'a> {
    /// Uses something of the sight, and makes the forecasts first that it turns out to need from far away.
    pub(crate) fn with<T>(self, look: impl Fn(Sight<'a>) -> T) -> T {
        loop {
            let looked = look(self);
            match self.memory.deep.suspended.take() {
                None => return looked,
                Some(first) => self.forecast_from_far(first),
            }
        }
    }

    /// Makes a forecast, and before it those that it is made of: with a stack of its own, however long the chain is.
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
