//! What the search tells apart by exact shapes: pairs of which spheres say something wrong in a problem.
//!
//! The search sees spheres that hold the shapes. Where they touch in the start or the goal and the shapes do not, there would be no search at all. So
//! these pairs, of two links or of a link and what stands around, are left out of the vector checks and looked at here, from posture to posture, after
//! everything else was found free. That is slow, and needed for few pairs of few problems. The finished path is checked by all exact shapes anyway.

use crate::cloud::Cloud;
use crate::exact::{self, Exact, Other, Shape};
use crate::mechanism::Mechanism;
use crate::pairs::Pair;
use crate::solid::Form;
use crate::space::{State, between};
use crate::surroundings::Surroundings;
use parry3d::math::Vector;
use ratn_model::pose::Pose;
use std::collections::BTreeSet;
use std::sync::Arc;

/// What is not looked at by spheres.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Doubts {
    /// Links, the lower index first.
    pub(crate) pairs: BTreeSet<Pair>,
    /// Links, and the name of what stands around.
    pub(crate) beside: BTreeSet<(usize, String)>,
}

/// Couples of things that are to be kept apart, by their exact shapes.
#[derive(Debug, Clone)]
pub(crate) struct Confirmed {
    mechanism: Mechanism,
    couples: Vec<Couple>,
}

#[derive(Debug, Clone)]
struct Couple {
    link: usize,
    own: Vec<Bounded>,
    other: Against,
}

#[derive(Debug, Clone)]
enum Against {
    Link(usize, Vec<Bounded>),
    Standing(Vec<Bounded>),
    Cloud(Arc<Cloud>),
}

/// A shape in a sphere.
#[derive(Debug, Clone)]
struct Bounded {
    shape: Shape,
    centre: Vector,
    radius: f32,
}

/// Two things that meet.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Met {
    Pair(Pair),
    Beside((usize, String)),
}

impl Doubts {
    /// What `coarse`, which knows a robot by its spheres, finds touching in a posture and `exact` finds apart.
    pub(crate) fn add(&mut self, coarse: &Exact<'_>, exact: &Exact<'_>, positions: &[f64]) {
        let mut mistaken = Doubts::met(coarse, positions);
        let met = Doubts::met(exact, positions);
        mistaken.pairs.retain(|pair| !met.pairs.contains(pair));
        mistaken.beside.retain(|beside| !met.beside.contains(beside));
        self.extend(mistaken);
    }

    /// All that meets in a posture.
    pub(crate) fn met(exact: &Exact<'_>, positions: &[f64]) -> Doubts {
        let mut met = Doubts::default();
        exact.visit(positions, &mut |link, other, _| {
            match other {
                Other::Link(second) => drop(met.pairs.insert((link, second))),
                Other::Standing(name) => drop(met.beside.insert((link, name.to_owned()))),
            }
            true
        });
        met
    }

    pub(crate) fn insert(&mut self, what: Met) {
        match what {
            Met::Pair(pair) => drop(self.pairs.insert(pair)),
            Met::Beside(beside) => drop(self.beside.insert(beside)),
        }
    }

    /// Shows each of them.
    pub(crate) fn into_each(self, see: &mut dyn FnMut(Met)) {
        self.pairs.into_iter().map(Met::Pair).chain(self.beside.into_iter().map(Met::Beside)).for_each(see);
    }

    /// Takes others, too, and says whether there were any that are new.
    pub(crate) fn extend(&mut self, others: Doubts) -> bool {
        let before = (self.pairs.len(), self.beside.len());
        self.pairs.extend(others.pairs);
        self.beside.extend(others.beside);
        before != (self.pairs.len(), self.beside.len())
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.pairs.is_empty() && self.beside.is_empty()
    }

    /// The robot without these checks.
    pub(crate) fn left_out_of(&self, mechanism: &Mechanism) -> Mechanism {
        let mut left = mechanism.clone();
        left.by_shapes.extend(&self.pairs);
        left.allowed.extend(self.beside.iter().cloned());
        left
    }
}

impl Confirmed {
    /// These couples of a robot and what stands around it.
    pub(crate) fn new(mechanism: &Mechanism, surroundings: Surroundings<'_>, doubts: &Doubts) -> Confirmed {
        let of_link = |link: usize| exact::shapes(&mechanism.links[link]).into_iter();
        // Meshes as they are, not the spheres that stand for them.
        let bounded = |link: usize| of_link(link).filter(|s| s.form.counts(true)).map(Bounded::new).collect();
        let among =
            doubts.pairs.iter().map(|&(a, b)| Couple { link: a, own: bounded(a), other: Against::Link(b, bounded(b)) });
        let mut couples: Vec<Couple> = among.collect();
        for (link, name) in &doubts.beside {
            let own = || of_link(*link).filter(|s: &Shape| s.form != Form::Cover).map(Bounded::new).collect();
            let standing = exact::standing(surroundings.obstacles, surroundings.meshes);
            let standing: Vec<Bounded> =
                standing.filter(|(own, _)| own == name).map(|(_, shape)| Bounded::new(shape)).collect();
            if !standing.is_empty() {
                couples.push(Couple { link: *link, own: own(), other: Against::Standing(standing) });
            }
            for cloud in surroundings.clouds.iter().filter(|cloud| cloud.name == *name) {
                couples.push(Couple { link: *link, own: own(), other: Against::Cloud(Arc::new(cloud.clone())) });
            }
        }
        Confirmed { mechanism: mechanism.clone(), couples }
    }

    /// Whether they are apart in a posture.
    pub(crate) fn is_free(&self, state: &State) -> bool {
        let positions: Vec<f64> =
            state[..self.mechanism.joints.len()].iter().map(|position| f64::from(*position)).collect();
        let poses = self.mechanism.poses(&positions);
        !self.couples.iter().any(|couple| couple.meets(&poses))
    }

    /// Whether they are apart on a straight motion cut into so many steps; `from` itself is not looked at.
    pub(crate) fn is_free_motion(&self, from: &State, to: &State, steps: usize) -> bool {
        if !self.is_free(to) {
            return false;
        }
        // Halving: what is between is found early.
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
        let pose = &poses[self.link];
        match &self.other {
            Against::Link(other, shapes) => self.own.iter().any(|own| own.meets(pose, shapes, &poses[*other])),
            Against::Standing(shapes) => self.own.iter().any(|own| own.meets(pose, shapes, &Pose::IDENTITY)),
            Against::Cloud(cloud) => self.own.iter().any(|own| own.shape.placed(pose).depth_in(cloud).is_some()),
        }
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
