//! The chain of older writers: from an environment, youngest first, as far as somebody wants to go.

use super::view::View;
use crate::plan::{EVERYTHING, Plan, Predicate};
use crate::window::graph::instance::{Instance, Role};
use crate::window::growth::environment::Link;
use ratn_model::fact::{FactPattern, Footprint};
use ratn_model::id::InstanceId;
use smallvec::SmallVec;

/// The facts that are looked at.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Looked<'p> {
    Everything,
    Patterns(&'p [FactPattern]),
}

impl<'p> Looked<'p> {
    pub(crate) fn at(footprint: &'p Footprint) -> Looked<'p> {
        match footprint {
            Footprint::Everything => Looked::Everything,
            Footprint::Patterns(patterns) => Looked::Patterns(patterns),
        }
    }

    pub(crate) fn is_nothing(self) -> bool {
        matches!(self, Looked::Patterns([]))
    }

    /// Whether some fact of a pattern is looked at.
    pub(crate) fn overlaps(self, pattern: &FactPattern) -> bool {
        match self {
            Looked::Everything => true,
            Looked::Patterns(patterns) => patterns.iter().any(|looked| looked.overlaps(pattern)),
        }
    }

    pub(crate) fn overlaps_any(self, footprint: &Footprint) -> bool {
        match (self, footprint) {
            (Looked::Everything, other) => !other.is_nothing(),
            (Looked::Patterns(patterns), Footprint::Everything) => !patterns.is_empty(),
            (_, Footprint::Patterns(others)) => others.iter().any(|other| self.overlaps(other)),
        }
    }

    /// The predicates whose writers are to be visited.
    fn predicates(self, plan: &Plan) -> SmallVec<[Predicate; 4]> {
        let mut predicates = SmallVec::new();
        predicates.push(EVERYTHING);
        match self {
            Looked::Everything => predicates.extend(plan.predicates().skip(1)),
            Looked::Patterns(patterns) => {
                for (place, pattern) in patterns.iter().enumerate() {
                    // Several patterns of one predicate are one chain.
                    if patterns[..place].iter().any(|before| before.predicate == pattern.predicate) {
                        continue;
                    }
                    predicates.extend(plan.predicate(&pattern.predicate));
                }
            }
        }
        predicates
    }
}

/// The next writer of one predicate.
#[derive(Clone, Copy)]
struct Next {
    predicate: Predicate,
    link: Link,
}

impl<'a> View<'a> {
    /// Visits the older writers of these facts that have not retired, youngest first and each once, while told to go on.
    pub(super) fn walk(&self, looked: Looked<'_>, mut visit: impl FnMut(&'a Instance, Link) -> bool) {
        let graph = self.sight.graph;
        let mut open: SmallVec<[Next; 4]> = SmallVec::new();
        let push = |open: &mut SmallVec<[Next; 4]>, predicate: Predicate, link: Option<Link>| {
            let Some(link) = link.filter(|link| graph.contains(link.writer)) else { return };
            // Several ways, over regions, may lead to the same writer.
            if !open.iter().any(|next| next.predicate == predicate && next.link.writer == link.writer) {
                open.push(Next { predicate, link });
            }
        };
        let environment = &self.instance.environment;
        for predicate in looked.predicates(self.sight.plan) {
            push(&mut open, predicate, environment.writer(predicate));
        }
        let mut last: Option<InstanceId> = None;
        let mut beside: SmallVec<[InstanceId; 2]> = SmallVec::new();
        while let Some(place) = youngest(&open) {
            let Next { predicate, link } = open.swap_remove(place);
            let Some(writer) = graph.get(link.writer) else { continue };
            match graph.joined(link.writer) {
                Some(links) if writer.role() == Some(Role::Join) => {
                    let merged = links.iter().filter(|(of, _)| *of == predicate);
                    merged.for_each(|(_, link)| push(&mut open, predicate, Some(*link)));
                    continue;
                }
                _ => push(&mut open, predicate, writer.environment.writer(predicate)),
            }
            if last.replace(link.writer) == Some(link.writer) {
                continue;
            }
            if writer.is_detached() {
                beside.push(link.writer);
            }
            if !visit(writer, link) {
                return;
            }
        }
        // A younger writer that has retired already hides those that still run beside it.
        for id in graph.detached().iter().rev().filter(|id| **id < self.instance.id && !beside.contains(id)) {
            if let Some(writer) = graph.get(*id)
                && !visit(writer, self.link_beside(writer))
            {
                return;
            }
        }
    }
}

impl View<'_> {
    /// A running PIA that no chain leads to any more: along the arm that it has, or along any if its path was left.
    fn link_beside(&self, writer: &Instance) -> Link {
        let arms = &self.sight.plan.state(writer.state).arms;
        let own = writer.arms.first().and_then(|own| arms.iter().find(|arm| arm.outcomes == own.outcomes));
        match own {
            Some(arm) => Link { writer: writer.id, outcome: arm.outcome, vague: !arm.same_effects },
            None => Link { writer: writer.id, outcome: 0, vague: true },
        }
    }
}

fn youngest(open: &[Next]) -> Option<usize> {
    (0..open.len()).max_by_key(|place| open[*place].link.writer)
}
