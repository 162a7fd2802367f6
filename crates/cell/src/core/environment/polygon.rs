//! Convex polygons in a plane, also those that are a line or a point.

/// Corners, counterclockwise.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Polygon(Vec<[f64; 2]>);

impl Polygon {
    /// The polygon of these corners (at least one), given in any order.
    pub(super) fn around(corners: Vec<[f64; 2]>) -> Polygon {
        let mut polygon = Polygon(corners);
        let [x, y] = polygon.middle();
        polygon.0.sort_by(|p, q| {
            let [p, q] = [p, q].map(|corner| (corner[1] - y).atan2(corner[0] - x));
            p.total_cmp(&q)
        });
        polygon
    }

    /// The mean of its corners.
    pub(super) fn middle(&self) -> [f64; 2] {
        let count = self.0.len().max(1) as f64;
        [0, 1].map(|i| self.0.iter().map(|corner| corner[i]).sum::<f64>() / count)
    }

    /// The nearest of its points to another point.
    pub(super) fn nearest(&self, to: [f64; 2]) -> [f64; 2] {
        let edges = || self.0.iter().zip(self.0.iter().cycle().skip(1));
        let turn = |([ax, ay], [bx, by]): (&[f64; 2], &[f64; 2])| (bx - ax) * (to[1] - ay) - (by - ay) * (to[0] - ax);
        if self.0.len() > 2 && edges().all(|edge| turn(edge) >= 0.0) {
            return to;
        }
        let on = |([ax, ay], [bx, by]): (&[f64; 2], &[f64; 2])| {
            let (x, y) = (bx - ax, by - ay);
            let share = ((to[0] - ax) * x + (to[1] - ay) * y) / (x * x + y * y).max(f64::MIN_POSITIVE);
            let share = share.clamp(0.0, 1.0);
            [ax + x * share, ay + y * share]
        };
        let far = |[x, y]: [f64; 2]| (x - to[0]).hypot(y - to[1]);
        edges().map(on).min_by(|p, q| far(*p).total_cmp(&far(*q))).unwrap_or(to)
    }
}
