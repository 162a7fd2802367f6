//! The configuration of a cell, the section `[cell]` of a config. Every key has a default; an unknown key is an error.

use crate::core::faults::{Fault, MAX_FAULTS};
use ratn_perception::camera::Intrinsics;
use ratn_perception::noise::Noise;
use ratn_worker::endpoint::Endpoint;
use ratn_worker::provider::standstill_bound;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;
use std::time::Duration;

/// The maximum number of boxes in a cell: the number of places on the base.
pub const MAX_BOXES: usize = 9;

/// The maximum number of each kind of tableware in a cell: the number of places for it on the table.
pub const MAX_TABLEWARE: usize = 3;

/// The longest time that the resource manager waits for standstill.
const LONGEST_STANDSTILL: Duration = Duration::from_secs(60);

/// The robot of the paper.
pub const AIMM: &str = "aimm";

/// The scene that the cell begins with: one for each of the paper's two experiments.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Setting {
    /// Boxes on a table, to be fetched onto the base.
    #[default]
    Boxes,
    /// Bowls, forks and cups on a rack, to be set on a table that already has plates.
    Table,
}

/// How many objects of each kind a new scene has. Each setting uses its own kinds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Goods {
    /// Boxes, 1 to 9.
    pub boxes: usize,
    /// Bowls, 0 to 3.
    pub bowls: usize,
    /// Forks, 0 to 3.
    pub forks: usize,
    /// Cups, 0 to 3; with bowls and forks at least one.
    pub cups: usize,
    /// Plates, 0 to 3: they lie on the table and are not moved.
    pub plates: usize,
}

/// A cell's configuration.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CellConfig {
    /// The address to listen on: `local` (a Unix socket in the runtime directory), `127.0.0.1:0` or `unix:/path`.
    pub listen: Endpoint,
    /// The endpoint of the resource manager; unless given, the one in the runtime directory.
    pub resource_manager: Option<Endpoint>,
    /// The host name under which the resources are offered.
    pub host: String,
    /// The robot: the name of a built-in one, or the path of a `robot.toml`.
    pub robot: String,
    /// The scene: `boxes` on a table, or `table`, which is tableware on a rack.
    pub scene: Setting,
    /// How many boxes stand on the table, 1 to 9.
    pub boxes: usize,
    /// How many bowls stand on the rack, 0 to 3.
    pub bowls: usize,
    /// How many forks lie on the rack, 0 to 3.
    pub forks: usize,
    /// How many cups stand on the rack, 0 to 3.
    pub cups: usize,
    /// How many plates lie on the table, 0 to 3.
    pub plates: usize,
    /// The seed from which the sizes and places of objects and the camera's noise are derived.
    pub seed: u64,
    /// The robot's seconds per second of wall time.
    pub speed: f64,
    /// How long the session with the resource manager survives without a keep-alive, in milliseconds.
    pub session_ttl_ms: u64,
    /// When a lease of a module that can move has ended, the next lease is granted once the cell has confirmed standstill, at the latest after this many
    /// milliseconds. By default, and at least, `session_ttl_ms` (the cell may learn of the end that late) and 3 s of the robot, in which it brakes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub standstill_ms: Option<u64>,
    /// The folder in which an emergency stop is stored so that it survives the process: choose one that a reboot does not empty. By default
    /// `state/cell` in the runtime directory.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub state_dir: Option<PathBuf>,
    /// The new file to which the cell records everything, for `ratn cell --replay`.
    pub record: Option<PathBuf>,
    /// The faults to inject: `grasp_slips:2` at the second grasp, `object_moved@12.5` at a time, `sensor_dropout~0.05` by chance.
    pub faults: Vec<Fault>,
    /// The controllers that move arm and base along their trajectories.
    pub controllers: ControllersConfig,
    /// The gripper.
    pub gripper: GripperConfig,
    /// The pan-tilt unit.
    pub pan_tilt: PanTiltConfig,
    /// The camera.
    pub camera: CameraConfig,
    /// The battery.
    pub battery: BatteryConfig,
    /// The errors of the robot's model of itself.
    pub errors: ErrorsConfig,
}

/// The controllers that move arm and base along their trajectories: critically damped second-order systems. The stiffer they are, the less they lag.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ControllersConfig {
    /// Stiffness of the arm's joints: the natural frequency in radians per second.
    pub arm_stiffness: f64,
    /// The maximum error of a joint, in radians; beyond it the motion ends `aborted`.
    pub arm_most_off_rad: f64,
    /// Stiffness of the base: the natural frequency in radians per second.
    pub base_stiffness: f64,
    /// The maximum error of the base, in metres and in radians; beyond it the drive ends `aborted`.
    pub base_most_off: f64,
}

