//! The order in which the commands of one event are performed.
//!
//! ```text
//! in the order of the program   commits, operations, goals …
//! then                          acquires, the most urgent first: what is free goes to whom it serves most
//! then                          releases: the same for what becomes free
//! ```
//!
//! The resource manager grants as requests arrive; it cannot know what comes next. Where something is deleted or used up it is the other way
//! round: what is given back may be that, and nobody is granted what the program has removed before. There a release is performed
//!
//! - never before a commit of its own instance;
//! - before the removal that it follows, where nothing is committed in between;
//! - else before the removal that follows it, or before the acquires where none does.
//!
//! A goal is told to stop before what it was given is given back: a cancellation goes before the removal that it follows, too, where nothing is
//! committed in between.
//!
//! A commit stays behind the removals that it follows in the program: where one of these is refused, nothing behind it becomes real.

use crate::protocol::Command;
use ratn_model::id::InstanceId;
use ratn_model::resource::{Requirement, ResourceOperation};
use std::cmp::Reverse;
use std::collections::BTreeMap;

/// Where a command stands: its part, its place in the program, its turn among those that have the same one, and its priority.
type Place = (u8, usize, Turn, Reverse<i64>);

/// Before what has a place of its own, goals are told to stop, and then what they held is given back.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Turn {
    Stop,
    GiveBack,
    Own,
}

/// The commands of one event as they are performed. What one event both asked for and withdrew is not asked for.
pub(super) fn in_order(commands: Vec<Command>) -> Vec<Command> {
    let asks = |c: &Command| matches!(c, Command::Acquire { .. } | Command::Withdraw { .. } | Command::Release { .. });
    if !commands.iter().any(asks) {
        return commands;
    }
    let commands = without_withdrawn(commands);
    let removes = commands.iter().any(removes);
    let place = |(number, command): (usize, &Command)| match command {
        Command::Release { instance, .. } if removes => {
            (0, release(&commands, number, *instance), Turn::GiveBack, Reverse(0))
        }
        Command::Cancel { .. } if removes => match removal_before(&commands, number) {
            Some(removal) => (0, removal, Turn::Stop, Reverse(0)),
            None => (0, number, Turn::Own, Reverse(0)),
        },
        Command::Acquire { priority, .. } => (1, 0, Turn::Own, Reverse(*priority)),
        Command::Release { .. } => (2, 0, Turn::Own, Reverse(0)),
        Command::End { .. } => (3, 0, Turn::Own, Reverse(0)),
        _ => (0, number, Turn::Own, Reverse(0)),
    };
    let places: Vec<Place> = commands.iter().enumerate().map(place).collect();
    let mut ordered: Vec<(Place, Command)> = places.into_iter().zip(commands).collect();
    ordered.sort_by_key(|(place, _)| *place);
    ordered.into_iter().map(|(_, command)| command).collect()
}

/// The number of the command that a release goes before, beside removals.
fn release(commands: &[Command], number: usize, instance: InstanceId) -> usize {
    let is_own = |command: &Command| matches!(command, Command::Commit { instance: of, .. } if *of == instance);
    let own = commands.iter().rposition(is_own).filter(|own| *own > number);
    let behind = || {
        let from = own.unwrap_or(number);
        commands[from..].iter().position(removes).map_or(commands.len(), |removal| from + removal)
    };
    own.is_none().then(|| removal_before(commands, number)).flatten().unwrap_or_else(behind)
}

/// The first removal since the last commit before a command.
fn removal_before(commands: &[Command], number: usize) -> Option<usize> {
    let commits = |command: &Command| matches!(command, Command::Commit { .. });
    let since = commands[..number].iter().rposition(commits).map_or(0, |commit| commit + 1);
    commands[since..number].iter().position(removes).map(|removal| since + removal)
}

fn without_withdrawn(mut commands: Vec<Command>) -> Vec<Command> {
    let mut asked: BTreeMap<InstanceId, usize> = BTreeMap::new();
    let mut needed = vec![true; commands.len()];
    for (place, command) in commands.iter().enumerate() {
        match command {
            Command::Acquire { instance, .. } => drop(asked.insert(*instance, place)),
            Command::Withdraw { instance } => {
                if let Some(acquire) = asked.remove(instance) {
                    (needed[acquire], needed[place]) = (false, false);
                }
            }
            _ => {}
        }
    }
    let mut needed = needed.into_iter();
    commands.retain(|_| needed.next().unwrap_or(true));
    commands
}

fn removes(command: &Command) -> bool {
    removed(command).next().is_some()
}

