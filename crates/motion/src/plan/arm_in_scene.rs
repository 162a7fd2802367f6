//! The arm in the scene of one request: collision checks, constraints on the tool, straight motions of the tool, and durations.
//!
//! There are two collision checks. The exact shapes ([`Checker`]) decide about straight parts, where contact may be allowed, and about starts and
//! goals. The vector checks ([`Space`]) decide about free motions; a posture where they find room is a *door* from one to the other.

use super::contact;
use super::error::PlanError;
use super::search::Search;
use crate::arm::{self, joints};
use crate::cloud::Cloud;
use crate::collision::{CONTACT_TOLERANCE_M, Checker, Collision, Contact, PADDING_M};
use crate::connect::{Budget, ConnectError, Route, connect};
use crate::constrained::{self, Constraint};
use crate::joint_vector::JointVector;
use crate::keep::{KeptAxis, timed_keeping};
use crate::ladder;
use crate::leaving::{Leaving, NOTHING_NEW};
use crate::line::{self, Cause, LineError, Lines};
use crate::pace::{Pace, Stop};
use crate::pressing::{Pressing, straight_collision};
use crate::reach::{Postures, Reach};
use crate::refine::{End, Measure, Refinement};
use crate::request::{Request, kept_out};
use crate::robot::{Configuration, Geometry, Robot};
use crate::simplify::shortened;
use crate::space::{Obstacle, State, state};
use crate::straight::Straight;
use crate::timing::rough::Rough;
use crate::timing::{Section, Speed, timed_while};
use crate::trajectory::Curve;
use crate::validate::check_collisions_while;
use crate::way_points::{Followed, Follower, WayPoints};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ratn_model::pose::Pose;
use ratn_world::scene::{Scene, Shape};
use std::sync::Arc;

/// The padding, in metres, where the start is too close to something for the usual padding. A free path keeps at least this distance. A
/// controller that aborts on such a path stops a little beside it, so planning may also begin at a start with less room that touches nothing.
const TIGHT_PADDING_M: f64 = 0.002;

/// The paddings that a start may have, in the order in which they are tried.
pub(super) const PADDINGS_M: [f64; 3] = [PADDING_M, TIGHT_PADDING_M, 0.0];

/// Number of random postures tried around a posture without room, and the distance of the last of them, in radians per joint.
const WAYS_OUT: usize = 100;
const WAY_OUT_RAD: f64 = 0.4;

/// Where a retreat ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Extent {
    /// At the end of the straight part.
    Whole,
    /// At the first free posture.
    UntilFree,
}

/// The checker of the exact shapes for a request.
fn checker<'a>(
    robot: &'a Robot,
    scene: &Scene,
    request: &Request,
    here: &Configuration,
    seen: Option<&Arc<Cloud>>,
    padding_m: f64,
) -> Checker<'a> {
    Checker::new(robot, scene, here, padding_m)
        .reaching_into(&request.reaches_into)
        .keeping_out_of(&request.keep_out)
        .beside(seen.cloned())
}

/// The arm of a request in its scene.
pub(super) struct ArmInScene<'a> {
    robot: &'a Robot,
    scene: &'a Scene,
    request: &'a Request,
    here: Configuration,
    checker: Checker<'a>,
    search: Search<'a>,
    /// The couples that the vector checks leave out, checked by exact shapes: pairs of links, and links with obstacles.
    unseen: [Option<Checker<'a>>; 2],
    /// Points that a camera saw and that belong to no known object, in the frame of the base.
    seen: Option<Arc<Cloud>>,
    /// The kinematics of the tool in the frame of the base, which is at `base`.
    reach: Reach,
    base: Pose,
    /// The constraint on the tool.
    constraint: Option<Constraint>,
    rough: Rough,
    random: ChaCha8Rng,
}

