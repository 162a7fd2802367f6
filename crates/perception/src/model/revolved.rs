//! Walls of even thickness revolved about an axis: a polyline of (radius, height) is the middle of the wall.

use super::Round;
use super::form::{BELLY, Form, LIFT};

/// A point of the half plane: distance from the axis and height above the table, in metres.
pub(super) type Point = [f64; 2];

/// Thickness of the walls, in metres.
const WALL: f64 = 0.004;

/// Width of the rim around a can's lid, in metres.
const RIM: f64 = 0.003;

/// Height of the seam that protrudes from a can's side at its top, in metres.
const SEAM: f64 = 0.004;

/// A round object: its greatest radius, its height, and its form (see [`super::form`]).
#[derive(Debug, Clone, Copy)]
pub(super) struct Turned {
    pub(super) kind: Round,
    pub(super) radius: f64,
    pub(super) height: f64,
    pub(super) form: Form,
}

/// The middle of the wall from the axis to the rim, as parts of the radius and the height that remain without the wall itself; and the part of
/// the form's belly by which each point moves outwards.
fn shape(kind: Round) -> &'static [[f64; 3]] {
    match kind {
        Round::Can => &[],
        Round::Cup => &[[0.0, 0.0, 0.0], [0.78, 0.0, 1.0], [1.0, 1.0, 0.0]],
        Round::Bowl => &[[0.0, 0.0, 0.0], [0.45, 0.0, 0.5], [0.74, 0.22, 1.0], [0.91, 0.56, 0.6], [1.0, 1.0, 0.0]],
        Round::Plate => &[[0.0, 0.0, 0.0], [0.60, 0.0, 1.0], [0.72, 0.42, 1.0], [1.0, 1.0, 0.0]],
    }
}

/// The middle of the wall, in metres.
fn wall(of: &Turned) -> impl Iterator<Item = Point> + Clone + use<> {
    let half = WALL / 2.0;
    let (across, bottom) = (of.radius - half, half + of.form[LIFT]);
    let (belly, rise) = (of.form[BELLY], of.height - half - bottom);
    shape(of.kind).iter().map(move |[r, z, out]| [(r * across + out * belly).min(across), bottom + z * rise])
}

/// How much the topmost part of the wall leans outwards, in radians from upright; `None` for closed objects.
pub(super) fn rim_lean(of: &Turned) -> Option<f64> {
    let (below, rim) = pairs(wall(of)).last()?;
    Some((rim[0] - below[0]).atan2(rim[1] - below[1]))
}

/// Both sides of a wall count as seen when it is this close to edge-on: the cosine between its normal and the ray.
const EDGE_ON: f64 = 0.15;

/// Signed distance from the side of the wall that faces the eye: a point that noise has put behind a wall of 4 mm still belongs to the side
/// that was seen. `to_eye` is the vector from the point to the eye, outwards and up.
pub(super) fn distance(of: &Turned, point: Point, to_eye: Point) -> f64 {
    if of.kind == Round::Can {
        return can_distance(of, point, to_eye);
    }
    let half = WALL / 2.0;
    let nearest = pairs(wall(of))
        .map(|(a, b)| (square_from_segment(point, a, b), a, b))
        .min_by(|left, right| left.0.total_cmp(&right.0));
    let Some((square, a, b)) = nearest else { return f64::INFINITY };
    let outwards = normal(a, b);
    let facing = outwards[0] * to_eye[0] + outwards[1] * to_eye[1];
    let off = outwards[0] * (point[0] - a[0]) + outwards[1] * (point[1] - a[1]);
    // The rim is seen from all sides.
    let along = [b[0] - a[0], b[1] - a[1]];
    let past = (point[0] - b[0]) * along[0] + (point[1] - b[1]) * along[1];
    let at_rim = b[1] >= of.height - WALL && past > -half * along[0].hypot(along[1]);
    let behind = facing.abs() > EDGE_ON * to_eye[0].hypot(to_eye[1]) && off * facing < 0.0 && !at_rim;
    if behind { -square.sqrt() - half } else { square.sqrt() - half }
}

/// Signed distance from the wall itself.
fn from_wall(of: &Turned, point: Point) -> f64 {
    let squares = pairs(wall(of)).map(|(a, b)| square_from_segment(point, a, b));
    squares.fold(f64::INFINITY, f64::min).sqrt() - WALL / 2.0
}

