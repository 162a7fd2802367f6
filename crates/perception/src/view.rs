//! Classifies each pixel of the image by what it tells about a surface: it sees something that stands on the surface, or the surface is free
//! there, or that is unknown.

use crate::camera::{Camera, DepthImage};
use crate::cluster;
use crate::detection::{DetectionError, Region};
use crate::fit::relief::{Depth, Relief};
use crate::fit::{Edge, Evidence, Fit, UNLIKE_AT_EDGES};
use crate::flying::Heights;
use crate::level;
use crate::mask::{Ball, Mask};
use crate::plane::Plane;
use crate::quantile::median;
use crate::silhouette::{self, Sight};
use crate::vector::{Vector, cross, dot, length, scale, sub};
use ratn_model::pose::Pose;

/// Maximum height of the surface above or below its given pose, in metres.
const PLANE_SLACK: f64 = 0.06;
/// Maximum height of objects on the surface, in metres.
const TALLEST: f64 = 0.25;
/// Minimum number of pixels of an object.
const MIN_PIXELS: usize = 40;
/// Height above the plane in standard deviations from which a point does not belong to it, and the limits of that height, in metres.
const CLEAR_OF_PLANE: f64 = 3.5;
const CLEARANCE: std::ops::RangeInclusive<f64> = 0.0035..=0.014;
/// Points this many standard deviations higher are hardly ever taken for the plane.
const UNBIASED: f64 = 1.5;
/// Approximate number of points from which the plane is estimated; the rest are left out evenly.
const PLANE_POINTS: usize = 12_000;
/// Minimum part of a depth's standard deviation that counts as height above the plane, for a camera that looks along the plane.
const LEAST_FALL: f64 = 0.2;
/// Minimum horizontal part of a ray: from straight above no wall is seen.
const LEAST_LEVEL: f64 = 0.3;
/// An edge is on the far side of an object where the direction across it goes up by this cosine: nothing else determines where the object ends
/// there.
const UPWARDS: f64 = 0.6;
/// Distance from the silhouette of the rays whose distance from a model is compared, in pixels.
const BESIDE_EDGE: f64 = 2.5;
/// A ray has passed points that are this many standard deviations nearer than what it met.
const PASSED: f64 = 3.0;
/// A point hides some of the surface behind it if it is higher than a wall of this many pixels plus this many standard deviations of noise.
const HIDES: (f64, f64) = (2.0, 4.0);
/// Minimum standard deviation of a depth, in metres.
const LEAST_SIGMA: f64 = 0.0004;
/// Which pixels around a cluster's pixel are checked for seeing past it, in steps along rows and columns.
const BESIDE: [isize; 4] = [1, 2, 3, 5];
/// The region around a fork in which depths are compared: beyond it along and across, and above or below the surface, in metres.
const AROUND: [f64; 2] = [0.035, 0.012];
const LOW: f64 = 0.035;
/// Approximate maximum number of these depths.
const MOST_DEPTHS: f64 = 1200.0;
/// Objects on the plane lift its estimate by about this part of its points' standard deviation, because low parts are taken for the plane.
const LIFT: f64 = 0.08;
/// The pixel belongs to no cluster.
const NOBODY: u16 = u16::MAX;
/// Seed of RANSAC's choices: any number will do; the same image gives the same objects.
const SEED: u64 = 0x5EED;

/// The view of a surface.
pub(crate) struct View<'a> {
    image: &'a DepthImage,
    rays: Rays,
    /// What each pixel tells about the surface.
    sights: Vec<Sight>,
    /// The surface's frame in the world: on the measured plane, with z along its normal.
    pub(crate) frame: Pose,
    /// What stands on it: pixels by cluster, largest first.
    pub(crate) clusters: Vec<Vec<Seen>>,
    /// For each cluster, the original clusters that it consists of.
    parts: Vec<[u16; 2]>,
    /// For each pixel, the original cluster that it belongs to.
    owners: Vec<u16>,
    /// Standard deviations of a depth, and of a height above the surface, in metres.
    sigma: f64,
    sigma_above: f64,
    /// Standard deviation of the noise that neighbouring pixels share, in metres of depth.
    shared: f64,
    /// See [`Evidence`].
    floor: f64,
    /// Uncertainty of the plane: the variance of its height, in metres², and of its slope.
    pub(crate) plane_variance: [f64; 2],
}

