//! The slow and exact check: every shape of the robot as the URDF has it, against every obstacle, by parry3d.
//!
//! It confirms what the vector kernels found, and says what touches what and how deep. A closed mesh is solid: what is wholly inside
//! touches it, too.

use crate::cloud::Cloud;
use crate::frame::compose;
use crate::geometry::Body;
use crate::inside::Inside;
use crate::mechanism::Mechanism;
use crate::mesh::Mesh;
use crate::robot::to_f32;
use crate::robot_model::Link;
use crate::space::Obstacle;
use crate::surroundings::{MeshObstacle, Surroundings};
use parry3d::math::{Pose as Pose32, Vector};
use parry3d::query;
use parry3d::shape::SharedShape;
use ratn_model::pose::Pose;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::sync::Arc;

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
    obstacles: Vec<(&'a str, Shape)>,
    clouds: &'a [Cloud],
    /// Per link.
    bodies: Vec<Vec<Shape>>,
    /// Links that are to be kept apart.
    pairs: Vec<(usize, usize)>,
}

/// What a link or an obstacle has: its pose there, its shape, and how near to it is as good as touching, in metres.
#[derive(Debug)]
struct Shape {
    at: Pose,
    shape: SharedShape,
    skin: f32,
    /// Of a mesh; other shapes are solid by themselves.
    inside: Option<Arc<Inside>>,
}

/// The shapes of meshes, each made once, however many links and obstacles have it.
#[derive(Default)]
struct Meshes(BTreeMap<*const Mesh, (SharedShape, Arc<Inside>)>);

impl Meshes {
    fn shape(&mut self, at: Pose, mesh: &Arc<Mesh>, padding_m: f64) -> Shape {
        let made = || (mesh.shape(), Arc::new(Inside::new(mesh)));
        let (shape, inside) = self.0.entry(Arc::as_ptr(mesh)).or_insert_with(made).clone();
        Shape { at, shape, skin: padding_m as f32, inside: Some(inside) }
    }
}

/// A shape in its place.
struct Placed<'s> {
    pose: Pose32,
    shape: &'s Shape,
}

impl Shape {
    fn primitive(body: &Body, padding_m: f64) -> Shape {
        Shape { at: body.pose, shape: body.geometry.shape(padding_m), skin: 0.0, inside: None }
    }
}

impl Placed<'_> {
    /// How deep this is in another shape whose surface it does not meet: as deep as the deepest of its parts, by a point of each.
    fn depth_inside(&self, other: &Placed<'_>) -> Option<f64> {
        let centre = [[0.0; 3]];
        let points = self.shape.inside.as_ref().map_or(&centre[..], |inside| inside.corners());
        let deep = |point: &[f64; 3]| {
            let [x, y, z] = point.map(|c| c as f32);
            let at = other.pose.inverse_transform_point(self.pose.transform_point(Vector::new(x, y, z)));
            let is_inside = match &other.shape.inside {
                Some(inside) => inside.contains([at.x, at.y, at.z].map(f64::from)),
                None => other.shape.shape.contains_local_point(at),
            };
            let surface = || other.shape.shape.project_local_point(at, false).point;
            is_inside.then(|| f64::from((surface() - at).length()))
        };
        points.iter().filter_map(deep).reduce(f64::max)
    }

    /// How deep the deepest ball of a cloud is in this.
    fn depth_in(&self, cloud: &Cloud) -> Option<f64> {
        let mut deepest = None;
        self.meet(cloud, 0.0, &mut |_, depth| {
            deepest = Some(deepest.map_or(depth, |d: f32| d.max(depth)));
            true
        });
        deepest.map(f64::from)
    }

    /// Shows the balls of a cloud that come within a margin, by number, and how deep they are in that.
    fn meet(&self, cloud: &Cloud, margin: f32, wants_more: &mut dyn FnMut(usize, f32) -> bool) {
        let reach = cloud.radius_m() as f32 + self.shape.skin + margin;
        let inside = self.shape.inside.as_deref();
        cloud
            .visit_near(&self.pose, &self.shape.shape, inside, reach, &mut |point, gap| wants_more(point, reach - gap));
    }
}

