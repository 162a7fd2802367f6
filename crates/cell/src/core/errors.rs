//! The errors of the robot's measurements of itself: its encoders, its camera's pose on the head, and the localisation of its base.
//!
//! Controllers and sensors work in *measured* coordinates, and so does everything that the cell reports to the robot. The true values follow from
//! them by the errors here, which are drawn from the seed: those of encoders and camera once, those of the localisation at every stop of the base.
//! The environment, the contact judge and the ground truth use only true values.

use crate::config::ErrorsConfig;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ratn_model::pose::Pose;
use ratn_motion::joint_vector::{JointVector, PerJoint};
use ratn_motion::robot::Configuration;
use std::f64::consts::TAU;

/// The errors of one cell: of its encoders, of its camera, and of its base's localisation since the last stop.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Errors {
    config: ErrorsConfig,
    /// The encoders of each arm, in the order of the arms' numbers.
    arms: Vec<Encoders>,
    /// The true optical frame in the nominal optical frame.
    camera: Pose,
    /// The true pose of the base in the frame of its localised pose: x, y and heading.
    base: [f64; 3],
}

/// The encoders of an arm.
#[derive(Debug, Clone, PartialEq)]
struct Encoders {
    /// The reading of each encoder at its joint's zero, in radians.
    offsets: JointVector,
    /// The periodic error of each encoder, with one period per turn: amplitude and phase, in radians.
    waves: PerJoint<[f64; 2]>,
}

/// Streams of the seed's generator; faults use stream 1.
const CALIBRATION: u64 = 2;
const LOCALISATION: u64 = 3;
/// The encoders of arm number 1; further arms use the streams after it.
const OTHER_ENCODERS: u64 = 4;

impl Encoders {
    fn new(config: &ErrorsConfig, joints: usize, random: &mut ChaCha8Rng) -> Encoders {
        let offsets = JointVector::from_fn(joints, |_| config.encoder_rad * normal(random));
        let wave = |_| [config.encoder_wave_rad * normal(random), random.random_range(0.0..TAU)];
        Encoders { offsets, waves: PerJoint::from_fn(joints, wave) }
    }

    fn truth(&self, measured: &JointVector) -> JointVector {
        JointVector::from_fn(self.offsets.len(), |j| {
            let [amplitude, phase] = self.waves[j];
            measured[j] - self.offsets[j] - amplitude * (measured[j] + phase).sin()
        })
    }
}

impl Errors {
    /// The errors of a cell with this seed, these numbers of joints per arm, and this number of stops of the base.
    pub(super) fn new(config: ErrorsConfig, joints: &[usize], seed: u64, stops: u64) -> Errors {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        random.set_stream(CALIBRATION);
        let first = joints.iter().take(1).map(|joints| Encoders::new(&config, *joints, &mut random));
        let mut arms: Vec<Encoders> = first.collect();
        let place = std::array::from_fn(|_| config.camera_m * normal(&mut random));
        let [roll, pitch, yaw] = std::array::from_fn(|_| config.camera_rad * normal(&mut random));
        let camera = Pose::from_rpy(place, roll, pitch, yaw);
        for (stream, joints) in (OTHER_ENCODERS..).zip(joints.iter().skip(1)) {
            let mut random = ChaCha8Rng::seed_from_u64(seed);
            random.set_stream(stream);
            arms.push(Encoders::new(&config, *joints, &mut random));
        }
        let mut errors = Errors { config, arms, camera, base: [0.0; 3] };
        errors.localise(seed, stops);
        errors
    }

    /// Draws the localisation error for the base's stop of this number.
    pub(super) fn localise(&mut self, seed: u64, stop: u64) {
        let mut random = ChaCha8Rng::seed_from_u64(seed ^ stop.wrapping_mul(0x9E37_79B9_7F4A_7C15));
        random.set_stream(LOCALISATION);
        let sigmas = [self.config.localisation_m, self.config.localisation_m, self.config.localisation_rad];
        self.base = sigmas.map(|sigma| sigma * normal(&mut random));
    }

    /// The true configuration for a measured one.
    pub(super) fn truth(&self, measured: &Configuration) -> Configuration {
        let [x, y, heading] = measured.base;
        let [ahead, left, turn] = self.base;
        let (sin, cos) = heading.sin_cos();
        let base = [x + cos * ahead - sin * left, y + sin * ahead + cos * left, heading + turn];
        let mut truth = Configuration { base, ..*measured };
        for (arm, encoders) in self.arms.iter().enumerate() {
            if let Some(at) = measured.of_arm(arm) {
                truth.set_joints(arm, encoders.truth(&at.joints));
            }
        }
        truth
    }

