//! Couples that the search checks by exact shapes, because their spheres collide in the problem though the shapes do not.
//!
//! The search uses spheres that hold the shapes. If spheres touched in the start or the goal where the shapes do not, there could be no search at
//! all. So these couples, of two links or of a link and an obstacle, are left out of the vector checks and are checked here, from posture to
//! posture, after all other checks have passed. That is slow, and needed for few couples of few problems. The finished path is checked by the
//! exact shapes anyway.

use crate::cloud::Cloud;
use crate::exact::{self, Exact, Other, Shape};
use crate::mechanism::Mechanism;
use crate::pairs::Pair;
use crate::space::{State, between};
use crate::surroundings::Surroundings;
use parry3d::math::Vector;
use ratn_model::pose::Pose;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// Couples that are to be kept apart.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Couples {
    /// Pairs of links, the lower index first.
    pub(crate) pairs: BTreeSet<Pair>,
    /// A link and the name of an obstacle.
    pub(crate) beside: BTreeSet<(usize, String)>,
}

/// Couples that are checked by their exact shapes.
#[derive(Debug, Clone)]
pub(crate) struct Confirmed {
    mechanism: Mechanism,
    couples: Vec<Couple>,
}

#[derive(Debug, Clone)]
struct Couple {
    is: Met,
    own: Vec<Bounded>,
    other: Against,
}

#[derive(Debug, Clone)]
enum Against {
    Shapes(Vec<Bounded>),
    Cloud(Arc<Cloud>),
}

/// A shape in its bounding sphere.
#[derive(Debug, Clone)]
struct Bounded {
    shape: Shape,
    centre: Vector,
    radius: f32,
}

/// A couple that collides.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Met {
    Pair(Pair),
    Beside((usize, String)),
}

impl Couples {
    /// All couples that collide in a posture.
    pub(crate) fn met(exact: &Exact<'_>, positions: &[f64]) -> Couples {
        let mut met = Couples::default();
        exact.visit(positions, &mut |link, other, _| {
            met.insert(match other {
                Other::Link(second) => Met::Pair((link, second)),
                Other::Standing(name) => Met::Beside((link, name.to_owned())),
            });
            true
        });
        met
    }

    /// Those that are not among others.
    pub(crate) fn without(mut self, others: &Couples) -> Couples {
        self.pairs.retain(|pair| !others.pairs.contains(pair));
        self.beside.retain(|beside| !others.beside.contains(beside));
        self
    }

    pub(crate) fn insert(&mut self, what: Met) {
        match what {
            Met::Pair(pair) => drop(self.pairs.insert(pair)),
            Met::Beside(beside) => drop(self.beside.insert(beside)),
        }
    }

    fn contains(&self, what: &Met) -> bool {
        match what {
            Met::Pair(pair) => self.pairs.contains(pair),
            Met::Beside(beside) => self.beside.contains(beside),
        }
    }

    /// Calls `see` with each couple.
    pub(crate) fn into_each(self, see: &mut dyn FnMut(Met)) {
        self.pairs.into_iter().map(Met::Pair).chain(self.beside.into_iter().map(Met::Beside)).for_each(see);
    }

    /// Adds other couples; returns whether any of them is new.
    pub(crate) fn extend(&mut self, others: Couples) -> bool {
        let before = (self.pairs.len(), self.beside.len());
        self.pairs.extend(others.pairs);
        self.beside.extend(others.beside);
        before != (self.pairs.len(), self.beside.len())
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.pairs.is_empty() && self.beside.is_empty()
    }

    /// The mechanism without the checks of these couples.
    pub(crate) fn left_out_of(&self, mechanism: &Mechanism) -> Mechanism {
        let mut left = mechanism.clone();
        left.by_shapes.extend(&self.pairs);
        left.allowed.extend(self.beside.iter().cloned());
        left
    }
}

