//! A fork on its back: a handle that narrows to a bent neck, a hollow head, and tines with gaps between them.

use super::mesh::Mesh;
use rand::{Rng, RngExt};

/// Numbers of segments: along the handle and head, along each tine, and around a cross section.
const LENGTHWISE: i32 = 28;
const TINE: i32 = 8;

/// A fork that fills a box of this size, with the tips in the direction of x.
pub(super) fn fork(size: [f64; 3], random: &mut impl Rng) -> Mesh {
    let [length, width, height] = size;
    let mut within = |low: f64, high: f64| random.random_range(low..high);
    // Positions along the fork, from 0 at the handle's end to 1 at the tips: the neck, the point that touches the table, the roots of the
    // tines.
    let (neck, bow, root) = (within(0.60, 0.67), within(0.83, 0.88), within(0.76, 0.80));
    let (tips, narrow, end) = (within(0.55, 0.85), within(0.25, 0.38), within(0.65, 0.95));
    let thick = within(0.0018, 0.0032);
    let tines = if within(0.0, 1.0) < 0.2 { 3 } else { 4 };
    let metal = within(0.45, 0.62);
    let middle = |at: f64| height * curve(&[(0.0, 0.02), (0.35, 0.45), (neck, 0.95), (bow, 0.05), (1.0, tips)], at);
    let half = |at: f64| {
        let wide = [(0.0, 0.75 * end), (0.06, end), (0.4, narrow + 0.2), (neck, narrow), (root, 1.0), (1.0, 0.92)];
        width / 2.0 * curve(&wide, at)
    };
    let mut mesh = Mesh::default();
    let section = |mesh: &mut Mesh, at: f64, from: f64, to: f64, thick: f64| -> Vec<u32> {
        // Rounded above: narrower at the top than in the middle.
        let (z, inset) = (middle(at), ((to - from) * 0.15).min(0.0012));
        let corners = [
            (from, 0.0),
            (from + inset, thick / 2.0),
            (to - inset, thick / 2.0),
            (to, 0.0),
            (to - inset, -thick / 2.0),
            (from + inset, -thick / 2.0),
        ];
        corners.into_iter().map(|(y, up)| mesh.point([at * length, y, z + up])).collect()
    };
    let strip = |mesh: &mut Mesh, parts: i32, [start, stop]: [f64; 2], sides: &dyn Fn(f64) -> [f64; 3]| {
        let rings: Vec<Vec<u32>> = (0..=parts)
            .map(|i| {
                let at = start + (stop - start) * f64::from(i) / f64::from(parts);
                let [from, to, thick] = sides(at);
                section(mesh, at, from, to, thick)
            })
            .collect();
        mesh.skin(&rings);
        mesh.cap(&rings[0]);
        mesh.cap(&rings[rings.len() - 1]);
    };
    strip(&mut mesh, LENGTHWISE, [0.0, root], &|at| [-half(at), half(at), thick]);
    for tine in 0..tines {
        // Each tine keeps its place in the head's width and gets thinner towards its tip.
        let pitch = 2.0 / (f64::from(tines) - 1.0 + metal);
        strip(&mut mesh, TINE, [root, 1.0], &|at| {
            let thin = 1.0 - 0.45 * ((at - root) / (1.0 - root)).powi(2);
            let centre = -1.0 + pitch * (f64::from(tine) + metal / 2.0);
            let [from, to] = [-1.0, 1.0].map(|side| (centre + side * thin * pitch * metal / 2.0) * half(at));
            [from, to, thick * thin]
        });
    }
    mesh.fitted(size)
}

/// A smooth curve through nodes (x, y) with x increasing: cubic Hermite with Catmull-Rom slopes. Its extremes are near nodes.
fn curve(nodes: &[(f64, f64)], x: f64) -> f64 {
    let last = nodes.len() - 1;
    let slope = |i: usize| {
        let (a, b) = (nodes[i.saturating_sub(1)], nodes[(i + 1).min(last)]);
        (b.1 - a.1) / (b.0 - a.0)
    };
    let i = nodes.iter().skip(1).take(last - 1).filter(|node| node.0 <= x).count();
    let ((x0, y0), (x1, y1)) = (nodes[i], nodes[i + 1]);
    let (wide, t) = (x1 - x0, ((x - x0) / (x1 - x0)).clamp(0.0, 1.0));
    let (a, b) = (slope(i) * wide, slope(i + 1) * wide);
    let (t2, t3) = (t * t, t * t * t);
    (2.0 * t3 - 3.0 * t2 + 1.0) * y0 + (t3 - 2.0 * t2 + t) * a + (3.0 * t2 - 2.0 * t3) * y1 + (t3 - t2) * b
}