impl<'a> ArmInScene<'a> {
    pub(super) fn new(robot: &'a Robot, scene: &'a Scene, request: &'a Request) -> Result<ArmInScene<'a>, PlanError> {
        let here = request.start.with_base(&scene.base);
        let base = arm::on_floor(robot, &scene.base);
        let mut around = arm::objects(robot, scene);
        around.extend(request.keep_out.iter().enumerate().map(|(i, region)| Obstacle {
            name: kept_out(i),
            pose: base.inverse().compose(&region.pose),
            geometry: Geometry::from(&Shape::Box { size: region.size }),
        }));
        let seen = request.seen.as_ref().map(|seen| seen.unknown(robot, scene, &here)).transpose()?;
        let seen = seen.map(|cloud| cloud.moved(&base.inverse())).transpose()?;
        let clouds = seen.clone();
        let seen = seen.map(Arc::new);
        let search = Search::new(robot, arm::from_base(robot, scene, &here), around, clouds.into_iter().collect());
        let mut arm = ArmInScene {
            robot,
            scene,
            request,
            checker: checker(robot, scene, request, &here, seen.as_ref(), PADDING_M),
            unseen: [None, None],
            reach: Reach::new(search.mechanism(), robot.tool, Pose::IDENTITY),
            search,
            base,
            seen,
            constraint: None,
            rough: Rough::new(&request.joints(robot), request.speed),
            random: ChaCha8Rng::seed_from_u64(request.seed),
            here,
        };
        arm.look_at_unseen();
        Ok(arm)
    }

    fn look_at_unseen(&mut self) {
        let all = checker(self.robot, self.scene, self.request, &self.here, self.seen.as_ref(), 0.0);
        self.unseen = self.search.unseen(&all);
    }

    pub(super) fn request(&self) -> &'a Request {
        self.request
    }

