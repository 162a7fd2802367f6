//! The critical path: traced backwards from the end of a run to what the run was waiting for at each moment.
//!
//! An instance that ran had waited for the result that let it begin, or for a resource that was released; the path continues there. A state
//! that waits for a condition, a time, a signal or an answer is on the path for as long as it waited. The links follow each other in time;
//! the gaps between them are the latency of the system's parts.

use super::names::{Names, shown};
use super::timeline::{Behind, Cause, Instance, Phase, Stage, Timeline};
use ratn_model::id::InstanceId;
use serde::Serialize;
use std::fmt::Write as _;

/// Minimum length of a link that is shown to people.
const SHORTEST_S: f64 = 0.05;

/// A link of the critical path: what the run waited for during an interval.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Link {
    /// Its start.
    pub from_s: f64,
    /// Its end.
    pub to_s: f64,
    /// The path of the instance.
    pub path: String,
    /// The instance's stage.
    pub stage: Stage,
    /// What the instance had waited for before.
    pub waited_for: String,
}

/// The critical path from the start of a run to its end. Empty if the run has not ended, or ended by itself.
pub fn path(run: &Timeline) -> Vec<Link> {
    let mut links = Vec::new();
    let mut at = run.ended_by.instance().and_then(|id| last_phase(run, id, run.end_s));
    // Each step goes to an earlier phase, so there are no more steps than phases.
    let bound: usize = run.instances().map(|one| one.phases.len() + 1).sum();
    for _ in 0..bound {
        let Some((instance, index)) = at else { break };
        let phase = &instance.phases[index];
        let (link, before) = step(run, instance, index, phase);
        links.extend(link);
        at = before.filter(|(next, to)| is_before((next, *to), (instance, index)));
    }
    links.reverse();
    links
}

type Place<'r> = (&'r Instance, usize);

/// The link of a phase, if any, and the phase from which the path comes.
fn step<'r>(
    run: &'r Timeline,
    instance: &'r Instance,
    index: usize,
    phase: &'r Phase,
) -> (Option<Link>, Option<Place<'r>>) {
    let earlier = index.checked_sub(1).map(|index| (instance, index));
    let link = |waited_for: String| Link {
        from_s: phase.from_s,
        to_s: phase.to_s,
        path: instance.path.to_string(),
        stage: phase.stage,
        waited_for,
    };
    match phase.stage {
        // What the instance had waited for was running meanwhile: the path continues there.
        Stage::Waiting => match &phase.ended_by {
            Cause::Result(id, _) if *id != instance.id => (None, last_phase(run, *id, phase.to_s)),
            Cause::Result(..) => (None, earlier),
            Cause::Start => (None, None),
            Cause::Answer(id, _) | Cause::Projected(id, _) if *id != instance.id => {
                (None, last_phase(run, *id, phase.to_s))
            }
            other => {
                let came_from = earlier.or_else(|| last_phase(run, instance.expanded_by.instance()?, phase.from_s));
                let itself = instance.awaited_itself.as_ref().filter(|(since_s, _)| phase.from_s >= *since_s);
                let waited_for = itself.map_or_else(|| other.awaited(), |(_, what)| what.clone());
                ((phase.to_s > phase.from_s).then(|| link(waited_for)), came_from)
            }
        },
        Stage::Asking => {
            let wait = instance.waits.get(instance.waits.partition_point(|wait| wait.to_s < phase.to_s));
            let wait = wait.filter(|wait| wait.to_s == phase.to_s);
            let freed = wait.and_then(|wait| {
                let released = wait.behind.iter().filter(|one| one.released && one.instance != instance.id);
                released.max_by(|a, b| a.to_s.total_cmp(&b.to_s))
            });
            let kinds = wait.map(|wait| wait.kinds.join(", ")).unwrap_or_default();
            match freed {
                Some(Behind { instance: holder, holder: path, resource, to_s, .. }) => {
                    let given = link(format!("{resource}, given back by {path}"));
                    (Some(Link { from_s: to_s.max(phase.from_s), ..given }), last_phase(run, *holder, *to_s))
                }
                None => (Some(link(kinds)), earlier),
            }
        }
        Stage::Preparing => (Some(link("its projection".to_owned())), earlier),
        Stage::Running => (Some(link(began_on(instance, index))), earlier),
        Stage::Finished => (Some(link("what is before it, to become real".to_owned())), earlier),
        Stage::Retired | Stage::Squashed => (None, earlier),
    }
}

/// The cause that let a running instance begin.
fn began_on(instance: &Instance, index: usize) -> String {
    let waits = instance.phases[..index].iter().rev().find(|phase| phase.stage == Stage::Waiting);
    let cause = waits.map_or(&instance.expanded_by, |phase| &phase.ended_by);
    match cause {
        Cause::Result(id, _) if *id == instance.id => "its own attempt before".to_owned(),
        other => other.awaited(),
    }
}

/// The last phase of an instance that had ended by a moment.
fn last_phase(run: &Timeline, id: InstanceId, to_s: f64) -> Option<Place<'_>> {
    let instance = run.instance(id)?;
    let is_work = |phase: &&Phase| phase.stage != Stage::Finished;
    let ended = instance.phases.partition_point(|phase| phase.to_s <= to_s);
    let index = instance.phases[..ended].iter().rposition(|phase| is_work(&phase))?;
    Some((instance, index))
}

/// Time decreases along the path; at equal times, the order of phases or that of instances does.
fn is_before((next, to): (&Instance, usize), (instance, index): (&Instance, usize)) -> bool {
    let (next_s, now_s) = (next.phases[to].to_s, instance.phases[index].to_s);
    next_s < now_s || (next_s == now_s && (next.id != instance.id || to < index))
}

/// A table for people.
pub fn table(links: &[Link]) -> String {
    let mut text = String::new();
    if links.is_empty() {
        return text;
    }
    let names = Names::of(links.iter().map(|link| link.path.as_str()), 22);
    let width = names.width;
    let _ = writeln!(text, "\n{:<w$}  from s    to s  length  was          began on", "critical path", w = width + 2);
    let is_long = |link: &Link| link.to_s - link.from_s >= SHORTEST_S;
    for (path, link) in names.iter().zip(links).filter(|(_, link)| is_long(link)) {
        let Link { from_s, to_s, stage, waited_for, .. } = link;
        let (length, waited_for) = (to_s - from_s, shown(waited_for));
        let _ = writeln!(
            text,
            "  {path:<width$} {from_s:>7.1} {to_s:>7.1} {length:>7.1}  {:<11}  {waited_for}",
            stage.name()
        );
    }
    let along: f64 = links.iter().map(|link| link.to_s - link.from_s).fold(0.0, |all, one| all + one);
    let short = links.iter().filter(|link| !is_long(link)).count();
    let _ = writeln!(
        text,
        "  {along:.1} s in {} links, {short} of them shorter than {SHORTEST_S} s and not shown",
        links.len()
    );
    text
}