/// The gripper.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GripperConfig {
    /// The opening between the fingers, in metres; by default, and at most, as far as the robot's fingers can open.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub opening_m: Option<f64>,
    /// Time that closing takes, in the robot's seconds.
    pub close_s: f64,
    /// Time that opening takes, in the robot's seconds.
    pub open_s: f64,
    /// The force of each finger, in newtons.
    pub force_n: f64,
}

/// The pan-tilt unit.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PanTiltConfig {
    /// The fraction of its maximum speed that it uses, above 0 and at most 1.
    pub speed: f64,
    /// Time that it takes to come to rest, in the robot's seconds.
    pub settle_s: f64,
}

/// The camera.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CameraConfig {
    /// Frames per second of the robot's time.
    pub frames_per_s: f64,
    /// The intrinsic parameters: focal lengths and principal point in pixels, and the size of the image.
    pub intrinsics: Intrinsics,
    /// The camera's noise.
    pub noise: Noise,
}

/// The errors of the robot's model of itself: standard deviations of normal distributions, drawn from the seed. docs/cell.md says which errors
/// real robots have.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ErrorsConfig {
    /// Zero offset of each of the arm's encoders, in radians.
    pub encoder_rad: f64,
    /// Amplitude of each encoder's periodic error, with one period per turn, in radians.
    pub encoder_wave_rad: f64,
    /// Error of the camera's position on the head along each axis, in metres.
    pub camera_m: f64,
    /// Error of the camera's orientation about each axis, in radians.
    pub camera_rad: f64,
    /// Error of the base's localised position along each axis, in metres; drawn anew at every stop.
    pub localisation_m: f64,
    /// Error of the base's localised heading, in radians; drawn anew at every stop.
    pub localisation_rad: f64,
}

/// The battery.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BatteryConfig {
    /// The charge at the start, 0 to 1.
    pub level: f64,
    /// The charge that one hour without motion uses, as a fraction.
    pub idle_per_hour: f64,
    /// The additional charge that one hour of arm motion uses.
    pub motion_per_hour: f64,
    /// The additional charge that one hour of driving uses.
    pub driving_per_hour: f64,
}

impl Setting {
    /// All settings.
    pub const ALL: [Setting; 2] = [Setting::Boxes, Setting::Table];

    /// The name of the setting in texts.
    pub fn name(self) -> &'static str {
        match self {
            Setting::Boxes => "boxes",
            Setting::Table => "table",
        }
    }

    /// The setting with this name.
    pub fn named(name: &str) -> Option<Setting> {
        Setting::ALL.into_iter().find(|setting| setting.name() == name)
    }
}

impl ErrorsConfig {
    /// No errors at all.
    pub const NONE: ErrorsConfig = ErrorsConfig {
        encoder_rad: 0.0,
        encoder_wave_rad: 0.0,
        camera_m: 0.0,
        camera_rad: 0.0,
        localisation_m: 0.0,
        localisation_rad: 0.0,
    };
    /// The errors of a carefully calibrated robot.
    pub const REALISTIC: ErrorsConfig = ErrorsConfig {
        encoder_rad: 2e-4,
        encoder_wave_rad: 2e-4,
        camera_m: 0.001,
        camera_rad: 0.00175,
        localisation_m: 0.005,
        localisation_rad: 0.00524,
    };
    /// The errors of a robot that was calibrated once and has been used for a long time.
    pub const ROUGH: ErrorsConfig = ErrorsConfig {
        encoder_rad: 5e-4,
        encoder_wave_rad: 5e-4,
        camera_m: 0.003,
        camera_rad: 0.00524,
        localisation_m: 0.01,
        localisation_rad: 0.00873,
    };

    /// The covariance of the camera's nominal pose: position and small rotation along and about the axes of its optical frame, in metres² and radians².
    pub fn camera_covariance(&self) -> [f64; 6] {
        std::array::from_fn(|i| if i < 3 { self.camera_m } else { self.camera_rad }.powi(2))
    }
}

