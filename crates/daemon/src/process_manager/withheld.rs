//! Offers of workers that move something, held back while the roster cannot be written: a successor that does not know of a motion would
//! not wait for its end.

use super::pools::Command;
use std::collections::{BTreeMap, VecDeque};

#[derive(Debug, Default)]
pub(super) struct Withheld {
    /// By worker id.
    offers: BTreeMap<String, Command>,
}

impl Withheld {
    /// The commands to perform now, in order: the held-back ones first, where motions are `kept` for a successor.
    pub(super) fn pass(&mut self, commands: Vec<Command>, kept: bool) -> VecDeque<Command> {
        if kept {
            return std::mem::take(&mut self.offers).into_values().chain(commands).collect();
        }
        let mut passed = VecDeque::new();
        for command in commands {
            match command {
                Command::Offer { ref worker, standstill: Some(_), .. } => {
                    tracing::warn!(
                        id = worker.id,
                        "it moves something: it is offered once the list of workers is written"
                    );
                    self.offers.insert(worker.id.clone(), command);
                    continue;
                }
                Command::Withdraw { ref id } => drop(self.offers.remove(id)),
                _ => {}
            }
            passed.push_back(command);
        }
        passed
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ratn_proto::types::{WorkerState, WorkerStatus};
    use std::time::Duration;

    fn offer(id: &str, standstill: Option<Duration>) -> Command {
        let worker = WorkerStatus {
            id: id.to_owned(),
            template: "arm".to_owned(),
            state: WorkerState::Starting,
            pid: 42,
            endpoint: "unix:/w".to_owned(),
            reason: String::new(),
            resident_bytes: 0,
            cpu_millicores: 0,
            limits: String::new(),
            age_s: 0,
            held: false,
        };
        Command::Offer { worker, kind: "Arm".to_owned(), standstill }
    }

    #[test]
    fn what_moves_is_offered_once_a_successor_would_hear_of_it_unless_it_was_withdrawn_before() {
        let bound = Some(Duration::from_secs(6));
        let (moving, other, gone) = (offer("arm-1", bound), offer("planner-1", None), offer("arm-2", bound));
        let mut withheld = Withheld::default();
        assert_eq!(withheld.pass(vec![moving.clone(), other.clone(), gone], false), [other]);
        let withdraw = Command::Withdraw { id: "arm-2".to_owned() };
        assert_eq!(withheld.pass(vec![withdraw.clone()], false), [withdraw]);
        let check = Command::Check { id: "arm-1".to_owned(), within: Duration::from_secs(1) };
        assert_eq!(withheld.pass(vec![check.clone()], true), [moving, check]);
        assert!(withheld.pass(Vec::new(), true).is_empty());
    }
}
