//! Demand: how many workers the waiting requests need from one host.

use crate::process_manager::config::Labels;
use ratn_model::resource::ResourceClass;
use ratn_model::value::Value;
use ratn_proto::types::Demand;
use std::borrow::Cow;

/// How many workers of a kind there should be on `host` for all of `demands`; those there are count. 0 for none.
pub(super) fn demanded(demands: &[Demand], kind: &str, (host, labels): (&str, &Labels)) -> u32 {
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
    let count = |demand: &Demand| (demand.provided + demand.requirement.count).units_up();
    demands.iter().filter(met).map(count).max().unwrap_or(0)
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
        Demand { requirement, kinds: vec!["Planner".to_owned(), "PathPlanner".to_owned()], provided: 1.into() }
    }

    #[test]
    fn the_largest_demand_counts_beside_what_is_provided() {
        let demands = [demand(2, |_| {}), demand(4, |_| {}), demand(1, |_| {})];
        assert_eq!(demanded(&demands, "PathPlanner", ("compute", &Labels::new())), 5);
        assert_eq!(demanded(&demands, "Detector", ("compute", &Labels::new())), 0);
    }

    #[test]
    fn what_no_worker_of_this_host_would_meet_is_not_demanded_of_it() {
        let elsewhere = |r: &mut Requirement| {
            r.attributes.insert("host".to_owned(), Value::String("elsewhere".to_owned()));
        };
        assert_eq!(demanded(&[demand(1, elsewhere)], "PathPlanner", ("compute", &Labels::new())), 0);
        assert_eq!(demanded(&[demand(1, elsewhere)], "PathPlanner", ("elsewhere", &Labels::new())), 2);
        let with_gpu = |r: &mut Requirement| {
            r.attributes.insert("gpu".to_owned(), Value::Bool(true));
        };
        let labels = |gpu| [("gpu".to_owned(), Label::Bool(gpu))].into();
        assert_eq!(demanded(&[demand(1, with_gpu)], "PathPlanner", ("compute", &labels(true))), 2);
        assert_eq!(demanded(&[demand(1, with_gpu)], "PathPlanner", ("compute", &labels(false))), 0);
        let module = |r: &mut Requirement| r.class = Some(ResourceClass::Module);
        assert_eq!(demanded(&[demand(1, module)], "PathPlanner", ("compute", &Labels::new())), 0);
    }
}
