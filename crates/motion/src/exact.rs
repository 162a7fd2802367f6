//! The slow and exact check: every shape of the robot as the URDF has it, against every obstacle, by parry3d.
//!
//! It confirms what the vector kernels found, and says what touches what and how deep.

use crate::frame::compose;
use crate::mechanism::Mechanism;
use crate::robot::to_f32;
use crate::space::Obstacle;
use parry3d::math::Pose as Pose32;
use parry3d::query;
use parry3d::shape::SharedShape;
use ratn_model::pose::Pose;
use std::fmt;

/// Two things that touch.
#[derive(Debug, Clone, PartialEq)]
pub struct Touch {
    /// A link of the robot.
    pub link: String,
    /// An obstacle or another link.
    pub other: String,
    /// How far one is inside the other, in metres.
    pub depth_m: f64,
}

impl fmt::Display for Touch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} is {:.1} mm inside {}", self.link, self.depth_m * 1e3, self.other)
    }
}

/// A robot among obstacles, exactly.
#[derive(Debug)]
pub struct Exact<'a> {
    mechanism: &'a Mechanism,
    obstacles: Vec<Solid<'a>>,
    /// Per link.
    bodies: Vec<Vec<Shape>>,
    /// Links that are to be kept apart.
    pairs: Vec<(usize, usize)>,
}

/// What a link has: its pose there, its shape, and how near to it is as good as touching, in metres.
#[derive(Debug)]
struct Shape {
    at: Pose,
    shape: SharedShape,
    skin: f32,
}

/// A shape in its place.
struct Placed<'s> {
    pose: Pose32,
    shape: &'s SharedShape,
    skin: f32,
}

#[derive(Debug)]
struct Solid<'a> {
    name: &'a str,
    pose: Pose32,
    shape: SharedShape,
}

impl<'a> Exact<'a> {
    /// A robot among obstacles.
    pub fn new(mechanism: &'a Mechanism, obstacles: &'a [Obstacle]) -> Exact<'a> {
        let solid = |obstacle: &'a Obstacle| {
            let body = obstacle.geometry.at(obstacle.pose);
            Solid { name: &obstacle.name, pose: to_f32(&body.pose), shape: body.geometry.shape(0.0) }
        };
        let bodies = |link: &crate::mechanism::Part| {
            let primitives = link.bodies.iter().map(|b| (b.pose, b.geometry.shape(link.padding_m), 0.0));
            let meshes = link.meshes.iter().map(|m| (m.pose, m.mesh.shape(), link.padding_m as f32));
            primitives.chain(meshes).map(|(at, shape, skin)| Shape { at, shape, skin }).collect()
        };
        Exact {
            mechanism,
            obstacles: obstacles.iter().map(solid).collect(),
            bodies: mechanism.links.iter().map(bodies).collect(),
            pairs: mechanism.pairs(),
        }
    }

    /// What touches first in a posture, if anything.
    pub fn touch(&self, positions: &[f64]) -> Option<Touch> {
        let mut first = None;
        self.visit(positions, &mut |touch| {
            first = Some(touch);
            false
        });
        first
    }

    /// All that touches in a posture, the deepest first, once per pair of names.
    pub fn touches(&self, positions: &[f64]) -> Vec<Touch> {
        let mut all: Vec<Touch> = Vec::new();
        self.visit(positions, &mut |touch| {
            all.push(touch);
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

    /// Shows touches until it hears that no more are wanted.
    fn visit(&self, positions: &[f64], wants_more: &mut dyn FnMut(Touch) -> bool) {
        let poses = self.mechanism.poses(positions);
        let mut placed: Vec<Vec<Placed<'_>>> = Vec::with_capacity(self.bodies.len());
        for (shapes, link) in self.bodies.iter().zip(&poses) {
            let place = |s: &'_ Shape| to_f32(&compose(link, &s.at));
            placed.push(shapes.iter().map(|s| Placed { pose: place(s), shape: &s.shape, skin: s.skin }).collect());
        }
        let name = |link: usize| self.mechanism.links[link].name.clone();
        for (link, bodies) in placed.iter().enumerate() {
            for body in bodies {
                for solid in self.obstacles.iter().filter(|o| self.mechanism.is_kept_from(link, o.name)) {
                    let other = Placed { pose: solid.pose, shape: &solid.shape, skin: 0.0 };
                    if let Some(depth_m) = depth(body, &other)
                        && !wants_more(Touch { link: name(link), other: solid.name.to_owned(), depth_m })
                    {
                        return;
                    }
                }
            }
        }
        for &(link, second) in &self.pairs {
            for (body, other) in placed[link].iter().flat_map(|body| placed[second].iter().map(move |o| (body, o))) {
                if let Some(depth_m) = depth(body, other)
                    && !wants_more(Touch { link: name(link), other: name(second), depth_m })
                {
                    return;
                }
            }
        }
    }

    /// What touches first along a path, looked at `per_radian` times per radian.
    pub fn touch_along(&self, path: &[Vec<f64>], per_radian: f64) -> Option<Touch> {
        let start = path.first().and_then(|first| self.touch(first));
        start.or_else(|| {
            path.windows(2).find_map(|pair| {
                let way: f64 = pair[0].iter().zip(&pair[1]).map(|(a, b)| (b - a).powi(2)).sum::<f64>().sqrt();
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

/// How deep two shapes are in each other, if they touch; a pair that parry cannot decide counts as touching.
fn depth(a: &Placed<'_>, b: &Placed<'_>) -> Option<f64> {
    let skin = a.skin + b.skin;
    if skin > 0.0 {
        return match query::contact(&a.pose, &**a.shape, &b.pose, &**b.shape, skin) {
            Ok(contact) => contact.map(|c| f64::from(skin - c.dist)),
            Err(_) => Some(0.0),
        };
    }
    match query::intersection_test(&a.pose, &**a.shape, &b.pose, &**b.shape) {
        Ok(found) if !found.intersecting => None,
        Ok(_) => {
            let contact = query::contact(&a.pose, &**a.shape, &b.pose, &**b.shape, 0.0).ok().flatten();
            Some(contact.map_or(0.0, |c| -f64::from(c.dist)))
        }
        Err(_) => Some(0.0),
    }
}
