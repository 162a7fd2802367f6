//! Explains in one sentence why an instance waits at present.

use super::Timeline;
use super::instance::{Instance, Stage};
use super::resources::{Asked, Holding};
use ratn_model::id::InstanceId;

/// Maximum number of names listed; further ones are counted.
const MOST_NAMES: usize = 4;

impl Timeline {
    /// Why an instance that is still kept does not run, and since when. `None` if it runs, or has retired or been squashed.
    pub fn explain(&self, id: InstanceId) -> Option<String> {
        let instance = self.instance(id)?;
        let why = match instance.stage {
            Stage::Asking => return self.resources.asked(id).map(|asked| self.asking(instance, asked)),
            Stage::Waiting if self.stopped_at == Some(id) => {
                "the operator: the run is paused at a breakpoint here".to_owned()
            }
            Stage::Waiting if self.is_paused() && self.hints.is_pia(&instance.path) => {
                "the operator: the run is paused".to_owned()
            }
            Stage::Waiting => match &instance.awaits {
                Some(awaits) => awaits.clone(),
                None => self.older(id)?,
            },
            Stage::Preparing => "its projection".to_owned(),
            Stage::Finished => format!("{}, to become real", self.older(id)?),
            Stage::Running | Stage::Retired | Stage::Squashed => return None,
        };
        Some(format!("{} waits for {why}", instance.path))
    }

    /// What comes before it in the program: the running instances, else the first one without an outcome.
    fn older(&self, id: InstanceId) -> Option<String> {
        let running = self.at_work.range(..id).filter_map(|other| self.instance(*other));
        let names: Vec<String> =
            running.map(|one| format!("{} (running for {})", one.path, self.since(one.since_s))).collect();
        if !names.is_empty() {
            return Some(format!("what is before it: {}", listed(&names)));
        }
        let first = self.open.range(..id).next().and_then(|other| self.instance(*other))?;
        Some(format!("what is before it: {}", first.path))
    }

    fn asking(&self, instance: &Instance, asked: &Asked) -> String {
        let path = &instance.path;
        let all_held: Vec<String> = asked.kinds.iter().filter_map(|kind| self.all_held(kind)).collect();
        if !all_held.is_empty() {
            return format!("{path} waits for {}", all_held.join("; and for "));
        }
        let first = self.resources.queue().into_iter().take_while(|other| other.instance != instance.id);
        let first = first.filter(|other| other.kinds.iter().any(|kind| asked.kinds.contains(kind)));
        let names: Vec<String> =
            first.filter_map(|other| self.instance(other.instance)).map(|other| other.path.to_string()).collect();
        let kinds = asked.kinds.join(", ");
        if names.is_empty() {
            let since = self.since(asked.from_s);
            return format!("{path} has waited for {since} for the resource manager, which it asked for {kinds}");
        }
        format!("{path} waits for {kinds}: it is the turn of {}", listed(&names))
    }

    /// `PathPlanner: both are held, by plan_approach[3] for 4 s and plan_retract[1] for 1 s`
    fn all_held(&self, kind: &str) -> Option<String> {
        let mut holdings: Vec<&Holding> = self.resources.held().filter(|holding| holding.is_a(kind)).collect();
        let total = self.resources.total(kind);
        if holdings.is_empty() || holdings.len() < total {
            return None;
        }
        holdings.sort_by(|a, b| a.from_s.total_cmp(&b.from_s).then(a.instance.cmp(&b.instance)));
        let by: Vec<String> =
            holdings.iter().map(|holding| format!("{} for {}", holding.holder, self.since(holding.from_s))).collect();
        let what = match total {
            0 | 1 => "it is held".to_owned(),
            2 => "both are held".to_owned(),
            many => format!("all {many} are held"),
        };
        Some(format!("{kind}: {what}, by {}", listed(&by)))
    }

    /// A duration since `from_s`: `4 s`, or `0.4 s` if it is short.
    fn since(&self, from_s: f64) -> String {
        seconds((self.end_s - from_s).max(0.0))
    }
}

/// A duration for people.
pub(crate) fn seconds(length_s: f64) -> String {
    if length_s < 9.95 && (length_s - length_s.round()).abs() >= 0.05 {
        format!("{length_s:.1} s")
    } else {
        format!("{length_s:.0} s")
    }
}

/// `a, b and c`
fn listed(names: &[String]) -> String {
    let more = names.len().saturating_sub(MOST_NAMES);
    let shown = &names[..names.len() - more];
    match (shown, more) {
        ([], _) => String::new(),
        ([one], 0) => one.clone(),
        ([first @ .., last], 0) => format!("{} and {last}", first.join(", ")),
        (shown, more) => format!("{} and {more} more", shown.join(", ")),
    }
}