/// Signed distance from the object filled to its rim.
pub(super) fn fill_distance(of: &Turned, point: Point) -> f64 {
    let (radius, height) = (of.radius, of.height);
    if of.kind == Round::Can {
        let [r, z] = point;
        let seam = cylinder_distance(radius, SEAM, [r, z - height + SEAM]);
        return cylinder_distance(radius + of.form[BELLY], height, point).min(seam);
    }
    let to_wall = from_wall(of, point);
    let [r, z] = point;
    if z < 0.0 || z > height {
        return to_wall.min(if z > height && r < radius { z - height } else { f64::INFINITY });
    }
    // Inside the hollow the distance is negative: the smaller of the depth below the rim and below the outer side.
    let inside = pairs(wall(of))
        .find(|(a, b)| b[1] > a[1] && (a[1]..=b[1]).contains(&z))
        .is_some_and(|(a, b)| r < a[0] + (b[0] - a[0]) * (z - a[1]) / (b[1] - a[1]));
    if inside { -(to_wall.max(0.0) + WALL).min(height - z) } else { to_wall }
}

/// The outline of the material: from the axis at the bottom, around the rim, back to the axis above. Corners are mitred.
pub(super) fn outline(of: &Turned) -> Vec<Point> {
    let (radius, height) = (of.radius, of.height);
    if of.kind == Round::Can {
        return vec![[0.0, 0.0], [radius, 0.0], [radius, height], [0.0, height]];
    }
    let middle: Vec<Point> = wall(of).collect();
    let side = |sign: f64| -> Vec<Point> {
        (0..middle.len())
            .map(|i| {
                let before = (i > 0).then(|| normal(middle[i - 1], middle[i]));
                let after = (i + 1 < middle.len()).then(|| normal(middle[i], middle[i + 1]));
                let (a, b) = (before.or(after).unwrap_or([0.0; 2]), after.or(before).unwrap_or([0.0; 2]));
                let along = 1.0 + a[0] * b[0] + a[1] * b[1];
                let offset = [0, 1].map(|k| sign * WALL / 2.0 * (a[k] + b[k]) / along);
                [middle[i][0] + offset[0], middle[i][1] + offset[1]]
            })
            .collect()
    };
    let mut outline = side(1.0);
    // The rim ends half a wall beyond the middle line's end.
    if let [.., before, last] = middle[..] {
        let beyond = normal(before, last);
        outline.push([last[0] - beyond[1] * WALL / 2.0, last[1] + beyond[0] * WALL / 2.0]);
    }
    outline.extend(side(-1.0).into_iter().rev());
    outline
}

/// The unit normal to the right of the direction from `a` to `b`: outwards.
fn normal(a: Point, b: Point) -> Point {
    let length = (b[0] - a[0]).hypot(b[1] - a[1]);
    [(b[1] - a[1]) / length, (a[0] - b[0]) / length]
}

/// Signed distance from the lid or the near side of a can, for a point that noise has moved along its ray. The far side is not seen, so points
/// behind it belong to the lid; points in front of the near edge belong to the one of the two that their ray meets.
fn can_distance(of: &Turned, [r, z]: Point, to_eye: Point) -> f64 {
    let lid = if r < of.radius - RIM { of.height + of.form[LIFT] } else { of.height };
    let above = z - lid;
    // The point at which the ray passes through the lid's plane.
    let through = r - to_eye[0] * above / to_eye[1].max(1e-9);
    let hidden = above < 0.0 && to_eye[0] < -EDGE_ON * to_eye[0].hypot(to_eye[1]);
    if (hidden || above > 0.0) && through < of.radius {
        return above;
    }
    let radius = if z < of.height - SEAM { of.radius + of.form[BELLY] } else { of.radius };
    if above > 0.0 && to_eye[0] > 0.0 { r - radius } else { cylinder_distance(radius, lid, [r, z]) }
}

fn cylinder_distance(radius: f64, height: f64, [r, z]: Point) -> f64 {
    let (across, along) = (r - radius, (z - height / 2.0).abs() - height / 2.0);
    (across.max(0.0).powi(2) + along.max(0.0).powi(2)).sqrt() + across.max(along).min(0.0)
}

fn pairs(points: impl Iterator<Item = Point> + Clone) -> impl Iterator<Item = (Point, Point)> {
    points.clone().zip(points.skip(1))
}

fn square_from_segment(p: Point, a: Point, b: Point) -> f64 {
    let (along, to) = ([b[0] - a[0], b[1] - a[1]], [p[0] - a[0], p[1] - a[1]]);
    let t = ((to[0] * along[0] + to[1] * along[1]) / (along[0] * along[0] + along[1] * along[1])).clamp(0.0, 1.0);
    (to[0] - t * along[0]).powi(2) + (to[1] - t * along[1]).powi(2)
}
