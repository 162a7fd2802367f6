//! A recording for Foxglove and Rerun, in Foxglove's schemas: log messages (`/log`, and `/event_log` line by line as JSON), the objects as
//! believed (`/scene`), the pose of the base (`/tf`), and the joints (`/joint_states`).
//!
//! Joint positions are those in the log: along the commanded trajectories, and at the final positions that drivers reported. They are
//! commanded, not measured. The robot itself is its URDF, which the viewer has to be given.

mod file;
mod joints;
mod scene;

use super::wire::foxglove::{self, log::Level};
use super::{Writer, unix_ns};
use file::File;
use joints::Joints;
use prost::Message;
use prost_types::Timestamp;
use ratn_executive::protocol::{Command, Event, LogEntry, LogLine, Note};
use ratn_model::program::SUCCESS;
use ratn_report::timeline::{Changed, Timeline};
use scene::Shown;
use std::io::{self, Write};

/// The schema of a line of an event log: an object with at least `at`.
const LINE_SCHEMA: &str =
    r#"{"title":"ratn.LogLine","type":"object","properties":{"at":{"type":"integer"}},"required":["at"]}"#;

pub(crate) struct Mcap<W> {
    /// `None` until the first line.
    file: Option<(File<W>, Topics)>,
    out: Option<W>,
    believed: Shown,
    joints: Joints,
}

#[derive(Clone, Copy)]
struct Topics {
    log: u16,
    line: u16,
    scene: u16,
    transforms: u16,
    joints: u16,
}

impl<W: Write> Mcap<W> {
    pub(crate) fn new(out: W) -> Mcap<W> {
        Mcap { file: None, out: Some(out), believed: Shown::default(), joints: Joints::default() }
    }

    fn file(&mut self) -> io::Result<(&mut File<W>, Topics)> {
        if let Some(out) = self.out.take() {
            let mut file = File::begin(out)?;
            let mut protobuf = |topic: &str, name: &str| {
                file.channel(topic, "protobuf", (name, "protobuf", super::wire::foxglove::DESCRIPTORS))
            };
            let log = protobuf("/log", "foxglove.Log")?;
            let scene = protobuf("/scene", "foxglove.SceneUpdate")?;
            let transforms = protobuf("/tf", "foxglove.FrameTransforms")?;
            let joints = protobuf("/joint_states", "foxglove.JointStates")?;
            let line = file.channel("/event_log", "json", ("ratn.LogLine", "jsonschema", LINE_SCHEMA.as_bytes()))?;
            self.file = Some((file, Topics { log, line, scene, transforms, joints }));
        }
        self.file
            .as_mut()
            .map(|(file, topics)| (file, *topics))
            .ok_or_else(|| io::Error::other("the file has not begun"))
    }

    fn joints_until(&mut self, run: &Timeline, at_s: f64) -> io::Result<()> {
        for (at_s, joints) in self.joints.until(at_s) {
            let at_ns = unix_ns(run, at_s);
            let message = foxglove::JointStates { timestamp: Some(timestamp(at_ns)), joints };
            let (file, topics) = self.file()?;
            file.message(topics.joints, at_ns, &message.encode_to_vec())?;
        }
        Ok(())
    }

    fn scene(&mut self, at_ns: u64) -> io::Result<()> {
        let Some(update) = self.believed.update(timestamp(at_ns)) else { return Ok(()) };
        let base = self.believed.base(timestamp(at_ns));
        let (file, topics) = self.file()?;
        file.message(topics.scene, at_ns, &update.encode_to_vec())?;
        match base {
            Some(base) => file.message(topics.transforms, at_ns, &base.encode_to_vec()),
            None => Ok(()),
        }
    }
}

