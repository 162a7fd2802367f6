//! What two flat fingers hold by friction, and how it slips if that is not enough.
//!
//! Each pad presses with a force `N`; a patch of each touches the object. In the plane of the pads (x and z of the tool frame) friction can bear a
//! force and a torque about the closing axis (y) within an ellipsoid, the limit surface of Howe and Cutkosky ("Practical force-motion models for
//! sliding manipulation", IJRR 1996): (f / f_max)² + (τ / τ_max)² ≤ 1 with f_max = 2 μ N and τ_max = f_max times the mean lever of the patch.
//! Within it the object sticks; outside it slides along the normal of the surface. So a box held too weakly slides down, and one held off its
//! centre of mass turns until it hangs. The caller checks whether enough of it is left between the pads.

use ratn_model::pose::Pose;

/// Force and friction of a grip.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Grip {
    /// Newtons per finger.
    pub force_n: f64,
    /// Coulomb's friction coefficient between pads and object.
    pub friction: f64,
}

/// The held object, in the frame of the tool.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hold {
    /// The object's frame; its centre of mass is its origin.
    pub in_tool: Pose,
    /// The patch where the pads touch it: minimum and maximum x and z, in metres.
    pub patch: [[f64; 2]; 2],
    /// Mass in kilograms.
    pub mass_kg: f64,
    /// Moment of inertia about the closing axis through the centre of mass, in kg m².
    pub inertia: f64,
}

/// The load on the object: gravity as felt in the accelerated tool frame, in m/s².
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Load(pub [f64; 3]);

/// The sliding velocity of the object between the pads: along x and z in m/s, about y in rad/s.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Slip {
    /// Metres per second along the tool's x and z.
    pub along: [f64; 2],
    /// Radians per second about the tool's y.
    pub about: f64,
}

/// Mean distance of a disc's points from its centre, as a fraction of its radius.
const MEAN_LEVER: f64 = 2.0 / 3.0;

impl Slip {
    /// Whether the object sticks.
    pub fn is_none(&self) -> bool {
        *self == Slip::default()
    }
}

impl Grip {
    /// The fraction of the friction limit that the load takes: above 1 the object slips.
    pub fn strain(&self, hold: &Hold, load: &Load) -> f64 {
        let (force, torque, limits) = self.balance(hold, load);
        strain(force, torque, limits)
    }

    /// One step of `dt` seconds: returns the slip after it, and the pose of the object in the tool frame.
    pub fn step(&self, hold: &Hold, load: &Load, slip: Slip, dt: f64) -> (Slip, Pose) {
        let (force, torque, limits) = self.balance(hold, load);
        let excess = strain(force, torque, limits);
        if slip.is_none() && excess <= 1.0 {
            return (Slip::default(), hold.in_tool);
        }
        // Friction acts against the sliding velocity, or against the load that starts the slip, along the normal of the limit surface there.
        let [f_max, t_max] = limits;
        let friction = if slip.is_none() {
            ([-force[0] / excess, -force[1] / excess], -torque / excess)
        } else {
            let scale =
                (f_max.powi(2) * (slip.along[0].powi(2) + slip.along[1].powi(2)) + (t_max * slip.about).powi(2)).sqrt();
            let per = |limit: f64, speed: f64| -limit.powi(2) * speed / scale.max(f64::MIN_POSITIVE);
            ([per(f_max, slip.along[0]), per(f_max, slip.along[1])], per(t_max, slip.about))
        };
        let next = Slip {
            along: [0, 1].map(|i| slip.along[i] + (force[i] + friction.0[i]) / hold.mass_kg * dt),
            about: slip.about + (torque + friction.1) / hold.inertia * dt,
        };
        // Friction stops the object, it does not push it back.
        let still = next.along[0] * slip.along[0] + next.along[1] * slip.along[1] + next.about * slip.about <= 0.0;
        if excess <= 1.0 && still {
            return (Slip::default(), hold.in_tool);
        }
        let [px, pz] = middle(hold);
        let turn = Pose::from_rpy([0.0; 3], 0.0, next.about * dt, 0.0);
        let about_patch = Pose::at(px, 0.0, pz).compose(&turn).compose(&Pose::at(-px, 0.0, -pz));
        let mut in_tool = about_patch.compose(&hold.in_tool);
        in_tool.position[0] += next.along[0] * dt;
        in_tool.position[2] += next.along[1] * dt;
        (next, in_tool)
    }

