//! Reads PCD, the point clouds of PCL: text, binary, or compressed binary; `x`, `y` and `z` may be anywhere in `FIELDS`.
//!
//! The `VIEWPOINT` gives the camera's pose and is not applied, as in PCL. Compressed files store one field after the other, packed by LZF
//! (Marc Lehmann's LibLZF).

use crate::cloud::MAX_POINTS;
use crate::point_files::{Lines, PointsError};
use crate::scalar::Scalar;

/// Maximum unpacked bytes of a compressed file.
const MOST_UNPACKED: usize = 512 << 20;

/// The content of a header; empty or `None` where it has no such line.
#[derive(Debug, Default)]
struct Header {
    fields: Vec<String>,
    sizes: Vec<usize>,
    kinds: Vec<String>,
    counts: Vec<usize>,
    width: Option<usize>,
    height: Option<usize>,
    points: Option<usize>,
}

/// A coordinate in a record.
#[derive(Debug, Clone, Copy)]
struct Axis {
    /// The index of its field,
    field: usize,
    /// and its binary format.
    kind: Option<Scalar>,
}

/// The points of a file; coordinates may be non-finite.
pub(crate) fn points(bytes: &[u8]) -> Result<Vec<[f64; 3]>, PointsError> {
    let mut lines = Lines::new(bytes);
    let mut header = Header::default();
    let data = loop {
        let Some((line, text)) = lines.next() else {
            return Err(PointsError::Line { line: lines.line(), reason: "it ends before `DATA`".to_owned() });
        };
        if let Some(data) = header.take(text.trim()).map_err(|reason| PointsError::Line { line, reason })? {
            break data;
        }
    };
    let wrong = |reason: String| PointsError::Line { line: lines.line(), reason };
    let count = header.count().map_err(wrong)?;
    let axes = header.axes().map_err(wrong)?;
    let first = bytes.len() - lines.rest().len();
    match &*data {
        "ascii" => header.text(&mut lines, count, axes),
        "binary" => header.records(bytes, first, count, axes),
        "binary_compressed" => header.columns(bytes, first, count, axes),
        _ => Err(wrong(format!("`DATA {data}`: it is `ascii`, `binary` or `binary_compressed`"))),
    }
}

impl Header {
    /// Parses a header line; the `DATA` line is the last, and returns the kind of data that follows.
    fn take(&mut self, text: &str) -> Result<Option<String>, String> {
        let mut words = text.split_whitespace();
        let key = words.next().unwrap_or("");
        let words: Vec<String> = words.map(str::to_owned).collect();
        let number = |word: &String| word.parse::<usize>().map_err(|_| format!("`{word}` in {key} is no whole number"));
        let numbers = || words.iter().map(number).collect::<Result<Vec<usize>, _>>();
        let one = || match &words[..] {
            [word] => number(word).map(Some),
            _ => Err(format!("{key} has one number")),
        };
        match key {
            "FIELDS" => self.fields = words,
            "SIZE" => self.sizes = numbers()?,
            "TYPE" => self.kinds = words,
            "COUNT" => self.counts = numbers()?,
            "WIDTH" => self.width = one()?,
            "HEIGHT" => self.height = one()?,
            "POINTS" => self.points = one()?,
            "DATA" => return Ok(Some(words.join(" "))),
            _ => {}
        }
        Ok(None)
    }

    /// Number of points.
    fn count(&self) -> Result<usize, String> {
        let grid = self.width.zip(self.height).map(|(width, height)| width.saturating_mul(height));
        let count = match (self.points, grid) {
            (Some(points), Some(grid)) if points != grid => {
                return Err(format!("POINTS says {points}, WIDTH and HEIGHT say {grid}"));
            }
            (points, grid) => points.or(grid).ok_or("its header has no POINTS, nor WIDTH and HEIGHT")?,
        };
        if count > MAX_POINTS {
            return Err(format!("{count} points are announced, at most {MAX_POINTS} are supported: thin it first"));
        }
        Ok(count)
    }

