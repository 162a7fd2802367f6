//! A table with boxes, and what happens to them as the arm carries them to the deck.

#![allow(clippy::unwrap_used, unreachable_pub, dead_code, reason = "shared by several test programs, which may panic")]

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ratn_model::pose::Pose;
use ratn_motion::aimm;
use ratn_motion::arm;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::pace::{Control, Progress};
use ratn_motion::plan::{Goal, Plan, PlanError, Request, plan};
use ratn_motion::robot::{Configuration, Robot};
use ratn_motion::straight::Straight;
use ratn_world::scene::{Placement, Scene, SceneObject, Shape};
use std::f64::consts::TAU;

pub struct Cell {
    pub robot: Robot,
    pub scene: Scene,
    pub arm: JointVector,
    pub improvement_iterations: usize,
}

/// A request without straight parts.
pub fn request(start: Configuration, goals: Vec<Goal>) -> Request {
    Request { speed: 0.3, seed: 7, ..Request::new(start, goals) }
}

impl Cell {
    /// `boxes` boxes of random sizes and yaws, box_1.., two rows of five places.
    pub fn with_boxes(boxes: usize, seed: u64) -> Cell {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let [x, y, z] = aimm::TABLE_CENTRE;
        let shape = Shape::Box { size: aimm::TABLE_SIZE };
        let mut objects =
            vec![SceneObject { name: "table".into(), shape, placement: Placement::World(Pose::at(x, y, z)) }];
        for i in 0..boxes {
            let size: [f64; 3] =
                std::array::from_fn(|k| random.random_range(aimm::BOX_LEAST[k]..=aimm::BOX_GREATEST[k]));
            let size = [size[0].max(size[1]), size[0].min(size[1]), size[2]];
            let place = (i * 3) % 10;
            let x = aimm::BOX_REGION[0][place / 5];
            let y = aimm::BOX_REGION[1][0] + 0.19 * (place % 5) as f64;
            let position = [x, y, aimm::TABLE_HEIGHT_M + size[2] / 2.0];
            let pose = Pose::from_rpy(position, 0.0, 0.0, random.random_range(0.0..TAU));
            let placement = Placement::World(pose);
            objects.push(SceneObject { name: format!("box_{}", i + 1), shape: Shape::Box { size }, placement });
        }
        let scene = Scene { base: Pose::IDENTITY, objects };
        Cell { robot: Robot::aimm(), scene, arm: aimm::OBSERVATION, improvement_iterations: 0 }
    }

    pub fn object(&self, name: &str) -> &SceneObject {
        self.scene.objects.iter().find(|o| o.name == name).unwrap()
    }

    fn object_mut(&mut self, name: &str) -> &mut SceneObject {
        self.scene.objects.iter_mut().find(|o| o.name == name).unwrap()
    }

    pub fn approach(&self, name: &str) -> Request {
        let object = self.object(name);
        let (Placement::World(pose), Shape::Box { size }) = (object.placement.clone(), object.shape) else {
            panic!("{name}")
        };
        let goals = aimm::grasp_poses(&pose, size).map(Goal::Pose).to_vec();
        Request { approach: Straight::down(aimm::APPROACH_M), ..self.request(goals) }
    }

    pub fn transfer(&self, name: &str, slot: usize) -> Request {
        let (Placement::Gripper(_), Shape::Box { size }) = (&self.object(name).placement, self.object(name).shape)
        else {
            panic!("{name}")
        };
        let target = self.scene.base.compose(&aimm::slots()[slot]).compose(&Pose::at(0.0, 0.0, size[2] / 2.0));
        let goals = aimm::grasp_poses(&target, size).map(Goal::Pose).to_vec();
        Request {
            depart: Straight::up(aimm::APPROACH_M),
            approach: Straight::down(aimm::APPROACH_M),
            ..self.request(goals)
        }
    }

    pub fn retract(&self) -> Request {
        Request { depart: Straight::up(aimm::APPROACH_M), ..self.request(vec![Goal::Joints(aimm::OBSERVATION)]) }
    }

    fn request(&self, goals: Vec<Goal>) -> Request {
        Request { improvement_iterations: self.improvement_iterations, ..request(self.state(), goals) }
    }

    pub fn plan(&self, request: &Request) -> Result<Plan, PlanError> {
        plan(&self.robot, &self.scene, request, &mut |_: Progress| Control::Continue)
    }

    /// The arm is where the plan ends.
    pub fn follow(&mut self, plan: &Plan) {
        self.arm = plan.end;
    }

    /// The arm where it is, everything else as the scene lets one assume.
    pub fn state(&self) -> Configuration {
        Configuration { arm: self.arm, ..arm::assumed(&self.robot, &self.scene) }
    }

    fn tool(&self) -> Pose {
        self.robot.tool_pose(&self.state())
    }

    pub fn grasp(&mut self, name: &str) {
        let tool = self.tool();
        let object = self.object_mut(name);
        if let Placement::World(pose) = object.placement {
            object.placement = Placement::Gripper(tool.inverse().compose(&pose));
        }
    }

    pub fn release(&mut self, name: &str) {
        let tool = self.tool();
        let object = self.object_mut(name);
        if let Placement::Gripper(pose) = object.placement {
            object.placement = Placement::World(tool.compose(&pose));
        }
    }
}