impl Goods {
    /// Whether a cell of this setting can have these numbers of objects.
    pub fn fit(&self, setting: Setting) -> bool {
        let Goods { boxes, bowls, forks, cups, plates } = *self;
        match setting {
            Setting::Boxes => (1..=MAX_BOXES).contains(&boxes),
            Setting::Table => {
                [bowls, forks, cups, plates].iter().all(|many| *many <= MAX_TABLEWARE) && bowls + forks + cups > 0
            }
        }
    }

    /// The total number of objects in this setting.
    pub fn count(&self, setting: Setting) -> usize {
        match setting {
            Setting::Boxes => self.boxes,
            Setting::Table => self.bowls + self.forks + self.cups + self.plates,
        }
    }
}

/// A value of a cell's configuration that is out of its range.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("`{key}` of the cell is {value}: it must be {rule}")]
pub struct ConfigError {
    /// The key.
    pub key: &'static str,
    /// Its value.
    pub value: String,
    /// The rule for its values.
    pub rule: &'static str,
}

impl CellConfig {
    /// The objects of the first scene.
    pub fn goods(&self) -> Goods {
        let CellConfig { boxes, bowls, forks, cups, plates, .. } = *self;
        Goods { boxes, bowls, forks, cups, plates }
    }

    /// The maximum time until the next lease of a module that can move is granted.
    pub fn standstill(&self) -> Duration {
        self.standstill_ms.map_or_else(|| self.stops_within(), Duration::from_millis)
    }

    /// The time in which the cell has stopped by itself after a lease has ended: it may learn of that only when its own session is over, and its
    /// actions have returned 3 s later, of the robot where that is slowed down.
    fn stops_within(&self) -> Duration {
        let ttl = Duration::from_millis(self.session_ttl_ms);
        // What is no number is refused elsewhere.
        let speed = if self.speed.is_nan() { 1.0 } else { self.speed.clamp(1e-3, 1.0) };
        ttl + (standstill_bound(ttl) - ttl).div_f64(speed)
    }

