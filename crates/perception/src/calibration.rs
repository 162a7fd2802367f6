//! Adds the camera's calibration error to a detection's covariance, and corrects both by a surface of known height.
//!
//! A detection is relative to the camera's pose as given. If that pose is wrong by a small displacement t and a small rotation r along and about
//! the axes of the optical frame, an object at p in that frame is wrong by t + r × p: with 0.1° at 1.3 m that is 2 mm, more than the noise. To
//! first order the two covariances add. Many surfaces are known better than that: a table top has a known height and is level. Then the surface
//! on which an object was seen measures the calibration: an update of a Kalman filter (Kalman 1960) with the height and the two slopes, one
//! after the other, corrects all components that correlate with them.

use crate::camera::Camera;
use crate::detection::Detection;
use crate::vector::{cross, sub};
use ratn_model::pose::Pose;

/// Covariance of a pose: x, y, z in metres, then small rotations about these axes in radians.
type Covariance = [[f64; 6]; 6];

/// Variances of a camera's pose: displacements along and small rotations about the axes of its optical frame, in metres² and radians².
pub type Calibration = [f64; 6];

/// A level surface of known height.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Surface {
    /// Its height, in metres.
    pub height_m: f64,
    /// The standard deviation of the height, in metres.
    pub sigma_m: f64,
    /// The standard deviation of its slope about any axis, in radians.
    pub sigma_rad: f64,
}

/// Maximum distance of an object from a surface on which it can stand, in standard deviations.
const GATE: f64 = 5.0;

impl Detection {
    /// Adds the error of the camera's calibration to the covariance.
    #[must_use]
    pub fn with_calibration(mut self, camera: &Camera, calibration: &Calibration) -> Detection {
        let shared = self.by_calibration(camera, calibration);
        self.covariance = each(|row, column| self.covariance[row][column] + shared[row][column]);
        self
    }

    /// The covariance that follows from the calibration alone.
    fn by_calibration(&self, camera: &Camera, calibration: &Calibration) -> Covariance {
        let from_camera = sub(self.pose.position, camera.pose.position);
        let mut covariance = [[0.0; 6]; 6];
        for (i, variance) in calibration.iter().enumerate() {
            let axis = camera.pose.rotate(std::array::from_fn(|k| f64::from(u8::from(k == i % 3))));
            // How an error along or about this axis displaces and rotates what is seen.
            let (moves, turns) = if i < 3 { (axis, [0.0; 3]) } else { (cross(axis, from_camera), axis) };
            let along = |k: usize| if k < 3 { moves[k] } else { turns[k - 3] };
            covariance = each(|row, column| covariance[row][column] + variance * along(row) * along(column));
        }
        covariance
    }

    /// Corrects a detection, whose covariance includes the calibration, by a surface on which it is known to stand, unless it is too far above
    /// or below the surface.
    ///
    /// The gains follow from the calibration's correlations, not from those of the fit: where a fit leaves a direction undetermined, its
    /// covariance has metres there, and a tenth of a millimetre of height would move the object by centimetres.
    #[must_use]
    pub fn standing_on(mut self, surface: &Surface, camera: &Camera, calibration: &Calibration) -> Detection {
        let up = self.pose.rotate([0.0, 0.0, 1.0]);
        let below = self.pose.position[2] - self.model.size()[2] / 2.0;
        let (missing, variance) = (surface.height_m - below, surface.sigma_m.powi(2));
        if missing.powi(2) > GATE.powi(2) * (self.covariance[2][2] + variance) {
            return self;
        }
        // The gains are those of a detection whose own errors are independent of each other.
        let shared = self.by_calibration(camera, calibration);
        let own = |k: usize| self.covariance[k][k] - shared[k][k];
        let mut gains_of = each(|row, column| shared[row][column] + if row == column { own(row) } else { 0.0 });
        // After each measurement, the remaining error depends on the change so far.
        let mut change = [0.0; 6];
        let slope = surface.sigma_rad.powi(2);
        for (of, missing, variance) in [(2, missing, variance), (3, up[1], slope), (4, -up[0], slope)] {
            let gain: [f64; 6] = std::array::from_fn(|k| gains_of[k][of] / (gains_of[of][of] + variance));
            let innovation = missing - change[of];
            (0..6).for_each(|k| change[k] += gain[k] * innovation);
            gains_of = updated(&gains_of, of, &gain, variance);
            self.covariance = updated(&self.covariance, of, &gain, variance);
        }
        let [x, y, z, roll, pitch, yaw] = change;
        let Pose { position, .. } = self.pose;
        let turned = Pose::from_rpy([0.0; 3], roll, pitch, yaw).compose(&Pose { position: [0.0; 3], ..self.pose });
        self.pose = Pose { position: [position[0] + x, position[1] + y, position[2] + z], ..turned };
        self
    }
}

