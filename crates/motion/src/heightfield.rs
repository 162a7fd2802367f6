//! Heights over a grid as a solid: terrain, a pile, or a scan from above.
//!
//! Rows run along y and columns along x, the centre of the grid is the origin. Two triangles lie between each four heights. The solid reaches down to a
//! bottom. Heights are read from text (a row per line, separated by semicolons, commas or spaces, whichever of these a line contains first in this order)
//! or from a grey image (PGM, text or binary, with 8 or 16 bits); the first line is the row with the greatest y, as seen from above.

use crate::mesh::{MAX_TRIANGLES, Mesh, MeshError};

/// Maximum number of heights along a side.
pub const MOST_ALONG: usize = 4096;

/// Why there are no heights.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum HeightsError {
    /// Something is not a number, or a row has another length.
    #[error("line {line}: {reason}")]
    Text {
        /// Line number, from 1.
        line: usize,
        /// What is wrong.
        reason: String,
    },
    /// The image is incomplete, or of another format.
    #[error("at byte {offset}: {reason}")]
    Image {
        /// Byte offset, from 0.
        offset: usize,
        /// What is wrong.
        reason: String,
    },
    /// The size of the grid is not supported.
    #[error("{columns} × {rows} heights: expected 2 to {MOST_ALONG} along each side")]
    Size {
        /// Number along x.
        columns: usize,
        /// Number along y.
        rows: usize,
    },
    /// The solid cannot be made into a mesh.
    #[error(transparent)]
    Mesh(#[from] MeshError),
}

/// Heights over a grid.
#[derive(Debug, Clone, PartialEq)]
pub struct Heights {
    columns: usize,
    /// Row by row, from the least y.
    heights: Vec<f64>,
}

impl Heights {
    /// Rows of heights, from the least y, each from the least x.
    ///
    /// # Errors
    /// [`HeightsError::Size`] where rows differ in length, or are too few or too many.
    pub fn new(columns: usize, heights: Vec<f64>) -> Result<Heights, HeightsError> {
        let rows = heights.len() / columns.max(1);
        let fits = |count: usize| (2..=MOST_ALONG).contains(&count);
        if !fits(columns) || !fits(rows) || rows * columns != heights.len() {
            return Err(HeightsError::Size { columns, rows });
        }
        Ok(Heights { columns, heights })
    }

    /// Reads text or a PGM image; `scale` converts the numbers to metres.
    ///
    /// # Errors
    /// [`HeightsError`] names the line or the byte.
    pub fn read(bytes: &[u8], scale: f64) -> Result<Heights, HeightsError> {
        let (columns, mut heights) = match bytes {
            [b'P', b'2' | b'5', ..] => pgm(bytes)?,
            [0x89, b'P', b'N', b'G', ..] => {
                let reason = "PNG images are not supported: convert it to PGM, which keeps 16 bits".to_owned();
                return Err(HeightsError::Image { offset: 0, reason });
            }
            _ => text(bytes)?,
        };
        heights.iter_mut().for_each(|height| *height *= scale);
        let rows: Vec<&[f64]> = heights.chunks(columns.max(1)).rev().collect();
        Heights::new(columns, rows.concat())
    }

    /// The solid between the heights and a bottom; `size` is the grid's extent along x and y, in metres.
    ///
    /// # Errors
    /// [`HeightsError::Mesh`] where it is not finite or has too many triangles.
    pub fn solid(&self, size: [f64; 2], bottom: f64) -> Result<Mesh, HeightsError> {
        let (columns, rows) = (self.columns, self.heights.len() / self.columns);
        // Two triangles between each four heights, three below each height at the edge.
        let count = 2 * (columns - 1) * (rows - 1) + 6 * (columns + rows - 2);
        if count > MAX_TRIANGLES {
            return Err(MeshError::Count { triangles: count }.into());
        }
        let least = self.heights.iter().copied().fold(f64::INFINITY, f64::min);
        // A bottom above the least height would intersect the surface.
        let bottom = bottom.min(least - 1e-3);
        let along = |i: usize, count: usize, size: f64| (i as f64 / (count - 1) as f64 - 0.5) * size;
        let flat = |x: usize, y: usize| [along(x, columns, size[0]), along(y, rows, size[1])];
        let top = |(x, y): (usize, usize)| [flat(x, y)[0], flat(x, y)[1], self.heights[y * columns + x]];
        let low = |(x, y): (usize, usize)| [flat(x, y)[0], flat(x, y)[1], bottom];
        let mut triangles = Vec::with_capacity(count);
        for y in 0..rows - 1 {
            for x in 0..columns - 1 {
                let [a, b, c, d] = [(x, y), (x + 1, y), (x + 1, y + 1), (x, y + 1)];
                triangles.extend([[a, b, c], [a, c, d]].map(|t| t.map(top)));
            }
        }
        // Around the edge, with the inside to the left.
        let mut edge: Vec<(usize, usize)> = (0..columns - 1).map(|x| (x, 0)).collect();
        edge.extend((0..rows - 1).map(|y| (columns - 1, y)));
        edge.extend((1..columns).rev().map(|x| (x, rows - 1)));
        edge.extend((1..rows).rev().map(|y| (0, y)));
        let middle = [0.0, 0.0, bottom];
        for (i, here) in edge.iter().enumerate() {
            let next = edge[(i + 1) % edge.len()];
            triangles.extend([
                [low(*here), low(next), top(next)],
                [low(*here), top(next), top(*here)],
                [middle, low(next), low(*here)],
            ]);
        }
        Ok(Mesh::new(triangles)?)
    }
}