/// A pixel of a cluster and the point it sees, in the surface's frame.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Seen {
    pixel: u32,
    pub(crate) point: Vector,
}

/// The rays of all pixels in a frame: their direction is linear in column and row.
struct Rays {
    eye: Vector,
    origin: Vector,
    per_column: Vector,
    per_row: Vector,
    width: usize,
}

impl Rays {
    fn new(camera: &Camera, frame: &Pose) -> Rays {
        let pose = frame.inverse().compose(&camera.pose);
        let optics = &camera.intrinsics;
        Rays {
            eye: pose.position,
            origin: pose.rotate(optics.ray(0, 0)),
            per_column: pose.rotate([1.0 / optics.fx, 0.0, 0.0]),
            per_row: pose.rotate([0.0, 1.0 / optics.fy, 0.0]),
            width: optics.width,
        }
    }

    fn point(&self, pixel: usize, depth: f64) -> Vector {
        let way = self.way(pixel % self.width, pixel / self.width);
        std::array::from_fn(|i| self.eye[i] + depth * way[i])
    }

    /// The direction of a pixel's ray: multiplied by the depth, it is the vector from the eye.
    fn way(&self, column: usize, row: usize) -> Vector {
        self.way_at(column as f64, row as f64)
    }

    fn way_at(&self, column: f64, row: f64) -> Vector {
        std::array::from_fn(|i| self.origin[i] + column * self.per_column[i] + row * self.per_row[i])
    }

    /// Column and row at which a point appears; `None` behind the camera.
    fn pixel(&self, point: Vector) -> Option<[f64; 2]> {
        let to = sub(point, self.eye);
        // The axes are orthogonal; those of columns and rows have the length of a pixel at a depth of 1.
        let ahead = cross(self.per_column, self.per_row);
        let depth = dot(to, ahead) / length(ahead);
        let at = |axis: Vector| (dot(to, axis) / depth - dot(self.origin, axis)) / dot(axis, axis);
        (depth > 1e-6).then(|| [at(self.per_column), at(self.per_row)])
    }
}

