//! The visible part of a run from its log: motions of joints, the pose of the base, and the objects.
//!
//! It knows no robot: [`crate::robot`] later maps the joints of an arm or a head. Memory is bounded: tracks with the present positions are
//! kept, and the latest earlier ones. Pure: it takes lines.

use ratn_executive::protocol::{Command, Event, LogEntry, LogLine};
use ratn_model::fact::{Change as Written, FactKey, Term};
use ratn_model::id::InstanceId;
use ratn_model::pose::Pose;
use ratn_model::value::{TrajectoryPoint, Value};
use ratn_report::believed::Believed;
use ratn_report::motions::{Change, Motions, Way, thinned};
use ratn_world::scene::{BASE, Scene};
use std::collections::{BTreeSet, VecDeque};

/// Maximum number of tracks kept.
const MOST_TRACKS: usize = 96;
/// Maximum number of points of a track; a longer trajectory is thinned.
const MOST_POINTS: usize = 600;
/// Kinds of resources in the standard catalogue.
const ARM_KIND: &str = "Arm";
const BASE_KIND: &str = "Base";
/// Maximum number of joints of a track; a track with more is not kept.
pub(crate) const MOST_JOINTS: usize = 64;
/// Maximum number of parts remembered.
const MOST_PARTS: usize = 128;

/// The visible part of a run.
#[derive(Debug, Default)]
pub(crate) struct Film {
    motions: Motions,
    believed: Believed,
    /// Number of changes so far, and the number of the last one that changed the world.
    version: u64,
    world_changed: u64,
    tracks: VecDeque<Track>,
    /// The parts that were moved so far, each with its number of positions; also those of dropped tracks.
    parts: BTreeSet<(Part, usize)>,
    /// Whether tracks were dropped because of too many joints.
    leaves_out: bool,
    /// Number of tracks so far.
    numbers: u64,
    base: Option<Pose>,
    /// Whether the system of the run has a base that drives; known if the log tells that it has an arm.
    drives: Option<bool>,
}

/// A group of joints.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Part {
    /// Joints with these names.
    Named(Vec<String>),
    /// All joints of an arm; the arm has a name if there are several.
    Arm(Option<String>),
    /// Pan and tilt.
    Head,
    /// The fingers of an arm: the distance of each from the middle; without a position they are open.
    Fingers(Option<String>),
    /// x, y and heading of the base.
    Base,
}

/// Positions or a motion of some joints.
#[derive(Debug)]
pub(crate) struct Track {
    /// Its number.
    pub(crate) id: u64,
    /// The instance that moves them, also after the motion.
    pub(crate) instance: Option<InstanceId>,
    /// The joints.
    pub(crate) part: Part,
    /// Start.
    pub(crate) from_s: f64,
    /// End, if it is over.
    pub(crate) until_s: Option<f64>,
    /// Whether its times are estimates.
    pub(crate) estimated: bool,
    /// In order of time; if the first point is not at 0, the track begins at the present positions.
    pub(crate) points: Vec<TrajectoryPoint>,
    changed: u64,
}

impl Film {
    /// Applies the next line.
    pub(crate) fn apply(&mut self, line: &LogLine) {
        let at_s = line.at.seconds();
        if let LogEntry::Event(Event::Started { capacity, .. }) = &line.entry
            && capacity.contains_key(ARM_KIND)
        {
            self.drives = Some(capacity.contains_key(BASE_KIND));
        }
        if self.believed.follow(line) {
            self.version += 1;
            self.world_changed = self.version;
            if let Some(base) = base(line).filter(|base| self.base != Some(*base)) {
                self.base = Some(base);
                self.stands(at_s, Part::Base, &ratn_motion::robot::on_floor(&base));
            }
        }
        // Begin and end are handled separately, because both borrow `self`.
        let mut begun = None;
        match self.motions.follow(line) {
            Some(Change::Begins(instance, motion)) => begun = track(instance, motion),
            Some(Change::Ends(instance, motion, end)) => {
                let end = end.map(<[f64]>::to_vec);
                self.ends(instance, at_s);
                let part = match motion.way {
                    Way::Along(trajectory) => Part::Named(trajectory.joints),
                    Way::To(_) => Part::Arm(motion.arm),
                };
                if let Some(end) = end {
                    self.stands(at_s, part, &end);
                }
            }
            Some(Change::Stands { arm, at }) => {
                let at = at.to_vec();
                self.stands(at_s, Part::Arm(arm), &at);
            }
            Some(Change::Looks { pan, tilt }) => self.stands(at_s, Part::Head, &[pan, tilt]),
            Some(Change::Fingers { arm, width_m }) => {
                let half = width_m.map(|width_m| width_m / 2.0);
                self.stands(at_s, Part::Fingers(arm), half.as_slice());
            }
            None => {}
        }
        if let Some(track) = begun {
            self.add(track);
        }
    }

