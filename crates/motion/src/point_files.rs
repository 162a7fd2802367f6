//! Reading points from files: PCD and PLY as text, or three numbers per line (`.xyz`, `.csv`, `.txt`).

use crate::cloud::MAX_POINTS;

/// Why there are no points.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PointsError {
    /// Of another kind.
    #[error("points are read from .xyz, .csv, .txt, .pcd or .ply as text; convert it")]
    Kind,
    /// A line that cannot be read.
    #[error("line {line}: {reason}")]
    Line {
        /// Counted from 1.
        line: usize,
        /// What is wrong.
        reason: String,
    },
}

/// The points of a file, by the end of its name. What a camera did not see (`nan`) is left out.
///
/// # Errors
/// [`PointsError`] names the line.
pub fn points(name: &str, bytes: &[u8]) -> Result<Vec<[f32; 3]>, PointsError> {
    let text = String::from_utf8_lossy(bytes);
    let mut lines = text.lines().enumerate();
    let kind = name.to_ascii_lowercase();
    let most = match kind.rsplit_once('.') {
        Some((_, "xyz" | "csv" | "txt")) => MAX_POINTS + 1,
        Some((_, "pcd")) => header(&mut lines, "DATA ascii", "DATA ", "FIELDS x y z", "POINTS ")?,
        Some((_, "ply")) => header(&mut lines, "end_header", "format binary", "", "element vertex ")?,
        _ => return Err(PointsError::Kind),
    };
    let mut points = Vec::new();
    for (index, line) in lines {
        let words = line.split('#').next().unwrap_or("").split([',', ';', ' ', '\t', '\r']);
        let words: Vec<&str> = words.filter(|word| !word.is_empty()).collect();
        if words.is_empty() {
            continue;
        }
        if points.len() >= most.min(MAX_POINTS + 1) {
            break;
        }
        let numbers: Vec<f32> = words.iter().take(3).map_while(|word| word.parse().ok()).collect();
        let reason = "a point has three numbers".to_owned();
        let point = <[f32; 3]>::try_from(numbers).map_err(|_| PointsError::Line { line: index + 1, reason })?;
        points.push(point);
    }
    points.retain(|point| point.iter().all(|c| c.is_finite()));
    Ok(points)
}

/// Reads past a header up to the line `last`; gives the number of points that it announces.
fn header<'t>(
    lines: &mut impl Iterator<Item = (usize, &'t str)>,
    last: &str,
    refused: &str,
    fields: &str,
    count: &str,
) -> Result<usize, PointsError> {
    let mut announced = usize::MAX;
    let mut line = 0;
    for (index, text) in lines {
        line = index + 1;
        let text = text.trim();
        if text == last {
            return Ok(announced);
        }
        if let Some(number) = text.strip_prefix(count) {
            let reason = "the number of points is no whole number".to_owned();
            announced = number.trim().parse().map_err(|_| PointsError::Line { line, reason })?;
        }
        if text.starts_with(refused) {
            let reason = format!("`{text}`: only text is read; save it as text");
            return Err(PointsError::Line { line, reason });
        }
        if !fields.is_empty() && text.starts_with("FIELDS") && !text.starts_with(fields) {
            let reason = format!("`{text}`: its first fields are not x, y, z");
            return Err(PointsError::Line { line, reason });
        }
    }
    Err(PointsError::Line { line, reason: format!("it ends before `{last}`") })
}
