//! An event log as evaluated by `ratn-report`: nodes, causes, the critical path, the chart. Nothing is computed here.

use crate::error::{Error, line};
use crate::task::json;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use ratn_event_log::without_visits;
use ratn_report::gantt::{self, By};
use ratn_report::report::Report;
use ratn_report::timeline::{Activity, Ending, Instance, Job, Timeline};
use serde_json::{Value, json as object};
use std::path::PathBuf;

/// An event log, read as far as it was written. Results are JSON, unless stated otherwise.
#[pyclass(frozen, module = "ratn")]
pub(crate) struct Log {
    run: Timeline,
}

#[pymethods]
impl Log {
    #[new]
    fn new(py: Python<'_>, path: PathBuf) -> PyResult<Log> {
        let log = py.detach(|| ratn_event_log::read(&path)).map_err(|error| Error::new_err(line(&error)))?;
        Ok(Log { run: Timeline::of(&log.lines) })
    }

    /// A record of each attempt, in the order in which the attempts began.
    fn nodes(&self) -> PyResult<String> {
        let mut jobs: Vec<(&Instance, &Job)> =
            self.run.instances().flat_map(|one| one.jobs.iter().map(move |job| (one, job))).collect();
        jobs.sort_by(|(a, one), (b, other)| one.from_s.total_cmp(&other.from_s).then(a.id.cmp(&b.id)));
        json(&jobs.into_iter().map(|(instance, job)| self.record(instance, job)).collect::<Vec<_>>())
    }

    /// What each visit of a state waited for; `name` is the path of a visit, a path without visit numbers, or the last part of one.
    fn why(&self, name: &str) -> PyResult<String> {
        let last = |path: &str| path.rsplit('/').next().unwrap_or(path).to_owned();
        let is_meant = |one: &&Instance| {
            let plain = without_visits(&one.path);
            *one.path == *name || plain == name || last(&one.path) == name || last(&plain) == name
        };
        json(&self.run.instances().filter(is_meant).map(|one| self.reasons(one)).collect::<Vec<_>>())
    }

    /// The paths of all nodes, each once.
    fn paths(&self) -> Vec<String> {
        let mut paths: Vec<String> = self.run.instances().map(|one| without_visits(&one.path)).collect();
        paths.sort();
        paths.dedup();
        paths
    }

    /// The critical path of the run.
    fn critical_path(&self) -> PyResult<String> {
        json(&ratn_report::critical::path(&self.run))
    }

    /// The report.
    fn report(&self) -> PyResult<String> {
        json(&Report::of(&self.run))
    }

    /// The report as a text for people.
    fn report_text(&self) -> String {
        Report::of(&self.run).to_string()
    }

    /// The Gantt chart as SVG; a row is a `resource` or a `node`.
    fn gantt(&self, by: &str) -> PyResult<String> {
        let by = match by {
            "resource" => By::Resource,
            "node" => By::Node,
            other => return Err(PyValueError::new_err(format!("by is `{other}`: expected `resource` or `node`"))),
        };
        Ok(gantt::stacked(&[&self.run], by, None))
    }
}

impl Log {
    fn record(&self, instance: &Instance, job: &Job) -> Value {
        let (outcome, reason) = match &job.ending {
            Ending::Outcome(outcome, reason) => (Some(outcome.as_str()), reason.as_str()),
            Ending::Crashed(reason) => (Some("crashed"), reason.as_str()),
            Ending::Cancelled => (Some("cancelled"), ""),
            Ending::Open => (None, ""),
        };
        let activity = match job.activity {
            Activity::Motion => "motion",
            Activity::Detection => "detection",
            Activity::Other => "other",
            Activity::Planning => "planning",
        };
        object!({
            "path": *instance.path,
            "instance": instance.id.0,
            "provider": job.provider,
            "action": job.action,
            "attempt": job.attempt,
            "began_s": job.from_s,
            "ended_s": outcome.map(|_| job.to_s),
            "outcome": outcome,
            "reason": reason,
            "activity": activity,
            "resources": job.resources,
            "speculative": instance.speculative,
            "ahead_of_time": job.ahead_of_time,
            "result": instance.yield_of(job),
        })
    }

    fn reasons(&self, instance: &Instance) -> Value {
        let phases = instance.phases.iter().map(|phase| {
            object!({
                "stage": phase.stage,
                "from_s": phase.from_s,
                "to_s": phase.to_s,
                "waited_for": phase.ended_by.awaited(),
            })
        });
        let waits = instance.waits.iter().map(|wait| {
            object!({
                "from_s": wait.from_s,
                "to_s": wait.to_s,
                "kinds": wait.kinds,
                "resources": wait.resources,
                "held_by": wait.behind,
            })
        });
        object!({
            "path": *instance.path,
            "stage": instance.stage,
            "now": self.run.explain(instance.id),
            "phases": phases.collect::<Vec<_>>(),
            "resources": waits.collect::<Vec<_>>(),
            "invalidated": instance.invalidations,
            "outcome": instance.outcome.as_deref(),
        })
    }
}
