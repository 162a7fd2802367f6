//! A robot as data: which of the joints and links of a URDF are its arm, gripper, base, head and camera (`robot.toml`).
//!
//! The built-in robots are read the same way. [`Robot::of`](crate::robot::Robot::of) checks the names against the URDF.

use crate::mechanism::MechanismError;
use crate::mesh::MeshError;
use crate::mesh_files::MeshFiles;
use crate::robot::{Robot, RobotError, RobotFault};
use crate::workplace::Workplace;
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use toml::Spanned;
use toml::de::{DeTable, DeValue};

/// The content of a `robot.toml`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RobotDescription {
    /// The robot's name in messages.
    pub name: String,
    /// The path of the URDF; relative to the folder of this file, as are all paths.
    pub urdf: PathBuf,
    /// The SRDF: which links are not checked against each other. Without it, these are computed from how links meet.
    #[serde(default)]
    pub srdf: Option<PathBuf>,
    /// The folders for `package://NAME/…`: they contain packages, or are one.
    #[serde(default)]
    pub packages: Vec<PathBuf>,
    /// The arm, or the first one.
    pub arm: ArmDescription,
    /// Further arms. The planner moves one of the arms at a time, and the others stand; a cell moves several at once.
    #[serde(default, rename = "other_arm")]
    pub other_arms: Vec<ArmDescription>,
    /// The gripper. A robot without one grasps nothing.
    #[serde(default)]
    pub gripper: Option<GripperDescription>,
    /// A base that drives. A robot without one stands where its URDF places it.
    #[serde(default)]
    pub base: Option<BaseDescription>,
    /// A pan-tilt unit that carries the camera. Without it the camera has the fixed direction of the URDF.
    #[serde(default)]
    pub head: Option<HeadDescription>,
    /// The camera.
    #[serde(default)]
    pub camera: Option<CameraDescription>,
    /// Postures of the arm by name, in radians (metres for a prismatic joint), in the order of its joints.
    #[serde(default)]
    pub postures: BTreeMap<String, Vec<f64>>,
    /// The table, the boxes and their places, for a cell.
    #[serde(default)]
    pub workplace: Option<Workplace>,
}

/// An arm.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ArmDescription {
    /// The arm's name in goals.
    #[serde(default = "arm")]
    pub name: String,
    /// Its joints, from the foot to the tool.
    pub joints: Vec<String>,
    /// The link whose frame is moved to goals: its z axis points in the approach direction of the gripper, y is the closing direction of the fingers.
    pub tool: String,
    /// Its gripper; the first arm's gripper is that of the robot.
    #[serde(default)]
    pub gripper: Option<GripperDescription>,
    /// Its postures; the first arm's postures are those of the robot. The arm stands in the posture `home` unless a goal says otherwise.
    #[serde(default)]
    pub postures: BTreeMap<String, Vec<f64>>,
}

fn arm() -> String {
    "arm".to_owned()
}

/// A gripper of two fingers that close towards the middle.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GripperDescription {
    /// The prismatic joint of one finger, 0 where the fingers meet: its position is half of the opening. The other finger's joint mimics it.
    pub joint: String,
    /// The link to which both fingers are attached.
    pub hand: String,
    /// The link of one finger, which gives the fingers' thickness.
    pub finger: String,
}

/// A base that drives on a floor.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BaseDescription {
    /// The joints of x, y and heading, in this order.
    pub joints: [String; 3],
    /// The link of its body: objects on top of it ride on the base.
    pub body: String,
    /// The area in which it may drive, within the limits of its joints. Without it only the limits count.
    #[serde(default)]
    pub area: Option<DriveArea>,
}

/// A rectangle on the floor, in the world frame, in metres.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DriveArea {
    /// Minimum and maximum x of the base.
    pub x: [f64; 2],
    /// Minimum and maximum y of the base.
    pub y: [f64; 2],
}

/// A pan-tilt unit.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HeadDescription {
    /// Pan, positive to the left, and tilt, positive downwards.
    pub joints: [String; 2],
}

/// A camera.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraDescription {
    /// The link that is its optical frame: z forward, x right, y down.
    pub link: String,
}

/// Why a file does not describe a robot.
#[derive(Debug, thiserror::Error)]
pub enum DescriptionError {
    /// A file cannot be read.
    #[error("{}: cannot be read: {reason}", file.display())]
    Read {
        /// The file.
        file: PathBuf,
        /// The system's error message.
        reason: String,
    },
    /// The file is not TOML of this form.
    #[error("{}: {reason}", file.display())]
    Form {
        /// The file.
        file: PathBuf,
        /// Line, column and the error.
        reason: String,
    },
    /// Names in the file do not fit the URDF.
    #[error("{}: {}{fault}", file.display(), line.map_or_else(String::new, |line| format!("line {line}: ")))]
    Fault {
        /// The file.
        file: PathBuf,
        /// The line of the wrong name, from 1.
        line: Option<usize>,
        /// The error.
        fault: Box<RobotFault>,
    },
}