impl<'a> View<'a> {
    /// `deviation` is the standard deviation of the surface from its given pose, in metres.
    ///
    /// # Errors
    /// [`DetectionError`] when the surface is not in the image.
    pub(crate) fn new(
        image: &'a DepthImage,
        camera: &Camera,
        region: &Region,
        body: &[Ball],
        deviation: f64,
    ) -> Result<View<'a>, DetectionError> {
        let (width, height) = (image.width, image.height);
        if (width, height) != (camera.intrinsics.width, camera.intrinsics.height) || image.depth.len() != width * height
        {
            return Err(DetectionError::WrongCamera { width, height });
        }
        let near = near_surface(image, camera, region);
        let plane = Plane::find(&near, deviation, SEED).ok_or(DetectionError::NoPlane { points: near.len() })?;
        let (sigma_above, on_plane) = scatter(&near, &plane);
        let frame = region.pose.compose(&plane.frame());
        let half = region.size.map(|edge| edge / 2.0);
        let (looking, up) = (camera.pose.rotate([0.0, 0.0, 1.0]), frame.rotate([0.0, 0.0, 1.0]));
        let fall = (0..3).map(|i| looking[i] * up[i]).sum::<f64>().abs().max(LEAST_FALL);
        let clearance = |sigma: f64| (CLEAR_OF_PLANE * sigma).clamp(*CLEARANCE.start(), *CLEARANCE.end());
        let sigma_in_mean = sigma_above / level::SIDE as f64;
        let (clear, clear_in_mean) = (clearance(sigma_above), clearance(sigma_in_mean));
        let variance = sigma_above.powi(2) / on_plane.max(1.0);
        let mut view = View {
            image,
            rays: Rays::new(camera, &frame),
            shared: 1.0 / fall,
            sights: vec![Sight::Missing; image.depth.len()],
            sigma_above,
            frame,
            clusters: Vec::new(),
            parts: Vec::new(),
            owners: vec![NOBODY; image.depth.len()],
            sigma: (sigma_above / fall).max(LEAST_SIGMA),
            floor: clear_in_mean + UNBIASED * sigma_in_mean,
            // Points spread evenly over the region's shorter edge have a variance of a third of half its length, squared.
            plane_variance: [variance + (LIFT * sigma_above).powi(2), variance * 3.0 / half[0].min(half[1]).powi(2)],
        };
        let mask = Mask::new(body, &frame, [half[0], half[1], TALLEST]);
        let above =
            view.sort(clear, clear_in_mean, |p| p[0].abs() <= half[0] && p[1].abs() <= half[1] && !mask.hides(*p));
        view.gather(&above);
        Ok(view)
    }

    /// Marks free pixels, and returns the points within the region that stand on the surface: those that are clear of the plane themselves, and
    /// those whose mean with the pixels around them is.
    fn sort(&mut self, clear: f64, clear_in_mean: f64, within: impl Fn(&Vector) -> bool) -> Vec<Seen> {
        let heights = self.heights();
        let width = self.image.width;
        let means = level::means(&heights, width, clear as f32);
        self.shared *= level::shared(&heights, width, clear as f32, self.sigma_above);
        let seen = Heights { of: &heights, width, sigma: self.sigma_above };
        let mut above = Vec::new();
        for (pixel, (z, mean)) in heights.iter().zip(means).enumerate() {
            if z.is_nan() {
                continue;
            }
            self.sights[pixel] = Sight::Standing;
            if f64::from(*z) >= TALLEST {
                continue;
            }
            let stands = f64::from(*z) >= clear || (f64::from(*z) > -clear && f64::from(mean) >= clear_in_mean);
            if !stands {
                self.sights[pixel] = Sight::Free;
                continue;
            }
            if seen.is_flying(pixel, self.rise(pixel)) {
                self.sights[pixel] = Sight::Flying;
                continue;
            }
            let point = self.rays.point(pixel, f64::from(self.image.depth[pixel]));
            if within(&point) {
                above.push(Seen { pixel: pixel as u32, point });
            }
        }
        above
    }

    /// Height of an upright wall per pixel where this pixel sees it, in metres.
    fn rise(&self, pixel: usize) -> f64 {
        let way = self.rays.way(pixel % self.image.width, pixel / self.image.width);
        let level = (way[0].hypot(way[1]) / length(way)).max(LEAST_LEVEL);
        f64::from(self.image.depth[pixel]) * length(self.rays.per_row) / level
    }

    /// Height of each pixel's point above the surface, in metres; NaN for no return.
    fn heights(&self) -> Vec<f32> {
        let rays = &self.rays;
        let mut heights = Vec::with_capacity(self.image.depth.len());
        for (row, depths) in self.image.depth.chunks(self.image.width).enumerate() {
            let start = rays.origin[2] + row as f64 * rays.per_row[2];
            heights.extend(depths.iter().enumerate().map(|(column, depth)| match valid(*depth) {
                Some(depth) => (rays.eye[2] + depth * (start + column as f64 * rays.per_column[2])) as f32,
                None => f32::NAN,
            }));
        }
        heights
    }

    fn gather(&mut self, above: &[Seen]) {
        let (width, height) = (self.image.width, self.image.height);
        let at_border = |seen: &Seen| {
            let (column, row) = (seen.pixel as usize % width, seen.pixel as usize / width);
            column == 0 || row == 0 || column + 1 == width || row + 1 == height
        };
        let points: Vec<Vector> = above.iter().map(|seen| seen.point).collect();
        let clusters = cluster::clusters(&points, MIN_PIXELS).into_iter();
        let seen = clusters.map(|members| members.into_iter().map(|i| above[i as usize]).collect::<Vec<Seen>>());
        // Clusters that the image cuts off are not known as a whole.
        self.clusters = seen.filter(|cluster| !cluster.iter().any(at_border)).collect();
        for (number, cluster) in self.clusters.iter().enumerate() {
            self.parts.push([number as u16; 2]);
            cluster.iter().for_each(|seen| self.owners[seen.pixel as usize] = number as u16);
        }
    }

    /// Adds the union of two clusters as another cluster, unless their centroids are farther apart than `most`.
    pub(crate) fn joined(&mut self, a: usize, b: usize, most: f64) -> Option<usize> {
        let parts = [self.parts[a][0], self.parts[b][0]];
        let [a, b] = [a, b].map(|cluster| &self.clusters[cluster]);
        let middle = |cluster: &[Seen]| -> Vector {
            std::array::from_fn(|i| cluster.iter().map(|seen| seen.point[i]).sum::<f64>() / cluster.len().max(1) as f64)
        };
        if length(sub(middle(a), middle(b))) > most {
            return None;
        }
        let both = a.iter().chain(b).copied().collect();
        self.clusters.push(both);
        self.parts.push(parts);
        Some(self.clusters.len() - 1)
    }

    /// The evidence of a cluster: at most `points` of its points, evenly, at most `free` of the rays beside it, and at most `edges` of its
    /// edges.
    pub(crate) fn evidence(&self, cluster: usize, [points, free, edges]: [usize; 3]) -> Evidence {
        let members = &self.clusters[cluster];
        let beside = self.beside(cluster);
        let thinned = |count: usize, most: usize| (0..count).step_by(count.div_ceil(most).max(1));
        let first = members.first().map_or(self.rays.eye, |seen| seen.point);
        Evidence {
            eye: self.rays.eye,
            points: thinned(members.len(), points).map(|i| members[i].point).collect(),
            free: thinned(beside.len(), free).map(|i| self.rays.point(beside[i], self.passed(beside[i]))).collect(),
            edges: self.edges(cluster, edges),
            floor: self.floor,
            sigma: self.sigma,
            shared: self.shared,
            pitch: length(sub(first, self.rays.eye)) * length(self.rays.per_column),
        }
    }

    /// How far a ray has passed for certain, in metres of depth: noise may have put the point that it met a little behind.
    fn passed(&self, pixel: usize) -> f64 {
        let depth = f64::from(self.image.depth[pixel]);
        if self.sights[pixel] == Sight::Standing { depth - PASSED * self.sigma } else { depth }
    }

    /// At most `most` rays along a cluster's silhouette, evenly.
    fn edges(&self, cluster: usize, most: usize) -> Vec<Edge> {
        let width = self.image.width;
        let hides =
            |seen: &&Seen| seen.point[2] > HIDES.0 * self.rise(seen.pixel as usize) + HIDES.1 * self.sigma_above;
        let crossings: Vec<(Vector, silhouette::Crossing)> = self.clusters[cluster]
            .iter()
            .filter(hides)
            .flat_map(|seen| silhouette::beside(&self.sights, width, seen.pixel as usize).map(|at| (seen.point, at)))
            .collect();
        let edge = |(point, at): &(Vector, silhouette::Crossing)| {
            let [right, down] = silhouette::outwards(&self.sights, width, at)?;
            let [edge, way] =
                [0.0, BESIDE_EDGE].map(|off| self.rays.way_at(at.column + off * right, at.row + off * down));
            let (to_surface, away) = (-self.rays.eye[2] / way[2], length(sub(*point, self.rays.eye)));
            let [from, to] = [edge, way].map(|way| scale(way, 1.0 / length(way)));
            let (turn, level) = (length(sub(to, from)), from[0].hypot(from[1]).max(LEAST_LEVEL));
            // At the sides, points and the rays past them already determine where the object ends.
            if (to[2] - from[2]) / turn < UPWARDS * level {
                return None;
            }
            let beside = turn * away;
            Some(Edge {
                end: std::array::from_fn(|i| self.rays.eye[i] + to_surface * way[i]),
                beside,
                sigma: UNLIKE_AT_EDGES.hypot(at.sigma * beside / BESIDE_EDGE),
            })
        };
        let stride = crossings.len().div_ceil(most).max(1);
        crossings.iter().step_by(stride).filter_map(edge).collect()
    }

    /// The depths around a fork in its present pose.
    pub(crate) fn relief(&self, fit: &Fit) -> Relief {
        let [long, width, height] = fit.model().size();
        let (along, across) = (long / 2.0 + AROUND[0], width / 2.0 + AROUND[1]);
        let (sin, cos) = fit.yaw().sin_cos();
        let [x, y] = fit.at();
        let corners = [(along, across), (along, -across), (-along, across), (-along, -across)]
            .map(|(u, v)| [x + cos * u - sin * v, y + sin * u + cos * v]);
        let seen = corners.into_iter().flat_map(|[x, y]| [0.0, height].map(|z| self.rays.pixel([x, y, z])));
        let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for pixel in seen.flatten() {
            for axis in 0..2 {
                low[axis] = low[axis].min(pixel[axis]);
                high[axis] = high[axis].max(pixel[axis]);
            }
        }
        let size = [self.image.width, self.image.height];
        let range = |axis: usize| (low[axis].max(0.0) as usize)..((high[axis].max(0.0) as usize + 1).min(size[axis]));
        let mut depths = Vec::new();
        for row in range(1) {
            for column in range(0) {
                let Some(depth) = valid(self.image.depth[row * self.image.width + column]) else { continue };
                let way = self.rays.way(column, row);
                // The point at which the ray reaches the surface, and the height of the point that it met.
                let surface = -self.rays.eye[2] / way[2];
                let (u, v) = (self.rays.eye[0] + surface * way[0] - x, self.rays.eye[1] + surface * way[1] - y);
                let beside = (cos * u + sin * v).abs() > along || (cos * v - sin * u).abs() > across;
                if !beside && (self.rays.eye[2] + depth * way[2]).abs() < LOW {
                    depths.push(Depth { way, depth, pixel: [column as i32, row as i32] });
                }
            }
        }
        let stride = (depths.len() as f64 / MOST_DEPTHS).ceil().max(1.0) as usize;
        let distance = length(sub([x, y, 0.0], self.rays.eye));
        Relief {
            eye: self.rays.eye,
            depths: depths.into_iter().step_by(stride).collect(),
            sigma: self.sigma,
            shared: self.shared,
            pitch: distance * length(self.rays.per_column),
        }
    }

    /// Pixels beside a cluster that see past it, to the surface or to another cluster, each once.
    fn beside(&self, cluster: usize) -> Vec<usize> {
        let own = self.parts[cluster];
        let passes = |pixel: usize| match self.sights[pixel] {
            Sight::Free => true,
            Sight::Standing => self.owners[pixel] != NOBODY && !own.contains(&self.owners[pixel]),
            Sight::Missing | Sight::Flying => false,
        };
        let (width, rows) = (self.image.width as isize, self.image.height as isize);
        let mut found = Vec::new();
        for seen in &self.clusters[cluster] {
            let (column, row) = (seen.pixel as isize % width, seen.pixel as isize / width);
            for step in BESIDE {
                for (column, row) in
                    [(column - step, row), (column + step, row), (column, row - step), (column, row + step)]
                {
                    if (0..width).contains(&column) && (0..rows).contains(&row) {
                        let pixel = (row * width + column) as usize;
                        if passes(pixel) {
                            found.push(pixel);
                        }
                    }
                }
            }
        }
        found.sort_unstable();
        found.dedup();
        found
    }
}

