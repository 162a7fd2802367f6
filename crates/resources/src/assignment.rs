//! Which units serve which requirement: a maximum assignment, so that a request that can be served is.
//!
//! Requirements take units greedily; where that falls short and several requirements share a kind (`PathPlanner` beside
//! `PathPlanner{host: a}`), units are moved between them along augmenting paths (Kuhn's algorithm).

use crate::resource::Resources;
use ratn_model::resource::{Requirement, ResourceOperation};
use std::collections::{BTreeMap, BTreeSet};

/// Units by resource id.
pub(crate) type Units = BTreeMap<String, u32>;

/// How far the requirements of one request can be served.
#[derive(Debug)]
pub(crate) struct Assignment {
    /// Per requirement, the units it gets (empty for `exists`).
    pub(crate) taken: Vec<Units>,
    /// Per requirement, what is missing.
    pub(crate) missing: Vec<u32>,
}

/// What counts as available.
#[derive(Clone, Copy)]
pub(crate) enum Available<'a> {
    /// Free units without those that are reserved.
    Free(&'a Units),
    /// Everything that exists and is not consumed, whoever holds it.
    Existing,
}

impl Assignment {
    pub(crate) fn is_complete(&self) -> bool {
        self.missing.iter().all(|units| *units == 0)
    }

    /// The maximum assignment of what is available to the requirements.
    pub(crate) fn of(resources: &Resources, available: Available<'_>, requirements: &[Requirement]) -> Assignment {
        let mut search = Search {
            resources,
            available,
            requirements,
            taken: vec![Units::new(); requirements.len()],
            used: Units::new(),
        };
        let mut missing = vec![0; requirements.len()];
        for (index, requirement) in requirements.iter().enumerate() {
            missing[index] = match requirement.operation {
                ResourceOperation::Exists => {
                    let found = u32::try_from(resources.quantity(requirement)).unwrap_or(u32::MAX);
                    requirement.count.saturating_sub(found)
                }
                _ => search.greedy(index),
            };
        }
        for (index, units) in missing.iter_mut().enumerate() {
            let shared = |other: &Requirement| takes(other) && other.kind == requirements[index].kind;
            if takes(&requirements[index]) && requirements.iter().filter(|r| shared(r)).count() > 1 {
                while *units > 0 && search.augment(index, &mut BTreeSet::new()) {
                    *units -= 1;
                }
            }
        }
        Assignment { taken: search.taken, missing }
    }
}

struct Search<'a> {
    resources: &'a Resources,
    available: Available<'a>,
    requirements: &'a [Requirement],
    taken: Vec<Units>,
    used: Units,
}

impl<'a> Search<'a> {
    fn left(&self, id: &str) -> u32 {
        let Some(resource) = self.resources.get(id) else { return 0 };
        let used = self.used.get(id).copied().unwrap_or(0);
        match self.available {
            Available::Existing => resource.quantity().saturating_sub(used),
            Available::Free(reserved) => {
                resource.free().saturating_sub(reserved.get(id).copied().unwrap_or(0)).saturating_sub(used)
            }
        }
    }

    fn take(&mut self, index: usize, id: &str, units: u32) {
        *self.used.entry(id.to_owned()).or_insert(0) += units;
        *self.taken[index].entry(id.to_owned()).or_insert(0) += units;
    }

    fn give_back(&mut self, index: usize, id: &str) {
        for units in [&mut self.used, &mut self.taken[index]] {
            if let Some(count) = units.get_mut(id) {
                *count -= 1;
                if *count == 0 {
                    units.remove(id);
                }
            }
        }
    }

    /// Takes what is there; returns what is missing.
    fn greedy(&mut self, index: usize) -> u32 {
        let resources = self.resources;
        let requirement = &self.requirements[index];
        let mut wanted = requirement.count;
        for (id, _) in resources.fitting(requirement) {
            if wanted == 0 {
                break;
            }
            let units = self.left(id).min(wanted);
            if units > 0 {
                self.take(index, id, units);
                wanted -= units;
            }
        }
        wanted
    }

    /// One more unit for a requirement, if need be by moving another requirement to another resource.
    fn augment(&mut self, index: usize, visited: &mut BTreeSet<String>) -> bool {
        let resources = self.resources;
        let requirement = &self.requirements[index];
        let fitting: Vec<&str> = resources.fitting(requirement).map(|(id, _)| id).collect();
        if let Some(id) = fitting.iter().find(|id| self.left(id) > 0) {
            self.take(index, id, 1);
            return true;
        }
        for id in fitting {
            if !visited.insert(id.to_owned()) {
                continue;
            }
            for other in 0..self.requirements.len() {
                if other != index && self.taken[other].contains_key(id) && self.augment(other, visited) {
                    self.give_back(other, id);
                    self.take(index, id, 1);
                    return true;
                }
            }
        }
        false
    }
}

fn takes(requirement: &Requirement) -> bool {
    matches!(requirement.operation, ResourceOperation::Block | ResourceOperation::Consume)
}