impl<W: Write> Writer for Mcap<W> {
    fn line(&mut self, line: &LogLine, run: &Timeline, _: &Changed) -> io::Result<()> {
        let at_s = line.at.seconds();
        let at_ns = unix_ns(run, at_s);
        self.joints_until(run, at_s)?;
        let (file, topics) = self.file()?;
        file.message(topics.line, at_ns, &serde_json::to_vec(line)?)?;
        if let Some((level, message)) = said(line, run) {
            let (name, timestamp) = (run.task.clone(), Some(timestamp(at_ns)));
            let log = foxglove::Log { timestamp, level: level.into(), message, name, file: String::new(), line: 0 };
            file.message(topics.log, at_ns, &log.encode_to_vec())?;
        }
        self.joints.follow(line);
        if self.believed.follow(line) {
            self.scene(at_ns)?;
        }
        Ok(())
    }

    fn end(&mut self, run: &Timeline, _: &Changed) -> io::Result<()> {
        self.joints_until(run, run.end_s)?;
        self.file()?.0.end()
    }
}

/// The message for people that a line gives.
fn said(line: &LogLine, run: &Timeline) -> Option<(Level, String)> {
    let path = |id| run.instance(id).map_or_else(|| format!("{id}"), |one| one.path.to_string());
    Some(match &line.entry {
        LogEntry::Event(Event::Started { task, .. }) => (Level::Info, format!("{task} begins")),
        LogEntry::Event(Event::Finished { instance, outcome, reason, .. }) if outcome != SUCCESS => {
            (Level::Warning, format!("{} ended with {outcome}: {reason}", path(*instance)))
        }
        LogEntry::Event(Event::Finished { instance, .. }) => (Level::Info, format!("{} is done", path(*instance))),
        LogEntry::Event(Event::Improved { instance, cost_s, .. }) => {
            (Level::Info, format!("{} has a result of {cost_s:.2} s, and goes on for a better one", path(*instance)))
        }
        LogEntry::Event(Event::Crashed { instance, reason, .. }) => {
            (Level::Error, format!("{} crashed: {reason}", path(*instance)))
        }
        LogEntry::Event(Event::Refused { instance, reason }) => {
            (Level::Warning, format!("{} is refused its resources: {reason}", path(*instance)))
        }
        LogEntry::Event(Event::PauseRequested) => (Level::Info, "paused".to_owned()),
        LogEntry::Event(Event::ResumeRequested) => (Level::Info, "goes on".to_owned()),
        LogEntry::Event(Event::Signalled { signal, .. }) => (Level::Info, format!("the signal `{signal}`")),
        LogEntry::Event(Event::Answered { instance, choice }) => {
            (Level::Info, format!("{} is answered: {choice}", path(*instance)))
        }
        LogEntry::Command(Command::Note(Note::Awaiting { instance, awaited, .. })) => {
            (Level::Info, format!("{} waits for {awaited}", path(*instance)))
        }
        LogEntry::Event(Event::AbortRequested { reason, .. }) => (Level::Warning, format!("is aborted: {reason}")),
        LogEntry::Command(Command::Start { instance, goal, .. }) => {
            (Level::Info, format!("{} begins: {}/{}", path(*instance), goal.provider, goal.action))
        }
        LogEntry::Command(Command::Note(Note::Decided { path, decision, .. })) => {
            (Level::Info, format!("{path} decides: {decision}"))
        }
        LogEntry::Command(Command::Note(Note::Squashed { instance })) => {
            (Level::Debug, format!("{} is discarded", path(*instance)))
        }
        LogEntry::Command(Command::Note(Note::Invalidated { instance, reason })) => {
            (Level::Info, format!("{} is done again: {reason}", path(*instance)))
        }
        LogEntry::Command(Command::End { outcome, .. }) => (Level::Info, format!("the task ends with {outcome}")),
        _ => return None,
    })
}

fn timestamp(at_ns: u64) -> Timestamp {
    Timestamp { seconds: (at_ns / 1_000_000_000) as i64, nanos: (at_ns % 1_000_000_000) as i32 }
}
