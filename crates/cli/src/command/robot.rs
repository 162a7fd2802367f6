//! `ratn robot check`: reads the description of a robot and says what it has, how far it reaches, and what of it collides.

use crate::arguments::{RobotArguments, RobotCommand};
use crate::failure::Failure;
use crate::output;
use ratn_motion::robot::Robot;
use ratn_motion::survey::survey;

/// Runs the command.
pub(crate) fn run(arguments: &RobotArguments) -> Result<(), Failure> {
    let RobotCommand::Check { robot } = &arguments.command;
    let robot = Robot::named_or_file(robot).map_err(|error| Failure::Refused(format!("ratn: {error}")))?;
    let survey = survey(&robot);
    output::result(survey.lines.join("\n"))?;
    if survey.faults.is_empty() {
        return Ok(());
    }
    Err(anyhow::anyhow!("{}: {}", robot.name(), survey.faults.join("; ")).into())
}
