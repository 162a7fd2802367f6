//! A trace of track events for ui.perfetto.dev: a track per resource, with its holders and their work; one more for waits. A flow leads
//! from each result to the instances that had waited for it; it ends at once if such an instance was discarded before it ran.
//!
//! If several instances hold a resource at once, it has a track for each. The packets are written in the order of the log; a reader sorts
//! them by time.

use super::wire::perfetto::track_event::Type;
use super::wire::perfetto::{DebugAnnotation, ProcessDescriptor, Trace, TracePacket, TrackDescriptor, TrackEvent};
use super::{Writer, unix_ns};
use prost::Message;
use ratn_executive::protocol::{Command, Event, LogEntry, LogLine};
use ratn_model::id::InstanceId;
use ratn_model::program::SUCCESS;
use ratn_otlp::ids::number_of;
use ratn_report::lanes::Lanes;
use ratn_report::statistics::mode_name;
use ratn_report::timeline::{Cause, Changed, Ending, Holding, Instance, Stage, Timeline};
use std::collections::BTreeMap;
use std::io::{self, Write};
use std::sync::Arc;

/// The run is the only process, with one sequence of packets.
const PROCESS: u64 = 1;
const SEQUENCE: u32 = 1;
/// The sequence begins without earlier interned names.
const INCREMENTAL_STATE_CLEARED: u32 = 1;
const ELSEWHERE: &str = "no resource";
const WAITING: &str = "waiting for resources";

pub(crate) struct Perfetto<W> {
    out: W,
    lanes: BTreeMap<Arc<str>, Lanes>,
    /// The holdings, by resource and holder: the lane, and whether the work is shown on that lane.
    held: Vec<Held>,
    /// Where the work of a running instance is shown.
    at_work: BTreeMap<InstanceId, Work>,
    ends: Option<Ends>,
    flows: u64,
    /// Flows that end where an instance begins to run, each with the track on which it begins.
    arriving: BTreeMap<InstanceId, (u64, u64)>,
}

/// An open slice of work.
#[derive(Clone, Copy)]
struct Work {
    track: u64,
    /// The lane, if it holds no resource.
    elsewhere: Option<usize>,
}

/// The instance of the last event has a result: the end of its slice is written after the consequences of the result.
struct Ends {
    instance: InstanceId,
    track: u64,
    /// The annotations of the end; `None` once they are written.
    said: Option<Vec<DebugAnnotation>>,
}

struct Held {
    resource: Arc<str>,
    instance: InstanceId,
    lane: usize,
    track: u64,
}

impl<W: Write> Perfetto<W> {
    pub(crate) fn new(out: W) -> Perfetto<W> {
        let (lanes, at_work, arriving) = Default::default();
        Perfetto { out, lanes, held: Vec::new(), at_work, ends: None, flows: 0, arriving }
    }

    fn packet(&mut self, packet: TracePacket) -> io::Result<()> {
        self.out.write_all(&Trace { packet: vec![packet] }.encode_to_vec())
    }

    fn describe(&mut self, track: TrackDescriptor) -> io::Result<()> {
        self.packet(TracePacket { track_descriptor: Some(track), ..TracePacket::default() })
    }

