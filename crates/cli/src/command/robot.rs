//! `ratn robot check`: reads the description of a robot and says what it has, how far it reaches, and what of it collides.

use crate::arguments::{RobotArguments, RobotCommand};
use crate::failure::Failure;
use crate::output;
use ratn_motion::robot::Robot;
use ratn_motion::survey::survey;

/// Runs the command.
pub(crate) fn run(arguments: &RobotArguments) -> Result<(), Failure> {
    let RobotCommand::Check { robot } = &arguments.command;
    let robot = Robot::named_or_file(robot).map_err(|error| match error.is_unreadable() {
        true => Failure::Refused(format!("ratn: {error}")),
        false => Failure::Failed(error.into()),
    })?;
    let survey = survey(&robot);
    output::result(survey.lines.join("\n"))?;
    if survey.faults.is_empty() {
        return Ok(());
    }
    Err(anyhow::anyhow!("{}: {}", robot.name(), survey.faults.join("; ")).into())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    #[test]
    fn a_wrong_description_fails_and_one_that_cannot_be_read_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("robot.toml");
        let check = || run(&RobotArguments { command: RobotCommand::Check { robot: file.display().to_string() } });
        assert!(matches!(check(), Err(Failure::Refused(_))));
        std::fs::write(&file, "name = 3").unwrap();
        assert!(matches!(check(), Err(Failure::Failed(_))));
        // A mesh is a file, too.
        let shape = |geometry: &str| {
            format!(
                "<robot name='r'><link name='foot'><collision><geometry>{geometry}</geometry></collision></link><link name='tool'/>\
                 <joint name='turn' type='revolute'><parent link='foot'/><child link='tool'/><axis xyz='0 0 1'/>\
                 <limit lower='-1' upper='1' velocity='1' effort='1'/></joint></robot>"
            )
        };
        std::fs::write(&file, "name = 'r'\nurdf = 'r.urdf'\n[arm]\njoints = ['turn']\ntool = 'tool'\n").unwrap();
        std::fs::write(folder.path().join("r.urdf"), shape("<mesh filename='foot.stl'/>")).unwrap();
        assert!(matches!(check(), Err(Failure::Refused(_))), "{:?}", check());
        std::fs::write(folder.path().join("foot.stl"), "solid foot\nendsolid foot\n").unwrap();
        assert!(matches!(check(), Err(Failure::Failed(_))), "{:?}", check());
        std::fs::write(folder.path().join("r.urdf"), shape("<box size='0.1 0.1 0.1'/>")).unwrap();
        assert!(check().is_ok());
    }
}