    fn axes(&self) -> Result<[Axis; 3], String> {
        for (key, count) in [("SIZE", self.sizes.len()), ("TYPE", self.kinds.len()), ("COUNT", self.counts.len())] {
            if count != 0 && count != self.fields.len() {
                return Err(format!("{key} speaks of {count} fields, FIELDS of {}", self.fields.len()));
            }
        }
        let mut axes = [Axis { field: 0, kind: None }; 3];
        for (axis, name) in axes.iter_mut().zip(["x", "y", "z"]) {
            let field = self.fields.iter().position(|field| field == name);
            let field = field.ok_or_else(|| format!("its FIELDS have no `{name}`"))?;
            if self.each(field) != 1 {
                return Err(format!("its field `{name}` has a COUNT of {}: expected 1", self.each(field)));
            }
            *axis = Axis { field, kind: self.kind(field) };
        }
        Ok(axes)
    }

    /// Count of numbers in a field of each point.
    fn each(&self, field: usize) -> usize {
        self.counts.get(field).copied().unwrap_or(1)
    }

    fn kind(&self, field: usize) -> Option<Scalar> {
        match (self.kinds.get(field)?.as_str(), *self.sizes.get(field)?) {
            ("F", 4) => Some(Scalar::Single),
            ("F", 8) => Some(Scalar::Double),
            ("I", size @ (1 | 2 | 4 | 8)) => Some(Scalar::Signed(size)),
            ("U", size @ (1 | 2 | 4 | 8)) => Some(Scalar::Unsigned(size)),
            _ => None,
        }
    }

    /// The offset of each field in a record, and the record's length; `None` on overflow.
    fn offsets(&self) -> Option<Vec<usize>> {
        let mut offsets = vec![0_usize];
        for field in 0..self.fields.len() {
            let size = self.sizes.get(field).copied()?.checked_mul(self.each(field))?;
            offsets.push(offsets[field].checked_add(size)?);
        }
        Some(offsets)
    }

    fn text(&self, lines: &mut Lines<'_>, count: usize, axes: [Axis; 3]) -> Result<Vec<[f64; 3]>, PointsError> {
        let words = (0..self.fields.len()).try_fold(0_usize, |sum, field| sum.checked_add(self.each(field)));
        let place = |axis: Axis| (0..axis.field).try_fold(0_usize, |sum, field| sum.checked_add(self.each(field)));
        let too_many = PointsError::Line { line: lines.line(), reason: "its COUNT is beyond all measure".to_owned() };
        let (Some(expected), [Some(x), Some(y), Some(z)]) = (words, axes.map(place)) else { return Err(too_many) };
        let mut points = Vec::new();
        for (line, text) in lines.by_ref() {
            let wrong = |reason: String| PointsError::Line { line, reason };
            let words: Vec<&str> = text.split_whitespace().collect();
            if words.is_empty() || words[0].starts_with('#') {
                continue;
            }
            if points.len() == count {
                return Err(wrong(format!("more than the {count} points that are announced")));
            }
            if words.len() != expected {
                return Err(wrong(format!("{} numbers: a point of these FIELDS has {expected}", words.len())));
            }
            let number = |i: usize| words[i].parse().map_err(|_| wrong(format!("`{}` is no number", words[i])));
            points.push([number(x)?, number(y)?, number(z)?]);
        }
        if points.len() < count {
            let reason = format!("it ends after {} of {count} points: it was cut off", points.len());
            return Err(PointsError::Line { line: lines.line(), reason });
        }
        Ok(points)
    }

    fn records(&self, bytes: &[u8], first: usize, count: usize, axes: [Axis; 3]) -> Result<Vec<[f64; 3]>, PointsError> {
        let (offsets, record, _) = self.layout(first, count)?;
        let records = &bytes[first..];
        if record.saturating_mul(count) > records.len() {
            let reason = format!(
                "it ends within the {count} points of {record} bytes that begin at byte {first}: it was cut off"
            );
            return Err(PointsError::Byte { offset: bytes.len(), reason });
        }
        let at = |point: usize, axis: Axis| point * record + offsets[axis.field];
        numbers(records, first, count, axes, at)
    }