/// The covariance after a measurement of one component with a variance, for any gain (Joseph form).
fn updated(before: &Covariance, of: usize, gain: &[f64; 6], variance: f64) -> Covariance {
    each(|row, column| {
        before[row][column] - gain[row] * before[of][column] - before[row][of] * gain[column]
            + gain[row] * (before[of][of] + variance) * gain[column]
    })
}

fn each(entry: impl Fn(usize, usize) -> f64) -> Covariance {
    std::array::from_fn(|row| std::array::from_fn(|column| entry(row, column)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Intrinsics;
    use crate::model::Model;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    const SIGMA_M: f64 = 0.002;
    const SIGMA_RAD: f64 = 0.003;
    /// Standard deviation of a detection's own error.
    const OWN_M: f64 = 0.0005;
    const SIZE: [f64; 3] = [0.12, 0.07, 0.10];
    const TABLE: Surface = Surface { height_m: 0.7, sigma_m: 0.001, sigma_rad: 0.0005 };

    fn camera() -> Camera {
        Camera::looking([0.1, 0.0, 1.75], [0.8, 0.0, 0.7], Intrinsics::DEFAULT)
    }

    fn calibration() -> Calibration {
        std::array::from_fn(|i| if i < 3 { SIGMA_M } else { SIGMA_RAD }.powi(2))
    }

    /// Boxes on a table as seen by a camera with a calibration error, and their true poses.
    fn seen() -> Vec<(Detection, Pose)> {
        let (camera, calibration) = (camera(), calibration());
        let mut random = ChaCha8Rng::seed_from_u64(7);
        // The sum of twelve uniforms is about normal.
        let mut normal = move |sigma: f64| sigma * ((0..12).map(|_| random.random::<f64>()).sum::<f64>() - 6.0);
        let once = |i: usize| {
            let on = TABLE.height_m + normal(TABLE.sigma_m);
            let truth = Pose::from_rpy([0.8, 0.02 * (i % 50) as f64 - 0.5, on + SIZE[2] / 2.0], 0.0, 0.0, 0.3);
            let place = std::array::from_fn(|_| normal(SIGMA_M));
            let error = Pose::from_rpy(place, normal(SIGMA_RAD), normal(SIGMA_RAD), normal(SIGMA_RAD));
            let mut pose = camera.pose.compose(&error.inverse()).compose(&camera.pose.inverse().compose(&truth));
            pose.position = pose.position.map(|x| x + normal(OWN_M));
            let mut covariance = [[0.0; 6]; 6];
            (0..3).for_each(|k| covariance[k][k] = OWN_M.powi(2));
            (3..6).for_each(|k| covariance[k][k] = 1e-8);
            let alone = Detection { model: Model::Box { size: SIZE }, pose, covariance, confidence: 1.0 };
            (alone.with_calibration(&camera, &calibration), truth)
        };
        (0..500).map(once).collect()
    }

    /// The mean squared position error weighted by the inverse covariance, divided by its three dimensions.
    fn normalised_square(of: &[(Detection, Pose)]) -> f64 {
        let one = |(seen, truth): &(Detection, Pose)| {
            let e = sub(seen.pose.position, truth.position);
            let [a, b, c]: [[f64; 3]; 3] = std::array::from_fn(|i| std::array::from_fn(|j| seen.covariance[i][j]));
            // Cramer's rule: the rows of the inverse are the cross products of those of the symmetric matrix.
            let rows = [cross(b, c), cross(c, a), cross(a, b)];
            let determinant: f64 = (0..3).map(|k| a[k] * rows[0][k]).sum();
            let weighted: f64 = (0..3).map(|i| e[i] * (0..3).map(|j| rows[i][j] * e[j]).sum::<f64>()).sum();
            weighted / determinant / 3.0
        };
        of.iter().map(one).sum::<f64>() / of.len() as f64
    }

    fn rms(of: &[(Detection, Pose)], axes: &[usize]) -> f64 {
        let square = |(seen, truth): &(Detection, Pose)| {
            axes.iter().map(|i| (seen.pose.position[*i] - truth.position[*i]).powi(2)).sum::<f64>()
        };
        (of.iter().map(square).sum::<f64>() / of.len() as f64).sqrt()
    }

    #[test]
    fn what_the_calibration_is_off_is_in_the_covariance() {
        let seen = seen();
        assert!((normalised_square(&seen) - 1.0).abs() < 0.1, "{}", normalised_square(&seen));
        assert!(rms(&seen, &[2]) > 0.002, "the errors are larger than a detection's own");
    }

    #[test]
    fn a_surface_of_known_height_corrects_height_and_slope_and_what_goes_with_them() {
        let before = seen();
        let after: Vec<_> =
            before.iter().map(|(seen, truth)| (seen.standing_on(&TABLE, &camera(), &calibration()), *truth)).collect();
        assert!((normalised_square(&after) - 1.0).abs() < 0.1, "{}", normalised_square(&after));
        assert!(rms(&after, &[2]) < 0.5 * rms(&before, &[2]), "{} {}", rms(&before, &[2]), rms(&after, &[2]));
        assert!(rms(&after, &[0, 1]) < 0.95 * rms(&before, &[0, 1]));
        let leans = |pose: &Pose| pose.rotate([0.0, 0.0, 1.0])[2].clamp(-1.0, 1.0).acos();
        let most = |of: &[(Detection, Pose)]| of.iter().map(|(seen, _)| leans(&seen.pose)).fold(0.0, f64::max);
        assert!(most(&after) < 0.5 * most(&before), "{} {}", most(&before), most(&after));
    }

    #[test]
    fn what_stands_on_something_else_is_left_where_it_was_seen() {
        let (seen, _) = seen().swap_remove(0);
        assert_eq!(seen.standing_on(&Surface { height_m: 0.75, ..TABLE }, &camera(), &calibration()), seen);
    }

    #[test]
    fn what_a_fit_leaves_open_is_not_moved_by_a_little_height() {
        let (mut seen, _) = seen().swap_remove(0);
        // A box whose ends were not seen: its variance along y is metres, with a small correlation to z.
        seen.covariance = [[0.0; 6]; 6];
        (seen.covariance[0][0], seen.covariance[1][1], seen.covariance[2][2]) = (1e-6, 4.0, 1e-6);
        (seen.covariance[1][2], seen.covariance[2][1]) = (1.9e-3, 1.9e-3);
        seen.pose = Pose::at(0.8, 0.1, TABLE.height_m + SIZE[2] / 2.0 + 1e-4);
        let stands = seen.standing_on(&TABLE, &camera(), &[0.0; 6]);
        assert!((stands.pose.position[1] - 0.1).abs() < 1e-9, "{:?}", stands.pose);
        assert!((stands.pose.position[2] - seen.pose.position[2]).abs() > 4e-5);
    }
}
