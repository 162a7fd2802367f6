//! The closed parts of a mesh: triangles that are connected by common edges, with an even number of triangles at each edge.
//!
//! A triangle that occurs several times, from one side or from both, counts once. If it occurs an even number of times, it may also be a wall
//! within a part, or between two parts that touch: then the part is closed without it. A part that is closed neither with these triangles nor
//! without them has no inside and is left out.
//!
//! Bodies may touch along edges, where more than two triangles meet. Triangles that are connected by other edges and are closed by themselves
//! form a separate part, so that an error in one body, or another orientation, does not affect the body beside it.
//!
//! Each part is oriented consistently where that is possible, so that the winding number tells its inside, also where the part intersects
//! itself; otherwise only the parity of crossings tells.

use crate::mesh::Mesh;
use std::collections::{BTreeMap, VecDeque};

type Corner = [f64; 3];
type Indices = [u32; 3];

/// A closed part.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct ClosedPart {
    pub(crate) triangles: Vec<[Corner; 3]>,
    /// Whether every edge is used equally often in both directions.
    pub(crate) is_oriented: bool,
    /// Orientation of its triangles as seen from outside: 1 counter-clockwise, -1 clockwise, 0 where the file does not tell.
    pub(crate) sense: i32,
}

/// A triangle, which may occur several times.
#[derive(Debug, Clone, Copy)]
struct Face {
    corners: Indices,
    is_odd: bool,
    /// Whether it occurs more often from one side than from the other.
    has_side: bool,
}

/// The closed parts of a mesh, and a corner of each part that is connected by common corners, closed or not.
pub(crate) fn closed_parts(mesh: &Mesh) -> (Vec<ClosedPart>, Vec<Corner>) {
    let (corners, indices) = numbered(mesh);
    let faces = faces(&indices);
    let all: Vec<u32> = (0..faces.len() as u32).collect();
    let mut parts = Vec::new();
    for part in connected(&faces, &all) {
        let mut others = Vec::new();
        for body in joined_at(&faces, &part, |count| count == 2) {
            match closed(&faces, &body) {
                Some(closed) => parts.extend(closed),
                None => others.extend(body),
            }
        }
        for part in connected(&faces, &others) {
            parts.extend(closed(&faces, &part).into_iter().flatten());
        }
    }
    (parts.iter().map(|part| turned(&corners, &faces, part)).collect(), first_corners(&corners, &indices))
}

/// The closed parts of a connected part; `None` where it is not closed.
fn closed(faces: &[Face], part: &[u32]) -> Option<Vec<Vec<u32>>> {
    let (odd, even): (Vec<u32>, Vec<u32>) = part.iter().partition(|face| faces[**face as usize].is_odd);
    if !odd.is_empty() && is_closed(faces, &odd) {
        let walls = connected(faces, &even).into_iter().filter(|part| is_closed(faces, part));
        return Some(connected(faces, &odd).into_iter().chain(walls).collect());
    }
    is_closed(faces, part).then(|| vec![part.to_vec()])
}

fn first_corners(corners: &[Corner], indices: &[Indices]) -> Vec<Corner> {
    let mut joined: Vec<u32> = (0..corners.len() as u32).collect();
    for [a, b, c] in indices {
        join(&mut joined, *a, *b);
        join(&mut joined, *a, *c);
    }
    (0..joined.len()).filter(|corner| joined[*corner] as usize == *corner).map(|corner| corners[corner]).collect()
}

/// Gives corners with equal coordinates the same index.
fn numbered(mesh: &Mesh) -> (Vec<Corner>, Vec<Indices>) {
    let mut numbers: BTreeMap<[u64; 3], u32> = BTreeMap::new();
    let (mut corners, mut indices) = (Vec::new(), Vec::with_capacity(mesh.triangles().len()));
    for triangle in mesh.triangles() {
        indices.push(triangle.map(|corner| {
            // Makes minus zero equal to zero.
            let key = corner.map(|c| (c + 0.0).to_bits());
            *numbers.entry(key).or_insert_with(|| {
                corners.push(corner);
                corners.len() as u32 - 1
            })
        }));
    }
    (corners, indices)
}

/// Each triangle once, without degenerate ones.
fn faces(indices: &[Indices]) -> Vec<Face> {
    let sorted = |mut corners: Indices| {
        corners.sort_unstable();
        corners
    };
    let is_flat = |[a, b, c]: &Indices| a == b || b == c || c == a;
    let mut all: Vec<(Indices, Indices)> =
        indices.iter().filter(|corners| !is_flat(corners)).map(|corners| (sorted(*corners), *corners)).collect();
    all.sort_unstable();
    let same = all.chunk_by(|a, b| a.0 == b.0);
    same.map(|same| {
        let key = same[0].0;
        // Whether the corners are in the same cyclic order as the sorted ones.
        let ahead =
            |corners: Indices| [[0, 1, 2], [1, 2, 0], [2, 0, 1]].iter().any(|order| order.map(|i| key[i]) == corners);
        let sum: i32 = same.iter().map(|(_, corners)| if ahead(*corners) { 1 } else { -1 }).sum();
        let corners = if sum < 0 { [key[0], key[2], key[1]] } else { key };
        Face { corners, is_odd: same.len() % 2 == 1, has_side: sum != 0 }
    })
    .collect()
}

