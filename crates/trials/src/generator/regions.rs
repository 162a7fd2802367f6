//! Concurrencies: barriers, whose regions do not conflict, and races.

use super::*;

impl Maker {
    /// Two or three regions, each with its own facts, actuators and variables.
    pub(super) fn barrier(&mut self, id: StateId, path: &str, depth: u64, room: &Room, visible: &Visible) -> StateKind {
        let count = 2 + self.dice.below(2) as usize;
        let shares = self.features.weak && self.dice.percent(50);
        let mut rooms = self.rooms(count, room, shares);
        if room.tolerant {
            let owner = self.dice.below(count as u64) as usize;
            rooms.iter_mut().enumerate().for_each(|(number, region)| region.tolerant = number == owner);
        }
        for actuator in &room.actuators {
            let owner = self.dice.below(count as u64) as usize;
            rooms[owner].actuators.push(actuator);
        }
        let mut variables: Vec<(Vec<String>, Vec<String>)> = vec![Default::default(); count];
        for name in &visible.variables {
            let owner = self.dice.below(count as u64) as usize;
            let assignable = visible.assignable.contains(name);
            for (number, (seen, assigned)) in variables.iter_mut().enumerate() {
                if !assignable || number == owner {
                    seen.push(name.clone());
                }
                if assignable && number == owner {
                    assigned.push(name.clone());
                }
            }
        }
        let mut regions = Vec::new();
        for (number, (room, (variables, assignable))) in rooms.iter().zip(variables).enumerate() {
            let inner = Visible { variables, assignable, ..visible.clone() };
            regions.push(self.region(id, path, number, depth, room, &inner));
        }
        self.concurrency(id, regions, false, room, visible)
    }

    /// Rooms of concurrent regions: no region reads what another one may write, unless they share it.
    fn rooms(&mut self, count: usize, room: &Room, shares: bool) -> Vec<Room> {
        let mut rooms =
            vec![Room { is_alone: false, writable: Vec::new(), actuators: Vec::new(), ..room.clone() }; count];
        for region in &mut rooms {
            region.readable.retain(|predicate| shares || !room.writable.contains(predicate));
        }
        for predicate in &room.writable {
            let owner = self.dice.below(count as u64 + 1) as usize;
            for (number, region) in rooms.iter_mut().enumerate() {
                // A predicate without owner may be read by all.
                if (number == owner || owner == count) && !region.readable.contains(predicate) {
                    region.readable.push(*predicate);
                }
                if number == owner || shares {
                    region.writable.push(*predicate);
                }
            }
        }
        rooms
    }

    /// Two regions of a few actions.
    pub(super) fn preemptive(
        &mut self,
        id: StateId,
        path: &str,
        depth: u64,
        room: &Room,
        visible: &Visible,
    ) -> StateKind {
        let actuators = [vec!["Arm", "Base"], vec!["Head"]];
        let mut regions = Vec::new();
        let rooms = match self.features.ways_out {
            // Cases on which the reference has a verdict.
            true => self.rooms(actuators.len(), room, false),
            false => vec![room.clone(); actuators.len()],
        };
        for (number, (actuators, room)) in actuators.into_iter().zip(rooms).enumerate() {
            let room = Room { actuators, is_preemptive: true, tolerant: false, ..room };
            let inner = Visible { assignable: Vec::new(), ..visible.clone() };
            regions.push(self.region(id, path, number, depth.max(2), &room, &inner));
        }
        self.concurrency(id, regions, true, room, visible)
    }

    pub(super) fn region(
        &mut self,
        parent: StateId,
        around: &str,
        number: usize,
        depth: u64,
        room: &Room,
        visible: &Visible,
    ) -> StateId {
        let name = format!("r{}_{number}", self.states.len());
        let path = format!("{around}/{name}");
        let id = self.push(name, path.clone(), Some(parent));
        let kind = if self.dice.percent(25) {
            self.action(id, room, visible)
        } else {
            self.hierarchy(id, &path, depth, room, visible)
        };
        self.at(id).kind = kind;
        self.at(id).annotations.routine &= !room.is_preemptive;
        id
    }

    pub(super) fn concurrency(
        &mut self,
        id: StateId,
        regions: Vec<StateId>,
        preemptive: bool,
        room: &Room,
        visible: &Visible,
    ) -> StateKind {
        let ended = |region: StateId, by: &str| {
            let outcome = Expr::Port { state: region, port: "outcome".to_owned() };
            Expr::Binary(
                BinaryOperator::Equal,
                Box::new(outcome),
                Box::new(Expr::Literal(Value::String(by.to_owned()))),
            )
        };
        let (first, last) = (regions[0], regions[regions.len() - 1]);
        let successes = (preemptive && self.features.watched && self.dice.percent(50))
            .then(|| 1 + self.dice.below(regions.len() as u64) as u32);
        let mut decide = Vec::new();
        if self.dice.percent(50) {
            decide.push((FOUND.to_owned(), ended(first, FOUND)));
            decide.push((EMPTY.to_owned(), ended(last, ABORTED)));
            if self.dice.percent(50) {
                decide.push((SUCCESS.to_owned(), ended(first, SUCCESS)));
            }
        }
        let from = self.dice.one_of(&regions).copied().unwrap_or(first);
        let writes = match &self.at(from).kind {
            StateKind::Action { .. } => true,
            StateKind::Sequence { outputs, .. } => !outputs.is_empty(),
            _ => false,
        };
        let value = match self.dice.below(3) {
            0 => {
                let one = Expr::Literal(Value::Int(1));
                Some(Expr::Call(Function::If, vec![ended(from, SUCCESS), one, Expr::Literal(Value::Int(2))]))
            }
            1 if writes => Some(Expr::Port { state: from, port: "x".to_owned() }),
            _ => None,
        };
        let outputs: Vec<TaskOutput> =
            value.map(|value| TaskOutput { name: "x".to_owned(), ty: Type::Any, value }).into_iter().collect();
        let mut outcomes: Vec<String> =
            decide.iter().map(|(name, _)| name.clone()).filter(|name| name != SUCCESS).collect();
        if preemptive && successes.is_none() && decide.is_empty() {
            outcomes = regions.iter().flat_map(|id| self.states[id.0 as usize].outcomes.clone()).collect();
            outcomes.sort();
            outcomes.dedup();
        }
        let assign = self.assignments(visible, !outputs.is_empty());
        let annotations = self.boundary(room, visible);
        let state = self.at(id);
        state.outcomes = outcomes;
        state.assign = assign;
        state.annotations = annotations;
        StateKind::Concurrency { regions, preemptive, successes, decide, outputs }
    }
}
