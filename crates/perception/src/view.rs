//! The image sorted by what each pixel says of a surface: it sees something that stands on it, or the surface is free there,
//! or nobody knows.

use crate::camera::{Camera, DepthImage};
use crate::cluster;
use crate::detection::{DetectionError, Region};
use crate::fit::relief::{Depth, Relief};
use crate::fit::{Edge, Evidence, Fit, UNLIKE_AT_EDGES};
use crate::flying::Heights;
use crate::level;
use crate::mask::{Ball, Mask};
use crate::plane::Plane;
use crate::silhouette::{self, Sight};
use crate::vector::{Vector, cross, dot, length, median, scale, sub};
use ratn_model::pose::Pose;

/// How far above or below its given pose the surface may be, in metres.
const PLANE_SLACK: f64 = 0.06;
/// Nothing taller stands on the surface, in metres.
const TALLEST: f64 = 0.25;
/// Something is seen by at least so many pixels.
const MIN_PIXELS: usize = 40;
/// So many deviations above the plane nothing belongs to it any more, and not less or more than these, in metres.
const CLEAR_OF_PLANE: f64 = 3.5;
const CLEARANCE: std::ops::RangeInclusive<f64> = 0.0035..=0.014;
/// What is this many deviations higher is hardly ever taken for the plane.
const UNBIASED: f64 = 1.5;
/// Points that the plane is estimated from, about; the rest are left out evenly.
const PLANE_POINTS: usize = 12_000;
/// The least part of a depth's deviation that counts as height above the plane: a camera that looks along it says nothing else.
const LEAST_FALL: f64 = 0.2;
/// The least part of a ray that is taken for level: straight from above no wall is seen.
const LEAST_LEVEL: f64 = 0.3;
/// An edge is on the far side of something where the way across it goes up by this cosine: nothing else says where it ends there.
const UPWARDS: f64 = 0.6;
/// How far outside of the silhouette the rays are whose distance from a model is compared, in pixels.
const BESIDE_EDGE: f64 = 2.5;
/// What is so many deviations nearer than what a ray met has been passed by it.
const PASSED: f64 = 3.0;
/// What is higher than a wall of so many pixels, and than noise in so many deviations, hides some of the surface behind it.
const HIDES: (f64, f64) = (2.0, 4.0);
/// A depth is not more certain than this, in metres.
const LEAST_SIGMA: f64 = 0.0004;
/// Which pixels around a cluster's are asked whether they see past it, in steps along rows and columns.
const BESIDE: [isize; 4] = [1, 2, 3, 5];
/// How far around a fork, along it and across, depths are compared with what they should be, and how high above or below the surface, in metres.
const AROUND: [f64; 2] = [0.035, 0.012];
const LOW: f64 = 0.035;
/// Not more of them, about.
const MOST_DEPTHS: f64 = 1200.0;
/// What stands on the plane lifts it by about so much of its points' deviation: low parts are taken for it.
const LIFT: f64 = 0.08;
/// No cluster.
const NOBODY: u16 = u16::MAX;
/// RANSAC's choices: any number does; the same image gives the same objects.
const SEED: u64 = 0x5EED;

/// What is seen on a surface.
pub(crate) struct View<'a> {
    image: &'a DepthImage,
    rays: Rays,
    /// What each pixel says of the surface.
    sights: Vec<Sight>,
    /// The surface's frame in the world: on the plane as seen, its z axis the plane's normal.
    pub(crate) frame: Pose,
    /// What stands on it: pixels, the largest cluster first.
    pub(crate) clusters: Vec<Vec<Seen>>,
    /// Of each cluster, which ones of the first it is made of.
    parts: Vec<[u16; 2]>,
    /// Of each pixel, which of the first clusters it belongs to.
    owners: Vec<u16>,
    /// Standard deviation of a depth, and of a height above the surface, in metres.
    sigma: f64,
    sigma_above: f64,
    /// Of what the noise of neighbouring pixels has in common, in metres of depth.
    shared: f64,
    /// See [`Evidence`].
    floor: f64,
    /// How well the plane is known: the variance of its height, in metres², and of its slope.
    pub(crate) plane_variance: [f64; 2],
}

