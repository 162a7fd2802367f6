//! The order in which the commands of one event are performed.
//!
//! ```text
//! in the order of the program   commits, operations, goals …
//! then                          acquires, the most urgent first: free resources go to the instance that needs them most
//! then                          releases: likewise for what they free
//! ```
//!
//! The resource manager grants as requests arrive; it cannot know what comes next. If something is deleted or consumed, the order is reversed: a
//! release may give back that very resource, and nobody may be granted what the program has removed before. A release is then performed
//!
//! - never before a commit of its own instance;
//! - before the removal that precedes it, if there is no commit in between;
//! - else before the next removal, or, if there is none, before the acquires.
//!
//! A goal is cancelled before its resources are given back. So a cancellation, too, goes before the removal that precedes it, if there is no commit
//! in between.
//!
//! A commit stays behind the removals that precede it in the program: if one of these is refused, nothing behind it becomes real.

use crate::protocol::Command;
use ratn_model::id::InstanceId;
use ratn_model::resource::{Requirement, ResourceOperation};
use std::cmp::Reverse;
use std::collections::BTreeMap;

/// The place of a command: its part, its position in the program, its turn among commands with the same position, and its priority.
type Place = (u8, usize, Turn, Reverse<i64>);

/// Order of commands moved to another command's place: cancellations, then releases, then that command.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Turn {
    Stop,
    GiveBack,
    Own,
}

/// The commands of one event in the order in which they are performed. An acquire that the same event also withdraws is dropped.
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

/// Number of the command before which a release goes, if the event has removals.
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

/// The resources that a command deletes or consumes.
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

    /// Builds a command from a letter and the number of an instance: `c` commits, `d` deletes, `n` creates, `r` releases, `a` acquires (a lower
    /// number is more urgent), `w` withdraws, `x` cancels a goal, `e` ends.
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
        // In the order of the window, and in that of the interpreter.
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
