//! What the search sees of an arm in its scene, and what of it is told apart by the shapes as they are.
//!
//! The search sees spheres. Those of primitives stand out by no more than the planner keeps as room, those that hold a mesh by centimetres. So where such
//! spheres touch what the shapes do not, in a posture where a motion is to begin or end or in any that is looked at after a search in vain, the couple is
//! left out of the vector checks and confirmed by the shapes from then on ([`confirmed`](crate::confirmed)), as `ratn plan` does.

use crate::arm::{self, BySpheres, CLEARANCE_M};
use crate::cloud::Cloud;
use crate::collision::{Checker, between};
use crate::confirmed::{Confirmed, Couples, Met};
use crate::diagnosis::{crowding, of_spheres};
use crate::exact::{Exact, Touch};
use crate::joint_vector::JointVector;
use crate::mechanism::Mechanism;
use crate::pairs::drawn;
use crate::robot::Robot;
use crate::space::{Obstacle, ROUNDING_M, Space};
use crate::surroundings::Surroundings;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

/// Postures that are looked at after a search in vain: along the straight way, and drawn.
const ALONG: usize = 20;
const DRAWN: usize = 200;

/// See the module. All is in the frame of the base.
pub(super) struct Search<'a> {
    robot: &'a Robot,
    /// The arm with its shapes as they are, and what stands around it.
    exact: Mechanism,
    around: Vec<Obstacle>,
    clouds: Vec<Cloud>,
    /// What is told apart by the shapes.
    confirmed: Couples,
    seen: BySpheres,
    pub(super) space: Space,
}

impl<'a> Search<'a> {
    pub(super) fn new(robot: &'a Robot, exact: Mechanism, around: Vec<Obstacle>, clouds: Vec<Cloud>) -> Search<'a> {
        let seen = BySpheres::of(robot, exact.clone());
        let obstacles: Vec<Obstacle> = seen.standing.iter().chain(&around).cloned().collect();
        let space = arm::space(&seen.arm, surroundings(&obstacles, &clouds));
        Search { robot, exact, around, clouds, confirmed: Couples::default(), seen, space }
    }

    /// The arm, with its shapes as they are.
    pub(super) fn mechanism(&self) -> &Mechanism {
        &self.exact
    }

    /// What the vector checks do not look at, of a checker without padding: the pairs of links, and what links are beside of what stands around; `None` where
    /// that is nothing.
    pub(super) fn unseen(&self, all: &Checker<'a>) -> [Option<Checker<'a>>; 2] {
        let mut pairs = Couples { pairs: arm::unseen(self.robot, &self.exact), ..Couples::default() };
        pairs.extend(Couples { pairs: self.confirmed.pairs.clone(), ..Couples::default() });
        let beside = Couples { beside: self.confirmed.beside.clone(), ..Couples::default() };
        [pairs, beside].map(|couples| (!couples.is_empty()).then(|| all.clone().of(&couples)))
    }

    /// Whether anything is told apart by the shapes.
    pub(super) fn tells_apart(&self) -> bool {
        !self.confirmed.is_empty()
    }

    /// Whether spheres of meshes take for touching in a posture what the shapes keep apart, and that is new. It is told apart by the shapes from now on.
    pub(super) fn doubt_at(&mut self, posture: &JointVector) -> bool {
        let mistaken = self.mistaken(&mut [*posture].into_iter());
        self.confirm(mistaken)
    }

    /// The same of all that is so on the straight way between two postures or in postures that are drawn, where a search was in vain; and of the pairs that it
    /// does not look at.
    pub(super) fn doubt_between(&mut self, from: &JointVector, to: &JointVector) -> bool {
        let along = (0..=ALONG).map(|i| between(from, to, i as f64 / ALONG as f64));
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let joints = self.robot.arm_joints();
        let drawn = (0..DRAWN).map(|_| JointVector::from_fn(joints.len(), |j| drawn(&joints[j], &mut random)));
        let mut doubts = self.mistaken(&mut along.chain(drawn));
        doubts.extend(Couples { pairs: arm::unseen(self.robot, &self.exact), ..Couples::default() });
        self.confirm(doubts)
    }

    /// The couples with meshes that spheres find touching in any of these postures though the shapes keep apart.
    fn mistaken(&self, postures: &mut dyn Iterator<Item = JointVector>) -> Couples {
        let coarse = of_spheres(&self.seen.arm, ROUNDING_M);
        let obstacles = self.obstacles();
        let coarse = Exact::new(&coarse, surroundings(&obstacles, &self.clouds));
        let around = surroundings(&self.around, &self.clouds);
        let mut mistaken = Couples::default();
        for posture in postures {
            let met = self.of_meshes(Couples::met(&coarse, &posture));
            mistaken.extend(Confirmed::new(&self.exact, around, &met, CLEARANCE_M).apart(&met, &posture));
        }
        mistaken
    }

    /// Of what spheres find touching that of which one at least stands for a mesh; what stands of the robot as the link that it is.
    fn of_meshes(&self, met: Couples) -> Couples {
        let is_mesh = |link: usize| self.exact.links[link].covers > 0;
        let mut of_meshes = Couples::default();
        met.into_each(&mut |couple| {
            let couple = match couple {
                Met::Beside((link, name)) => match self.standing(&name) {
                    Some(other) => Met::Pair((link.min(other), link.max(other))),
                    None => Met::Beside((link, name)),
                },
                pair => pair,
            };
            if match &couple {
                Met::Pair((a, b)) => is_mesh(*a) || is_mesh(*b),
                Met::Beside((link, _)) => is_mesh(*link),
            } {
                of_meshes.insert(couple);
            }
        });
        of_meshes
    }

    /// The link of the robot that stands there by this name among the obstacles.
    fn standing(&self, name: &str) -> Option<usize> {
        let index = self.seen.standing.iter().position(|obstacle| obstacle.name == name);
        index.map(|index| self.seen.links[index])
    }

    fn obstacles(&self) -> Vec<Obstacle> {
        self.seen.standing.iter().chain(&self.around).cloned().collect()
    }

    /// Has more told apart by the shapes; whether that is any.
    fn confirm(&mut self, doubts: Couples) -> bool {
        if !self.confirmed.extend(doubts) {
            return false;
        }
        self.seen = BySpheres::of(self.robot, self.confirmed.left_out_of(&self.exact));
        self.space = arm::space(&self.seen.arm, surroundings(&self.obstacles(), &self.clouds));
        let around = surroundings(&self.around, &self.clouds);
        self.space.confirm(Confirmed::new(&self.exact, around, &self.confirmed, CLEARANCE_M));
        true
    }

    /// What is so near in a posture that touches nothing that the vector checks find no room.
    pub(super) fn crowding(&self, posture: &JointVector) -> Option<String> {
        let coarse = of_spheres(&self.seen.arm, ROUNDING_M);
        let touches = Exact::new(&coarse, surroundings(&self.obstacles(), &self.clouds)).touches(posture);
        let Touch { link, other, depth_m } = touches.into_iter().next()?;
        let other = self.standing(&other).map_or(other, |link| self.exact.links[link].name.clone());
        Some(crowding(&self.seen.arm, self.robot.model.links.len(), &Touch { link, other, depth_m }))
    }
}

fn surroundings<'s>(obstacles: &'s [Obstacle], clouds: &'s [Cloud]) -> Surroundings<'s> {
    Surroundings { obstacles, clouds, meshes: &[] }
}