/// A pixel of a cluster and the point it sees, in the surface's frame.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Seen {
    pixel: u32,
    pub(crate) point: Vector,
}

/// Every pixel's ray in a frame: its direction is linear in column and row.
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

    /// The direction of a pixel's ray: times the depth it is the way from the eye.
    fn way(&self, column: usize, row: usize) -> Vector {
        self.way_at(column as f64, row as f64)
    }

    fn way_at(&self, column: f64, row: f64) -> Vector {
        std::array::from_fn(|i| self.origin[i] + column * self.per_column[i] + row * self.per_row[i])
    }

    /// Column and row at which a point appears; `None` behind the camera.
    fn pixel(&self, point: Vector) -> Option<[f64; 2]> {
        let to = sub(point, self.eye);
        // The axes are orthogonal, those of columns and rows as long as a pixel at a depth of 1.
        let ahead = cross(self.per_column, self.per_row);
        let depth = dot(to, ahead) / length(ahead);
        let at = |axis: Vector| (dot(to, axis) / depth - dot(self.origin, axis)) / dot(axis, axis);
        (depth > 1e-6).then(|| [at(self.per_column), at(self.per_row)])
    }
}

impl<'a> View<'a> {
    /// `deviation`: how far from its given pose the surface is, in metres, as a normal distribution's.
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
            // The variance of places spread evenly over the region's shorter edge is a third of its half, squared.
            plane_variance: [variance + (LIFT * sigma_above).powi(2), variance * 3.0 / half[0].min(half[1]).powi(2)],
        };
        let mask = Mask::new(body, &frame, [half[0], half[1], TALLEST]);
        let above =
            view.sort(clear, clear_in_mean, |p| p[0].abs() <= half[0] && p[1].abs() <= half[1] && !mask.hides(*p));
        view.gather(&above);
        Ok(view)
    }

    /// Marks what is free, and says what stands within the region: what is itself clear of the plane, and what is so in the mean
    /// with the pixels around it.
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

    /// How much higher an upright wall is by a pixel where this one sees it, in metres.
    fn rise(&self, pixel: usize) -> f64 {
        let way = self.rays.way(pixel % self.image.width, pixel / self.image.width);
        let level = (way[0].hypot(way[1]) / length(way)).max(LEAST_LEVEL);
        f64::from(self.image.depth[pixel]) * length(self.rays.per_row) / level
    }

    /// How far each pixel's point is above the surface, in metres; not a number where nothing came back.
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
        // What the image cuts off is not known to its end.
        self.clusters = seen.filter(|cluster| !cluster.iter().any(at_border)).collect();
        for (number, cluster) in self.clusters.iter().enumerate() {
            self.parts.push([number as u16; 2]);
            cluster.iter().for_each(|seen| self.owners[seen.pixel as usize] = number as u16);
        }
    }

    /// Two clusters as one more, unless their middles are farther apart than `most`.
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

    /// At most `points` of a cluster's points, evenly, and at most `free` of the rays beside it.
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

    /// How far a ray has surely passed, in metres of depth: where it met something, noise may have put it a little behind.
    fn passed(&self, pixel: usize) -> f64 {
        let depth = f64::from(self.image.depth[pixel]);
        if self.sights[pixel] == Sight::Standing { depth - PASSED * self.sigma } else { depth }
    }

    /// At most so many rays along a cluster's silhouette, evenly.
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
            // At the sides, points and the rays past them say where it ends.
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

    /// The depths around a fork, as it lies now.
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
                // Where the ray reaches the surface, and how high what it met is.
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

    /// Pixels beside a cluster that see past it, the surface or another cluster, each once.
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

/// Points about where the surface should be, of every so many columns and rows.
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

/// How much the points of a plane scatter about it, and how many there are: 1.4826 times the median distance is a normal
/// distribution's deviation, whatever stands on the plane.
fn scatter(points: &[Vector], plane: &Plane) -> (f64, f64) {
    let mut off: Vec<f64> = points.iter().map(|p| plane.above(*p).abs()).filter(|off| *off < 0.02).collect();
    (1.4826 * median(&mut off).unwrap_or(0.0), off.len() as f64)
}

fn valid(depth: f32) -> Option<f64> {
    (depth.is_finite() && depth > 0.0).then_some(f64::from(depth))
}
