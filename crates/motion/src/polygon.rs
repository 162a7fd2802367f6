//! Triangulates a flat polygon of a file.
//!
//! A convex polygon is cut from its first corner. From others ears are cut off: corners whose triangle contains no other corner (Meisters, *Polygons
//! have ears*, American Mathematical Monthly 1975). All edges of the outline are edges of triangles, in their direction, even if the polygon
//! intersects itself, so that a closed mesh stays closed.

type Corner = [f64; 3];

/// Maximum number of corners of a polygon that is not convex: the work grows with its square.
pub(crate) const MOST_CORNERS: usize = 1_000;

/// Tolerance for a negative area of three corners that counts as flat, relative to the polygon's area.
const FLAT: f64 = 1e-9;

/// The triangles of a polygon of three corners or more.
///
/// # Errors
/// The error message for a polygon that is not convex and has more than [`MOST_CORNERS`] corners.
pub(crate) fn triangles(corners: &[Corner]) -> Result<Vec<[Corner; 3]>, String> {
    let fan = || (1..corners.len().saturating_sub(1)).map(|i| [corners[0], corners[i], corners[i + 1]]).collect();
    if corners.len() < 4 {
        return Ok(fan());
    }
    let flat = flattened(corners);
    let tolerance = -FLAT * area(&flat);
    let count = flat.len();
    if (0..count).all(|i| turn(flat[(i + count - 1) % count], flat[i], flat[(i + 1) % count]) >= tolerance) {
        return Ok(fan());
    }
    if corners.len() > MOST_CORNERS {
        let reason = "that is not convex: at most {MOST_CORNERS} are supported, export triangles";
        return Err(format!(
            "a face of {count} corners {}",
            reason.replace("{MOST_CORNERS}", &MOST_CORNERS.to_string())
        ));
    }
    Ok(ears(&flat).into_iter().map(|ear| ear.map(|i| corners[i])).collect())
}

/// The polygon projected to the plane of two axes in which its area is largest, counterclockwise.
fn flattened(corners: &[Corner]) -> Vec<[f64; 2]> {
    let first = corners[0];
    let at = |i: usize| -> Corner { std::array::from_fn(|axis| corners[i % corners.len()][axis] - first[axis]) };
    // Newell's normal.
    let mut normal = [0.0; 3];
    for i in 0..corners.len() {
        let (here, next) = (at(i), at(i + 1));
        for (axis, sum) in normal.iter_mut().enumerate() {
            let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
            *sum += (here[u] - next[u]) * (here[v] + next[v]);
        }
    }
    let axis = (0..3).max_by(|a, b| normal[*a].abs().total_cmp(&normal[*b].abs())).unwrap_or(2);
    let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
    let (u, v) =
        if area(&(0..corners.len()).map(|i| [at(i)[u], at(i)[v]]).collect::<Vec<_>>()) < 0.0 { (v, u) } else { (u, v) };
    (0..corners.len()).map(|i| [at(i)[u], at(i)[v]]).collect()
}

/// Twice the area, negative if clockwise.
fn area(flat: &[[f64; 2]]) -> f64 {
    (0..flat.len()).map(|i| (flat[i], flat[(i + 1) % flat.len()])).map(|(a, b)| a[0] * b[1] - b[0] * a[1]).sum()
}

/// Twice the area of three corners, negative if they turn clockwise.
fn turn(a: [f64; 2], b: [f64; 2], c: [f64; 2]) -> f64 {
    (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])
}

fn ears(flat: &[[f64; 2]]) -> Vec<[usize; 3]> {
    let mut left: Vec<usize> = (0..flat.len()).collect();
    let mut is_ear: Vec<bool> = (0..left.len()).map(|i| ear(flat, &left, i)).collect();
    let mut ears = Vec::with_capacity(flat.len() - 2);
    while left.len() > 3 {
        let bends = |i: &usize| turns(flat, &left, *i) > 0.0;
        // A polygon that intersects itself, or has no area, may have no ear: then any corner is cut off.
        let next = is_ear.iter().position(|is| *is).or_else(|| (0..left.len()).find(bends)).unwrap_or(0);
        ears.push(around(&left, next));
        left.remove(next);
        is_ear.remove(next);
        // Only the two neighbours have changed.
        for beside in [(next + left.len() - 1) % left.len(), next % left.len()] {
            is_ear[beside] = ear(flat, &left, beside);
        }
    }
    ears.push([left[0], left[1], left[2]]);
    ears
}

fn around(left: &[usize], i: usize) -> [usize; 3] {
    [left[(i + left.len() - 1) % left.len()], left[i], left[(i + 1) % left.len()]]
}

fn turns(flat: &[[f64; 2]], left: &[usize], i: usize) -> f64 {
    let [a, b, c] = around(left, i).map(|corner| flat[corner]);
    turn(a, b, c)
}

fn ear(flat: &[[f64; 2]], left: &[usize], i: usize) -> bool {
    if turns(flat, left, i) <= 0.0 {
        return false;
    }
    let [a, b, c] = around(left, i).map(|corner| flat[corner]);
    let holds = |other: &usize| {
        let at = flat[*other];
        ![a, b, c].contains(&at) && turn(a, b, at) >= 0.0 && turn(b, c, at) >= 0.0 && turn(c, a, at) >= 0.0
    };
    !left.iter().any(holds)
}
