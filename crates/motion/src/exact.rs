//! The slow and exact collision check: every shape of the robot as in the URDF against every obstacle, by their distance
//! ([`distance`](crate::distance)).
//!
//! It confirms what the vector kernels found, and reports what touches what and how deep. A closed mesh is solid: a shape wholly inside touches
//! it, too.

use crate::cloud::Cloud;
use crate::frame::compose;
use crate::mechanism::Mechanism;
use crate::robot::to_f32;
use crate::robot_model::Link;
use crate::solid::{Placed, Solid};
use crate::space::Obstacle;
use crate::surroundings::{MeshObstacle, Surroundings};
use ratn_model::pose::Pose;
use std::collections::BTreeSet;
use std::fmt;

/// Two things that touch.
#[derive(Debug, Clone, PartialEq)]
pub struct Touch {
    /// A link of the robot.
    pub link: String,
    /// An obstacle or another link.
    pub other: String,
    /// Penetration in metres.
    pub depth_m: f64,
}

impl fmt::Display for Touch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} is {:.1} mm inside {}", self.link, self.depth_m * 1e3, self.other)
    }
}

/// A robot among obstacles, for the exact check.
#[derive(Debug)]
pub struct Exact<'a> {
    mechanism: &'a Mechanism,
    obstacles: Vec<(&'a str, Shape)>,
    clouds: &'a [Cloud],
    /// Per link.
    bodies: Vec<Vec<Shape>>,
    /// Links that are to be kept apart.
    pairs: Vec<(usize, usize)>,
}

/// The other thing that a link touches.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Other<'n> {
    /// An obstacle, by its name.
    Standing(&'n str),
    /// Another link, which has the greater index.
    Link(usize),
}

/// A shape of a link or an obstacle, with its pose.
#[derive(Debug, Clone)]
pub(crate) struct Shape {
    pub(crate) at: Pose,
    pub(crate) solid: Solid,
}

impl Shape {
    pub(crate) fn placed(&self, frame: &Pose) -> Placed<'_> {
        Placed { pose: to_f32(&compose(frame, &self.at)), solid: &self.solid }
    }
}

impl Placed<'_> {
    /// Penetration of the deepest ball of a cloud in this shape.
    pub(crate) fn depth_in(&self, cloud: &Cloud) -> Option<f64> {
        let mut deepest = None;
        self.meet(cloud, 0.0, &mut |_, depth| {
            deepest = Some(deepest.map_or(depth, |d: f32| d.max(depth)));
            true
        });
        deepest.map(f64::from)
    }

    /// Calls `wants_more` with the index and penetration of each ball of a cloud within a margin, until it returns false.
    fn meet(&self, cloud: &Cloud, margin: f32, wants_more: &mut dyn FnMut(usize, f32) -> bool) {
        let reach = cloud.radius_m() as f32 + self.solid.skin_m as f32 + margin;
        let (shape, inside) = (&self.solid.shape, self.solid.inside.as_deref());
        cloud.visit_near(&self.pose, shape, inside, reach, &mut |point, gap| wants_more(point, reach - gap));
    }
}