    fn event(&mut self, run: &Timeline, at_s: f64, kind: Type, track: u64, event: TrackEvent) -> io::Result<()> {
        let event = TrackEvent { r#type: Some(kind.into()), track_uuid: Some(track), ..event };
        self.packet(TracePacket {
            timestamp: Some(unix_ns(run, at_s)),
            trusted_packet_sequence_id: Some(SEQUENCE),
            track_event: Some(event),
            ..TracePacket::default()
        })
    }

    /// A lane of a track; writes its descriptor if it is new.
    fn lane(&mut self, name: &Arc<str>, from_s: f64, to_s: f64) -> io::Result<(usize, u64)> {
        let (lane, is_new) = self.lanes.entry(name.clone()).or_default().take(from_s, to_s);
        let uuid = number_of(&format!("{name} {lane}"));
        if is_new {
            let name = if lane == 0 { name.to_string() } else { format!("{name} ({})", lane + 1) };
            let parent_uuid = Some(PROCESS);
            self.describe(TrackDescriptor { uuid: Some(uuid), name: Some(name), parent_uuid, process: None })?;
        }
        Ok((lane, uuid))
    }

    fn begin(&mut self, run: &Timeline) -> io::Result<()> {
        let name = format!("{} ({})", run.task, mode_name(run.mode));
        let process = ProcessDescriptor { pid: Some(1), process_name: Some(name) };
        self.packet(TracePacket {
            timestamp: Some(unix_ns(run, 0.0)),
            trusted_packet_sequence_id: Some(SEQUENCE),
            sequence_flags: Some(INCREMENTAL_STATE_CLEARED),
            track_descriptor: Some(TrackDescriptor {
                uuid: Some(PROCESS),
                process: Some(process),
                ..TrackDescriptor::default()
            }),
            ..TracePacket::default()
        })
    }

    fn takes(&mut self, run: &Timeline, one: &Holding) -> io::Result<()> {
        let (lane, track) = self.lane(&one.resource, one.from_s, f64::INFINITY)?;
        self.held.push(Held { resource: one.resource.clone(), instance: one.instance, lane, track });
        let said = vec![note("kind", &one.kind)];
        let event = TrackEvent { debug_annotations: said, ..named(&one.holder, "held") };
        self.event(run, one.from_s, Type::SliceBegin, track, event)
    }

    fn gives_back(&mut self, run: &Timeline, one: &Holding) -> io::Result<()> {
        let is_it = |held: &Held| held.resource == one.resource && held.instance == one.instance;
        let Some(at) = self.held.iter().position(is_it) else { return Ok(()) };
        let Held { resource, lane, track, .. } = self.held.remove(at);
        // Work that still uses it ends with it: slices of a track have to be nested.
        let at_work = self.at_work.iter().find(|(_, work)| work.track == track).map(|(id, _)| *id);
        if let Some(id) = at_work {
            self.ends_work(run, id, one.to_s, Vec::new())?;
        }
        if let Some(lanes) = self.lanes.get_mut(&resource) {
            lanes.free(lane, one.to_s);
        }
        self.event(run, one.to_s, Type::SliceEnd, track, TrackEvent::default())
    }

    fn starts_work(&mut self, run: &Timeline, id: InstanceId, at_s: f64) -> io::Result<()> {
        let Some((instance, job)) = run.instance(id).and_then(|one| Some((one, one.jobs.last()?))) else {
            return Ok(());
        };
        let mut tracks = self.held.iter().filter(|held| job.resources.iter().any(|id| **id == *held.resource));
        let own = tracks.clone().find(|held| held.instance == id).or_else(|| tracks.next()).map(|held| held.track);
        let is_taken = own.is_some_and(|own| self.at_work.values().any(|work| work.track == own));
        let (track, elsewhere) = match own {
            Some(track) if !is_taken => (track, None),
            _ => {
                let (lane, track) = self.lane(&Arc::from(ELSEWHERE), at_s, f64::INFINITY)?;
                (track, Some(lane))
            }
        };
        self.at_work.insert(id, Work { track, elsewhere });
        let name = format!("{} {}/{}", instance.path, job.provider, job.action);
        let mut said = vec![note("attempt", &job.attempt.to_string())];
        said.extend(instance.speculative.then(|| note("speculative", "a condition on its path is open")));
        said.extend(job.ahead_of_time.then(|| note("ahead of time", "something older has not ended")));
        let terminating_flow_ids = self.arriving.remove(&id).into_iter().map(|(flow, _)| flow).collect();
        let event = TrackEvent { debug_annotations: said, terminating_flow_ids, ..named(&name, "work") };
        self.event(run, at_s, Type::SliceBegin, track, event)
    }

    fn ends_work(&mut self, run: &Timeline, id: InstanceId, at_s: f64, said: Vec<DebugAnnotation>) -> io::Result<()> {
        let Some(Work { track, elsewhere }) = self.at_work.remove(&id) else { return Ok(()) };
        if let (Some(lane), Some(lanes)) = (elsewhere, self.lanes.get_mut(ELSEWHERE)) {
            lanes.free(lane, at_s);
        }
        let event = TrackEvent { debug_annotations: said, ..TrackEvent::default() };
        self.event(run, at_s, Type::SliceEnd, track, event)
    }

    /// The consequences of the last event are written: now its instance's slice ends.
    fn ends_at_last(&mut self, run: &Timeline, at_s: f64) -> io::Result<()> {
        let Some((id, said)) = self.ends.as_mut().and_then(|ends| Some((ends.instance, ends.said.take()?))) else {
            return Ok(());
        };
        self.ends_work(run, id, at_s, said)
    }

    /// An instance has stopped waiting because of the result of another one.
    fn flows(&mut self, run: &Timeline, id: InstanceId, at_s: f64) -> io::Result<()> {
        let Some(last) = run.instance(id).and_then(|one| one.phases.last()) else { return Ok(()) };
        let Cause::Result(of, path) = &last.ended_by else { return Ok(()) };
        let Some(track) = self.ends.as_ref().filter(|ends| ends.instance == *of && *of != id).map(|ends| ends.track)
        else {
            return Ok(());
        };
        if last.stage != Stage::Waiting || last.to_s != at_s || self.arriving.contains_key(&id) {
            return Ok(());
        }
        self.flows += 1;
        self.arriving.insert(id, (self.flows, track));
        let name = format!("result of {path}");
        let event = TrackEvent { flow_ids: vec![self.flows], ..named(&name, "result") };
        self.event(run, at_s, Type::Instant, track, event)
    }

    /// Ends the flow to an instance that will not begin any more.
    fn leads_nowhere(&mut self, run: &Timeline, one: &Instance) -> io::Result<()> {
        let Some((flow, track)) = self.arriving.remove(&one.id) else { return Ok(()) };
        let name = format!("{} was not begun", one.path);
        self.event(
            run,
            run.end_s,
            Type::Instant,
            track,
            TrackEvent { terminating_flow_ids: vec![flow], ..named(&name, "result") },
        )
    }

    fn waited(&mut self, run: &Timeline, id: InstanceId) -> io::Result<()> {
        let Some((instance, wait)) = run.instance(id).and_then(|one| Some((one, one.waits.last()?))) else {
            return Ok(());
        };
        if wait.to_s <= wait.from_s || wait.kinds.is_empty() {
            return Ok(());
        }
        let (_, track) = self.lane(&Arc::from(WAITING), wait.from_s, wait.to_s)?;
        let name = format!("{} waits for {}", instance.path, wait.kinds.join(", "));
        let behind = wait.behind.iter().map(|one| note(&one.resource, &format!("was held by {}", one.holder)));
        let event = TrackEvent { debug_annotations: behind.collect(), ..named(&name, "wait") };
        self.event(run, wait.from_s, Type::SliceBegin, track, event)?;
        self.event(run, wait.to_s, Type::SliceEnd, track, TrackEvent::default())
    }
}

impl<W: Write> Writer for Perfetto<W> {
    fn line(&mut self, line: &LogLine, run: &Timeline, changed: &Changed) -> io::Result<()> {
        let at_s = line.at.seconds();
        if let LogEntry::Event(event) = &line.entry
            && !matches!(event, Event::Progressed { .. } | Event::Recorded { .. } | Event::SessionLost { .. })
        {
            self.ends_at_last(run, at_s)?;
            self.ends = None;
        }
        match &line.entry {
            LogEntry::Event(Event::Started { .. }) => self.begin(run)?,
            LogEntry::Event(Event::Granted { instance, .. }) => self.waited(run, *instance)?,
            LogEntry::Event(Event::Finished { instance, outcome, reason, .. }) => {
                self.ends_behind(*instance, outcome, reason);
            }
            LogEntry::Event(Event::Improved { instance, .. }) => self.ends_behind(*instance, SUCCESS, ""),
            LogEntry::Event(Event::Crashed { instance, reason, .. }) => self.ends_behind(*instance, "crashed", reason),
            LogEntry::Command(Command::Acquire { instance, .. } | Command::Project { instance, .. }) => {
                self.flows(run, *instance, at_s)?;
            }
            LogEntry::Command(Command::Start { instance, .. }) => {
                self.flows(run, *instance, at_s)?;
                self.starts_work(run, *instance, at_s)?;
            }
            LogEntry::Command(Command::Cancel { instance, .. }) => {
                self.ends_work(run, *instance, at_s, vec![note("outcome", "cancelled")])?;
            }
            _ => {}
        }
        for holding in &changed.released {
            if self.ends.as_ref().is_some_and(|ends| ends.instance == holding.instance) {
                self.ends_at_last(run, at_s)?;
            }
            self.gives_back(run, holding)?;
        }
        changed.left.iter().try_for_each(|one| self.leads_nowhere(run, one))?;
        changed.granted.iter().try_for_each(|holding| self.takes(run, holding))
    }