    /// The force in the plane of the pads, the torque about the centre of the patch, and the maxima of both that friction bears.
    fn balance(&self, hold: &Hold, load: &Load) -> ([f64; 2], f64, [f64; 2]) {
        let force = [load.0[0] * hold.mass_kg, load.0[2] * hold.mass_kg];
        let [px, pz] = middle(hold);
        let lever = [hold.in_tool.position[0] - px, hold.in_tool.position[2] - pz];
        // The y component of lever × force.
        let torque = lever[1] * force[0] - lever[0] * force[1];
        let area: f64 = hold.patch.iter().map(|[low, high]| (high - low).max(0.0)).product();
        let f_max = 2.0 * self.friction * self.force_n;
        (force, torque, [f_max, f_max * MEAN_LEVER * (area / std::f64::consts::PI).sqrt()])
    }
}

fn strain(force: [f64; 2], torque: f64, [f_max, t_max]: [f64; 2]) -> f64 {
    let part = |load: f64, limit: f64| if load == 0.0 { 0.0 } else { load / limit };
    (part(force[0], f_max).powi(2) + part(force[1], f_max).powi(2) + part(torque, t_max).powi(2)).sqrt()
}

fn middle(hold: &Hold) -> [f64; 2] {
    hold.patch.map(|[low, high]| (low + high) / 2.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Gravity for a tool that points down.
    const DOWN: Load = Load([0.0, 0.0, 9.81]);
    const PATCH: [[f64; 2]; 2] = [[-0.0125, 0.0125], [-0.03, 0.015]];

    fn hold(x: f64) -> Hold {
        Hold { in_tool: Pose::at(x, 0.0, 0.02), patch: PATCH, mass_kg: 0.5, inertia: 0.001 }
    }

    fn slide(grip: Grip, mut hold: Hold, seconds: f64) -> (Slip, Pose) {
        let (dt, mut slip) = (0.004, Slip::default());
        for _ in 0..(seconds / dt) as usize {
            let in_tool;
            (slip, in_tool) = grip.step(&hold, &DOWN, slip, dt);
            hold.in_tool = in_tool;
        }
        (slip, hold.in_tool)
    }

    #[test]
    fn a_box_held_firmly_in_its_middle_stays_to_the_last_bit() {
        let grip = Grip { force_n: 40.0, friction: 0.6 };
        assert!(grip.strain(&hold(0.0), &DOWN) < 0.2);
        assert_eq!(slide(grip, hold(0.0), 10.0), (Slip::default(), hold(0.0).in_tool));
    }

    #[test]
    fn a_box_held_too_weakly_slides_down_slower_than_it_would_fall() {
        let grip = Grip { force_n: 3.0, friction: 0.6 };
        let (_, after) = slide(grip, hold(0.0), 0.1);
        let fallen = after.position[2] - 0.02;
        // Gravity minus friction: 9.81 - 2 · 0.6 · 3 / 0.5 m/s².
        assert!((fallen - 0.5 * (9.81 - 7.2) * 0.01).abs() < 0.1 * fallen, "{fallen}");
        assert!(after.position[0].abs() < 1e-9);
    }

    #[test]
    fn a_box_held_off_its_centre_turns_towards_hanging_and_one_held_harder_does_not() {
        let (_, held) = slide(Grip { force_n: 60.0, friction: 0.6 }, hold(0.06), 1.0);
        assert_eq!(held, hold(0.06).in_tool);
        let (_, turned) = slide(Grip { force_n: 10.0, friction: 0.6 }, hold(0.06), 0.3);
        let angle = turned.angle(&hold(0.06).in_tool);
        assert!(angle > 0.05, "{angle}");
        assert!(turned.position[2] > 0.02 + 0.002, "its centre of mass sinks");
    }

    #[test]
    fn what_slides_comes_to_rest_when_it_is_gripped_again() {
        let (weak, firm) = (Grip { force_n: 3.0, friction: 0.6 }, Grip { force_n: 40.0, friction: 0.6 });
        let mut hold = hold(0.0);
        let mut slip = Slip::default();
        for step in 0..100 {
            let in_tool;
            (slip, in_tool) = if step < 10 { weak } else { firm }.step(&hold, &DOWN, slip, 0.004);
            hold.in_tool = in_tool;
        }
        assert!(slip.is_none());
        assert!((0.0205..0.03).contains(&hold.in_tool.position[2]), "{:?}", hold.in_tool);
    }
}