    /// Checks the rules that the types cannot express.
    ///
    /// # Errors
    /// [`ConfigError`] names the first invalid value.
    pub fn check(&self) -> Result<(), ConfigError> {
        let is_slow = self.speed < 1.0;
        let rules = [
            ("boxes", self.boxes as f64, (1..=MAX_BOXES).contains(&self.boxes), "1 to 9"),
            ("bowls", self.bowls as f64, self.bowls <= MAX_TABLEWARE, "0 to 3"),
            ("forks", self.forks as f64, self.forks <= MAX_TABLEWARE, "0 to 3"),
            ("cups", self.cups as f64, self.cups <= MAX_TABLEWARE, "0 to 3"),
            ("plates", self.plates as f64, self.plates <= MAX_TABLEWARE, "0 to 3"),
            (
                "forks",
                self.forks as f64,
                self.bowls + self.forks + self.cups > 0,
                "at least 1 where there are no bowls and no cups",
            ),
            ("speed", self.speed, self.speed > 0.0 && self.speed <= 1000.0, "above 0 and at most 1000"),
            (
                "session_ttl_ms",
                self.session_ttl_ms as f64,
                self.stops_within() <= LONGEST_STANDSTILL && self.session_ttl_ms >= 500,
                match is_slow {
                    true => {
                        "500 to 60000 - 3000 / speed, so that what moves has stopped within a minute: raise the speed or lower it"
                    }
                    false => "500 to 57000",
                },
            ),
            (
                "standstill_ms",
                self.standstill_ms.unwrap_or_default() as f64,
                (self.stops_within()..=LONGEST_STANDSTILL).contains(&self.standstill()),
                match is_slow {
                    true => "session_ttl_ms + 3000 / speed to 60000",
                    false => "session_ttl_ms + 3000 to 60000",
                },
            ),
            (
                "controllers.arm_stiffness",
                self.controllers.arm_stiffness,
                (2.0..=100.0).contains(&self.controllers.arm_stiffness),
                "2 to 100",
            ),
            (
                "controllers.base_stiffness",
                self.controllers.base_stiffness,
                (2.0..=100.0).contains(&self.controllers.base_stiffness),
                "2 to 100",
            ),
            (
                "controllers.arm_most_off_rad",
                self.controllers.arm_most_off_rad,
                (0.02..=1.0).contains(&self.controllers.arm_most_off_rad),
                "0.02 to 1",
            ),
            (
                "controllers.base_most_off",
                self.controllers.base_most_off,
                (0.03..=1.0).contains(&self.controllers.base_most_off),
                "0.03 to 1",
            ),
            (
                "gripper.opening_m",
                self.gripper.opening_m.unwrap_or_default(),
                self.gripper.opening_m.is_none_or(|metres| metres > 0.0 && metres.is_finite()),
                "above 0, and at most what the robot's gripper opens to",
            ),
            ("gripper.close_s", self.gripper.close_s, (0.0..=60.0).contains(&self.gripper.close_s), "0 to 60"),
            ("gripper.force_n", self.gripper.force_n, (0.1..=200.0).contains(&self.gripper.force_n), "0.1 to 200"),
            ("faults", self.faults.len() as f64, self.faults.len() <= MAX_FAULTS, "at most 64"),
            ("gripper.open_s", self.gripper.open_s, (0.0..=60.0).contains(&self.gripper.open_s), "0 to 60"),
            (
                "pan_tilt.speed",
                self.pan_tilt.speed,
                self.pan_tilt.speed > 0.0 && self.pan_tilt.speed <= 1.0,
                "above 0 and at most 1",
            ),
            ("pan_tilt.settle_s", self.pan_tilt.settle_s, (0.0..=60.0).contains(&self.pan_tilt.settle_s), "0 to 60"),
            (
                "camera.frames_per_s",
                self.camera.frames_per_s,
                (0.1..=1000.0).contains(&self.camera.frames_per_s),
                "0.1 to 1000",
            ),
            (
                "camera.intrinsics.width",
                self.camera.intrinsics.width as f64,
                (16..=1024).contains(&self.camera.intrinsics.width),
                "16 to 1024",
            ),
            (
                "camera.intrinsics.height",
                self.camera.intrinsics.height as f64,
                (16..=1024).contains(&self.camera.intrinsics.height),
                "16 to 1024",
            ),
            ("camera.intrinsics.fx", self.camera.intrinsics.fx, self.camera.intrinsics.fx > 0.0, "above 0"),
            ("camera.intrinsics.fy", self.camera.intrinsics.fy, self.camera.intrinsics.fy > 0.0, "above 0"),
            (
                "camera.noise.sigma_at_1m",
                self.camera.noise.sigma_at_1m,
                (0.0..0.1).contains(&self.camera.noise.sigma_at_1m),
                "0 to 0.1",
            ),
            (
                "camera.noise.projector_m",
                self.camera.noise.projector_m,
                (0.0..1.0).contains(&self.camera.noise.projector_m),
                "0 to 1",
            ),
            (
                "errors.encoder_rad",
                self.errors.encoder_rad,
                (0.0..=0.01).contains(&self.errors.encoder_rad),
                "0 to 0.01",
            ),
            (
                "errors.encoder_wave_rad",
                self.errors.encoder_wave_rad,
                (0.0..=0.01).contains(&self.errors.encoder_wave_rad),
                "0 to 0.01",
            ),
            ("errors.camera_m", self.errors.camera_m, (0.0..=0.05).contains(&self.errors.camera_m), "0 to 0.05"),
            ("errors.camera_rad", self.errors.camera_rad, (0.0..=0.05).contains(&self.errors.camera_rad), "0 to 0.05"),
            (
                "errors.localisation_m",
                self.errors.localisation_m,
                (0.0..=0.1).contains(&self.errors.localisation_m),
                "0 to 0.1",
            ),
            (
                "errors.localisation_rad",
                self.errors.localisation_rad,
                (0.0..=0.1).contains(&self.errors.localisation_rad),
                "0 to 0.1",
            ),
            ("battery.level", self.battery.level, (0.0..=1.0).contains(&self.battery.level), "0 to 1"),
            ("battery.idle_per_hour", self.battery.idle_per_hour, self.battery.idle_per_hour >= 0.0, "0 or more"),
            ("battery.motion_per_hour", self.battery.motion_per_hour, self.battery.motion_per_hour >= 0.0, "0 or more"),
            (
                "battery.driving_per_hour",
                self.battery.driving_per_hour,
                self.battery.driving_per_hour >= 0.0,
                "0 or more",
            ),
        ];
        match rules.into_iter().find(|(_, _, holds, _)| !holds) {
            Some((key, value, _, rule)) => Err(ConfigError { key, value: value.to_string(), rule }),
            None => Ok(()),
        }
    }
}