    fn columns(&self, bytes: &[u8], first: usize, count: usize, axes: [Axis; 3]) -> Result<Vec<[f64; 3]>, PointsError> {
        let (offsets, _, all) = self.layout(first, count)?;
        let length =
            |at: usize| Scalar::Unsigned(4).read(&bytes[at.min(bytes.len())..], false).map(|length| length as usize);
        let wrong = |offset: usize, reason: String| PointsError::Byte { offset, reason };
        let (Some(packed), Some(unpacked)) = (length(first), length(first + 4)) else {
            return Err(wrong(
                bytes.len(),
                "it ends before the lengths of its compressed data: it was cut off".to_owned(),
            ));
        };
        if unpacked != all || all > MOST_UNPACKED {
            let reason = format!(
                "{unpacked} bytes unpacked: {count} points have {all}, and at most {MOST_UNPACKED} are supported"
            );
            return Err(wrong(first + 4, reason));
        }
        let begin = first + 8;
        let packed = begin.checked_add(packed).and_then(|end| bytes.get(begin..end));
        let packed = packed
            .ok_or_else(|| wrong(bytes.len(), "it ends within its compressed data: it was cut off".to_owned()))?;
        let columns =
            unpack(packed, all).map_err(|at| wrong(begin + at, "its compressed data are damaged".to_owned()))?;
        let at = |point: usize, axis: Axis| {
            offsets[axis.field] * count + point * (offsets[axis.field + 1] - offsets[axis.field])
        };
        numbers(&columns, begin, count, axes, at)
    }

    /// The offsets of fields, the length of a record and of all records, in bytes.
    fn layout(&self, first: usize, count: usize) -> Result<(Vec<usize>, usize, usize), PointsError> {
        let offsets = self.offsets();
        let record = offsets.as_ref().and_then(|offsets| offsets.last().copied());
        let all = record.and_then(|record| record.checked_mul(count));
        let reason = "SIZE or COUNT are missing or beyond all measure".to_owned();
        let (Some(offsets), Some(record), Some(all)) = (offsets, record, all) else {
            return Err(PointsError::Byte { offset: first, reason });
        };
        Ok((offsets, record, all))
    }
}

fn numbers(
    bytes: &[u8],
    first: usize,
    count: usize,
    axes: [Axis; 3],
    at: impl Fn(usize, Axis) -> usize,
) -> Result<Vec<[f64; 3]>, PointsError> {
    let unknown = || {
        let reason = "x, y and z have SIZE 4 or 8 and TYPE F, or SIZE 1, 2, 4 or 8 and TYPE I or U".to_owned();
        PointsError::Byte { offset: first, reason }
    };
    let number = |point: usize, axis: Axis| {
        axis.kind.and_then(|kind| kind.read(bytes.get(at(point, axis)..)?, false)).ok_or_else(unknown)
    };
    let [x, y, z] = axes;
    (0..count).map(|point| Ok([number(point, x)?, number(point, y)?, number(point, z)?])).collect()
}

/// Unpacks LZF data of known unpacked length. A control byte n below 32 is followed by n + 1 literal bytes. Any other control byte is a
/// back reference: its upper three bits are the length (7: the next byte is added), its lower five bits and the next byte the distance.
///
/// # Errors
/// Where the data are damaged: the byte offset.
fn unpack(packed: &[u8], length: usize) -> Result<Vec<u8>, usize> {
    let mut out: Vec<u8> = Vec::new();
    let mut at = 0;
    while at < packed.len() {
        let begin = at;
        let mut next = || {
            let byte = packed.get(at).copied().ok_or(begin);
            at += 1;
            byte.map(usize::from)
        };
        let control = next()?;
        if control < 32 {
            let bytes = packed.get(at..at + control + 1).ok_or(begin)?;
            out.extend_from_slice(bytes);
            at += control + 1;
        } else {
            let long = control >> 5;
            let long = 2 + if long == 7 { 7 + next()? } else { long };
            let back = ((control & 31) << 8) + next()? + 1;
            let from = out.len().checked_sub(back).ok_or(begin)?;
            (from..from + long).for_each(|i| out.push(out[i]));
        }
        if out.len() > length {
            return Err(begin);
        }
    }
    if out.len() == length { Ok(out) } else { Err(packed.len()) }
}