const COMMA: &str = ": a comma ends a field, decimals are written with a point";

fn text(bytes: &[u8]) -> Result<(usize, Vec<f64>), HeightsError> {
    let text = String::from_utf8_lossy(bytes);
    let (mut columns, mut heights) = (0, Vec::new());
    for (index, line) in text.lines().enumerate() {
        let wrong = |reason: String| HeightsError::Text { line: index + 1, reason };
        let line = line.split('#').next().unwrap_or("").trim();
        if line.is_empty() {
            continue;
        }
        let words: Vec<&str> = match [';', ','].into_iter().find(|between| line.contains(*between)) {
            Some(between) => line.split(between).map(str::trim).collect(),
            None => line.split_whitespace().collect(),
        };
        if let Some(field) = words.iter().position(|word| word.is_empty()) {
            return Err(wrong(format!("field {} is empty: fill in what was not seen", field + 1)));
        }
        let count = words.len();
        if columns > 0 && count != columns {
            return Err(wrong(format!("{count} heights, the rows before it have {columns}")));
        }
        columns = count;
        let rows = heights.len() / columns + 1;
        if columns > MOST_ALONG || rows > MOST_ALONG {
            return Err(HeightsError::Size { columns, rows });
        }
        for word in words {
            let number =
                |_| wrong(format!("`{word}` is no number{}", if word.contains([',', ' ']) { COMMA } else { "" }));
            let height: f64 = word.parse().map_err(number)?;
            if !height.is_finite() {
                return Err(wrong(format!("`{word}` is not finite: fill in what was not seen")));
            }
            heights.push(height);
        }
    }
    Ok((columns, heights))
}

/// A PGM image (portable grey map).
fn pgm(bytes: &[u8]) -> Result<(usize, Vec<f64>), HeightsError> {
    let mut at = 2;
    let wrong = |offset: usize, reason: &str| HeightsError::Image { offset, reason: reason.to_owned() };
    let number = |at: &mut usize| -> Result<usize, HeightsError> {
        loop {
            match bytes.get(*at) {
                Some(b'#') => {
                    while bytes.get(*at).is_some_and(|b| *b != b'\n') {
                        *at += 1
                    }
                }
                Some(b) if b.is_ascii_whitespace() => *at += 1,
                _ => break,
            }
        }
        let digits = bytes[*at..].iter().take_while(|b| b.is_ascii_digit()).count();
        let text = std::str::from_utf8(&bytes[*at..*at + digits]).unwrap_or("");
        let value = text.parse().map_err(|_| wrong(*at, "expected a whole number"))?;
        *at += digits;
        Ok(value)
    };
    let (columns, rows, most) = (number(&mut at)?, number(&mut at)?, number(&mut at)?);
    if columns > MOST_ALONG || rows > MOST_ALONG || columns * rows == 0 {
        return Err(HeightsError::Size { columns, rows });
    }
    if !(1..=65_535).contains(&most) {
        return Err(wrong(at, "the greatest grey value is from 1 to 65535"));
    }
    let count = columns * rows;
    let fits = |value: usize, offset: usize| match value > most {
        true => Err(wrong(offset, &format!("a grey value of {value}: {most} is announced as the greatest"))),
        false => Ok(value as f64),
    };
    if bytes[1] == b'2' {
        let values = (0..count).map(|_| number(&mut at).and_then(|value| fits(value, at))).collect::<Result<_, _>>()?;
        return Ok((columns, values));
    }
    let (wide, first) = (1 + usize::from(most > 255), at + 1);
    let values = bytes.get(first..first + count * wide).ok_or_else(|| {
        wrong(bytes.len(), &format!("it ends here, {columns} × {rows} values of {wide} bytes begin at byte {first}"))
    })?;
    let value = |(i, b): (usize, &[u8])| {
        fits(b.iter().fold(0, |value, byte| value * 256 + usize::from(*byte)), first + i * wide)
    };
    Ok((columns, values.chunks_exact(wide).enumerate().map(value).collect::<Result<_, _>>()?))
}
