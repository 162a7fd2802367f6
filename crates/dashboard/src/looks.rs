//! Packs the meshes of a robot's visuals for the pages: vertices with normals. Pure.
//!
//! A vertex has twelve bytes, little-endian; three vertices are a triangle: x, y and z in 1/65535 of the mesh's bounding box, two unused
//! bytes, the normal's x, y and z as signed values in 1/127, an unused byte. A graphics card can use this as it is. If a robot has more
//! triangles than pages draw smoothly, its meshes are simplified.

use ratn_motion::mesh::Mesh;

/// Maximum number of triangles of a robot, all meshes together: about 11 MB.
const MOST_TRIANGLES: usize = 300_000;
/// Number of steps along each edge of a mesh's bounding box.
const PARTS: f64 = 65_535.0;
const CORNER_BYTES: usize = 12;
/// Faces that meet at a smaller angle form one smooth surface, with one normal per vertex: the cosine of 35°.
const SMOOTH: f64 = 0.82;
/// At a vertex of more triangles, each triangle keeps its own normal.
const MOST_AT_A_CORNER: usize = 64;

type Vector = [f64; 3];
type Corner = [u16; 3];

/// A packed mesh.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Packed {
    /// The centre of its bounding box, and the box's size.
    pub(crate) centre: Vector,
    pub(crate) size: Vector,
    /// Its vertices.
    pub(crate) bytes: Vec<u8>,
}

/// Packs the meshes of a robot.
pub(crate) fn packed(meshes: &[Mesh]) -> Vec<Packed> {
    packed_within(meshes, MOST_TRIANGLES)
}

fn packed_within(meshes: &[Mesh], most: usize) -> Vec<Packed> {
    let all: usize = meshes.iter().map(|mesh| mesh.triangles().len()).sum();
    // All meshes are reduced by the same ratio.
    let share = |mesh: &Mesh| (mesh.triangles().len() * most.min(all)).div_ceil(all);
    meshes.iter().map(|mesh| Packed::of(mesh, share(mesh))).collect()
}

impl Packed {
    fn of(mesh: &Mesh, most: usize) -> Packed {
        let corners = || mesh.triangles().iter().flatten();
        let least: Vector = std::array::from_fn(|i| corners().map(|c| c[i]).fold(f64::INFINITY, f64::min));
        let greatest: Vector = std::array::from_fn(|i| corners().map(|c| c[i]).fold(f64::NEG_INFINITY, f64::max));
        let size: Vector = std::array::from_fn(|i| greatest[i] - least[i]);
        let part =
            |at: f64, i: usize| if size[i] > 0.0 { ((at - least[i]) / size[i] * PARTS).round() as u16 } else { 0 };
        let whole = mesh.triangles().iter().map(|triangle| triangle.map(|c| std::array::from_fn(|i| part(c[i], i))));
        let triangles = coarser(whole.collect(), most);
        let metres = |corner: Corner| std::array::from_fn(|i| f64::from(corner[i]) / PARTS * size[i]);
        let normals = normals(&triangles, metres);
        let mut bytes = Vec::with_capacity(triangles.len() * 3 * CORNER_BYTES);
        for (corner, normal) in triangles.iter().flatten().zip(normals) {
            bytes.extend(corner.iter().flat_map(|part| part.to_le_bytes()));
            bytes.extend([0, 0]);
            bytes.extend(normal.map(|part| (part * 127.0).round() as i8 as u8));
            bytes.push(0);
        }
        Packed { centre: std::array::from_fn(|i| (least[i] + greatest[i]) / 2.0), size, bytes }
    }
}

/// The first cell size that removes triangles; smaller ones hardly do.
const FIRST_CELL: u32 = 16;

