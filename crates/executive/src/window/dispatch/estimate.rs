//! Estimated durations of nodes, and the longest remaining path: a node's own duration plus the longest path behind it. Behind a
//! node are the readers of its outputs, and the next PIA in program order, which may not begin before every older instance has
//! ended.

use super::{DEFAULT_DURATION_S, Dispatch};
use crate::binding;
use crate::window::graph::Graph;
use crate::window::graph::instance::{Instance, Role};
use crate::window::growth::environment::Binding;
use crate::window::memory::Sight;
use ratn_model::id::InstanceId;

/// Up to this size the window is estimated again whenever it has grown, beyond it when it has grown by this share.
const ALWAYS_ESTIMATED: usize = 64;
const ESTIMATED_SHARE: usize = 2;

/// Estimated duration of an instance, and of the longest path that begins with it, in seconds.
pub(crate) struct Estimate {
    id: InstanceId,
    duration_s: f32,
    remaining_s: f32,
}

impl Dispatch {
    /// Whether a window of this size that has grown by `grown` instances is to be estimated again.
    pub(crate) fn is_estimate_due(size: usize, grown: usize) -> bool {
        if size <= ALWAYS_ESTIMATED { grown > 0 } else { grown * ESTIMATED_SHARE >= size }
    }

    /// Durations and remaining paths of everything in the window.
    pub(crate) fn estimates(&self, sight: Sight<'_>) -> Vec<Estimate> {
        let graph = sight.graph;
        let ids = graph.ids();
        let size = usize::try_from(ids.end - ids.start).unwrap_or(0);
        // By id: the longest path of the readers of its outputs, and of the next PIA behind it.
        let (mut readers, mut pias) = (vec![0.0_f32; size], vec![0.0_f32; size]);
        let place = |id: InstanceId| {
            id.0.checked_sub(ids.start).and_then(|at| usize::try_from(at).ok()).filter(|at| *at < size)
        };
        let mut estimates = Vec::with_capacity(graph.len());
        // A younger instance always has a larger id.
        for instance in graph.iter().rev() {
            let Some(at) = place(instance.id) else { continue };
            let behind = instance.arms.iter().filter_map(|arm| arm.next);
            let join = match instance.role() {
                Some(Role::RegionEnd) => graph.join_behind(instance.line),
                _ => None,
            };
            let pia_s = behind.chain(join).filter_map(place).fold(0.0_f32, |most, next| most.max(pias[next]));
            let duration_s = self.duration_s(sight, instance);
            let remaining_s = duration_s + pia_s.max(readers[at]);
            pias[at] = if instance.is_pia() { remaining_s } else { pia_s };
            let environment = &instance.environment;
            let own = sight.plan.state(instance.state);
            let needs = if instance.role().is_none() { &own.start_flows } else { &own.flows };
            let assigned = own.variables.iter().filter_map(|name| match environment.variables.get(name)? {
                Binding::Assigned(producer) => Some(producer),
                Binding::Known(_) => None,
            });
            for producer in needs.iter().filter_map(|state| environment.producer(*state)).chain(assigned) {
                if let Some(at) = place(producer.instance) {
                    readers[at] = readers[at].max(remaining_s);
                }
            }
            estimates.push(Estimate { id: instance.id, duration_s, remaining_s });
        }
        estimates
    }

    /// Stores estimates; urgencies advised by look-ahead stay.
    pub(crate) fn set_estimates(graph: &mut Graph, estimates: Vec<Estimate>) {
        for Estimate { id, duration_s, remaining_s } in estimates {
            if let Some(cell) = graph.dispatching(id) {
                cell.duration_s = Some(duration_s);
                if !cell.is_advised {
                    cell.remaining_s = Some(remaining_s);
                }
            }
        }
    }

    fn duration_s(&self, sight: Sight<'_>, instance: &Instance) -> f32 {
        if instance.role().is_some() {
            return 0.0;
        }
        let state = sight.program.state(instance.state);
        if let Some(learned) = self.learned_s.get(&state.path).filter(|s| s.is_finite()) {
            return *learned as f32;
        }
        let known = instance.dispatch.duration_s;
        if state.annotations.duration_s.is_none() {
            return known.unwrap_or(DEFAULT_DURATION_S);
        }
        let said = sight.with(|sight| binding::expected_s(state, &sight.view(instance, None)));
        said.map_or(known.unwrap_or(DEFAULT_DURATION_S), |seconds| seconds as f32)
    }

    /// Stores the urgencies of new advice: how long before the end each instance should begin, in seconds.
    pub(crate) fn advise(graph: &mut Graph, urgency_s: &[(InstanceId, f64)]) {
        for (id, seconds) in urgency_s {
            if let Some(cell) = graph.dispatching(*id).filter(|_| seconds.is_finite()) {
                cell.remaining_s = Some(*seconds as f32);
                cell.is_advised = true;
            }
        }
    }
}