impl Default for CellConfig {
    fn default() -> CellConfig {
        CellConfig {
            listen: Endpoint::local(),
            resource_manager: None,
            host: "sim".to_owned(),
            robot: AIMM.to_owned(),
            scene: Setting::Boxes,
            boxes: 3,
            bowls: 2,
            forks: 2,
            cups: 0,
            plates: 0,
            seed: 1,
            speed: 1.0,
            session_ttl_ms: 3000,
            standstill_ms: None,
            state_dir: None,
            record: None,
            faults: Vec::new(),
            controllers: ControllersConfig::default(),
            gripper: GripperConfig::default(),
            pan_tilt: PanTiltConfig::default(),
            camera: CameraConfig::default(),
            battery: BatteryConfig::default(),
            errors: ErrorsConfig::default(),
        }
    }
}

impl Default for ControllersConfig {
    fn default() -> ControllersConfig {
        ControllersConfig { arm_stiffness: 60.0, arm_most_off_rad: 0.05, base_stiffness: 15.0, base_most_off: 0.05 }
    }
}

impl Default for GripperConfig {
    fn default() -> GripperConfig {
        GripperConfig { opening_m: None, close_s: 1.1, open_s: 0.8, force_n: 40.0 }
    }
}

impl Default for PanTiltConfig {
    fn default() -> PanTiltConfig {
        PanTiltConfig { speed: 0.15, settle_s: 0.5 }
    }
}

impl Default for CameraConfig {
    fn default() -> CameraConfig {
        CameraConfig { frames_per_s: 10.0, intrinsics: Intrinsics::DEFAULT, noise: Noise::DEFAULT }
    }
}

impl Default for ErrorsConfig {
    fn default() -> ErrorsConfig {
        ErrorsConfig::NONE
    }
}

impl Default for BatteryConfig {
    fn default() -> BatteryConfig {
        BatteryConfig { level: 1.0, idle_per_hour: 0.1, motion_per_hour: 0.4, driving_per_hour: 0.8 }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    #[test]
    fn an_empty_file_is_the_default_and_the_default_is_valid() {
        let config: CellConfig = toml::from_str("").unwrap();
        assert_eq!(config, CellConfig::default());
        config.check().unwrap();
    }

    #[test]
    fn a_cell_that_is_slowed_down_has_longer_to_come_to_rest() {
        let of = |text: &str| toml::from_str::<CellConfig>(text).unwrap().standstill().as_secs_f64();
        assert_eq!((of(""), of("speed = 50.0")), (6.0, 6.0));
        assert_eq!((of("speed = 0.25"), of("speed = 0.25\nsession_ttl_ms = 5000")), (15.0, 17.0));
        assert_eq!(of("speed = 0.25\nstandstill_ms = 16000"), 16.0);
    }

    #[test]
    fn the_next_holder_is_granted_the_arm_when_the_cell_has_stopped_by_itself_and_not_before() {
        let refused = |text: &str| toml::from_str::<CellConfig>(text).unwrap().check().err().map(|error| error.key);
        for (fits, short, key) in [
            ("session_ttl_ms = 57000", "session_ttl_ms = 57001", "session_ttl_ms"),
            ("speed = 0.5\nsession_ttl_ms = 54000", "speed = 0.5\nsession_ttl_ms = 57000", "session_ttl_ms"),
            ("speed = 0.06", "speed = 0.05", "session_ttl_ms"),
            ("standstill_ms = 6000", "standstill_ms = 5999", "standstill_ms"),
            ("speed = 0.25\nstandstill_ms = 15000", "speed = 0.25\nstandstill_ms = 7000", "standstill_ms"),
            ("standstill_ms = 60000", "standstill_ms = 60001", "standstill_ms"),
        ] {
            assert_eq!((refused(fits), refused(short)), (None, Some(key)), "{short}");
        }
        assert_eq!([refused("speed = nan"), refused("speed = -1.0")], [Some("speed"); 2]);
        assert_eq!(refused("session_ttl_ms = 9223372036854775807"), Some("session_ttl_ms"));
    }

    #[test]
    fn an_unknown_key_and_an_impossible_value_are_refused() {
        assert!(toml::from_str::<CellConfig>("boxs = 3").is_err());
        assert!(toml::from_str::<CellConfig>("[gripper]\nopen = 1").is_err());
        let text = "standstill_ms = 2999";
        let refused = toml::from_str::<CellConfig>(text).unwrap().check().unwrap_err().to_string();
        assert_eq!(refused, "`standstill_ms` of the cell is 2999: it must be session_ttl_ms + 3000 to 60000");
        let config: CellConfig = toml::from_str("boxes = 10").unwrap();
        assert_eq!(config.check().unwrap_err().to_string(), "`boxes` of the cell is 10: it must be 1 to 9");
    }
}
