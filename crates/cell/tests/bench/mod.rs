//! A cell in virtual time, for tests.

#![allow(dead_code, reason = "not every test uses all of it")]

use ratn_cell::config::CellConfig;
use ratn_cell::core::cell::Cell;
use ratn_cell::core::protocol::{Command, Ending, Event, Product, Request, Ticket};
use ratn_cell::core::recording::Line;
use ratn_model::pose::Pose;
use ratn_model::time::Timestamp;
use ratn_model::value::Trajectory;
use ratn_motion::aimm;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::pace::Control;
use ratn_motion::plan::{Goal, Request as PlanRequest, plan};
use ratn_motion::straight::Straight;
use ratn_world::scene::Scene;
use std::time::Duration;

/// A cell with a clock that only goes on when nothing else is left to do.
pub(crate) struct Bench {
    pub(crate) cell: Cell,
    pub(crate) now: Timestamp,
    tickets: u64,
    /// How often it is told the time besides.
    pub(crate) tick: Option<Duration>,
    /// What happened.
    pub(crate) lines: Vec<Line>,
    /// Why fingers hold nothing of what they closed around.
    pub(crate) noted: Vec<String>,
}

impl Bench {
    pub(crate) fn new(boxes: usize, seed: u64) -> Bench {
        Bench::of(CellConfig { boxes, seed, ..CellConfig::default() })
    }

    pub(crate) fn of(config: CellConfig) -> Bench {
        let cell = Cell::new(config).unwrap();
        Bench { cell, now: Timestamp::default(), tickets: 0, tick: None, lines: Vec::new(), noted: Vec::new() }
    }

    pub(crate) fn start(&mut self, request: Request) -> (Ticket, Vec<Command>) {
        self.start_with(0, request)
    }

    /// Starts a goal of the arm of this number.
    pub(crate) fn start_with(&mut self, arm: usize, request: Request) -> (Ticket, Vec<Command>) {
        self.tickets += 1;
        let ticket = Ticket(self.tickets);
        (ticket, self.handle(Event::Start { ticket, arm, request }))
    }

    /// Something else happens.
    pub(crate) fn event(&mut self, event: Event) -> Vec<Command> {
        self.handle(event)
    }

    pub(crate) fn pass(&mut self, seconds: f64) -> Vec<Command> {
        self.now = self.now + Duration::from_secs_f64(seconds);
        self.handle(Event::Tick)
    }

    fn handle(&mut self, event: Event) -> Vec<Command> {
        let mut commands = self.cell.handle(self.now, event.clone());
        self.lines.extend(Line::of_step(self.now, event, &commands, &self.cell));
        // They stay with the cell.
        self.noted.extend(commands.iter().filter_map(|command| match command {
            Command::Noted { what } => Some(what.clone()),
            _ => None,
        }));
        commands.retain(|command| !matches!(command, Command::Touched { .. } | Command::Noted { .. }));
        commands
    }

    /// Performs a request to its end.
    pub(crate) fn perform(&mut self, request: Request) -> Ending {
        self.perform_with(0, request)
    }

    /// Performs a request of the arm of this number to its end.
    pub(crate) fn perform_with(&mut self, arm: usize, request: Request) -> Ending {
        let (ticket, mut commands) = self.start_with(arm, request);
        while commands.is_empty() {
            let wakes = self.cell.next_wake().expect("the goal is under way");
            self.now = self.tick.map_or(wakes, |tick| wakes.min(self.now + tick));
            commands = self.handle(Event::Tick);
        }
        let [Command::Ended { ticket: ended, ending, .. }] = &commands[..] else { panic!("{commands:?}") };
        assert_eq!(*ended, ticket);
        ending.clone()
    }

    pub(crate) fn done(&mut self, request: Request) -> Product {
        match self.perform(request) {
            Ending::Done(product) => product,
            other => panic!("{other:?}"),
        }
    }

    /// Where the robot has its joints.
    pub(crate) fn arm(&self) -> JointVector {
        self.cell.measured().arm
    }

    pub(crate) fn plan(&self, scene: &Scene, goals: Vec<Goal>, depart_m: f64, approach_m: f64) -> Trajectory {
        self.try_plan(scene, goals, depart_m, approach_m).unwrap()
    }

    /// From where the robot has its joints.
    pub(crate) fn try_plan(
        &self,
        scene: &Scene,
        goals: Vec<Goal>,
        depart_m: f64,
        approach_m: f64,
    ) -> Result<Trajectory, String> {
        let request = PlanRequest {
            depart: Straight::up(depart_m),
            approach: Straight::down(approach_m),
            speed: 0.5,
            seed: 3,
            improvement_iterations: 50,
            ..PlanRequest::new(self.cell.measured(), goals)
        };
        let planned = plan(self.cell.robot(), scene, &request, &mut |_| Control::Continue);
        planned.map(|planned| planned.trajectory).map_err(|error| error.to_string())
    }

    /// Moves the arm by a plan in the true scene.
    pub(crate) fn go(&mut self, goals: Vec<Goal>, depart_m: f64, approach_m: f64) {
        let trajectory = self.plan(&self.cell.scene(), goals, depart_m, approach_m);
        self.done(Request::Follow { trajectory });
    }

    /// The same, as if an object were not there: nothing that the fingers meet of it is looked at.
    pub(crate) fn go_regardless_of(&mut self, object: &str, goals: Vec<Goal>, depart_m: f64, approach_m: f64) {
        let mut scene = self.cell.scene();
        scene.objects.retain(|there| there.name != object);
        let trajectory = self.plan(&scene, goals, depart_m, approach_m);
        self.done(Request::Follow { trajectory });
    }

    /// Moves the arm by a plan in what is believed to stand there.
    pub(crate) fn go_believing(&mut self, scene: &Scene, goal: Goal) {
        let trajectory = self.plan(scene, vec![goal], 0.0, 0.0);
        self.done(Request::Follow { trajectory });
    }

    /// Stands with the fingers around the box.
    pub(crate) fn reach_for(&mut self, index: usize) {
        let truth = self.cell.ground_truth()[index].clone();
        let goals = aimm::grasp_poses(&truth.pose, truth.size).map(Goal::Pose).to_vec();
        self.go(goals, 0.0, 0.10);
    }

    /// Brings the first box to where it is to go, and the arm home.
    pub(crate) fn fetch_the_first_box(&mut self) {
        self.reach_for(0);
        self.done(grasp());
        self.carry();
        self.done(Request::Release);
        self.go(vec![Goal::Joints(aimm::HOME)], 0.10, 0.0);
        self.pass(1.0);
    }

    /// Carries what is held to the middle of the deck, 3 mm above it; where it has to be then.
    pub(crate) fn carry(&mut self) -> Pose {
        let held = self.cell.ground_truth().into_iter().find(|object| object.held).expect("something is held");
        let in_tool = self.cell.robot().tool_pose(&self.cell.configuration()).inverse().compose(&held.pose);
        let slot = aimm::slots()[4].compose(&Pose::at(0.0, 0.0, held.size[2] / 2.0 + 0.003));
        self.go(vec![Goal::Pose(slot.compose(&in_tool.inverse()))], 0.10, 0.10);
        slot
    }
}

pub(crate) fn grasp() -> Request {
    Request::Grasp { object: "box_1".to_owned(), expected: None }
}
