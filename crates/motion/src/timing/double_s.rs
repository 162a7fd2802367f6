//! The fastest motion along a straight line from rest to rest within limits of velocity, acceleration and jerk: the double-S
//! profile in closed form (Biagiotti and Melchiorri, *Trajectory Planning for Automatic Machines and Robots*, section 3.4).
//!
//! ```text
//! acceleration  __/‾‾\____________/‾‾...   seven phases of constant jerk: +J 0 −J | 0 | −J 0 +J
//! ```

/// Limits along the line.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Limits {
    pub(crate) velocity: f64,
    pub(crate) acceleration: f64,
    pub(crate) jerk: f64,
}

/// Position and velocity at the end of a phase.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Instant {
    pub(crate) time_s: f64,
    pub(crate) way: f64,
    pub(crate) velocity: f64,
}

/// Minimum duration of a phase beside longer ones, in seconds; shorter ones are left out, because the derivatives of a cubic over less time
/// are numerically poor.
const LEAST_S: f64 = 1e-4;

/// The instants at which the jerk changes, the first at 0; between two of them the position is a cubic in time.
pub(crate) fn double_s(way: f64, limits: Limits) -> Vec<Instant> {
    let Limits { velocity, acceleration, jerk } = limits;
    // How long the jerk is applied and how long the acceleration is held, to reach a velocity.
    let ramp = |peak: f64| {
        if !jerk.is_finite() {
            return (0.0, peak / acceleration);
        }
        let by_jerk = (peak / jerk).sqrt();
        if by_jerk * jerk <= acceleration {
            (by_jerk, 0.0)
        } else {
            (acceleration / jerk, peak / acceleration - acceleration / jerk)
        }
    };
    let rise_s = |peak: f64| {
        let (jerking, holding) = ramp(peak);
        2.0 * jerking + holding
    };
    let mut peak = velocity;
    if peak * rise_s(peak) > way {
        // No cruise: way = peak · rise, either without holding (rise = 2 √(peak / J)) or with it (rise = A / J + peak / A).
        let without = (way / 2.0).powi(2).cbrt() * jerk.cbrt();
        let t = acceleration / jerk;
        let with = acceleration * (((t * t + 4.0 * way / acceleration).sqrt() - t) / 2.0);
        peak = if jerk.is_finite() && without <= acceleration * t { without } else { with };
    }
    let (jerking, holding) = ramp(peak);
    let cruise = (way / peak - rise_s(peak)).max(0.0);
    // A motion that is short altogether keeps its longest phases.
    let least = LEAST_S.min(jerking.max(holding).max(cruise));
    let [jerking, holding, cruise] = [jerking, holding, cruise].map(|s| if s < least { 0.0 } else { s });
    // Without the phases that were left out the motion would be too short: jerk and acceleration are scaled up, and then the
    // motion is slowed down to keep the limits.
    let rise = (jerking + holding) * (2.0 * jerking + holding + cruise);
    let (level, hard) = if jerking > 0.0 { (way / rise, way / rise / jerking) } else { (way / rise, 0.0) };
    let slower =
        (level / acceleration).sqrt().max((hard / jerk).cbrt()).max(level * (jerking + holding) / velocity).max(1.0);
    let [jerking, holding, cruise] = [jerking, holding, cruise].map(|s| s * slower);
    let (level, hard) = (level / slower.powi(2), hard / slower.powi(3));
    let mut instants = vec![Instant { time_s: 0.0, way: 0.0, velocity: 0.0 }];
    let (mut time_s, mut at, mut v) = (0.0, 0.0, 0.0);
    let phases = [
        (jerking, hard, 0.0),
        (holding, 0.0, level),
        (jerking, -hard, level),
        (cruise, 0.0, 0.0),
        (jerking, -hard, 0.0),
        (holding, 0.0, -level),
        (jerking, hard, -level),
    ];
    for (lasts, j, a) in phases.into_iter().filter(|(lasts, ..)| *lasts > 0.0) {
        at += lasts * (v + lasts * (a / 2.0 + lasts * j / 6.0));
        v += lasts * (a + lasts * j / 2.0);
        time_s += lasts;
        instants.push(Instant { time_s, way: at, velocity: v });
    }
    let last = instants.len() - 1;
    instants[last] = Instant { way, velocity: 0.0, ..instants[last] };
    instants
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The greatest shares of the limits that the cubics between the instants use.
    fn used(instants: &[Instant], limits: Limits) -> [f64; 3] {
        let mut used = [0.0_f64; 3];
        for pair in instants.windows(2) {
            let lasts = pair[1].time_s - pair[0].time_s;
            let mean = (pair[1].way - pair[0].way) / lasts;
            let first = (6.0 * mean - 4.0 * pair[0].velocity - 2.0 * pair[1].velocity) / lasts;
            let jerk = 6.0 * (pair[0].velocity + pair[1].velocity - 2.0 * mean) / (lasts * lasts);
            let accelerations = first.abs().max((first + jerk * lasts).abs());
            let shares =
                [pair[1].velocity / limits.velocity, accelerations / limits.acceleration, jerk.abs() / limits.jerk];
            used = std::array::from_fn(|i| used[i].max(shares[i]));
        }
        used
    }

    #[test]
    fn a_motion_of_nanoradians_goes_all_its_way_as_quickly_as_the_limits_allow() {
        for way in [2e-9, 1e-8, 1e-7, 1e-6] {
            let by_acceleration = Limits { velocity: 2.0, acceleration: 10.0, jerk: f64::INFINITY };
            let by_jerk = Limits { jerk: 7500.0, ..by_acceleration };
            let quickest_s = [2.0 * (way / 10.0_f64).sqrt(), 4.0 * (way / 2.0 / 7500.0_f64).cbrt()];
            for (limits, quickest_s) in [by_acceleration, by_jerk].into_iter().zip(quickest_s) {
                let instants = double_s(way, limits);
                let last = instants[instants.len() - 1];
                assert!((last.way, last.velocity) == (way, 0.0) && instants.len() > 2, "{way}: {instants:?}");
                assert!((last.time_s / quickest_s - 1.0).abs() < 1e-9, "{way}: {} s, not {quickest_s}", last.time_s);
                assert!(used(&instants, limits).iter().all(|used| *used < 1.0 + 1e-6), "{way}: {instants:?}");
            }
        }
    }
}
