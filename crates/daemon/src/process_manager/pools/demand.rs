//! Demand: how many workers the waiting requests need from one host.

use crate::process_manager::config::Labels;
use ratn_model::resource::{Quantity, ResourceClass};
use ratn_model::value::Value;
use ratn_proto::types::Demand;
use std::borrow::Cow;

/// How many workers of a kind there should be, existing ones included. 0 for no demand.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Demanded {
    /// For requests that wait for more than exists.
    pub(super) missing: u32,
    /// Also for requests that have long waited for workers that are held.
    pub(super) queued: u32,
}

/// How many workers of a kind there should be on `host` to meet all `demands`.
pub(super) fn demanded(demands: &[Demand], kind: &str, (host, labels): (&str, &Labels)) -> Demanded {
    let host = Value::String(host.to_owned());
    let of_workers = |name: &str| match name {
        "host" => Some(Cow::Borrowed(&host)),
        name => labels.get(name).map(|label| Cow::Owned(label.into())),
    };
    let met = |demand: &&Demand| {
        demand.kinds.iter().any(|known| known == kind)
            && demand.requirement.class.is_none_or(|class| class == ResourceClass::Process)
            && demand.requirement.accepts(of_workers)
    };
    let mut demanded = Demanded::default();
    for demand in demands.iter().filter(met) {
        let missing = demand.requirement.count.saturating_sub(demand.queued);
        let with = |more: Quantity| if more.is_zero() { 0 } else { (demand.provided + more).units_up() };
        demanded.missing = demanded.missing.max(with(missing));
        demanded.queued = demanded.queued.max(if demand.queued.is_zero() { 0 } else { with(demand.requirement.count) });
    }
    demanded
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::process_manager::config::Label;
    use ratn_model::resource::{Requirement, ResourceOperation};

    fn demand(missing: u32, edit: impl FnOnce(&mut Requirement)) -> Demand {
        let mut requirement =
            Requirement { count: missing.into(), ..Requirement::new(ResourceOperation::Block, "PathPlanner") };
        edit(&mut requirement);
        Demand {
            requirement,
            kinds: vec!["Planner".to_owned(), "PathPlanner".to_owned()],
            provided: 1.into(),
            queued: Quantity::ZERO,
        }
    }

    fn missing(demands: &[Demand], kind: &str, of: (&str, &Labels)) -> u32 {
        let demanded = demanded(demands, kind, of);
        assert_eq!(demanded.queued, 0);
        demanded.missing
    }

    #[test]
    fn the_largest_demand_counts_beside_what_is_provided() {
        let demands = [demand(2, |_| {}), demand(4, |_| {}), demand(1, |_| {})];
        assert_eq!(missing(&demands, "PathPlanner", ("compute", &Labels::new())), 5);
        assert_eq!(missing(&demands, "Detector", ("compute", &Labels::new())), 0);
    }

    #[test]
    fn what_no_worker_of_this_host_would_meet_is_not_demanded_of_it() {
        let elsewhere = |r: &mut Requirement| {
            r.attributes.insert("host".to_owned(), Value::String("elsewhere".to_owned()));
        };
        assert_eq!(missing(&[demand(1, elsewhere)], "PathPlanner", ("compute", &Labels::new())), 0);
        assert_eq!(missing(&[demand(1, elsewhere)], "PathPlanner", ("elsewhere", &Labels::new())), 2);
        let with_gpu = |r: &mut Requirement| {
            r.attributes.insert("gpu".to_owned(), Value::Bool(true));
        };
        let labels = |gpu| [("gpu".to_owned(), Label::Bool(gpu))].into();
        assert_eq!(missing(&[demand(1, with_gpu)], "PathPlanner", ("compute", &labels(true))), 2);
        assert_eq!(missing(&[demand(1, with_gpu)], "PathPlanner", ("compute", &labels(false))), 0);
        let module = |r: &mut Requirement| r.class = Some(ResourceClass::Module);
        assert_eq!(missing(&[demand(1, module)], "PathPlanner", ("compute", &Labels::new())), 0);
    }

    #[test]
    fn what_is_waited_for_is_told_apart_from_what_is_missing() {
        let queued = |missing: u32, queued: u32| Demand { queued: queued.into(), ..demand(missing + queued, |_| {}) };
        let of = |demands: &[Demand]| demanded(demands, "PathPlanner", ("compute", &Labels::new()));
        assert_eq!(of(&[queued(0, 3)]), Demanded { missing: 0, queued: 4 });
        assert_eq!(of(&[queued(1, 2)]), Demanded { missing: 2, queued: 4 });
        assert_eq!(of(&[queued(2, 0), queued(0, 1)]), Demanded { missing: 3, queued: 2 });
    }
}