    fn end(&mut self, run: &Timeline, changed: &Changed) -> io::Result<()> {
        self.ends_at_last(run, run.end_s)?;
        let open = |ending: &Ending| *ending == Ending::Open;
        let left = changed.left.iter().filter(|one| one.jobs.iter().any(|job| open(&job.ending)));
        for id in left.map(|one| one.id).collect::<Vec<_>>() {
            self.ends_work(run, id, run.end_s, vec![note("outcome", "open: the log ends before it")])?;
        }
        changed.left.iter().try_for_each(|one| self.leads_nowhere(run, one))?;
        changed.released.iter().try_for_each(|holding| self.gives_back(run, holding))
    }
}

impl<W> Perfetto<W> {
    fn ends_behind(&mut self, id: InstanceId, outcome: &str, reason: &str) {
        if let Some(Work { track, .. }) = self.at_work.get(&id) {
            let mut said = vec![note("outcome", outcome)];
            said.extend((!reason.is_empty()).then(|| note("reason", reason)));
            self.ends = Some(Ends { instance: id, track: *track, said: Some(said) });
        }
    }
}

fn named(name: &str, category: &str) -> TrackEvent {
    TrackEvent { name: Some(name.to_owned()), categories: vec![category.to_owned()], ..TrackEvent::default() }
}

fn note(name: &str, value: &str) -> DebugAnnotation {
    DebugAnnotation { name: Some(name.to_owned()), string_value: Some(value.to_owned()) }
}