/// Points near the expected surface, on a grid of columns and rows.
fn near_surface(image: &DepthImage, camera: &Camera, region: &Region) -> Vec<Vector> {
    let half = region.size.map(|edge| edge / 2.0);
    let rough = Rays::new(camera, &region.pose);
    let stride = (image.depth.len() as f64 / PLANE_POINTS as f64).sqrt().ceil().max(1.0) as usize;
    let near = (0..image.height)
        .step_by(stride)
        .flat_map(|row| (0..image.width).step_by(stride).map(move |column| row * image.width + column))
        .filter_map(|pixel| valid(image.depth[pixel]).map(|depth| rough.point(pixel, depth)))
        .filter(|p| p[0].abs() <= half[0] && p[1].abs() <= half[1] && p[2].abs() < PLANE_SLACK);
    near.collect()
}

/// The scatter of the points of a plane about it, and their number: 1.4826 times the median distance is a normal distribution's standard
/// deviation, whatever stands on the plane.
fn scatter(points: &[Vector], plane: &Plane) -> (f64, f64) {
    let mut off: Vec<f64> = points.iter().map(|p| plane.above(*p).abs()).filter(|off| *off < 0.02).collect();
    (1.4826 * median(&mut off).unwrap_or(0.0), off.len() as f64)
}

fn valid(depth: f32) -> Option<f64> {
    (depth.is_finite() && depth > 0.0).then_some(f64::from(depth))
}
