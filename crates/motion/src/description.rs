//! A robot as data: which of the joints and links of a URDF are its arm, gripper, base, head and camera (`robot.toml`).
//!
//! The built-in robots are read the same way. [`Robot::of`](crate::robot::Robot::of) holds the names against the URDF.

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

/// What a `robot.toml` says.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RobotDescription {
    /// What messages call it.
    pub name: String,
    /// The URDF; seen from the folder of the file that names it, as are all paths.
    pub urdf: PathBuf,
    /// The SRDF: which links are not checked against each other. Without it, that is found out from how links meet.
    #[serde(default)]
    pub srdf: Option<PathBuf>,
    /// Where `package://NAME/…` leads: folders that hold packages, or are one.
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
    /// A base that drives. A robot without one stands where its URDF puts it.
    #[serde(default)]
    pub base: Option<BaseDescription>,
    /// A pan-tilt unit that carries the camera. Without it the camera looks where the URDF has it.
    #[serde(default)]
    pub head: Option<HeadDescription>,
    /// The camera.
    #[serde(default)]
    pub camera: Option<CameraDescription>,
    /// Postures of the arm by name, in radians (metres for a joint that slides), in the order of its joints.
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
    /// What goals call it.
    #[serde(default = "arm")]
    pub name: String,
    /// Its joints, from the foot to the tool.
    pub joints: Vec<String>,
    /// The link whose frame is brought to goals: z points the way the gripper reaches, y along which the fingers close.
    pub tool: String,
    /// Its gripper; that of the first arm is the robot's.
    #[serde(default)]
    pub gripper: Option<GripperDescription>,
    /// Its postures, as those of the first arm are the robot's; in the one called `home` it stands unless a goal says where.
    #[serde(default)]
    pub postures: BTreeMap<String, Vec<f64>>,
}

fn arm() -> String {
    "arm".to_owned()
}

/// A gripper of two fingers that close on the middle.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GripperDescription {
    /// The joint that slides one finger, from 0 where they meet: its position is half of the opening. The other finger's joint mimics it.
    pub joint: String,
    /// The link that both fingers hang on.
    pub hand: String,
    /// The link of one finger, of which the thickness is taken.
    pub finger: String,
}

/// A base that drives on a floor.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BaseDescription {
    /// Its x, its y and its heading, in this order.
    pub joints: [String; 3],
    /// The link of its body: what stands on top of it rides along.
    pub body: String,
    /// Where it may drive, as far as the limits of its joints allow. Without it these alone count.
    #[serde(default)]
    pub area: Option<DriveArea>,
}

/// A rectangle on the floor, in the world frame, in metres.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DriveArea {
    /// Least and greatest x of the base.
    pub x: [f64; 2],
    /// Least and greatest y.
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

/// Why a file describes no robot.
#[derive(Debug, thiserror::Error)]
pub enum DescriptionError {
    /// A file cannot be read.
    #[error("{}: cannot be read: {reason}", file.display())]
    Read {
        /// The file.
        file: PathBuf,
        /// What the system says.
        reason: String,
    },
    /// It is not TOML of this form.
    #[error("{}: {reason}", file.display())]
    Form {
        /// The file.
        file: PathBuf,
        /// Line, column and what does not fit.
        reason: String,
    },
    /// Its names do not fit the URDF.
    #[error("{}: {}{fault}", file.display(), line.map_or_else(String::new, |line| format!("line {line}: ")))]
    Fault {
        /// The file.
        file: PathBuf,
        /// Where it names what does not fit, from 1.
        line: Option<usize>,
        /// What does not fit.
        fault: Box<RobotFault>,
    },
}

impl DescriptionError {
    /// Whether a file is missing or cannot be read, a mesh included; else a file says something wrong.
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
    /// Line, column and what does not fit.
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
    /// [`DescriptionError`] names the file and what does not fit.
    pub fn named_or_file(robot: &str) -> Result<Robot, DescriptionError> {
        match Robot::built_in(robot) {
            Some(robot) => Ok(robot),
            None => Robot::from_file(Path::new(robot)),
        }
    }

    /// The robot that a `robot.toml` describes, with its URDF, SRDF and meshes.
    ///
    /// # Errors
    /// [`DescriptionError`] names the file and what does not fit.
    pub fn from_file(file: &Path) -> Result<Robot, DescriptionError> {
        let Files { text, description, urdf_file, urdf, srdf_file, meshes } = Files::read(file)?;
        let srdf = srdf_file.as_deref().map(read_text).transpose()?;
        let fault = |fault| {
            // A line is one of the file that has it.
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

/// What a `robot.toml` says, and the files that it names.
pub(crate) struct Files {
    text: String,
    description: RobotDescription,
    urdf_file: PathBuf,
    /// The text of the URDF.
    pub(crate) urdf: String,
    srdf_file: Option<PathBuf>,
    /// Where the meshes are that the URDF names.
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

/// The line of a `robot.toml` in which a value is this text, from 1; the first one of several.
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
