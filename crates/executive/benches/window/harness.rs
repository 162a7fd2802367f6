//! An executive whose commands are answered by the bench.
//!
//! What is asked of the resource manager and the world pool is granted by the next events; goals end in program order. So the
//! window stays full: everything that can run does, and every end lets one instance retire and another be expanded.

use ratn_executive::executive::Executive;
use ratn_executive::protocol::{Command, Event, Learned, Mode};
use ratn_model::fact::FactKey;
use ratn_model::id::{FencingToken, InstanceId, LeaseId, ProjectionId, Revision};
use ratn_model::program::{Program, SUCCESS};
use ratn_model::resource::{Lease, LeasedResource};
use ratn_model::time::Timestamp;
use ratn_model::tolerance::Tolerance;
use ratn_model::value::Value;
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

/// One run of one program.
pub struct Harness {
    executive: Executive,
    asked: VecDeque<Asked>,
    running: VecDeque<(InstanceId, u32)>,
    now: u64,
    next_id: u64,
    /// Goals that have ended.
    pub finished: usize,
}

enum Asked {
    Resources(InstanceId),
    Projection(InstanceId, u32),
}

impl Harness {
    /// A window of a program, filled: everything that was asked for is granted.
    pub fn new(program: Program, world: Vec<(FactKey, Value)>) -> Harness {
        let mut harness = Harness {
            executive: Executive::new(Arc::new(program), Tolerance::EXACT),
            asked: VecDeque::new(),
            running: VecDeque::new(),
            now: 0,
            next_id: 0,
            finished: 0,
        };
        harness.handle(started(world));
        harness.grant_all();
        harness
    }

    /// So many events: what was asked for comes before the end of the next goal.
    pub fn run(&mut self, events: usize) {
        for _ in 0..events {
            let event = self.next_event();
            self.handle(event);
        }
    }

    /// Events until so many goals have ended.
    pub fn run_until(&mut self, finished: usize) {
        while self.finished < finished {
            self.run(1);
        }
    }

    /// Grants what was asked for; no goal ends.
    pub fn grant_all(&mut self) {
        while !self.asked.is_empty() {
            self.run(1);
        }
    }

    /// All goals end but the oldest, and those that begin then, too: a window of results that cannot retire.
    pub fn run_all_but_the_oldest(&mut self) {
        let oldest = self.running.pop_front().unwrap();
        while !(self.asked.is_empty() && self.running.is_empty()) {
            self.run(1);
        }
        self.running.push_front(oldest);
    }

    /// The oldest goal ends and says what it has measured.
    pub fn measure(&mut self, measured: Vec<(FactKey, Value)>) {
        let (instance, attempt) = self.running.pop_front().unwrap();
        let outputs = BTreeMap::new();
        self.handle(ended(instance, attempt, outputs, measured));
    }

    /// The executive's state.
    pub fn checkpoint(&self) -> Vec<u8> {
        self.executive.checkpoint()
    }

    /// Goes on with an executive that is made of a checkpoint.
    pub fn restore(&mut self, program: Program, bytes: &[u8]) {
        self.executive = Executive::restore(Arc::new(program), Tolerance::EXACT, bytes).unwrap();
    }

    /// How many goals are under way.
    pub fn under_way(&self) -> usize {
        self.running.len()
    }

    /// What the answers that are due take themselves.
    pub fn pending_bytes(&self) -> usize {
        self.running.capacity() * size_of::<(InstanceId, u32)>() + self.asked.capacity() * size_of::<Asked>()
    }

    /// Gives an event and takes the commands.
    pub fn handle(&mut self, event: Event) {
        self.now += 1_000_000;
        for command in self.executive.handle(Timestamp(self.now), event) {
            match command {
                Command::Acquire { instance, .. } => self.asked.push_back(Asked::Resources(instance)),
                Command::Project { instance, attempt, .. } => {
                    self.asked.push_back(Asked::Projection(instance, attempt));
                }
                Command::Start { instance, attempt, .. } => {
                    // A PIA begins after younger instances, and is older than what runs.
                    if self.running.front().is_some_and(|(oldest, _)| instance < *oldest) {
                        self.running.push_front((instance, attempt));
                    } else {
                        self.running.push_back((instance, attempt));
                    }
                }
                Command::Cancel { instance, .. } => self.running.retain(|(running, _)| *running != instance),
                Command::End { reason, .. } => panic!("the task has ended: {reason}"),
                _ => {}
            }
        }
    }

    fn next_event(&mut self) -> Event {
        self.next_id += 1;
        match self.asked.pop_front() {
            Some(Asked::Resources(instance)) => Event::Granted { instance, lease: lease(self.next_id) },
            Some(Asked::Projection(instance, attempt)) => {
                Event::Projected { instance, attempt, projection: ProjectionId(self.next_id) }
            }
            None => {
                let (instance, attempt) = self.running.pop_front().unwrap();
                self.finished += 1;
                success(instance, attempt)
            }
        }
    }
}

/// A goal has ended well, with one output.
pub fn success(instance: InstanceId, attempt: u32) -> Event {
    ended(instance, attempt, BTreeMap::from([("x".to_owned(), Value::Int(1))]), Vec::new())
}

/// A lease of one resource.
pub fn lease(id: u64) -> Lease {
    let (kind, endpoint, superclasses) = ("Brain".to_owned(), String::new(), Vec::new());
    let resources = vec![LeasedResource { id: "brain-1".to_owned(), kind, endpoint, superclasses }];
    Lease { id: LeaseId(id), token: FencingToken(id), resources, consumed: Vec::new() }
}

fn ended(
    instance: InstanceId,
    attempt: u32,
    outputs: BTreeMap<String, Value>,
    measured: Vec<(FactKey, Value)>,
) -> Event {
    Event::Finished {
        instance,
        attempt,
        outcome: SUCCESS.to_owned(),
        outputs,
        measured,
        evidence: Vec::new(),
        reason: String::new(),
        at_rest: true,
    }
}

/// The first event of a run.
pub fn started(world: Vec<(FactKey, Value)>) -> Event {
    Event::Started {
        task: "bench".to_owned(),
        digest: String::new(),
        mode: Mode::Cdtn,
        parameters: BTreeMap::new(),
        seed: 1,
        world,
        revision: Revision(0),
        capacity: BTreeMap::new(),
        learned: Learned::default(),
        breakpoints: Box::default(),
        origin: Default::default(),
    }
}