/// Simplifies to at most `most` triangles by vertex clustering: vertices move to the centres of grid cells, which grow until few enough
/// triangles remain.
fn coarser(triangles: Vec<[Corner; 3]>, most: usize) -> Vec<[Corner; 3]> {
    let is_flat = |[a, b, c]: &[Corner; 3]| a == b || b == c || a == c;
    let mut cell: u32 = 1;
    loop {
        let middle = |part: u16| (u32::from(part) / cell * cell + cell / 2).min(u32::from(u16::MAX)) as u16;
        let moved = triangles.iter().map(|triangle| triangle.map(|corner| corner.map(middle)));
        let mut left: Vec<[Corner; 3]> = moved.filter(|triangle| !is_flat(triangle)).collect();
        if cell > 1 {
            // Triangles that became equal are merged.
            left.sort_unstable();
            left.dedup();
        }
        if left.len() <= most || cell > u32::from(u16::MAX) {
            return left;
        }
        cell = if cell == 1 { FIRST_CELL } else { cell * 3 / 2 };
    }
}

/// A unit normal for each vertex of each triangle: the mean over the triangles of the same surface that meet there, weighted by their angle
/// there, so that it does not matter how a face is divided into triangles.
fn normals(triangles: &[[Corner; 3]], metres: impl Fn(Corner) -> Vector) -> Vec<Vector> {
    let faces: Vec<[Vector; 3]> = triangles.iter().map(|triangle| triangle.map(&metres)).collect();
    let upright = |[a, b, c]: &[Vector; 3]| unit(cross(minus(*b, *a), minus(*c, *a)));
    let normal_of: Vec<Vector> = faces.iter().map(upright).collect();
    let angle = |place: usize| {
        let (face, corner) = (&faces[place / 3], place % 3);
        let [to, from] = [(corner + 1) % 3, (corner + 2) % 3].map(|other| unit(minus(face[other], face[corner])));
        dot(to, from).clamp(-1.0, 1.0).acos()
    };
    let mut met: Vec<(Corner, usize)> =
        triangles.iter().flatten().enumerate().map(|(place, corner)| (*corner, place)).collect();
    met.sort_unstable();
    let mut normals = vec![[0.0, 0.0, 1.0]; met.len()];
    for there in met.chunk_by(|(one, _), (other, _)| one == other) {
        for (_, place) in there {
            let own = normal_of[place / 3];
            let beside = there.iter().filter(|(_, other)| dot(normal_of[other / 3], own) > SMOOTH);
            let add = |sum: Vector, (_, other): &(Corner, usize)| {
                std::array::from_fn(|i| sum[i] + angle(*other) * normal_of[other / 3][i])
            };
            normals[*place] = if there.len() <= MOST_AT_A_CORNER { unit(beside.fold([0.0; 3], add)) } else { own };
        }
    }
    normals
}

fn minus(a: Vector, b: Vector) -> Vector {
    std::array::from_fn(|i| a[i] - b[i])
}

fn dot(a: Vector, b: Vector) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

