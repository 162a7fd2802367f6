//! Makes frames for the pages from a fold. Pure: the same fold gives the same frame.

use crate::fold::{Fold, News};
use crate::{logs, wire};
use ratn_event_log::without_visits;
use ratn_executive::protocol::Awaited;
use ratn_model::id::InstanceId;
use ratn_report::statistics::mode_name;
use ratn_report::timeline::{Activity, Ending, Instance, Job, Stage, Timeline, Wait, Yield};
use ratn_task_control::control::{Awaiting, RunStatus};
use std::collections::BTreeMap;

/// Maximum number of waiting reasons in one answer.
const MOST_WAITING: usize = 100;
/// Maximum number of breakpoints sent; a run has no more.
const MOST_BREAKPOINTS: usize = 256;
/// Maximum number of queued instances sent.
const MOST_QUEUED: usize = 200;
/// Maximum number of stages, jobs, waits and invalidations per instance, the last ones.
const MOST_STAGES: usize = 12;
const MOST_JOBS: usize = 8;
const MOST_WAITS: usize = 4;
const MOST_BEHIND: usize = 4;
/// Maximum length of a user's text; a longer one is truncated.
const MOST_CHARACTERS: usize = 400;

/// The changes, and the run as a whole. The reason why `about` waits is included in any case.
pub(crate) fn frame(fold: &Fold, news: &News, about: Option<InstanceId>) -> wire::Frame {
    let run = &fold.run;
    let changed = news.changed.iter().filter_map(|id| run.instance(*id));
    let held: Vec<wire::Held> = run.resources.held().map(held).collect();
    wire::Frame {
        epoch: fold.epoch,
        version: news.version,
        fresh: news.fresh,
        more: news.more,
        run: wire::Run { problem: cut(&fold.problem), ..whole(run, fold.from_s) },
        instances: changed.map(|one| instance(fold, one)).collect(),
        gone: news.gone.iter().map(|id| id.0).collect(),
        waiting: waiting(run, about),
        queue: queue(run),
        kinds: kinds(run, &held),
        held,
    }
}

fn whole(run: &Timeline, from_s: f64) -> wire::Run {
    let ahead = run.speculation();
    let span = |span: &ratn_report::timeline::Span| wire::Span { from_s: span.from_s, to_s: span.to_s };
    wire::Run {
        task: cut(&run.task),
        id: cut(&run.run),
        file: cut(&run.file),
        mode: mode_name(run.mode).to_owned(),
        seed: run.seed.to_string(),
        began_unix_ms: run.began_unix_ms,
        parameters: run.parameters.iter().map(|(name, value)| cut(&format!("{name} = {value}"))).collect(),
        outcome: run.outcome.as_deref().map(cut),
        reason: cut(&run.reason),
        from_s,
        at_s: run.end_s,
        last_s: run.end_s,
        paused: run.is_paused(),
        stopped_at: run.stopped_at().map(|one| cut(&one.path)),
        breakpoints: cut_all(&run.breakpoints),
        pauses: run.pauses.iter().map(span).collect(),
        absences: run.absences.iter().map(span).collect(),
        expanded: run.count.expanded,
        retired: run.count.retired,
        squashed: run.count.squashed,
        useful: ahead.useful,
        useful_s: ahead.useful_s,
        wasted: ahead.wasted,
        wasted_s: ahead.wasted_s,
        ..wire::Run::default()
    }
}

fn instance(fold: &Fold, one: &Instance) -> wire::Instance {
    let phases = one.phases.iter().filter(|phase| phase.to_s > phase.from_s);
    let phases: Vec<wire::Phase> = phases
        .map(|phase| wire::Phase {
            stage: phase.stage.name(),
            from_s: phase.from_s,
            to_s: phase.to_s,
            awaited: cut(&phase.ended_by.awaited()),
        })
        .collect();
    wire::Instance {
        id: one.id.0,
        path: cut(&one.path),
        state: cut(&without_visits(&one.path)),
        stage: one.stage.name(),
        since_s: one.since_s,
        expanded_s: one.expanded_s,
        speculative: one.speculative,
        reused: one.reused,
        outcome: one.outcome.as_deref().map(cut),
        decision: one.decision.as_deref().map(cut),
        phases: last(phases, MOST_STAGES),
        jobs: last(one.jobs.iter().map(|of| job(one, of)).collect(), MOST_JOBS),
        waits: last(one.waits.iter().map(wait).collect(), MOST_WAITS),
        edges: logs::edges(fold, one.id),
        invalidations: last(one.invalidations.iter().map(|text| cut(text)).collect(), MOST_STAGES),
    }
}