impl DescriptionError {
    /// Whether a file, which may be a mesh, is missing or cannot be read; otherwise a file has wrong content.
    pub fn is_unreadable(&self) -> bool {
        match self {
            DescriptionError::Read { .. } => true,
            DescriptionError::Form { .. } => false,
            DescriptionError::Fault { fault, .. } => matches!(
                **fault,
                RobotFault::Model(MechanismError::Robot(RobotError::Mesh { error: MeshError::Read { .. }, .. }))
            ),
        }
    }
}

impl RobotDescription {
    /// Reads the text of a `robot.toml`.
    ///
    /// # Errors
    /// Line, column and the error.
    pub fn read(text: &str) -> Result<RobotDescription, String> {
        let read: RobotDescription = toml::from_str(text).map_err(|error| error.to_string().trim_end().to_owned())?;
        if read.arm.gripper.is_some() || !read.arm.postures.is_empty() {
            return Err("the gripper and the postures of the first arm are `[gripper]` and `[postures]` of the robot"
                .to_owned());
        }
        Ok(read)
    }
}

impl Robot {
    /// The built-in robot of this name, or the one that a `robot.toml` describes.
    ///
    /// # Errors
    /// [`DescriptionError`] names the file and the error.
    pub fn named_or_file(robot: &str) -> Result<Robot, DescriptionError> {
        match Robot::built_in(robot) {
            Some(robot) => Ok(robot),
            None => Robot::from_file(Path::new(robot)),
        }
    }

    /// The robot that a `robot.toml` describes, with its URDF, SRDF and meshes.
    ///
    /// # Errors
    /// [`DescriptionError`] names the file and the error.
    pub fn from_file(file: &Path) -> Result<Robot, DescriptionError> {
        let Files { text, description, urdf_file, urdf, srdf_file, meshes } = Files::read(file)?;
        let srdf = srdf_file.as_deref().map(read_text).transpose()?;
        let fault = |fault| {
            // Names the file to which the error's line belongs.
            let file = match &fault {
                RobotFault::Model(MechanismError::Robot(RobotError::Fault(_) | RobotError::Urdf(_))) => &urdf_file,
                RobotFault::Model(MechanismError::Srdf(_)) => srdf_file.as_deref().unwrap_or(file),
                _ => file,
            };
            let line = fault.named().and_then(|name| line_of(&text, name));
            DescriptionError::Fault { file: file.to_owned(), line, fault: Box::new(fault) }
        };
        Robot::of(description, &urdf, srdf.as_deref(), &mut |name| meshes.read(name)).map_err(fault)
    }
}

/// The content of a `robot.toml`, and the files that it names.
pub(crate) struct Files {
    text: String,
    description: RobotDescription,
    urdf_file: PathBuf,
    /// The text of the URDF.
    pub(crate) urdf: String,
    srdf_file: Option<PathBuf>,
    /// Where to find the meshes of the URDF.
    pub(crate) meshes: MeshFiles,
}

impl Files {
    /// Reads the description and the URDF.
    pub(crate) fn read(file: &Path) -> Result<Files, DescriptionError> {
        let text = read_text(file)?;
        let description =
            RobotDescription::read(&text).map_err(|reason| DescriptionError::Form { file: file.to_owned(), reason })?;
        let folder = file.parent().unwrap_or(Path::new("."));
        let urdf_file = folder.join(&description.urdf);
        let urdf = read_text(&urdf_file)?;
        let srdf_file = description.srdf.as_ref().map(|srdf| folder.join(srdf));
        let packages = description.packages.iter().map(|package| folder.join(package)).collect();
        let meshes = MeshFiles { beside: urdf_file.parent().unwrap_or(folder).to_owned(), packages };
        Ok(Files { text, description, urdf_file, urdf, srdf_file, meshes })
    }
}

/// The line of a `robot.toml` with this text as a value, from 1; the first one if there are several.
fn line_of(text: &str, name: &str) -> Option<usize> {
    let read = DeTable::parse(text).ok()?;
    let mut first: Option<usize> = None;
    let mut left: Vec<&Spanned<DeValue<'_>>> = read.get_ref().values().collect();
    while let Some(value) = left.pop() {
        match value.get_ref() {
            DeValue::String(said) if said == name => {
                let begins = value.span().start;
                first = Some(first.map_or(begins, |first| first.min(begins)));
            }
            DeValue::Array(values) => left.extend(values.iter()),
            DeValue::Table(values) => left.extend(values.values()),
            _ => {}
        }
    }
    let before = text.get(..first?)?;
    Some(1 + before.matches('\n').count())
}

fn read_text(file: &Path) -> Result<String, DescriptionError> {
    ratn_regular_file::read_text(file, ratn_regular_file::USUAL)
        .map_err(|error| DescriptionError::Read { file: file.to_owned(), reason: error.to_string() })
}