/// What a command deletes or uses up.
pub(crate) fn removed(command: &Command) -> impl Iterator<Item = &Requirement> {
    let operations = match command {
        Command::Operate { operations, .. } => operations.as_slice(),
        _ => &[],
    };
    operations.iter().filter(|one| matches!(one.operation, ResourceOperation::Delete | ResourceOperation::Consume))
}

#[cfg(test)]
mod tests {
    use super::*;
    use ratn_model::id::{LeaseId, Revision};

    /// Commands by a letter and the number of an instance: `c` commits, `d` deletes, `n` creates, `r` gives back, `a` asks (the lower the number the
    /// more urgent), `w` withdraws, `x` stops a goal, `e` ends.
    fn command(said: &str) -> Command {
        let number = said[1..].parse().unwrap_or(0);
        let instance = InstanceId(number);
        let operates = |operation| Command::Operate { instance, operations: vec![Requirement::new(operation, "Box")] };
        match &said[..1] {
            "c" => Command::Commit {
                instance,
                writer: String::new(),
                changes: Vec::new(),
                evidence: Vec::new(),
                revision: Revision(1),
            },
            "d" => operates(ResourceOperation::Delete),
            "n" => operates(ResourceOperation::Create),
            "r" => Command::Release { instance, lease: Some(LeaseId(number)), projection: None },
            "a" => {
                Command::Acquire { instance, requirements: Vec::new(), priority: -i64::try_from(number).unwrap_or(0) }
            }
            "w" => Command::Withdraw { instance },
            "x" => Command::Cancel { instance, attempt: 1 },
            _ => Command::End { outcome: String::new(), outputs: BTreeMap::new(), reason: String::new() },
        }
    }

    fn said(command: &Command) -> String {
        match command {
            Command::Commit { instance, .. } => format!("c{}", instance.0),
            Command::Operate { instance, .. } if removes(command) => format!("d{}", instance.0),
            Command::Operate { instance, .. } => format!("n{}", instance.0),
            Command::Release { instance, .. } => format!("r{}", instance.0),
            Command::Acquire { instance, .. } => format!("a{}", instance.0),
            Command::Withdraw { instance } => format!("w{}", instance.0),
            Command::Cancel { instance, .. } => format!("x{}", instance.0),
            _ => "e".to_owned(),
        }
    }

    fn check(commands: &str, expected: &str) {
        let ordered = in_order(commands.split(' ').map(command).collect());
        assert_eq!(ordered.iter().map(said).collect::<Vec<_>>().join(" "), expected, "of {commands}");
    }

    #[test]
    fn what_is_asked_for_comes_by_its_urgency_and_what_is_given_back_behind_it() {
        check("r1 c1 a3 a2 n1 e", "c1 n1 a2 a3 r1 e");
        check("a2 a3 w2 r1", "a3 r1");
    }

    #[test]
    fn what_a_state_holds_goes_back_before_something_is_deleted_at_its_end_and_behind_its_effects() {
        // As the window says it, and as the interpreter does.
        check("r1 c1 d1 a2", "c1 r1 d1 a2");
        check("c1 d1 r1 a2", "c1 r1 d1 a2");
        check("c1 d1 d1 r1", "c1 r1 d1 d1");
    }

    #[test]
    fn the_effects_of_the_state_around_it_are_behind_a_removal() {
        check("r1 c1 d1 c0 a2", "c1 r1 d1 c0 a2");
        check("c1 d1 r1 c0 a2", "c1 r1 d1 c0 a2");
        check("c1 d1 r1 c0 d0 c5", "c1 r1 d1 c0 d0 c5");
    }

    #[test]
    fn a_goal_is_told_to_stop_before_what_it_holds_goes_back() {
        check("c1 d1 x2 r2", "c1 x2 r2 d1");
        check("c1 d1 r2 x2", "c1 x2 r2 d1");
        check("c1 d1 x2 c3 r2", "c1 x2 d1 c3 r2");
        check("x2 c1 d1 r2", "x2 c1 r2 d1");
        check("c1 x2 r2", "c1 x2 r2");
    }

    #[test]
    fn what_a_routine_holds_goes_back_behind_its_effects() {
        check("c1 d1 c2 r2 a3", "c1 d1 c2 r2 a3");
        check("c1 d1 r2 a3", "c1 r2 d1 a3");
    }

    #[test]
    fn nobody_gives_back_before_its_own_effects_though_something_is_deleted_between() {
        check("r2 c1 d1 c2", "c1 d1 c2 r2");
        check("r2 c1 d1 c2 d2", "c1 d1 c2 r2 d2");
    }
}