impl<'a> Exact<'a> {
    /// A robot among obstacles.
    pub fn new(mechanism: &'a Mechanism, surroundings: impl Into<Surroundings<'a>>) -> Exact<'a> {
        let Surroundings { obstacles, clouds, meshes } = surroundings.into();
        let mut shapes = Meshes::default();
        let solid = |obstacle: &'a Obstacle| {
            let body = obstacle.geometry.at(obstacle.pose);
            (&*obstacle.name, Shape::primitive(&body, 0.0))
        };
        let mut standing: Vec<(&str, Shape)> = obstacles.iter().map(solid).collect();
        for MeshObstacle { name, pose, mesh, .. } in meshes {
            standing.push((name, shapes.shape(*pose, mesh, 0.0)));
        }
        let mut bodies = |link: &Link| -> Vec<Shape> {
            let primitives = link.bodies.iter().map(|body| Shape::primitive(body, link.padding_m));
            primitives.chain(link.meshes.iter().map(|m| shapes.shape(m.pose, &m.mesh, link.padding_m))).collect()
        };
        let bodies = mechanism.links.iter().map(&mut bodies).collect();
        Exact { mechanism, obstacles: standing, clouds, bodies, pairs: mechanism.pairs() }
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

    /// Whether two links meet where all links are in these poses, whatever is excepted.
    pub(crate) fn do_meet(&self, poses: &[Pose], a: usize, b: usize) -> bool {
        let placed = |link: usize| {
            self.bodies[link].iter().map(move |shape| Placed { pose: to_f32(&compose(&poses[link], &shape.at)), shape })
        };
        placed(a).any(|body| placed(b).any(|other| depth(&body, &other).is_some()))
    }

    /// The numbers of a cloud's points whose balls come within `margin_m` metres of the robot.
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
            placed.push(shapes.iter().map(|shape| Placed { pose: to_f32(&compose(link, &shape.at)), shape }).collect());
        }
        placed
    }

    /// Shows touches until it hears that no more are wanted.
    fn visit(&self, positions: &[f64], wants_more: &mut dyn FnMut(Touch) -> bool) {
        let placed = self.placed(positions);
        let name = |link: usize| self.mechanism.links[link].name.clone();
        for (link, bodies) in placed.iter().enumerate() {
            for body in bodies {
                for (obstacle, shape) in self.obstacles.iter().filter(|o| self.mechanism.is_kept_from(link, o.0)) {
                    let other = Placed { pose: to_f32(&shape.at), shape };
                    if let Some(depth_m) = depth(body, &other)
                        && !wants_more(Touch { link: name(link), other: (*obstacle).to_owned(), depth_m })
                    {
                        return;
                    }
                }
            }
        }
        for (link, bodies) in placed.iter().enumerate() {
            for cloud in self.clouds.iter().filter(|cloud| self.mechanism.is_kept_from(link, &cloud.name)) {
                let deepest = bodies.iter().filter_map(|body| body.depth_in(cloud)).reduce(f64::max);
                if let Some(depth_m) = deepest
                    && !wants_more(Touch { link: name(link), other: cloud.name.clone(), depth_m })
                {
                    return;
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

    /// What touches first along a path, looked at `per_radian` times per radian, and more often where a link that mimics a joint goes further.
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

/// How deep two shapes are in each other, if they touch or one is inside the other; a pair that parry cannot decide counts as touching.
fn depth(a: &Placed<'_>, b: &Placed<'_>) -> Option<f64> {
    let meshes = a.shape.inside.is_some() || b.shape.inside.is_some();
    // parry3d knows only the surface of a mesh.
    let inside = || if meshes { a.depth_inside(b).or_else(|| b.depth_inside(a)) } else { None };
    surfaces(a, b).or_else(inside)
}

fn surfaces(a: &Placed<'_>, b: &Placed<'_>) -> Option<f64> {
    let skin = a.shape.skin + b.shape.skin;
    let (first, second) = (&*a.shape.shape, &*b.shape.shape);
    if skin > 0.0 {
        return match query::contact(&a.pose, first, &b.pose, second, skin) {
            Ok(contact) => contact.map(|c| f64::from(skin - c.dist)),
            Err(_) => Some(0.0),
        };
    }
    match query::intersection_test(&a.pose, first, &b.pose, second) {
        Ok(found) if !found.intersecting => None,
        Ok(_) => {
            let contact = query::contact(&a.pose, first, &b.pose, second, 0.0).ok().flatten();
            Some(contact.map_or(0.0, |c| -f64::from(c.dist)))
        }
        Err(_) => Some(0.0),
    }
}
