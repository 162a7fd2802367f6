//! Where a box comes to rest when the fingers let go of it.
//!
//! It stands where it was let go if something is right below its centre; otherwise it falls onto whatever is there and lies
//! on its side. No dynamics: a box that falls is a failure, and where it ends is only approximate.

use super::boxes::Place;
use ratn_model::pose::Pose;
use std::f64::consts::FRAC_PI_2;

/// A level surface that something can stand on.
#[derive(Debug, Clone, PartialEq)]
pub struct Surface {
    /// Its name.
    pub name: String,
    /// The middle of it; x and y of this frame span it.
    pub pose: Pose,
    /// Extents along x and y, in metres.
    pub size: [f64; 2],
}

/// How far above a surface a box may be let go and still stand, in metres.
pub const MAX_DROP_M: f64 = 0.012;
/// How deep it may have been pressed into it, in metres.
const MAX_PRESSED_M: f64 = 0.015;
/// How far it may lean and still stand up.
const MAX_LEAN_RAD: f64 = 0.2;
/// The floor.
pub const FLOOR: &str = "floor";

/// The place of a box let go at `pose`.
pub fn settle(pose: &Pose, size: &[f64; 3], surfaces: &[Surface]) -> Place {
    // The face that looks down most, and how much it leans.
    let axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]].map(|a| pose.rotate(a));
    let down = (0..3).max_by(|a, b| axes[*a][2].abs().total_cmp(&axes[*b][2].abs())).unwrap_or(2);
    let lean = axes[down][2].abs().min(1.0).acos();
    let bottom = pose.position[2] - size[down] / 2.0;
    let below = surfaces
        .iter()
        .filter(|s| s.is_below(pose.position) && s.pose.position[2] <= bottom + MAX_PRESSED_M)
        .max_by(|a, b| a.pose.position[2].total_cmp(&b.pose.position[2]));
    let (name, top) = below.map_or((FLOOR, 0.0), |s| (s.name.as_str(), s.pose.position[2]));
    let stands = bottom - top <= MAX_DROP_M && lean <= MAX_LEAN_RAD;
    let heading = pose.rotate(if down == 0 { [0.0, 1.0, 0.0] } else { [1.0, 0.0, 0.0] });
    let yaw = heading[1].atan2(heading[0]);
    let [x, y, _] = pose.position;
    if stands && down == 2 {
        // Upside down is as good: a box has no top.
        let pose = Pose::from_rpy([x, y, top + size[2] / 2.0], 0.0, 0.0, yaw);
        return Place::At { pose, on: name.to_owned(), standing: true };
    }
    if stands {
        let pose = Pose { position: [x, y, top + size[down] / 2.0], ..*pose };
        return Place::At { pose, on: name.to_owned(), standing: true };
    }
    let pose = Pose::from_rpy([x, y, top + size[1] / 2.0], FRAC_PI_2, 0.0, yaw);
    Place::At { pose, on: name.to_owned(), standing: false }
}

impl Surface {
    fn is_below(&self, point: [f64; 3]) -> bool {
        let [x, y, _] = self.pose.inverse().transform(point);
        x.abs() <= self.size[0] / 2.0 && y.abs() <= self.size[1] / 2.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: [f64; 3] = [0.12, 0.07, 0.10];

    fn deck() -> Vec<Surface> {
        vec![Surface { name: "base".to_owned(), pose: Pose::at(0.0, 0.0, 0.6), size: [0.5, 0.5] }]
    }

    #[test]
    fn a_box_let_go_just_above_a_surface_stands_on_it() {
        let Place::At { pose, on, standing } =
            settle(&Pose::from_rpy([0.1, 0.1, 0.655], 0.02, 0.0, 0.7), &SIZE, &deck())
        else {
            panic!("nobody holds it")
        };
        assert!(standing && on == "base");
        assert!((pose.position[2] - 0.65).abs() < 1e-9);
        assert!(pose.angle(&Pose::from_rpy([0.0; 3], 0.0, 0.0, 0.7)) < 1e-6);
    }

    #[test]
    fn a_box_let_go_high_above_falls_over() {
        assert!(matches!(
            settle(&Pose::at(0.1, 0.1, 0.72), &SIZE, &deck()),
            Place::At { on, standing: false, .. } if on == "base"
        ));
    }

    #[test]
    fn a_box_let_go_beside_the_surface_falls_to_the_floor() {
        assert!(matches!(
            settle(&Pose::at(0.27, 0.1, 0.652), &SIZE, &deck()),
            Place::At { on, standing: false, .. } if on == FLOOR
        ));
    }
}
