//! Lists of states, and the targets of their outcomes.

use super::*;
use ratn_model::program::STOPPED;
use ratn_model::wait::TIMEOUT;

impl Maker {
    /// A list of states; also the names visible behind it, and the custom outcomes by which it is left.
    pub(super) fn list(
        &mut self,
        parent: StateId,
        path: &str,
        depth: u64,
        room: &Room,
        mut visible: Visible,
        in_loop: bool,
    ) -> (Vec<StateId>, Visible, Vec<String>) {
        let count = match (depth, room.is_preemptive) {
            (0, _) => 3 + self.dice.below(6),
            (_, true) => 1 + self.dice.below(3),
            _ => 1 + self.dice.below(4),
        };
        let mut children = Vec::new();
        for number in 0..count {
            if self.states.len() >= MAX_STATES && !children.is_empty() {
                break;
            }
            let id = self.state(parent, path, number, depth, room, &visible);
            children.push(id);
            let waits = self.at(id).is_pause();
            let writes = match &self.at(id).kind {
                StateKind::Action { .. } => !waits,
                StateKind::Sequence { outputs, .. } | StateKind::Concurrency { outputs, .. } => !outputs.is_empty(),
                _ => false,
            };
            if writes {
                visible.ports.push(id);
            }
        }
        let (outcomes, back) = self.transitions(&children);
        if in_loop || back {
            self.flow_back(&children);
        }
        (children, visible, outcomes)
    }

    /// Adds transitions to a list's states; returns the custom outcomes that leave the list, and whether a transition leads
    /// back.
    pub(super) fn transitions(&mut self, children: &[StateId]) -> (Vec<String>, bool) {
        let (mut leaving, mut back): (Vec<String>, bool) = (Vec::new(), false);
        for (place, id) in children.iter().enumerate() {
            let custom = self.at(*id).outcomes.clone();
            let all = [SUCCESS, ABORTED, PREEMPTED].map(str::to_owned).into_iter().chain(custom);
            for outcome in all {
                let target = if self.features.transitions { self.target(children, place, &outcome) } else { None };
                back |= matches!(&target, Some(Target::State(to)) if to <= id);
                let left = match &target {
                    Some(Target::State(_)) => None,
                    Some(Target::Outcome(name)) => Some(name.clone()),
                    None => Some(outcome.clone()),
                };
                if let Some(name) = left
                    && [FOUND, EMPTY, AGAIN, STOPPED, TIMEOUT].contains(&name.as_str())
                    && !leaving.contains(&name)
                {
                    leaving.push(name);
                }
                if let Some(target) = target {
                    self.at(*id).transitions.insert(outcome, target);
                }
            }
        }
        (leaving, back)
    }

    pub(super) fn target(&mut self, children: &[StateId], place: usize, outcome: &str) -> Option<Target> {
        let later = &children[place + 1..];
        let forward = |dice: &mut Dice| dice.one_of(later).map(|id| Target::State(*id));
        let leave = |name: &str| Some(Target::Outcome(name.to_owned()));
        let chance = self.dice.below(100);
        match outcome {
            SUCCESS => match chance {
                0..5 => forward(&mut self.dice),
                5..8 => leave(FOUND),
                8..10 => leave(SUCCESS),
                _ => None,
            },
            AGAIN => match chance {
                0..75 => self.dice.one_of(&children[..=place]).map(|id| Target::State(*id)),
                75..85 => forward(&mut self.dice),
                _ => None,
            },
            ABORTED | PREEMPTED => match chance {
                0..25 => forward(&mut self.dice),
                25..32 => leave(SUCCESS),
                32..36 => leave(EMPTY),
                _ => None,
            },
            _ => match chance {
                0..55 => forward(&mut self.dice),
                55..65 => leave(SUCCESS),
                65..70 => leave(FOUND),
                70..72 => leave(ABORTED),
                _ => None,
            },
        }
    }

    /// If a state may be visited again, an action may use what a later state wrote in the previous round.
    pub(super) fn flow_back(&mut self, children: &[StateId]) {
        if !self.features.variables || !self.dice.percent(40) {
            return;
        }
        let actions: Vec<StateId> = children
            .iter()
            .copied()
            .filter(|id| self.is_action(*id) && !self.states[id.0 as usize].is_pause())
            .collect();
        let [first, .., last] = actions.as_slice() else { return };
        self.at(*last).defaults.insert("x".to_owned(), Value::Int(1));
        if let StateKind::Action { inputs, .. } = &mut self.at(*first).kind {
            inputs.push(("before".to_owned(), Expr::Port { state: *last, port: "x".to_owned() }));
        }
    }

    pub(super) fn state(
        &mut self,
        parent: StateId,
        around: &str,
        number: u64,
        depth: u64,
        room: &Room,
        visible: &Visible,
    ) -> StateId {
        let name = format!("s{}_{number}", self.states.len());
        let path = if around.is_empty() { name.clone() } else { format!("{around}/{name}") };
        let id = self.push(name, path.clone(), Some(parent));
        if self.features.waits && !room.is_preemptive && self.dice.percent(14) {
            let kind = self.wait(id, room, visible);
            self.at(id).kind = kind;
            if depth < 3 && self.dice.percent(10) {
                self.guard(id, &path, depth, room, visible);
            }
            return id;
        }
        let composite = depth < 3 && self.dice.percent(38);
        let kinds = if room.is_preemptive { 1 } else { 9 };
        if composite && self.features.blind && !room.is_preemptive && self.dice.percent(40) {
            // Concurrent motions, one of which fails, are what these programs test.
            let kind = self.barrier(id, &path, depth, room, visible);
            self.at(id).kind = kind;
            return id;
        }
        if composite
            && self.features.patterns
            && !room.is_preemptive
            && self.dice.percent(30)
            && let Some(kind) = self.pattern(id, &path, room, visible)
        {
            self.at(id).kind = kind;
            return id;
        }
        let kind = match (composite, self.dice.below(kinds)) {
            (false, _) => self.action(id, room, visible),
            (true, 0 | 1) => self.hierarchy(id, &path, depth, room, visible),
            (true, 2 | 3) => self.for_each(id, &path, depth, room, visible),
            (true, 4) if self.features.whiles => self.repeat(id, &path, depth, room, visible),
            (true, 5) if self.features.regions => self.barrier(id, &path, depth, room, visible),
            (true, 6) if self.features.preemptive && room.is_alone => self.preemptive(id, &path, depth, room, visible),
            (true, _) => self.condition(id, &path, depth, room, visible),
        };
        self.at(id).kind = kind;
        if self.features.variables && self.dice.percent(65) {
            let list = Value::List(vec![Value::Int(0)].into());
            self.at(id).defaults = BTreeMap::from([("x".to_owned(), Value::Int(1)), ("list".to_owned(), list)]);
        }
        if self.features.speculation && self.dice.percent(10) {
            let marked = self.at(id).outcomes.first().cloned();
            self.at(id).annotations.exceptional.extend(marked);
        }
        if self.features.guards && depth < 3 && !room.is_preemptive && self.dice.percent(15) {
            self.guard(id, &path, depth, room, visible);
        }
        id
    }
}