impl<'a> Exact<'a> {
    /// A robot among obstacles.
    pub fn new(mechanism: &'a Mechanism, surroundings: impl Into<Surroundings<'a>>) -> Exact<'a> {
        let Surroundings { obstacles, clouds, meshes } = surroundings.into();
        let standing = standing(obstacles, meshes).collect();
        let bodies = mechanism.links.iter().map(|link| shapes(link, link.padding_m)).collect();
        Exact { mechanism, obstacles: standing, clouds, bodies, pairs: mechanism.pairs() }
    }

    /// The first contact found in a posture, if any.
    pub fn touch(&self, positions: &[f64]) -> Option<Touch> {
        let mut first = None;
        self.visit(positions, &mut |link, other, depth_m| {
            first = Some(self.told(link, other, depth_m));
            false
        });
        first
    }

    fn told(&self, link: usize, other: Other<'_>, depth_m: f64) -> Touch {
        let name = |link: usize| self.mechanism.links[link].name.clone();
        let other = match other {
            Other::Standing(name) => name.to_owned(),
            Other::Link(second) => name(second),
        };
        Touch { link: name(link), other, depth_m }
    }

    /// All contacts in a posture, the deepest first, one per pair of names.
    pub fn touches(&self, positions: &[f64]) -> Vec<Touch> {
        let mut all: Vec<Touch> = Vec::new();
        self.visit(positions, &mut |link, other, depth_m| {
            all.push(self.told(link, other, depth_m));
            true
        });
        all.sort_by(|a, b| b.depth_m.total_cmp(&a.depth_m));
        let mut deepest: Vec<Touch> = Vec::new();
        for touch in all {
            if !deepest.iter().any(|d| (&d.link, &d.other) == (&touch.link, &touch.other)) {
                deepest.push(touch);
            }
        }
        deepest
    }

    /// Whether two links collide in these poses, even if the pair is excepted.
    pub(crate) fn do_meet(&self, poses: &[Pose], a: usize, b: usize) -> bool {
        let placed = |link: usize| self.bodies[link].iter().map(move |shape| shape.placed(&poses[link]));
        placed(a).any(|body| placed(b).any(|other| body.touches(&other)))
    }

    /// Keeps only the pairs of links that collide in a posture.
    pub(crate) fn retain_meeting(&self, positions: &[f64], pairs: &mut Vec<(usize, usize)>) {
        let placed = self.placed(positions);
        pairs.retain(|&(a, b)| placed[a].iter().any(|body| placed[b].iter().any(|other| body.touches(other))));
    }

    /// Indices of a cloud's points whose balls come within `margin_m` metres of the robot.
    pub(crate) fn points_near(&self, positions: &[f64], cloud: &Cloud, margin_m: f64) -> BTreeSet<usize> {
        let mut near = BTreeSet::new();
        for body in self.placed(positions).iter().flatten() {
            body.meet(cloud, margin_m as f32, &mut |point, _| {
                near.insert(point);
                true
            });
        }
        near
    }

    fn placed(&self, positions: &[f64]) -> Vec<Vec<Placed<'_>>> {
        let poses = self.mechanism.poses(positions);
        let mut placed = Vec::with_capacity(self.bodies.len());
        for (shapes, link) in self.bodies.iter().zip(&poses) {
            placed.push(shapes.iter().map(|shape| shape.placed(link)).collect());
        }
        placed
    }

    /// Calls `wants_more` with each contact and its penetration in metres, until it returns false.
    pub(crate) fn visit(&self, positions: &[f64], wants_more: &mut dyn FnMut(usize, Other<'_>, f64) -> bool) {
        let placed = self.placed(positions);
        for (link, shapes) in placed.iter().enumerate() {
            for body in shapes {
                for (obstacle, shape) in self.obstacles.iter().filter(|o| self.mechanism.is_kept_from(link, o.0)) {
                    if let Some(depth_m) = body.depth(&shape.placed(&Pose::IDENTITY))
                        && !wants_more(link, Other::Standing(obstacle), depth_m)
                    {
                        return;
                    }
                }
            }
        }
        for (link, shapes) in placed.iter().enumerate() {
            for cloud in self.clouds.iter().filter(|cloud| self.mechanism.is_kept_from(link, &cloud.name)) {
                let deepest = shapes.iter().filter_map(|body| body.depth_in(cloud)).reduce(f64::max);
                if let Some(depth_m) = deepest
                    && !wants_more(link, Other::Standing(&cloud.name), depth_m)
                {
                    return;
                }
            }
        }
        for &(link, second) in &self.pairs {
            for body in &placed[link] {
                for other in &placed[second] {
                    if let Some(depth_m) = body.depth(other)
                        && !wants_more(link, Other::Link(second), depth_m)
                    {
                        return;
                    }
                }
            }
        }
    }

    /// The first contact along a path, checked at `per_radian` postures per radian, and more if a link that mimics a joint moves further than it.
    pub fn touch_along(&self, path: &[Vec<f64>], per_radian: f64) -> Option<Touch> {
        let start = path.first().and_then(|first| self.touch(first));
        let fineness = self.mechanism.fineness();
        let square = |(delta, fineness): (f64, &f64)| (delta * fineness).powi(2);
        start.or_else(|| {
            path.windows(2).find_map(|pair| {
                let deltas = pair[0].iter().zip(&pair[1]).map(|(a, b)| b - a);
                let way = deltas.zip(&fineness).map(square).sum::<f64>().sqrt();
                let steps = (way * per_radian).ceil().max(1.0) as usize;
                (1..=steps).find_map(|i| {
                    let t = i as f64 / steps as f64;
                    let posture: Vec<f64> = pair[0].iter().zip(&pair[1]).map(|(a, b)| a + (b - a) * t).collect();
                    self.touch(&posture)
                })
            })
        })
    }
}

/// All obstacles except clouds, with their names.
pub(crate) fn standing<'a>(
    obstacles: &'a [Obstacle],
    meshes: &'a [MeshObstacle],
) -> impl Iterator<Item = (&'a str, Shape)> {
    let solid = |obstacle: &'a Obstacle| {
        let body = obstacle.geometry.at(obstacle.pose);
        (&*obstacle.name, Shape { at: body.pose, solid: Solid::primitive(&body, 0.0) })
    };
    let mesh = |MeshObstacle { name, pose, mesh, .. }: &'a MeshObstacle| {
        (&**name, Shape { at: *pose, solid: Solid::mesh(mesh, 0.0) })
    };
    obstacles.iter().map(solid).chain(meshes.iter().map(mesh))
}

/// The exact shapes of a link, padded on every side.
pub(crate) fn shapes(link: &Link, padding_m: f64) -> Vec<Shape> {
    let primitives = link.own_bodies().iter();
    let primitives = primitives.map(|body| Shape { at: body.pose, solid: Solid::primitive(body, padding_m) });
    let meshes = link.meshes.iter();
    let meshes = meshes.map(|meshed| Shape { at: meshed.pose, solid: Solid::mesh(&meshed.mesh, padding_m) });
    primitives.chain(meshes).collect()
}
