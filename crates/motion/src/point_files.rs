//! Reads points from files: PCD and PLY, or three numbers per line (`.xyz`, `.csv`, `.txt`).
//!
//! A truncated file is refused if its format gives the length. A list of lines gives none: it is refused if its last line has no end and fewer fields
//! than the line before. A file that was truncated within its last number, or between two lines, cannot be recognised
//! as such.

use crate::cloud::MAX_POINTS;
use crate::{pcd, ply};
use std::borrow::Cow;

/// Why no points were read.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PointsError {
    /// The file has another format.
    #[error("points are read from .xyz, .csv, .txt, .pcd or .ply; convert it")]
    Kind,
    /// A line that cannot be read.
    #[error("line {line}: {reason}")]
    Line {
        /// Counted from 1.
        line: usize,
        /// What is wrong.
        reason: String,
    },
    /// Binary data cannot be read.
    #[error("at byte {offset}: {reason}")]
    Byte {
        /// Counted from 0.
        offset: usize,
        /// What is wrong.
        reason: String,
    },
}

/// The points of a file, whose format follows from the end of its name. Points that the camera did not see (`nan`, `inf`) are left out.
///
/// # Errors
/// [`PointsError`] names the line, or the byte.
pub fn points(name: &str, bytes: &[u8]) -> Result<Vec<[f32; 3]>, PointsError> {
    let kind = name.to_ascii_lowercase();
    let points = match kind.rsplit_once('.') {
        Some((_, "xyz" | "csv" | "txt")) => columns(bytes)?,
        Some((_, "pcd")) => pcd::points(bytes)?,
        Some((_, "ply")) => ply::points(bytes)?,
        _ => return Err(PointsError::Kind),
    };
    let is_seen = |point: &&[f64; 3]| point.iter().all(|c| c.is_finite());
    // Values too large for `f32` become infinite, which a cloud refuses.
    Ok(points.iter().filter(is_seen).map(|point| point.map(|c| c as f32)).collect())
}

/// The points of a PCD or PLY file without a name, by its first bytes.
///
/// # Errors
/// [`PointsError`] names the line, or the byte.
pub fn points_by_content(bytes: &[u8]) -> Result<Vec<[f32; 3]>, PointsError> {
    points(if bytes.starts_with(b"ply") { "it.ply" } else { "it.pcd" }, bytes)
}

/// The three numbers at the beginning of each line, separated by semicolons, else by commas, else by spaces.
fn columns(bytes: &[u8]) -> Result<Vec<[f64; 3]>, PointsError> {
    let (mut points, mut fields_before) = (Vec::new(), 0);
    let mut lines = Lines::new(bytes);
    while let Some((index, line)) = lines.next() {
        let ends = !lines.rest().is_empty() || bytes.ends_with(b"\n");
        let wrong = |reason: String| PointsError::Line { line: index, reason };
        let line = line.split('#').next().unwrap_or("").trim();
        if line.is_empty() {
            continue;
        }
        if points.len() == MAX_POINTS {
            return Err(wrong(format!("more than {MAX_POINTS} points: thin it first")));
        }
        let between = [';', ','].into_iter().find(|between| line.contains(*between));
        let words = || match between {
            Some(between) => Words::Split(line.split(between)),
            None => Words::Blanks(line.split_whitespace()),
        };
        let fields = words().count();
        if !ends && fields < fields_before {
            return Err(wrong(format!(
                "the last line has {fields} fields and no end, the one before it has {fields_before}: the file was cut off"
            )));
        }
        fields_before = fields;
        let numbers: Vec<f64> = words().take(3).map_while(|word| word.parse().ok()).collect();
        let point = <[f64; 3]>::try_from(numbers).map_err(|_| wrong("a point has three numbers".to_owned()))?;
        points.push(point);
    }
    Ok(points)
}

/// The fields of a line.
enum Words<'l> {
    Split(std::str::Split<'l, char>),
    Blanks(std::str::SplitWhitespace<'l>),
}

impl<'l> Iterator for Words<'l> {
    type Item = &'l str;

    fn next(&mut self) -> Option<&'l str> {
        match self {
            Words::Split(words) => words.next().map(str::trim),
            Words::Blanks(words) => words.next(),
        }
    }
}

/// The lines of a file, counted from 1; binary data may follow them.
#[derive(Debug)]
pub(crate) struct Lines<'b> {
    rest: &'b [u8],
    line: usize,
}

impl<'b> Lines<'b> {
    pub(crate) fn new(bytes: &'b [u8]) -> Lines<'b> {
        Lines { rest: bytes, line: 0 }
    }

    /// The number of the last line.
    pub(crate) fn line(&self) -> usize {
        self.line
    }

    /// The bytes after the last line.
    pub(crate) fn rest(&self) -> &'b [u8] {
        self.rest
    }
}

impl<'b> Iterator for Lines<'b> {
    type Item = (usize, Cow<'b, str>);

    fn next(&mut self) -> Option<(usize, Cow<'b, str>)> {
        if self.rest.is_empty() {
            return None;
        }
        let end = self.rest.iter().position(|byte| *byte == b'\n').unwrap_or(self.rest.len());
        let line = String::from_utf8_lossy(&self.rest[..end]);
        self.rest = self.rest.get(end + 1..).unwrap_or(&[]);
        self.line += 1;
        Some((self.line, line))
    }
}