/// An edge of a face: its corners with the lower index first, the face's index in a list, and whether the face uses the edge from the lower to
/// the higher corner.
type Edge = ((u32, u32), u32, bool);

fn edges(faces: &[Face], list: &[u32]) -> Vec<Edge> {
    let mut edges = Vec::with_capacity(3 * list.len());
    for (place, face) in list.iter().enumerate() {
        let [a, b, c] = faces[*face as usize].corners;
        for (from, to) in [(a, b), (b, c), (c, a)] {
            edges.push(((from.min(to), from.max(to)), place as u32, from < to));
        }
    }
    edges.sort_unstable();
    edges
}

fn at_each_edge(edges: &[Edge]) -> impl Iterator<Item = &[Edge]> {
    edges.chunk_by(|a, b| a.0 == b.0)
}

/// The parts of a list of faces that are connected by edges.
fn connected(faces: &[Face], list: &[u32]) -> Vec<Vec<u32>> {
    joined_at(faces, list, |_| true)
}

/// The same, using only edges where `is_joint` holds for the number of faces.
fn joined_at(faces: &[Face], list: &[u32], is_joint: impl Fn(usize) -> bool) -> Vec<Vec<u32>> {
    let mut joined: Vec<u32> = (0..list.len() as u32).collect();
    for same in at_each_edge(&edges(faces, list)).filter(|same| is_joint(same.len())) {
        same.iter().for_each(|(_, place, _)| join(&mut joined, same[0].1, *place));
    }
    let mut parts: BTreeMap<u32, Vec<u32>> = BTreeMap::new();
    for (place, face) in list.iter().enumerate() {
        parts.entry(root(&mut joined, place as u32)).or_default().push(*face);
    }
    parts.into_values().collect()
}

fn is_closed(faces: &[Face], list: &[u32]) -> bool {
    at_each_edge(&edges(faces, list)).all(|same| same.len() % 2 == 0)
}

/// A closed part, oriented consistently if possible.
fn turned(corners: &[Corner], faces: &[Face], list: &[u32]) -> ClosedPart {
    let edges = edges(faces, list);
    let is_balanced = |same: &[Edge]| 2 * same.iter().filter(|(_, _, up)| *up).count() == same.len();
    let has_sides = list.iter().all(|face| faces[*face as usize].has_side);
    let is_balanced = at_each_edge(&edges).all(is_balanced);
    let turned = if is_balanced { Some(vec![false; list.len()]) } else { consistent(&edges, list.len()) };
    let is_oriented = turned.is_some();
    let turned = turned.unwrap_or_else(|| vec![false; list.len()]);
    let triangle = |(face, turned): (&u32, &bool)| {
        let [a, b, c] = faces[*face as usize].corners.map(|corner| corners[corner as usize]);
        if *turned { [a, c, b] } else { [a, b, c] }
    };
    let triangles: Vec<[Corner; 3]> = list.iter().zip(&turned).map(triangle).collect();
    let sense = match has_sides && is_balanced {
        true if volume(&triangles) < 0.0 => -1,
        true => 1,
        false => 0,
    };
    ClosedPart { triangles, is_oriented, sense }
}

/// The faces to flip so that both faces at an edge use it in opposite directions; `None` where more than two faces meet, or where the surface is
/// one-sided.
fn consistent(edges: &[Edge], count: usize) -> Option<Vec<bool>> {
    let mut beside: Vec<Vec<(u32, bool)>> = vec![Vec::new(); count];
    for same in at_each_edge(edges) {
        let [(_, first, up), (_, second, other)] = same else { return None };
        beside[*first as usize].push((*second, up == other));
        beside[*second as usize].push((*first, up == other));
    }
    let mut turned: Vec<Option<bool>> = vec![None; count];
    turned[0] = Some(false);
    let mut open = VecDeque::from([0]);
    while let Some(face) = open.pop_front() {
        let here = turned[face as usize]?;
        for (next, is_against) in &beside[face as usize] {
            let wanted = here != *is_against;
            match turned[*next as usize] {
                Some(is) if is != wanted => return None,
                Some(_) => {}
                None => {
                    turned[*next as usize] = Some(wanted);
                    open.push_back(*next);
                }
            }
        }
    }
    turned.into_iter().collect()
}

/// Six times the signed volume, negative where triangles are clockwise.
fn volume(triangles: &[[Corner; 3]]) -> f64 {
    let origin = triangles[0][0];
    let of = |triangle: &[Corner; 3]| {
        let [a, b, c] = triangle.map(|corner| -> Corner { std::array::from_fn(|i| corner[i] - origin[i]) });
        let cross = [b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0]];
        a[0] * cross[0] + a[1] * cross[1] + a[2] * cross[2]
    };
    triangles.iter().map(of).sum()
}

fn join(joined: &mut [u32], a: u32, b: u32) {
    let (a, b) = (root(joined, a), root(joined, b));
    // The lower index stays, so that the first corner of a part is its root.
    joined[a.max(b) as usize] = a.min(b);
}

fn root(joined: &mut [u32], mut at: u32) -> u32 {
    while joined[at as usize] != at {
        joined[at as usize] = joined[joined[at as usize] as usize];
        at = joined[at as usize];
    }
    at
}