    /// Whether the robot of the run has a base that drives; `None` if unknown.
    pub(crate) fn drives(&self) -> Option<bool> {
        self.drives
    }

    /// The number of the last change.
    pub(crate) fn version(&self) -> u64 {
        self.version
    }

    /// All tracks that are kept, in order.
    pub(crate) fn tracks(&self) -> impl Iterator<Item = &Track> {
        self.tracks.iter()
    }

    /// The parts moved so far, each with its number of positions.
    pub(crate) fn parts(&self) -> impl Iterator<Item = &(Part, usize)> {
        self.parts.iter()
    }

    /// Whether there were tracks with more than [`MOST_JOINTS`] joints, which are not kept.
    pub(crate) fn leaves_out(&self) -> bool {
        self.leaves_out
    }

    /// The tracks that are new or have changed since a version.
    pub(crate) fn since(&self, version: u64) -> impl Iterator<Item = &Track> {
        self.tracks.iter().filter(move |track| track.changed > version)
    }

    /// The scene, if it has changed since a version, or if the version is 0. An inner `None`: the facts yield no scene.
    pub(crate) fn scene(&self, version: u64) -> Option<Option<Scene>> {
        (version == 0 || self.world_changed > version).then(|| self.believed.scene())
    }

    /// The last reported pose of the base.
    pub(crate) fn base(&self) -> Pose {
        self.base.unwrap_or(Pose::IDENTITY)
    }

    fn stands(&mut self, at_s: f64, part: Part, positions: &[f64]) {
        let point = TrajectoryPoint { time_s: 0.0, positions: positions.to_vec(), velocities: Vec::new() };
        let (from_s, until_s) = (at_s, Some(at_s));
        self.add(Track { part, from_s, until_s, points: vec![point], ..Track::default() });
    }

    fn ends(&mut self, instance: InstanceId, at_s: f64) {
        self.version += 1;
        let version = self.version;
        let open = self.tracks.iter_mut().filter(|one| one.instance == Some(instance) && one.until_s.is_none());
        open.for_each(|one| (one.until_s, one.changed) = (Some(at_s), version));
    }

    fn add(&mut self, track: Track) {
        let is_long = |point: &TrajectoryPoint| point.positions.len() > MOST_JOINTS;
        let names = match &track.part {
            Part::Named(names) => names.len(),
            _ => 0,
        };
        self.version += 1;
        if names > MOST_JOINTS || track.points.iter().any(is_long) {
            self.leaves_out = true;
            return;
        }
        if self.parts.len() < MOST_PARTS {
            let positions = track.points.first().map_or(0, |point| point.positions.len());
            self.parts.insert((track.part.clone(), positions));
        }
        self.numbers += 1;
        if self.tracks.len() >= MOST_TRACKS {
            // A track that is over and whose joints are in a later track is the least useful one.
            let is_over = |index: usize| {
                let one = &self.tracks[index];
                one.until_s.is_some() && self.tracks.iter().skip(index + 1).any(|later| later.part == one.part)
            };
            let given_up = (0..self.tracks.len()).find(|index| is_over(*index)).unwrap_or(0);
            self.tracks.remove(given_up);
        }
        self.tracks.push_back(Track { id: self.numbers, changed: self.version, ..track });
    }
}

impl Default for Track {
    fn default() -> Track {
        Track {
            id: 0,
            instance: None,
            part: Part::Base,
            from_s: 0.0,
            until_s: None,
            estimated: false,
            points: Vec::new(),
            changed: 0,
        }
    }
}

