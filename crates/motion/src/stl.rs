//! Reads STL: binary files, recognised by their length, or text between `solid` and `endsolid`.
//!
//! Normals, colours and names do not affect the shape. A text without its `endsolid` was truncated and is refused.

use crate::mesh::{MAX_TRIANGLES, MeshError};

type Triangle = [[f64; 3]; 3];

/// Bytes before the triangles of a binary file, and bytes of each triangle.
const HEADER: usize = 84;
const RECORD: usize = 50;

/// The offset of the first corner in a binary record: after the normal.
const CORNERS: usize = 12;

/// The triangles of a file.
pub(crate) fn triangles(bytes: &[u8]) -> Result<Vec<Triangle>, MeshError> {
    let announced = bytes.get(HEADER - 4..HEADER).and_then(|b| b.try_into().ok()).map(u32::from_le_bytes);
    let count = announced.map_or(0, |count| count as usize);
    let cut = || MeshError::Triangles { triangles: count, bytes: bytes.len() };
    let is_whole = |records: &[u8]| count.checked_mul(RECORD) == Some(records.len());
    // A binary header may begin with `solid`, so the length decides.
    match bytes.get(HEADER..).filter(|records| is_whole(records)) {
        Some(_) if !(1..=MAX_TRIANGLES).contains(&count) => Err(cut()),
        Some(records) => Ok(records.chunks_exact(RECORD).map(record).collect()),
        None => std::str::from_utf8(bytes).ok().filter(|text| is_text(text)).map_or_else(|| Err(cut()), lines),
    }
}

fn record(bytes: &[u8]) -> Triangle {
    let number = |i: usize| -> f64 {
        let at = CORNERS + 4 * i;
        f64::from(f32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]]))
    };
    std::array::from_fn(|corner| std::array::from_fn(|i| number(3 * corner + i)))
}

fn is_text(text: &str) -> bool {
    text.split_whitespace().next().is_some_and(|word| word.eq_ignore_ascii_case("solid"))
}

/// The open element of a text.
enum Open {
    Nothing,
    Solid,
    /// A facet with its corners so far.
    Facet(Vec<[f64; 3]>),
}

fn lines(text: &str) -> Result<Vec<Triangle>, MeshError> {
    let (mut triangles, mut open, mut last) = (Vec::new(), Open::Nothing, 1);
    for (index, line) in text.lines().enumerate() {
        let wrong = MeshError::Line { line: index + 1 };
        let mut words = line.split_whitespace();
        let Some(keyword) = words.next().map(str::to_ascii_lowercase) else { continue };
        last = index + 1;
        open = match (keyword.as_str(), open) {
            ("solid", Open::Nothing) => {
                // The rest of the line is the solid's name.
                if words.any(|word| word.eq_ignore_ascii_case("facet")) {
                    let reason =
                        "`facet` on the line of its `solid` is read as a name: begin a new line before it".to_owned();
                    return Err(MeshError::Text { line: index + 1, reason });
                }
                Open::Solid
            }
            ("facet", Open::Solid) => Open::Facet(Vec::new()),
            ("vertex", Open::Facet(mut corners)) => {
                let numbers: Vec<f64> = words.map_while(|word| word.parse().ok()).take(4).collect();
                corners.push(<[f64; 3]>::try_from(numbers).map_err(|_| wrong)?);
                Open::Facet(corners)
            }
            ("endfacet", Open::Facet(corners)) => {
                triangles.push(<Triangle>::try_from(corners).map_err(|_| wrong)?);
                if triangles.len() > MAX_TRIANGLES {
                    return Err(MeshError::Count { triangles: triangles.len() });
                }
                Open::Solid
            }
            ("endsolid", Open::Solid) => Open::Nothing,
            ("solid" | "facet" | "vertex" | "endfacet" | "endsolid", _) => return Err(wrong),
            // `outer loop`, `endloop`, and extensions of some writers.
            (_, open) => open,
        };
    }
    match open {
        Open::Nothing => Ok(triangles),
        _ => {
            let reason = "the file ends without `endsolid`: it was cut off, export or copy it again".to_owned();
            Err(MeshError::Text { line: last, reason })
        }
    }
}
