//! Dispatch order: not speculative before speculative, then the longest remaining path, then program order.
//!
//! The remaining path of a node is its estimated duration plus the longest of what waits for it: the readers of its
//! outputs, and the next PIA in program order, which may not begin before every older instance has ended.

use crate::context::Context;
use crate::window::Window;
use crate::window::instance::Role;
use ratn_model::fact::Footprint;
use ratn_model::id::InstanceId;
use std::collections::BTreeMap;

/// From the top: one bit that says "not speculative", milliseconds of remaining path, program order.
const REMAINING_BITS: u32 = 40;
const ORDER_BITS: u32 = 20;

impl Window {
    /// Estimates durations and remaining paths of everything in the window.
    pub(crate) fn estimate(&mut self, context: &Context<'_>) {
        let mut after: BTreeMap<InstanceId, f64> = BTreeMap::new();
        let mut next_pia: BTreeMap<InstanceId, f64> = BTreeMap::new();
        let ids: Vec<InstanceId> = self.instances.alive.keys().rev().copied().collect();
        // A younger instance always has a larger id.
        for id in ids {
            let duration_s = self.duration_s(context, id);
            let Some(instance) = self.instances.alive.get_mut(&id) else { continue };
            let pia_s = instance.next.iter().filter_map(|next| next_pia.get(next)).fold(0.0, |a: f64, b| a.max(*b));
            let readers_s = after.get(&id).copied().unwrap_or(0.0);
            instance.duration_s = duration_s;
            instance.remaining_s = duration_s + pia_s.max(readers_s);
            let remaining_s = instance.remaining_s;
            next_pia.insert(id, if instance.is_pia() { remaining_s } else { pia_s });
            let analysis = context.analysis.state(instance.state);
            if instance.role == Role::Node {
                for state in &analysis.flows {
                    if let Some(producer) = instance.environment.producers.get(state) {
                        let longest = after.entry(*producer).or_default();
                        *longest = longest.max(remaining_s);
                    }
                }
            }
        }
    }

    fn duration_s(&self, context: &Context<'_>, id: InstanceId) -> f64 {
        let Some(instance) = self.instances.alive.get(&id) else { return 0.0 };
        if instance.role != Role::Node {
            return 0.0;
        }
        let names =
            crate::window::instance::PlaceNames { instances: &self.instances, environment: &instance.environment };
        let scope = crate::binding::Bindings {
            names: &names,
            outputs: None,
            world: context.root,
            unknown: &Footprint::Everything,
        };
        crate::binding::expected_s(context.program.state(instance.state), &scope).unwrap_or(instance.duration_s)
    }

    /// The priority of an acquire: larger first.
    pub(crate) fn priority(&self, id: InstanceId, speculative: bool) -> i64 {
        let remaining_s = self.instances.alive.get(&id).map_or(0.0, |i| i.remaining_s);
        let greatest = |bits: u32| (1_i64 << bits) - 1;
        let remaining = ((remaining_s * 1000.0) as i64).clamp(0, greatest(REMAINING_BITS));
        // Ids grow in program order.
        let order = i64::try_from(id.0).unwrap_or(i64::MAX).min(greatest(ORDER_BITS));
        let certain = i64::from(!speculative);
        (certain << (REMAINING_BITS + ORDER_BITS)) | (remaining << ORDER_BITS) | (greatest(ORDER_BITS) - order)
    }
}
