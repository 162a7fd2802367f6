//! A trajectory between two of its knots in closed form: one joint's cubic with its extremes.

use crate::trajectory::Knot;

/// One joint between two knots: q + v t + a t² / 2 + j t³ / 6.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct Cubic {
    /// Seconds between the knots.
    pub(crate) lasts_s: f64,
    /// At the beginning.
    pub(crate) position: f64,
    /// At the beginning.
    pub(crate) velocity: f64,
    /// At the beginning.
    pub(crate) acceleration: f64,
    /// Constant.
    pub(crate) jerk: f64,
}

impl Cubic {
    /// Joint `j` between two knots.
    pub(crate) fn between<P: AsRef<[f64]>>(a: &Knot<P>, b: &Knot<P>, j: usize) -> Cubic {
        let h = b.time_s - a.time_s;
        let [p0, p1] = [a, b].map(|knot| knot.positions.as_ref()[j]);
        let [v0, v1] = [a, b].map(|knot| knot.velocities.as_ref()[j]);
        let mean = (p1 - p0) / h;
        Cubic {
            lasts_s: h,
            position: p0,
            velocity: v0,
            acceleration: (6.0 * mean - 4.0 * v0 - 2.0 * v1) / h,
            jerk: 6.0 * (v0 + v1 - 2.0 * mean) / (h * h),
        }
    }

    /// The position at a time since the beginning.
    pub(crate) fn position_at(&self, t: f64) -> f64 {
        self.position + t * (self.velocity + t * (self.acceleration / 2.0 + t * self.jerk / 6.0))
    }

    pub(crate) fn velocity_at(&self, t: f64) -> f64 {
        self.velocity + t * (self.acceleration + t * self.jerk / 2.0)
    }

    pub(crate) fn acceleration_at(&self, t: f64) -> f64 {
        self.acceleration + t * self.jerk
    }

    /// The maximum absolute velocity.
    pub(crate) fn greatest_velocity(&self) -> f64 {
        let ends = self.velocity.abs().max(self.velocity_at(self.lasts_s).abs());
        // At the zero of the acceleration, which is linear.
        match self.turns_at(-self.acceleration / self.jerk) {
            Some(t) => ends.max(self.velocity_at(t).abs()),
            None => ends,
        }
    }

    /// The maximum absolute acceleration: at one of the ends.
    pub(crate) fn greatest_acceleration(&self) -> f64 {
        self.acceleration.abs().max(self.acceleration_at(self.lasts_s).abs())
    }

    /// The minimum and maximum position between two times.
    pub(crate) fn range(&self, from: f64, to: f64) -> [f64; 2] {
        let (a, b) = (self.position_at(from), self.position_at(to));
        let mut range = [a.min(b), a.max(b)];
        for t in self.standstills().into_iter().flatten().filter(|t| from < *t && *t < to) {
            let q = self.position_at(t);
            range = [range[0].min(q), range[1].max(q)];
        }
        range
    }

    /// When the velocity, a quadratic, is zero.
    fn standstills(&self) -> [Option<f64>; 2] {
        let (a, b, c) = (self.jerk / 2.0, self.acceleration, self.velocity);
        let square = b * b - 4.0 * a * c;
        if square < 0.0 {
            return [None, None];
        }
        // The roots without cancellation; one of them is not finite if the velocity is linear.
        let q = -0.5 * (b + square.sqrt().copysign(b));
        [self.turns_at(q / a), self.turns_at(c / q)]
    }

    fn turns_at(&self, t: f64) -> Option<f64> {
        (t.is_finite() && 0.0 < t && t < self.lasts_s).then_some(t)
    }
}
