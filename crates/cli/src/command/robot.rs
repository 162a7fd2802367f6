//! `ratn robot check`: reads the description of a robot and reports its parts, its reach, its collisions, and what the simulated
//! cell needs in addition.

use crate::arguments::{RobotArguments, RobotCommand};
use crate::failure::Failure;
use crate::output;
use ratn_cell::config::Setting;
use ratn_cell::core::demands;
use ratn_motion::robot::Robot;
use ratn_motion::survey::{Survey, survey};

/// Runs the command.
pub(crate) fn run(arguments: &RobotArguments) -> Result<(), Failure> {
    let RobotCommand::Check { robot } = &arguments.command;
    let robot = Robot::named_or_file(robot).map_err(|error| match error.is_unreadable() {
        true => Failure::Refused(format!("ratn: {error}")),
        false => Failure::Failed(error.into()),
    })?;
    let Survey { mut lines, mut faults } = survey(&robot);
    let unmet = unmet(&robot);
    if robot.workplace().is_some() {
        lines.push(format!("cell      {}", if unmet.is_empty() { "it can stand there" } else { "CANNOT STAND THERE" }));
    }
    output::result(lines.join("\n"))?;
    faults.extend(unmet.into_iter().map(|unmet| format!("for the cell: {unmet}")));
    if faults.is_empty() {
        return Ok(());
    }
    Err(anyhow::anyhow!("{}", listed(robot.name(), &faults)).into())
}

/// All faults: one per line where there are several.
fn listed(robot: &str, faults: &[String]) -> String {
    match faults {
        [fault] => format!("{robot}: {fault}"),
        _ => format!("{robot}: {} faults:\n- {}", faults.len(), faults.join("\n- ")),
    }
}

/// What a cell would refuse in the scenes for which the robot has a workplace. A robot without a workplace is only for planning.
fn unmet(robot: &Robot) -> Vec<String> {
    let Some(workplace) = robot.workplace() else { return Vec::new() };
    let table = workplace.tableware.as_ref().map(|_| Setting::Table);
    let mut unmet: Vec<String> = Vec::new();
    for setting in [Setting::Boxes].into_iter().chain(table) {
        for demand in demands::unmet(robot, setting) {
            let said = demand.to_string();
            if !unmet.contains(&said) {
                unmet.push(said);
            }
        }
    }
    unmet
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
        // A mesh is a separate file.
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

    #[test]
    fn each_fault_of_several_has_its_line() {
        let faults = ["it stands".to_owned(), "it falls".to_owned()];
        assert_eq!(listed("r", &faults[..1]), "r: it stands");
        assert_eq!(listed("r", &faults), "r: 2 faults:\n- it stands\n- it falls");
    }

    #[test]
    fn a_line_is_said_of_the_file_that_has_it() {
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
        let refusal =
            || Robot::from_file(&folder.path().join("robot.toml")).map(drop).map_err(|error| error.to_string());
        let urdf = |radius: &str| {
            format!(
                "<robot name='r'><link name='foot'>\n<collision><geometry><sphere radius='{radius}'/></geometry></collision></link>\
                 <link name='tool'/><joint name='turn' type='revolute'><parent link='foot'/><child link='tool'/><axis xyz='0 0 1'/>\
                 <limit lower='-1' upper='1' velocity='1' effort='1'/></joint></robot>"
            )
        };
        write("robot.toml", "name = 'r'\nurdf = 'r.urdf'\nsrdf = 'r.srdf'\n[arm]\njoints = ['turn']\ntool = 'tool'\n");
        write("r.srdf", "<robot name='r'/>");
        write("r.urdf", &urdf("-1"));
        let said = refusal().unwrap_err();
        assert!(said.contains("r.urdf: ") && said.contains("line 2") && said.contains("`foot`"), "{said}");
        write("r.urdf", &urdf("1"));
        assert_eq!(refusal(), Ok(()));
        write("r.srdf", "<robot");
        let said = refusal().unwrap_err();
        assert!(said.contains("r.srdf: "), "{said}");
    }
}
