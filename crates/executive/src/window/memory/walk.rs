//! Walking the chain of older writers: from an environment, youngest first, as far as the reader needs.

use super::view::View;
use crate::plan::{Chain, EVERYTHING, Plan};
use crate::window::beside::is_in_order;
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

    /// Whether any of these facts matches the pattern.
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

    /// The chains with the possible writers of these facts.
    fn chains(self, plan: &Plan) -> SmallVec<[Chain; 4]> {
        let mut chains: SmallVec<[Chain; 4]> = SmallVec::new();
        chains.push(plan.chain_of(EVERYTHING));
        match self {
            Looked::Everything => chains.extend(plan.predicates().skip(1).map(|predicate| plan.chain_of(predicate))),
            Looked::Patterns(patterns) => {
                for chain in patterns.iter().flat_map(|pattern| plan.chains_of(pattern)).flatten() {
                    // Several patterns of one predicate may have the same chain.
                    if !chains.contains(&chain) {
                        chains.push(chain);
                    }
                }
            }
        }
        chains
    }
}

/// The next writer of one chain.
#[derive(Clone, Copy)]
struct Next {
    chain: Chain,
    link: Link,
}

impl<'a> View<'a> {
    /// Visits the older writers of these facts that have not retired, youngest first and each once, as long as `visit`
    /// returns true.
    pub(super) fn walk(&self, looked: Looked<'_>, mut visit: impl FnMut(&'a Instance, Link) -> bool) {
        let graph = self.sight.graph;
        let mut open: SmallVec<[Next; 4]> = SmallVec::new();
        let push = |open: &mut SmallVec<[Next; 4]>, chain: Chain, link: Option<Link>| {
            let Some(link) = link.filter(|link| graph.contains(link.writer)) else { return };
            // Several paths through regions may lead to the same writer.
            if !open.iter().any(|next| next.chain == chain && next.link.writer == link.writer) {
                open.push(Next { chain, link });
            }
        };
        let environment = &self.instance.environment;
        for chain in looked.chains(self.sight.plan) {
            push(&mut open, chain, environment.writer(chain));
        }
        let mut last: Option<InstanceId> = None;
        let mut beside: SmallVec<[InstanceId; 2]> = SmallVec::new();
        while let Some(place) = youngest(&open) {
            let Next { chain, link } = open.swap_remove(place);
            let Some(writer) = graph.get(link.writer) else { continue };
            match graph.joined(link.writer) {
                Some(links) if writer.role() == Some(Role::Join) => {
                    let merged = links.iter().filter(|(of, _)| *of == chain);
                    merged.for_each(|(_, link)| push(&mut open, chain, Some(*link)));
                    continue;
                }
                _ => push(&mut open, chain, writer.environment.writer(chain)),
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
        // Detached writers that still run; a younger writer that has retired already hides them in the root.
        for id in graph.detached().iter().rev().filter(|id| **id < self.instance.id && !beside.contains(id)) {
            // Effects of concurrent regions count once they are real.
            if let Some(writer) = graph.get(*id)
                && is_in_order(writer, self.instance)
                && !visit(writer, self.link_beside(writer))
            {
                return;
            }
        }
    }
}

impl View<'_> {
    /// The link to a detached PIA that no chain contains any more: along its arm, or along all arms if its path was
    /// left.
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
