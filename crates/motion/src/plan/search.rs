//! The space that the search uses for an arm in its scene, and the couples that are checked by exact shapes instead.
//!
//! The search uses spheres. Spheres of primitives stand out by no more than the planner's clearance, spheres of a mesh by centimetres. So a couple
//! whose mesh spheres collide though the shapes do not is taken out of the vector checks and confirmed by the shapes from then on
//! ([`confirmed`](crate::confirmed)), as `ratn plan` does. This is checked in postures where a motion is to begin or end, and in the postures
//! examined after a failed search.

use crate::arm::{self, BySpheres, CLEARANCE_M};
use crate::cloud::Cloud;
use crate::collision::{Checker, between};
use crate::confirmed::{Confirmed, Couples, Met};
use crate::diagnosis::{crowding, of_spheres};
use crate::exact::{Exact, Touch};
use crate::joint_vector::JointVector;
use crate::mechanism::Mechanism;
use crate::pace::Stop;
use crate::pairs::drawn;
use crate::robot::Robot;
use crate::space::{Obstacle, ROUNDING_M, Space};
use crate::surroundings::Surroundings;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

/// Number of postures examined after a failed search: along the straight way, and random ones.
const ALONG: usize = 20;
const DRAWN: usize = 200;

/// See the module. All poses are in the frame of the base.
pub(super) struct Search<'a> {
    robot: &'a Robot,
    /// The arm with its exact shapes, and the obstacles around it.
    exact: Mechanism,
    around: Vec<Obstacle>,
    clouds: Vec<Cloud>,
    /// The couples that are checked by exact shapes.
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

    /// The arm with its exact shapes.
    pub(super) fn mechanism(&self) -> &Mechanism {
        &self.exact
    }

    /// The couples that the vector checks leave out, from a checker `all` without padding: pairs of links, and links with obstacles; `None` if
    /// there are none.
    pub(super) fn unseen(&self, all: &Checker<'a>) -> [Option<Checker<'a>>; 2] {
        let mut pairs = Couples { pairs: arm::unseen(self.robot, &self.exact), ..Couples::default() };
        pairs.extend(Couples { pairs: self.confirmed.pairs.clone(), ..Couples::default() });
        let beside = Couples { beside: self.confirmed.beside.clone(), ..Couples::default() };
        [pairs, beside].map(|couples| (!couples.is_empty()).then(|| all.clone().of(&couples)))
    }

    /// Whether any couple is checked by exact shapes.
    pub(super) fn tells_apart(&self) -> bool {
        !self.confirmed.is_empty()
    }

    /// Finds couples whose mesh spheres collide in a posture though the shapes do not, and checks them by exact shapes from now on. Returns
    /// whether there are new ones.
    pub(super) fn doubt_at(&mut self, posture: &JointVector) -> bool {
        let mistaken = self.mistaken(&[*posture], &mut || Ok(()));
        mistaken.is_ok_and(|mistaken| self.confirm(mistaken))
    }

    /// As `doubt_at`, for the straight motion between two postures and for random postures, after a failed search; also adds the pairs that the
    /// search skips. `ask` is called before each posture and says whether the caller still wants the plan.
    ///
    /// # Errors
    /// The answer of `ask`.
    pub(super) fn doubt_between(
        &mut self,
        from: &JointVector,
        to: &JointVector,
        ask: &mut dyn FnMut() -> Result<(), Stop>,
    ) -> Result<bool, Stop> {
        let along = (0..=ALONG).map(|i| between(from, to, i as f64 / ALONG as f64));
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let joints = self.robot.arm_joints();
        let drawn = (0..DRAWN).map(|_| JointVector::from_fn(joints.len(), |j| drawn(&joints[j], &mut random)));
        let postures: Vec<JointVector> = along.chain(drawn).collect();
        let mut doubts = self.mistaken(&postures, ask)?;
        doubts.extend(Couples { pairs: arm::unseen(self.robot, &self.exact), ..Couples::default() });
        Ok(self.confirm(doubts))
    }

    /// Couples with meshes whose spheres collide in one of these postures though the shapes do not.
    fn mistaken(&self, postures: &[JointVector], ask: &mut dyn FnMut() -> Result<(), Stop>) -> Result<Couples, Stop> {
        let coarse = of_spheres(&self.seen.arm, ROUNDING_M);
        let obstacles = self.obstacles();
        let coarse = Exact::new(&coarse, surroundings(&obstacles, &self.clouds));
        let (mut met, mut all) = (Vec::with_capacity(postures.len()), Couples::default());
        for posture in postures {
            ask()?;
            let here = self.of_meshes(Couples::met(&coarse, posture));
            all.extend(here.clone());
            met.push(here);
        }
        let exactly = Confirmed::new(&self.exact, surroundings(&self.around, &self.clouds), &all, CLEARANCE_M);
        let mut mistaken = Couples::default();
        for (posture, met) in postures.iter().zip(&met) {
            ask()?;
            mistaken.extend(exactly.apart(met, posture));
        }
        Ok(mistaken)
    }

    /// Of the colliding couples those with at least one mesh. An obstacle that is a link of the robot is replaced by that link.
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

    /// The link of the robot that is the obstacle of this name.
    fn standing(&self, name: &str) -> Option<usize> {
        let index = self.seen.standing.iter().position(|obstacle| obstacle.name == name);
        index.map(|index| self.seen.links[index])
    }

    fn obstacles(&self) -> Vec<Obstacle> {
        self.seen.standing.iter().chain(&self.around).cloned().collect()
    }

    /// Adds couples to be checked by exact shapes; returns whether any is new.
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

    /// What is too close for the vector checks in a posture that touches nothing.
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

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use ratn_model::pose::Pose;
    use ratn_world::scene::Scene;

    #[test]
    fn who_no_longer_wants_a_plan_is_not_made_to_wait_for_the_look_at_postures_after_a_search() {
        let robot = Robot::built_in("panda").unwrap();
        let nothing = Scene { base: Pose::IDENTITY, objects: Vec::new() };
        let here = robot.at_zero();
        let mut search = Search::new(&robot, arm::from_base(&robot, &nothing, &here), Vec::new(), Vec::new());
        for (allowed, asked_for) in
            [(usize::MAX, 2 * (ALONG + 1 + DRAWN)), (3, 4), (ALONG + DRAWN + 9, ALONG + DRAWN + 10)]
        {
            let mut asked = 0;
            let doubted = search.doubt_between(&here.arm, &here.arm, &mut || {
                asked += 1;
                if asked > allowed { Err(Stop::Cancelled) } else { Ok(()) }
            });
            assert_eq!(asked, asked_for);
            assert_eq!(doubted.is_err(), allowed < usize::MAX);
        }
    }
}