fn cross(a: Vector, b: Vector) -> Vector {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// The unit vector; z for a vector without a direction.
fn unit(vector: Vector) -> Vector {
    let length = dot(vector, vector).sqrt();
    if length > 0.0 { vector.map(|part| part / length) } else { [0.0, 0.0, 1.0] }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    /// A grid of `squares` squares along x and y, over 2 m by 1 m, bent down at the middle by an angle.
    fn grid(squares: usize, angle_rad: f64) -> Mesh {
        let place = |i: usize, j: usize| {
            let (u, y) = (2.0 * i as f64 / squares as f64 - 1.0, j as f64 / squares as f64);
            if u <= 0.0 { [u, y, 0.0] } else { [u * angle_rad.cos(), y, -u * angle_rad.sin()] }
        };
        let square = |n: usize| {
            let (i, j) = (n / squares, n % squares);
            let [a, b, c, d] = [place(i, j), place(i + 1, j), place(i + 1, j + 1), place(i, j + 1)];
            [[a, b, c], [a, c, d]]
        };
        Mesh::new((0..squares * squares).flat_map(square).collect()).unwrap()
    }

    /// Vertices, in metres, with their normals.
    fn corners(packed: &Packed) -> Vec<(Vector, Vector)> {
        let read = |bytes: &[u8]| {
            let part = |i: usize| f64::from(u16::from_le_bytes([bytes[2 * i], bytes[2 * i + 1]])) / PARTS - 0.5;
            let at = std::array::from_fn(|i| packed.centre[i] + part(i) * packed.size[i]);
            (at, std::array::from_fn(|i| f64::from(bytes[8 + i] as i8) / 127.0))
        };
        packed.bytes.chunks_exact(CORNER_BYTES).map(read).collect()
    }

    #[test]
    fn corners_are_where_they_are_in_the_mesh() {
        let mesh = Mesh::new(vec![[[1.0, -2.0, 0.5], [1.5, -2.0, 0.5], [1.0, 4.0, 0.5]]]).unwrap();
        let packed = packed(std::slice::from_ref(&mesh)).pop().unwrap();
        assert_eq!((packed.centre, packed.size), ([1.25, 1.0, 0.5], [0.5, 6.0, 0.0]));
        for ((at, normal), expected) in corners(&packed).into_iter().zip(mesh.triangles().iter().flatten()) {
            assert!(minus(at, *expected).iter().all(|off| off.abs() < 1e-4), "{at:?} is not {expected:?}");
            assert_eq!(normal, [0.0, 0.0, 1.0]);
        }
    }

    #[test]
    fn a_surface_that_bends_is_smooth_and_an_edge_is_sharp() {
        let normals_of = |angle_rad: f64| {
            let packed = packed(&[grid(4, angle_rad)]).pop().unwrap();
            let on_edge = |(at, _): &(Vector, Vector)| at[0].abs() < 1e-3;
            corners(&packed).into_iter().filter(on_edge).map(|(_, normal)| normal[0]).collect::<Vec<f64>>()
        };
        // At a bend of 0.4 rad, vertices have half of it; at a right angle, each side has its own normal.
        assert!(normals_of(0.4).iter().all(|x| (x - 0.2_f64.sin()).abs() < 0.05), "{:?}", normals_of(0.4));
        let sharp = normals_of(std::f64::consts::FRAC_PI_2);
        assert!(sharp.iter().all(|x| x.abs() < 0.01 || (x - 1.0).abs() < 0.01), "{sharp:?}");
        assert!(sharp.iter().any(|x| *x > 0.5) && sharp.iter().any(|x| *x < 0.5));
    }

    #[test]
    fn too_many_triangles_become_fewer_and_reach_as_far() {
        let (large, small) = (grid(100, 0.4), grid(10, 0.4));
        let made = packed_within(&[large, small], 5_000);
        let counts: Vec<usize> = made.iter().map(|one| one.bytes.len() / CORNER_BYTES / 3).collect();
        assert!(counts.iter().sum::<usize>() <= 5_000 && counts.iter().all(|count| *count > 10), "{counts:?}");
        let far = corners(&made[0]).into_iter().map(|(at, _)| at[0]).fold(f64::NEG_INFINITY, f64::max);
        assert!((far - 0.4_f64.cos()).abs() < 0.05, "{far}");
        let whole = packed_within(&[grid(10, 0.4)], 200);
        assert_eq!(whole[0].bytes.len(), 200 * 3 * CORNER_BYTES);
    }

    #[test]
    fn a_corner_of_many_triangles_and_triangles_without_an_area_are_packed() {
        let fan = |n: usize| {
            let at = |n: usize| [(n as f64 * 1e-3).cos(), (n as f64 * 1e-3).sin(), 0.0];
            [[0.0; 3], at(n), at(n + 1)]
        };
        let mut triangles: Vec<[Vector; 3]> = (0..20_000).map(fan).collect();
        triangles.push([[0.5; 3]; 3]);
        let made = packed(&[Mesh::new(triangles).unwrap(), Mesh::new(vec![[[1.0; 3]; 3]]).unwrap()]);
        assert_eq!((made[0].bytes.len(), made[1].bytes.len()), (20_000 * 3 * CORNER_BYTES, 0));
        assert!(packed(&[]).is_empty());
    }
}
