//! Faults that are injected into the cell: by a schedule, or at random from the cell's seed.
//!
//! A [`Fault`] has a kind and a time: at the n-th occasion (`grasp_slips:2` is the second grasp), at a time of the robot (`object_moved@12.5`), or at
//! every occasion with a probability (`sensor_dropout~0.05`). The occasions are counted here; the effects of faults are in `deviations`.

use super::activity::seconds;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ratn_model::time::Timestamp;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;

/// The most faults that can be scheduled in a cell at once.
pub const MAX_FAULTS: usize = 64;

/// What goes wrong.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// The fingers lose the object that they close around; at a time: the held object slides out. Occasion: a grasp that holds something.
    GraspSlips,
    /// An object is moved to another place on the table. Occasion: a picture was taken.
    ObjectMoved,
    /// The camera gives no image; at a time: for a while. Occasion: a picture.
    SensorDropout,
    /// A controller gives up halfway. Occasion: a motion of the arm or of the base.
    ControllerAbort,
    /// The robot does not know where it stands, for a while: no picture can be placed in the world, and it does not drive.
    /// Occasion: a picture, or a drive.
    LocalisationLost,
}

/// When something goes wrong.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum When {
    /// At the n-th occasion from now on, counted from 1.
    Nth(u32),
    /// At this time of the robot, in seconds since the cell began.
    At(f64),
    /// At each occasion, with this probability.
    Chance(f64),
}

/// Something that goes wrong.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fault {
    /// What goes wrong.
    pub kind: Kind,
    /// When it goes wrong.
    pub when: When,
}

/// A text that names no fault.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "`{text}` is no fault: expected KIND:N (the n-th occasion), KIND@SECONDS or KIND~PROBABILITY, where KIND is {}",
    Kind::ALL.map(Kind::name).join(", ")
)]
pub struct FaultError {
    /// The text that names no fault.
    pub text: String,
}

/// The faults that are still to occur.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Faults {
    coming: Vec<Fault>,
    random: ChaCha8Rng,
}

impl Kind {
    /// All kinds.
    pub const ALL: [Kind; 5] =
        [Kind::GraspSlips, Kind::ObjectMoved, Kind::SensorDropout, Kind::ControllerAbort, Kind::LocalisationLost];

    /// The name of the kind in the text of a fault.
    pub fn name(self) -> &'static str {
        match self {
            Kind::GraspSlips => "grasp_slips",
            Kind::ObjectMoved => "object_moved",
            Kind::SensorDropout => "sensor_dropout",
            Kind::ControllerAbort => "controller_abort",
            Kind::LocalisationLost => "localisation_lost",
        }
    }
}

impl Faults {
    pub(super) fn new(coming: &[Fault], seed: u64) -> Faults {
        // The table uses another random stream.
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        random.set_stream(1);
        Faults { coming: coming.to_vec(), random }
    }

    /// The state for [`Faults::restore`]: the faults to come, and the number of words drawn from the generator.
    pub(super) fn save(&self) -> (Vec<Fault>, u64) {
        (self.coming.clone(), u64::try_from(self.random.get_word_pos()).unwrap_or(u64::MAX))
    }

    /// Restores a saved state.
    pub(super) fn restore(coming: &[Fault], seed: u64, drawn: u64) -> Faults {
        let mut faults = Faults::new(coming, seed);
        faults.random.set_word_pos(drawn.into());
        faults
    }

    /// Adds a fault, unless there are [`MAX_FAULTS`].
    pub(super) fn add(&mut self, fault: Fault) {
        if self.coming.len() < MAX_FAULTS {
            self.coming.push(fault);
        }
    }

    /// Number of faults that are still to occur.
    pub(super) fn len(&self) -> usize {
        self.coming.len()
    }

    /// Counts an occasion for faults of this kind; returns the fault that occurs.
    pub(super) fn occurs(&mut self, kind: Kind) -> Option<Fault> {
        let mut occurring = None;
        for fault in self.coming.iter_mut().filter(|fault| fault.kind == kind) {
            match &mut fault.when {
                When::Nth(left) => {
                    *left = left.saturating_sub(1);
                    if *left == 0 {
                        occurring = Some(*fault);
                    }
                }
                When::Chance(probability) => {
                    if self.random.random_bool(*probability) {
                        occurring = Some(*fault);
                    }
                }
                When::At(_) => {}
            }
        }
        self.coming.retain(|fault| fault.when != When::Nth(0));
        occurring
    }