impl Confirmed {
    /// The check of these couples, with `room_m` metres more distance from the obstacles.
    pub(crate) fn new(
        mechanism: &Mechanism,
        surroundings: Surroundings<'_>,
        couples: &Couples,
        room_m: f64,
    ) -> Confirmed {
        let links = &mechanism.links;
        let bounded = |link: usize, room_m: f64| -> Vec<Bounded> {
            exact::shapes(&links[link], links[link].padding_m + room_m).into_iter().map(Bounded::new).collect()
        };
        let mut standing: BTreeMap<&str, Vec<Bounded>> = BTreeMap::new();
        for (name, shape) in exact::standing(surroundings.obstacles, surroundings.meshes) {
            standing.entry(name).or_default().push(Bounded::new(shape));
        }
        let of_pair = |&(a, b): &Pair| Couple {
            is: Met::Pair((a, b)),
            own: bounded(a, 0.0),
            other: Against::Shapes(bounded(b, 0.0)),
        };
        let mut confirmed: Vec<Couple> = couples.pairs.iter().map(of_pair).collect();
        let named = |name: &String| couples.beside.iter().any(|(_, other)| other == name);
        let clouds = surroundings.clouds.iter().filter(|cloud| named(&cloud.name));
        let clouds: Vec<Arc<Cloud>> = clouds.map(|cloud| Arc::new(cloud.clone())).collect();
        for (link, name) in &couples.beside {
            let solid = standing.get(&**name).cloned().map(Against::Shapes);
            let points = clouds.iter().filter(|cloud| cloud.name == *name).cloned().map(Against::Cloud);
            let is = Met::Beside((*link, name.clone()));
            let others = solid.into_iter().chain(points);
            confirmed.extend(others.map(|other| Couple { is: is.clone(), own: bounded(*link, room_m), other }));
        }
        Confirmed { mechanism: mechanism.clone(), couples: confirmed }
    }

    /// Whether none of the couples collides in a posture.
    pub(crate) fn is_free(&self, state: &State) -> bool {
        let positions: Vec<f64> =
            state[..self.mechanism.joints.len()].iter().map(|position| f64::from(*position)).collect();
        let poses = self.mechanism.poses(&positions);
        !self.couples.iter().any(|couple| couple.meets(&poses))
    }

    /// The couples in `among` that do not collide in a posture.
    pub(crate) fn apart(&self, among: &Couples, positions: &[f64]) -> Couples {
        let poses = self.mechanism.poses(positions);
        let (mut apart, mut met) = (Couples::default(), Couples::default());
        for couple in self.couples.iter().filter(|couple| among.contains(&couple.is)) {
            if couple.meets(&poses) { &mut met } else { &mut apart }.insert(couple.is.clone());
        }
        // Several obstacles may have the same name.
        apart.pairs.retain(|pair| !met.pairs.contains(pair));
        apart.beside.retain(|beside| !met.beside.contains(beside));
        apart
    }

    /// Whether no couple collides on a straight motion cut into `steps` steps; `from` itself is not checked.
    pub(crate) fn is_free_motion(&self, from: &State, to: &State, steps: usize) -> bool {
        if !self.is_free(to) {
            return false;
        }
        // Bisection finds a collision in the middle early.
        let mut stride = steps.next_power_of_two();
        while stride > 1 {
            for i in (stride / 2..steps).step_by(stride) {
                if !self.is_free(&between(from, to, i as f32 / steps as f32)) {
                    return false;
                }
            }
            stride /= 2;
        }
        true
    }
}

impl Couple {
    fn meets(&self, poses: &[Pose]) -> bool {
        let (pose, at) = match &self.is {
            Met::Pair((link, second)) => (&poses[*link], &poses[*second]),
            Met::Beside((link, _)) => (&poses[*link], &Pose::IDENTITY),
        };
        self.own.iter().any(|own| match &self.other {
            Against::Shapes(shapes) => own.meets(pose, shapes, at),
            Against::Cloud(cloud) => own.shape.placed(pose).depth_in(cloud).is_some(),
        })
    }
}

impl Bounded {
    fn new(shape: Shape) -> Bounded {
        let sphere = shape.solid.shape.compute_local_bounding_sphere();
        let radius = sphere.radius() + shape.solid.skin_m as f32;
        Bounded { shape, centre: sphere.center(), radius }
    }

    fn meets(&self, pose: &Pose, others: &[Bounded], at: &Pose) -> bool {
        let own = self.shape.placed(pose);
        let centre = own.pose.transform_point(self.centre);
        others.iter().any(|other| {
            let its = other.shape.placed(at);
            let reach = self.radius + other.radius;
            centre.distance_squared(its.pose.transform_point(other.centre)) <= reach * reach && own.touches(&its)
        })
    }
}