    pub(super) fn robot(&self) -> &'a Robot {
        self.robot
    }

    pub(super) fn random(&mut self) -> &mut ChaCha8Rng {
        &mut self.random
    }

    pub(super) fn joints(&self, state: &State) -> JointVector {
        joints(self.robot, state)
    }

    /// The tool's pose in the world frame.
    pub(super) fn tool_pose(&self, arm: &JointVector) -> Pose {
        self.robot.tool_pose(&Configuration { arm: *arm, ..self.here })
    }

    /// The tool's pose in the frame of the base.
    pub(super) fn tool_from_base(&self, arm: &JointVector) -> Pose {
        self.reach.pose(arm)
    }

    /// Sets the padding of the exact shapes.
    pub(super) fn pad(&mut self, padding_m: f64) {
        if self.checker.padding() != padding_m {
            self.checker = checker(self.robot, self.scene, self.request, &self.here, self.seen.as_ref(), padding_m);
        }
    }

    /// Sets the padding to at least the tight one: an arm may stand closer to something where it was stopped, but it must not move there.
    pub(super) fn pad_at_least_tightly(&mut self) {
        if self.checker.padding() < TIGHT_PADDING_M {
            self.pad(TIGHT_PADDING_M);
        }
    }

    /// A checker with the fingers open, for leaving a goal where the tool releases what it holds; `None` if it holds nothing.
    pub(super) fn with_open_fingers(&self) -> Option<Checker<'a>> {
        let scene = contact::let_go(self.scene)?;
        let opened = Configuration { finger: self.robot.open_finger_m(), ..self.request.start };
        Some(checker(self.robot, &scene, self.request, &opened, self.seen.as_ref(), self.checker.padding()))
    }

    /// The first forbidden contact in a posture, or distance below the padding.
    pub(super) fn collision(&mut self, posture: &JointVector, contact: Contact) -> Option<Collision> {
        self.checker.collision(posture, contact)
    }

    /// The same for a straight motion of the joints without any contact.
    pub(super) fn edge_collision(&mut self, from: &JointVector, to: &JointVector) -> Option<Collision> {
        self.checker.edge_collision(from, to, Contact::None)
    }

    /// The first forbidden contact on a straight part, whose postures begin at its contact end.
    pub(super) fn straight_collision(&mut self, postures: &[JointVector], press_m: f64) -> Option<Collision> {
        straight_collision(&mut self.checker, postures, press_m)
    }

    /// Postures along a straight part that begins in `from`, where the fingers and what they hold may penetrate by `press_m` and on the way no
    /// deeper; or why it ends early. An arm with a redundant joint moves its elbow around obstacles.
    pub(super) fn leave(
        &mut self,
        from: &JointVector,
        part: &Straight,
        press_m: f64,
        pace: &mut Pace<'_>,
    ) -> Result<Result<Vec<JointVector>, String>, Stop> {
        let begins = match Pressing::at(&mut self.checker, from, press_m) {
            Ok(begins) => begins,
            Err(collision) => return Ok(Err(collision.to_string())),
        };
        let to = arm::moved(&self.reach, from, self.way(part, from));
        let lines = Lines::new(self.reach.pose(from), &[to], 0.0);
        let (checker, reach, mut met, mut pressing) = (&mut self.checker, &self.reach, None, begins.clone());
        let is_free = &mut |from: &JointVector, to: &JointVector| {
            met = pressing.goes(checker, from, to).err();
            met.as_ref().map_or(Ok(()), |collision| Err(collision.to_string()))
        };
        let mut traced = line::nearest(reach, &lines, from, is_free, &mut || pace.answer())?;
        // Another posture of the elbow does not help if the tool itself collides.
        let is_in_vain = met.is_some_and(|collision| self.checker.is_of_the_tool(&collision));
        if traced.ended.is_some() && !is_in_vain {
            let checker = &mut self.checker;
            let is_free =
                &mut |from: &JointVector, to: &JointVector| checker.edge_is_free(from, to, Contact::Gripper(press_m));
            if let Some(other) = ladder::climb(reach, &lines, from, is_free, &mut || pace.answer())? {
                // What is pressed depends on the way there.
                let mut pressing = begins;
                let goes = |pair: &[JointVector]| pressing.goes(checker, &pair[0], &pair[1]);
                if let Err(collision) = other.postures.windows(2).try_for_each(goes) {
                    return Ok(Err(collision.to_string()));
                }
                traced = other;
            }
        }
        Ok(match traced.ended {
            Some(Cause::Blocked { reason }) => Err(reason),
            _ => traced.whole().map_err(|error| error.to_string()),
        })
    }

    /// The gripper's contacts in a posture, which a retreat has to leave; `None` without contact.
    pub(super) fn leaving(&mut self, from: &JointVector) -> Option<Leaving> {
        Leaving::from(&mut self.checker, from)
    }

    /// Postures along a straight part that leaves the contacts of the gripper at its start and ends free; or why it ends early.
    pub(super) fn retreat(
        &mut self,
        from: &JointVector,
        leaving: &Leaving,
        part: &Straight,
        extent: Extent,
        pace: &mut Pace<'_>,
    ) -> Result<Result<Vec<JointVector>, String>, Stop> {
        let to = arm::moved(&self.reach, from, self.way(part, from));
        let lines = Lines::new(self.reach.pose(from), &[to], 0.0);
        let (mut rest, mut leaving, mut is_out) = (leaving.of_the_rest(&self.checker), leaving.clone(), false);
        let checker = &mut self.checker;
        let is_free = &mut |from: &JointVector, to: &JointVector| {
            if is_out && extent == Extent::UntilFree {
                return Err("it is out".to_owned());
            }
            if let Some(collision) = rest.edge_collision(from, to, NOTHING_NEW) {
                return Err(collision.to_string());
            }
            leaving.goes(checker, from, to).map_err(|collision| format!("{collision}, deeper than before"))?;
            is_out = leaving.is_over() && checker.is_free(to, Contact::None);
            Ok(())
        };
        let traced = line::nearest(&self.reach, &lines, from, is_free, &mut || pace.answer())?;
        if is_out && extent == Extent::UntilFree {
            return Ok(Ok(traced.postures));
        }
        let postures = match traced.whole() {
            Ok(postures) => postures,
            Err(error) => return Ok(Err(error.to_string())),
        };
        let end = self.collision(&postures[postures.len() - 1], Contact::None);
        Ok(end.map_or(Ok(postures), |collision| Err(format!("at its end {collision}"))))
    }

    /// Postures along a straight part that ends in `from`, in the opposite direction, each solved from the one before. Other postures at the goal
    /// are candidates, too, so no other elbow is tried.
    pub(super) fn line_back(&self, from: &JointVector, part: &Straight) -> Result<Vec<JointVector>, LineError> {
        arm::line_of_nearest(&self.reach, from, self.way(part, from).map(|c| -c))
    }

    /// Translation of the tool along a straight part, in the frame of the base.
    fn way(&self, part: &Straight, at: &JointVector) -> [f64; 3] {
        // A request that names a missing object has been refused before.
        part.way(self.scene, &self.base, &self.reach.pose(at)).unwrap_or_default()
    }

    /// Postures along straight lines of the tool from a posture through way points to a goal.
    pub(super) fn follow(
        &mut self,
        start: &JointVector,
        way: &WayPoints,
        leaving: Option<&mut Checker<'a>>,
        pace: &mut Pace<'_>,
    ) -> Result<Followed, PlanError> {
        let mut follower = Follower {
            scene: self.scene,
            reach: &self.reach,
            base: self.base,
            checker: &mut self.checker,
            leaving,
            constraint: self.constraint.as_ref(),
            presses_m: contact::presses_m(self.robot),
        };
        follower.follow(start, self.request, way, pace)
    }

    /// All postures for a pose of the tool in the world frame.
    pub(super) fn postures(&self, pose: &Pose) -> Postures {
        self.reach.postures(&self.reach.target(self.base.inverse().compose(pose)))
    }

    /// Some of these postures, the nearest to `near` first; every attempt returns others.
    pub(super) fn attempt(&mut self, postures: &Postures, near: &JointVector, attempt: usize) -> Vec<JointVector> {
        self.reach.attempt(postures, near, attempt, &mut self.random)
    }

    /// The nearest of these postures to `near`.
    pub(super) fn nearest(&self, postures: &Postures, near: &JointVector) -> Option<JointVector> {
        self.reach.nearest(postures, near).first().copied()
    }

    /// Applies the request's constraint on the tool from the end of the departure on.
    ///
    /// # Errors
    /// Names the constraint that the departure violates.
    pub(super) fn keep_from(&mut self, departure: &[JointVector]) -> Result<(), PlanError> {
        let start = departure[departure.len() - 1];
        let tool = self.reach.pose(&start);
        let mut keep = self.request.keep;
        if let Some(tolerance_rad) = self.request.upright_rad {
            let up = [0.0, 0.0, 1.0];
            keep.axis = Some(KeptAxis { axis: tool.inverse().rotate(up), direction: Some(up), tolerance_rad });
        }
        self.constraint = keep.constraint(self.search.mechanism(), self.robot.tool, &self.base, &tool);
        self.kept_along(departure).map_err(|reason| PlanError::NotKept { place: "on the departure", reason })?;
        self.kept_at(&state(&start)).map_err(|reason| PlanError::NotKept { place: "at the start", reason })
    }

    /// Checks the constraint on the tool at a posture; the error names what is violated.
    pub(super) fn kept_at(&self, at: &State) -> Result<(), String> {
        match self.constraint.as_ref().filter(|constraint| !constraint.holds(at)) {
            Some(constraint) => Err(constraint.breach(at)),
            None => Ok(()),
        }
    }

    /// Checks the constraint on the tool along postures; the error names what is violated.
    pub(super) fn kept_along(&self, postures: &[JointVector]) -> Result<(), String> {
        let Some(constraint) = &self.constraint else { return Ok(()) };
        let breaks = |pair: &&[JointVector]| !constraint.holds_along(&state(&pair[0]), &state(&pair[1]));
        match postures.windows(2).find(breaks) {
            Some(pair) => Err(constraint.breach(&state(&pair[1]))),
            None => Ok(()),
        }
    }

    /// Adds the couples whose spheres collide in a posture though their meshes do not to those checked by exact shapes. Returns whether any
    /// couples are checked that way.
    pub(super) fn tells_apart_at(&mut self, posture: &JointVector) -> bool {
        if self.search.doubt_at(posture) {
            self.look_at_unseen();
        }
        self.search.tells_apart()
    }

    /// Does the same for the straight motion between two postures and for random postures, after a search without a path or with a path that
    /// collides. Returns whether there are new couples.
    pub(super) fn doubt_between(
        &mut self,
        from: &JointVector,
        to: &JointVector,
        pace: &mut Pace<'_>,
    ) -> Result<bool, Stop> {
        let is_new = self.search.doubt_between(from, to, &mut || pace.poll())?;
        if is_new {
            self.look_at_unseen();
        }
        Ok(is_new)
    }

    /// The posture itself if the vector checks find room for it, or else a close one that can be reached from it.
    pub(super) fn door(&mut self, posture: &JointVector) -> Option<State> {
        let here = state(posture);
        let space = &mut self.search.space;
        if space.is_within(&here) && space.is_free(&here) {
            return Some(here);
        }
        (1..=WAYS_OUT).find_map(|attempt| {
            let radius = WAY_OUT_RAD * attempt as f64 / WAYS_OUT as f64;
            let aside = posture.map(|q| q + radius * self.random.random_range(-1.0..=1.0));
            let door = state(&self.robot.clamp(&aside));
            let keeps = self.constraint.as_ref().is_none_or(|c| c.holds_along(&here, &door));
            let free = keeps
                && self.search.space.is_free(&door)
                && self.checker.edge_is_free(posture, &joints(self.robot, &door), Contact::None);
            free.then_some(door)
        })
    }

    /// What is too close for the vector checks in a posture that touches nothing.
    pub(super) fn crowding(&self, posture: &JointVector) -> Option<String> {
        self.search.crowding(posture)
    }

    /// Estimated duration of a motion along postures, in seconds.
    pub(super) fn lasts_s(&mut self, path: &[State]) -> f64 {
        self.rough.duration_s(path)
    }

    /// A free path from a door to one of several others.
    pub(super) fn connect(
        &mut self,
        from: &State,
        to: &[State],
        budget: Budget,
        pace: &mut Pace<'_>,
    ) -> Result<Route, ConnectError> {
        let control = &mut |_: usize| pace.answer();
        match &self.constraint {
            None => connect(&mut self.search.space, from, to, budget, control),
            Some(constraint) => constrained::connect(&mut self.search.space, constraint, from, to, budget, control),
        }
    }

    /// Simplifies a free path: fewer and shorter motions.
    pub(super) fn shorten(&mut self, path: &mut Vec<State>, pace: &mut Pace<'_>) -> Result<(), Stop> {
        let control = &mut |_: usize| pace.answer();
        if let Some(constraint) = &self.constraint {
            let (shortcuts, seed) = (constrained::SHORTCUTS, self.request.seed);
            let stopped = constrained::shorten(&mut self.search.space, constraint, path, shortcuts, seed, control);
            return stopped.map_err(Stop::from);
        }
        match shortened(&mut self.search.space, path, control) {
            Ok(short) => *path = short,
            Err(ConnectError::Cancelled) => return Err(Stop::Cancelled),
            Err(_) => {}
        }
        Ok(())
    }

    /// Improvement of a free path to the first of the ends, by its duration.
    pub(super) fn refinement(&self, path: Vec<State>, end: usize, ends: Vec<End>) -> Refinement {
        let measure = Measure::Duration(Box::new(self.rough.clone()));
        let refinement = Refinement::new(path, end, ends, measure, self.request.seed);
        match &self.constraint {
            Some(constraint) => refinement.keeping(constraint.clone()),
            None => refinement,
        }
    }

    /// One step of the improvement.
    pub(super) fn step(&mut self, refinement: &mut Refinement, pace: &mut Pace<'_>) -> Result<(), Stop> {
        Ok(refinement.step(&mut self.search.space, &mut |_| pace.answer())?)
    }

    /// Times the sections as one motion within the requested limits. The motion keeps the constraint between all its knots as well, and the
    /// couples that the search leaves out do not collide on it.
    pub(super) fn timed(
        &mut self,
        sections: &[Section],
        goes_on: &mut dyn FnMut() -> bool,
    ) -> Result<Curve, PlanError> {
        let request = self.request;
        let joints = request.joints(self.robot);
        let (space, constraint) = (&mut self.search.space, &self.constraint);
        let mut is_free = |from: &JointVector, to: &JointVector| {
            let (from, to) = (state(from), state(to));
            constraint.as_ref().is_none_or(|c| c.holds_along(&from, &to)) && space.is_free_motion(&from, &to)
        };
        let mut time = |speed: &Speed| match constraint {
            None => Ok(timed_while(&joints, sections, speed.clone(), &mut is_free, goes_on)),
            Some(constraint) => timed_keeping(&joints, sections, speed.clone(), constraint, &mut is_free, goes_on)
                .ok_or(PlanError::NotKept {
                    place: "on the way",
                    reason: "the tool does not keep what it is to keep between the postures that were planned"
                        .to_owned(),
                }),
        };
        let curve = request.tool_speed.within(&self.reach, &request.speed.into(), &mut time)?;
        // No link of the robot may press another one. What the gripper may press was checked on the straight parts.
        let contacts = [Contact::None, Contact::Gripper(CONTACT_TOLERANCE_M)];
        for (unseen, contact) in self.unseen.iter_mut().zip(contacts) {
            let looked_at = unseen.as_mut().map(|unseen| check_collisions_while(unseen, &curve, contact, goes_on));
            match looked_at.unwrap_or(Ok(true)) {
                Ok(true) => {}
                // The time limit does not apply to the first motion: only cancellation by the caller ends its check.
                Ok(false) => return Err(PlanError::Cancelled),
                Err(violation) => return Err(PlanError::Unseen { reason: violation.to_string() }),
            }
        }
        Ok(curve)
    }
}