    /// When the next fault with a fixed time is due.
    pub(super) fn next(&self) -> Option<Timestamp> {
        self.coming.iter().filter_map(Fault::at).min()
    }

    /// Takes the faults that are due by `now`.
    pub(super) fn due(&mut self, now: Timestamp) -> Vec<Fault> {
        let is_due = |fault: &Fault| fault.at().is_some_and(|at| at <= now);
        let due = self.coming.iter().copied().filter(is_due).collect();
        self.coming.retain(|fault| !is_due(fault));
        due
    }

    /// The random generator of faults.
    pub(super) fn random(&mut self) -> &mut ChaCha8Rng {
        &mut self.random
    }
}

impl Fault {
    fn at(&self) -> Option<Timestamp> {
        match self.when {
            When::At(at_s) => Some(Timestamp::default() + seconds(at_s)),
            _ => None,
        }
    }
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let kind = self.kind.name();
        match self.when {
            When::Nth(n) => write!(f, "{kind}:{n}"),
            When::At(at_s) => write!(f, "{kind}@{at_s}"),
            When::Chance(p) => write!(f, "{kind}~{p}"),
        }
    }
}

impl FromStr for Fault {
    type Err = FaultError;

    fn from_str(text: &str) -> Result<Fault, FaultError> {
        let error = || FaultError { text: text.to_owned() };
        let split = text.find([':', '@', '~']).ok_or_else(error)?;
        let (kind, when) = text.split_at(split);
        let kind = Kind::ALL.into_iter().find(|k| k.name() == kind).ok_or_else(error)?;
        let number = || when[1..].parse::<f64>().ok().filter(|x| x.is_finite() && *x >= 0.0);
        let when = match &when[..1] {
            ":" => when[1..].parse().ok().filter(|n| *n > 0).map(When::Nth),
            "@" => number().map(When::At),
            _ => number().filter(|p| *p <= 1.0).map(When::Chance),
        };
        Ok(Fault { kind, when: when.ok_or_else(error)? })
    }
}

impl Serialize for Fault {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for Fault {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Fault, D::Error> {
        String::deserialize(deserializer)?.parse().map_err(serde::de::Error::custom)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    #[test]
    fn a_fault_reads_as_it_is_written_and_nonsense_is_refused_with_what_was_expected() {
        for text in ["grasp_slips:2", "object_moved@12.5", "sensor_dropout~0.05", "localisation_lost@0"] {
            assert_eq!(text.parse::<Fault>().unwrap().to_string(), text);
        }
        for text in ["grasp_slips", "grasp_slips:0", "object_moved@-1", "sensor_dropout~1.5", "earthquake:1", "", "é:1"]
        {
            assert!(text.parse::<Fault>().unwrap_err().to_string().contains("localisation_lost"), "{text}");
        }
    }

    #[test]
    fn the_nth_occasion_counts_its_own_kind_and_happens_once() {
        let mut faults = Faults::new(&["grasp_slips:2".parse().unwrap()], 1);
        assert_eq!(faults.occurs(Kind::SensorDropout), None);
        let happened: Vec<bool> = (0..4).map(|_| faults.occurs(Kind::GraspSlips).is_some()).collect();
        assert_eq!(happened, [false, true, false, false]);
    }

    #[test]
    fn a_scheduled_fault_is_due_at_its_time_and_once() {
        let mut faults = Faults::new(&["object_moved@2".parse().unwrap()], 1);
        let at = Timestamp::from_seconds;
        assert_eq!(faults.next(), Some(at(2.0)));
        assert_eq!(faults.occurs(Kind::ObjectMoved), None);
        assert_eq!([1.9, 2.0, 3.0].map(|t| faults.due(at(t)).len()), [0, 1, 0]);
    }

    #[test]
    fn chance_is_as_likely_as_it_says_and_the_same_for_the_same_seed() {
        let draw = |seed| {
            let mut faults = Faults::new(&["sensor_dropout~0.25".parse().unwrap()], seed);
            (0..4000).map(|_| faults.occurs(Kind::SensorDropout).is_some()).collect::<Vec<_>>()
        };
        let share = draw(1).iter().filter(|x| **x).count();
        assert!((850..1150).contains(&share), "{share}");
        assert_eq!(draw(1), draw(1));
        assert_ne!(draw(1), draw(2));
    }
}