/// The track of a motion; `None` for a motion to a posture of unknown duration: its end is shown instead.
fn track(instance: InstanceId, motion: &ratn_report::motions::Motion) -> Option<Track> {
    let (part, points, estimated) = match &motion.way {
        Way::Along(trajectory) => {
            let points = thinned(&trajectory.points, MOST_POINTS).into_iter().cloned().collect();
            (Part::Named(trajectory.joints.clone()), points, false)
        }
        Way::To(goal) => {
            let time_s = motion.expected_s.filter(|expected_s| *expected_s > 0.0)?;
            let point = TrajectoryPoint { time_s, positions: goal.clone(), velocities: vec![0.0; goal.len()] };
            (Part::Arm(motion.arm.clone()), vec![point], true)
        }
    };
    Some(Track { instance: Some(instance), part, from_s: motion.from_s, points, estimated, ..Track::default() })
}

/// The pose of the base in a line, if any.
fn base(line: &LogLine) -> Option<Pose> {
    let is_base = |key: &FactKey| {
        key.predicate == "at" && matches!(key.arguments.as_slice(), [Term::Name(name)] if name.as_str() == BASE)
    };
    let pose = |value: &Value| match value {
        Value::Pose(pose) => Some(*pose),
        _ => None,
    };
    match &line.entry {
        LogEntry::Event(Event::Started { world, .. }) => {
            world.iter().filter(|(key, _)| is_base(key)).find_map(|(_, value)| pose(value))
        }
        LogEntry::Event(Event::WorldChanged { facts, .. }) => {
            facts.iter().filter(|(key, _)| is_base(key)).find_map(|(_, value)| pose(value.as_ref()?))
        }
        LogEntry::Command(Command::Commit { changes, .. }) => changes.iter().rev().find_map(|change| match change {
            Written::Set { fact, value } if is_base(fact) => pose(value),
            _ => None,
        }),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    fn film(lines: &[String]) -> Film {
        let mut film = Film::default();
        lines.iter().for_each(|line| film.apply(&serde_json::from_str(line).unwrap()));
        film
    }

    /// A motion of one joint, from second `id` on, for half a second.
    fn motion(id: u64) -> [String; 2] {
        let (at, end) = (id * 1_000_000_000, id * 1_000_000_000 + 500_000_000);
        [
            format!(
                r#"{{"at":{at},"command":"start","instance":{id},"attempt":1,"goal":{{"provider":"arm","action":"follow","inputs":{{"trajectory":{{"trajectory":{{"joints":["j"],"points":[{{"time_s":0.0,"positions":[0.0],"velocities":[0.0]}},{{"time_s":1.0,"positions":[1.0],"velocities":[0.0]}}]}}}}}},"seed":1,"lease":null,"projection":null,"expected_s":null}}}}"#
            ),
            format!(
                r#"{{"at":{end},"event":"finished","instance":{id},"attempt":1,"outcome":"success","outputs":{{}},"measured":[],"reason":""}}"#
            ),
        ]
    }

    #[test]
    fn a_motion_is_told_when_it_begins_and_again_when_it_ends() {
        let lines = motion(1);
        let begun = film(&lines[..1]);
        let track = begun.tracks().next().unwrap();
        assert_eq!((track.from_s, track.until_s, track.points.len()), (1.0, None, 2));
        let ended = film(&lines);
        let since: Vec<(u64, Option<f64>)> = ended.since(begun.version()).map(|one| (one.id, one.until_s)).collect();
        assert_eq!(since, [(1, Some(1.5))]);
        assert_eq!(ended.since(ended.version()).count(), 0);
    }

    #[test]
    fn of_many_tracks_the_last_of_each_joint_stays() {
        let base = r#"{"at":0,"event":"world_changed","revision":1,"facts":[[{"predicate":"at","arguments":[{"name":"base"}]},{"pose":{"position":[1.0,2.0,0.0],"quaternion_xyzw":[0.0,0.0,0.0,1.0]}}]]}"#;
        let key = serde_json::to_string(&FactKey {
            predicate: "at".to_owned(),
            arguments: vec![Term::Name("base".to_owned())],
        });
        let base = base.replace(r#"{"predicate":"at","arguments":[{"name":"base"}]}"#, &key.unwrap());
        let lines: Vec<String> = [vec![base], (1..=200).flat_map(motion).collect()].concat();
        let film = film(&lines);
        assert_eq!(film.tracks().count(), MOST_TRACKS);
        assert_eq!(film.tracks().next().unwrap().part, Part::Base);
        assert_eq!(film.tracks().last().unwrap().id, 201);
        assert_eq!(film.base().position, [1.0, 2.0, 0.0]);
    }
}