    /// The localised pose of the base for a true one.
    pub(super) fn believed(&self, base: [f64; 3]) -> [f64; 3] {
        let [ahead, left, turn] = self.base;
        let heading = base[2] - turn;
        let (sin, cos) = heading.sin_cos();
        [base[0] - (cos * ahead - sin * left), base[1] - (sin * ahead + cos * left), heading]
    }

    /// The true optical frame for a nominal one.
    pub(super) fn eye(&self, nominal: &Pose) -> Pose {
        if self.camera == Pose::IDENTITY { *nominal } else { nominal.compose(&self.camera) }
    }
}

/// A standard normal sample (Box and Muller 1958).
fn normal(random: &mut ChaCha8Rng) -> f64 {
    let (radius, angle): (f64, f64) = (random.random_range(f64::MIN_POSITIVE..1.0), random.random_range(0.0..TAU));
    (-2.0 * radius.ln()).sqrt() * angle.cos()
}

#[cfg(test)]
mod tests {
    use super::*;
    use ratn_motion::robot::Robot;

    const SEEDS: u64 = 400;

    fn at_zero() -> Configuration {
        Robot::aimm().at_zero()
    }

    fn rms(values: impl Iterator<Item = f64>) -> f64 {
        let values: Vec<f64> = values.collect();
        (values.iter().map(|v| v * v).sum::<f64>() / values.len() as f64).sqrt()
    }

    /// For the number of samples in these tests, the root mean square is within 10 % of the standard deviation almost always.
    fn about(value: f64, sigma: f64) -> bool {
        (value / sigma - 1.0).abs() < 0.1
    }

    #[test]
    fn errors_have_the_sizes_that_the_configuration_says() {
        let config = ErrorsConfig::REALISTIC;
        let all: Vec<Errors> = (0..SEEDS).map(|seed| Errors::new(config, &[7], seed, 0)).collect();
        let here = Configuration { base: [0.3, -0.2, 1.0], ..at_zero() };
        let truths: Vec<Configuration> = all.iter().map(|errors| errors.truth(&here)).collect();
        assert!(about(rms(truths.iter().map(|t| t.base[2] - 1.0)), config.localisation_rad));
        let off = |t: &Configuration| (t.base[0] - 0.3).hypot(t.base[1] + 0.2) / 2.0_f64.sqrt();
        assert!(about(rms(truths.iter().map(off)), config.localisation_m));
        // The standard deviation of the periodic error, averaged over phases, is that of its amplitude times √½.
        let encoder = config.encoder_rad.hypot(config.encoder_wave_rad / 2.0_f64.sqrt());
        assert!(about(rms(truths.iter().flat_map(|t| t.arm.to_vec())), encoder));
        let eyes: Vec<Pose> = all.iter().map(|errors| errors.eye(&Pose::at(0.0, 0.0, 1.6))).collect();
        assert!(about(
            rms(eyes.iter().map(|eye| eye.distance(&Pose::at(0.0, 0.0, 1.6)) / 3.0_f64.sqrt())),
            config.camera_m
        ));
        assert!(about(rms(eyes.iter().map(|eye| eye.angle(&Pose::IDENTITY) / 3.0_f64.sqrt())), config.camera_rad));
    }

    #[test]
    fn the_same_seed_has_the_same_errors_and_every_stop_its_own() {
        let of = |seed, stop| Errors::new(ErrorsConfig::REALISTIC, &[7], seed, stop);
        assert_eq!(of(3, 0), of(3, 0));
        assert_ne!(of(3, 0).camera, of(4, 0).camera);
        let (first, second) = (of(3, 0), of(3, 1));
        assert!(first.camera == second.camera && first.arms == second.arms && first.base != second.base);
    }

    #[test]
    fn what_is_believed_of_where_the_base_truly_stands_is_what_leads_there() {
        let errors = Errors::new(ErrorsConfig::REALISTIC, &[7], 5, 2);
        let measured = Configuration { base: [1.5, 0.2, 3.0], ..at_zero() };
        let back = errors.believed(errors.truth(&measured).base);
        assert!((0..3).all(|i| (back[i] - measured.base[i]).abs() < 1e-12), "{back:?}");
    }

    #[test]
    fn without_errors_what_is_measured_is_true() {
        let errors = Errors::new(ErrorsConfig::NONE, &[7], 5, 2);
        let measured = Configuration { base: [1.5, 0.2, 3.0], arm: JointVector::all(7, 0.3), ..at_zero() };
        assert_eq!(errors.truth(&measured), measured);
        assert_eq!((errors.believed(measured.base), errors.eye(&Pose::IDENTITY)), (measured.base, Pose::IDENTITY));
    }
}