fn job(instance: &Instance, job: &Job) -> wire::Job {
    let (ending, reason) = match &job.ending {
        Ending::Outcome(outcome, reason) => (outcome.as_str(), reason.as_str()),
        Ending::Crashed(reason) => ("crashed", reason.as_str()),
        Ending::Cancelled => ("cancelled", ""),
        Ending::Open => ("", ""),
    };
    wire::Job {
        action: cut(&format!("{}/{}", job.provider, job.action)),
        activity: match job.activity {
            Activity::Motion => "motion",
            Activity::Detection => "detection",
            Activity::Other => "other",
            Activity::Planning => "planning",
        },
        attempt: job.attempt,
        from_s: job.from_s,
        to_s: (job.ending != Ending::Open).then_some(job.to_s),
        ending: cut(ending),
        reason: cut(job.invalidated.as_deref().filter(|_| reason.is_empty()).unwrap_or(reason)),
        worth: match instance.yield_of(job) {
            Yield::Used => "used",
            Yield::Lost => "lost",
            Yield::Open => "open",
        },
        resources: job.resources.iter().map(|one| cut(one)).collect(),
    }
}

fn wait(wait: &Wait) -> wire::Wait {
    let behind = wait.behind.iter().take(MOST_BEHIND);
    wire::Wait {
        from_s: wait.from_s,
        to_s: wait.to_s,
        kinds: wait.kinds.clone(),
        behind: behind.map(|one| cut(&format!("{} had {}", one.holder, one.resource))).collect(),
    }
}

/// Instances that have requested resources come first, because their cause can be seen.
fn waiting(run: &Timeline, about: Option<InstanceId>) -> Vec<wire::Waiting> {
    let told = |one: &Instance| {
        let sentence = cut(&run.explain(one.id)?);
        Some(wire::Waiting { id: one.id.0, sentence, since_s: one.since_s })
    };
    let mut all: Vec<&Instance> = run.waiting().collect();
    all.sort_by_key(|one| (one.stage != Stage::Asking, one.id));
    all.truncate(MOST_WAITING);
    let asked = about.and_then(|id| run.instance(id)).filter(|one| all.iter().all(|other| other.id != one.id));
    all.into_iter().chain(asked).filter_map(told).collect()
}

fn held(holding: &ratn_report::timeline::Holding) -> wire::Held {
    wire::Held {
        resource: cut(&holding.resource),
        kind: cut(&holding.kind),
        holder: cut(&holding.holder),
        instance: holding.instance.0,
        from_s: holding.from_s,
    }
}

fn queue(run: &Timeline) -> Vec<wire::Queued> {
    let queue = run.resources.queue().into_iter().take(MOST_QUEUED);
    let path = |id: InstanceId| run.instance(id).map_or_else(|| id.to_string(), |one| cut(&one.path));
    queue
        .map(|asked| wire::Queued {
            instance: asked.instance.0,
            path: path(asked.instance),
            kinds: asked.kinds.clone(),
            priority: asked.priority,
            from_s: asked.from_s,
        })
        .collect()
}

fn kinds(run: &Timeline, held: &[wire::Held]) -> Vec<wire::Kind> {
    let mut all: BTreeMap<&str, usize> = run.resources.known().map(|(_, kind)| (kind, 0)).collect();
    for one in held {
        *all.entry(&one.kind).or_default() += 1;
    }
    all.into_iter()
        .map(|(kind, held)| wire::Kind { kind: kind.to_owned(), total: run.resources.total(kind), held })
        .collect()
}

/// What the waiting states of a run wait for.
pub(crate) fn awaits(status: &RunStatus) -> Vec<wire::Awaits> {
    let told = |one: &Awaiting| {
        let (kind, text, choices) = match &one.awaited {
            Awaited::Answer { question, choices, .. } => ("answer", cut(question), choices.clone()),
            Awaited::Signal { signal } => ("signal", signal.clone(), Vec::new()),
            other => ("other", cut(&other.to_string()), Vec::new()),
        };
        wire::Awaits { path: one.path.clone(), kind, text, choices, until_s: one.until_s }
    };
    status.awaits.iter().take(MOST_WAITING).map(told).collect()
}

/// The breakpoints that a run reports.
pub(crate) fn breakpoints(status: &RunStatus) -> Vec<String> {
    cut_all(&status.breakpoints)
}

fn cut_all(texts: &[String]) -> Vec<String> {
    texts.iter().take(MOST_BREAKPOINTS).map(|text| cut(text)).collect()
}

fn last<T>(mut all: Vec<T>, most: usize) -> Vec<T> {
    all.drain(..all.len().saturating_sub(most));
    all
}

/// Truncates to the maximum number of characters.
fn cut(text: &str) -> String {
    match text.char_indices().nth(MOST_CHARACTERS) {
        Some((end, _)) => format!("{}…", &text[..end]),
        None => text.to_owned(),
    }
}
