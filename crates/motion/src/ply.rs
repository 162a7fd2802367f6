//! Reads the points of PLY files, text or binary: `x`, `y` and `z` of the element `vertex`, in any order.
//!
//! Elements before the points are skipped according to the header, including lists; those after the points are not read.

use crate::cloud::MAX_POINTS;
use crate::point_files::{Lines, PointsError};
use crate::scalar::Scalar;

/// A property of an element.
#[derive(Debug)]
struct Property {
    name: String,
    /// For a list, the format of its length.
    length: Option<Scalar>,
    kind: Scalar,
}

#[derive(Debug)]
struct Element {
    name: String,
    /// Its line in the header.
    line: usize,
    count: usize,
    properties: Vec<Property>,
}

#[derive(Debug, Clone, Copy)]
enum Format {
    Text,
    Binary { is_big_endian: bool },
}

/// The points of a file; coordinates may be non-finite.
pub(crate) fn points(bytes: &[u8]) -> Result<Vec<[f64; 3]>, PointsError> {
    let mut lines = Lines::new(bytes);
    let (format, elements) = header(&mut lines)?;
    let wrong = |line, reason| PointsError::Line { line, reason };
    let vertex = elements.iter().position(|element| element.name == "vertex");
    let vertex = vertex.ok_or_else(|| wrong(lines.line(), "its header has no element `vertex`".to_owned()))?;
    let (before, element) = (&elements[..vertex], &elements[vertex]);
    if element.count > MAX_POINTS {
        let reason =
            format!("{} points are announced, at most {MAX_POINTS} are supported: thin it first", element.count);
        return Err(wrong(element.line, reason));
    }
    let mut axes = [0; 3];
    for (axis, name) in axes.iter_mut().zip(["x", "y", "z"]) {
        let found = element.properties.iter().position(|p| p.name == name && p.length.is_none());
        *axis = found
            .ok_or_else(|| wrong(element.line, format!("its `vertex` has no property `{name}` that is a number")))?;
    }
    match format {
        Format::Text => from_text(&mut lines, before, element, axes),
        Format::Binary { is_big_endian } => {
            let first = bytes.len() - lines.rest().len();
            let mut records = Records { bytes, at: first, is_big_endian };
            before.iter().try_for_each(|element| records.pass(element))?;
            records.points(element, axes)
        }
    }
}

fn header(lines: &mut Lines<'_>) -> Result<(Format, Vec<Element>), PointsError> {
    let (mut format, mut elements): (Option<Format>, Vec<Element>) = (None, Vec::new());
    let mut is_first = true;
    for (line, text) in lines.by_ref() {
        let wrong = |reason: String| PointsError::Line { line, reason };
        if std::mem::take(&mut is_first) && text.trim() != "ply" {
            return Err(wrong("a PLY file begins with `ply`".to_owned()));
        }
        let words: Vec<&str> = text.split_whitespace().collect();
        let kind = |name: &str| scalar(name).ok_or_else(|| wrong(format!("`{name}` is no kind of number")));
        match words[..] {
            ["format", name, _] => {
                format = Some(match name {
                    "ascii" => Format::Text,
                    "binary_little_endian" => Format::Binary { is_big_endian: false },
                    "binary_big_endian" => Format::Binary { is_big_endian: true },
                    _ => return Err(wrong(format!("`{name}` is no format of PLY"))),
                });
            }
            ["element", name, count] => {
                let count = count.parse().map_err(|_| wrong(format!("`{count}` is no whole number")))?;
                elements.push(Element { name: name.to_owned(), line, count, properties: Vec::new() });
            }
            ["property", .., name] if words.len() == 3 || (words.len() == 5 && words[1] == "list") => {
                let length = if words.len() == 5 { Some(kind(words[2])?) } else { None };
                let property = Property { name: name.to_owned(), length, kind: kind(words[words.len() - 2])? };
                let element = elements.last_mut().ok_or_else(|| wrong("a property before any element".to_owned()))?;
                element.properties.push(property);
            }
            ["end_header"] => {
                let format = format.ok_or_else(|| wrong("its header names no `format`".to_owned()))?;
                return Ok((format, elements));
            }
            ["ply"] | ["comment", ..] | ["obj_info", ..] | [] => {}
            _ => return Err(wrong(format!("`{}` is no line of a PLY header", text.trim()))),
        }
    }
    Err(PointsError::Line { line: lines.line(), reason: "it ends before `end_header`".to_owned() })
}

fn scalar(name: &str) -> Option<Scalar> {
    Some(match name {
        "char" | "int8" => Scalar::Signed(1),
        "uchar" | "uint8" => Scalar::Unsigned(1),
        "short" | "int16" => Scalar::Signed(2),
        "ushort" | "uint16" => Scalar::Unsigned(2),
        "int" | "int32" => Scalar::Signed(4),
        "uint" | "uint32" => Scalar::Unsigned(4),
        "float" | "float32" => Scalar::Single,
        "double" | "float64" => Scalar::Double,
        _ => return None,
    })
}

fn from_text(
    lines: &mut Lines<'_>,
    before: &[Element],
    vertex: &Element,
    axes: [usize; 3],
) -> Result<Vec<[f64; 3]>, PointsError> {
    let is_there = |(_, text): &(usize, std::borrow::Cow<'_, str>)| !text.trim().is_empty();
    for element in before.iter().filter(|element| !element.properties.is_empty()) {
        for item in 0..element.count {
            if lines.find(is_there).is_none() {
                return Err(ends(lines.line(), item, element));
            }
        }
    }
    let mut points = Vec::new();
    while points.len() < vertex.count {
        let Some((line, text)) = lines.find(is_there) else {
            return Err(ends(lines.line(), points.len(), vertex));
        };
        let point = text_item(&text, vertex, axes);
        points.push(point.map_err(|reason| PointsError::Line { line, reason })?);
    }
    Ok(points)
}

fn ends(line: usize, item: usize, element: &Element) -> PointsError {
    let reason = format!("it ends after {item} of {} `{}`: it was cut off", element.count, element.name);
    PointsError::Line { line, reason }
}

fn text_item(text: &str, vertex: &Element, axes: [usize; 3]) -> Result<[f64; 3], String> {
    let mut words = text.split_whitespace();
    let mut point = [0.0; 3];
    let short = |property: &Property| format!("it ends before the property `{}`", property.name);
    for (index, property) in vertex.properties.iter().enumerate() {
        let word = words.next().ok_or_else(|| short(property))?;
        let no_number = || format!("`{word}` is no number for the property `{}`", property.name);
        if let Some(axis) = axes.iter().position(|axis| *axis == index) {
            point[axis] = word.parse().map_err(|_| no_number())?;
        }
        if property.length.is_some() {
            let length: usize = word.parse().map_err(|_| no_number())?;
            if length > 0 && words.nth(length - 1).is_none() {
                return Err(short(property));
            }
        }
    }
    match words.next() {
        Some(word) => Err(format!("`{word}` after the last property")),
        None => Ok(point),
    }
}

/// A reader of binary records.
struct Records<'b> {
    bytes: &'b [u8],
    at: usize,
    is_big_endian: bool,
}

impl Records<'_> {
    fn cut(&self, element: &Element, item: usize) -> PointsError {
        let reason = format!("it ends within number {item} of {} `{}`: it was cut off", element.count, element.name);
        PointsError::Byte { offset: self.bytes.len(), reason }
    }

    /// Skips an element.
    fn pass(&mut self, element: &Element) -> Result<(), PointsError> {
        if element.properties.iter().all(|property| property.length.is_none()) {
            let size: usize = element.properties.iter().map(|property| property.kind.size()).sum();
            let left = self.bytes.len() - self.at;
            let all = size.checked_mul(element.count).filter(|all| *all <= left);
            self.at += all.ok_or_else(|| self.cut(element, left.checked_div(size).unwrap_or(0)))?;
            return Ok(());
        }
        // Each item has a list, which takes at least the byte of its length.
        (0..element.count).try_for_each(|item| self.item(element, item, &mut |_, _| {}))
    }

    fn points(&mut self, vertex: &Element, axes: [usize; 3]) -> Result<Vec<[f64; 3]>, PointsError> {
        let mut points = Vec::new();
        for item in 0..vertex.count {
            let mut point = [0.0; 3];
            self.item(vertex, item, &mut |property, number| {
                if let Some(axis) = axes.iter().position(|axis| *axis == property) {
                    point[axis] = number;
                }
            })?;
            points.push(point);
        }
        Ok(points)
    }

    /// Reads one item, and passes the numbers that are not in lists to `show`, with their property's index.
    fn item(&mut self, element: &Element, item: usize, show: &mut dyn FnMut(usize, f64)) -> Result<(), PointsError> {
        for (index, property) in element.properties.iter().enumerate() {
            let first = property.length.unwrap_or(property.kind);
            let number = first.read(&self.bytes[self.at..], self.is_big_endian);
            let number = number.ok_or_else(|| self.cut(element, item))?;
            self.at += first.size();
            if property.length.is_none() {
                show(index, number);
                continue;
            }
            // A length that is negative or not whole cannot be skipped.
            if number < 0.0 || number.fract() != 0.0 || !number.is_finite() {
                let reason = format!("the list `{}` has a length of {number}", property.name);
                return Err(PointsError::Byte { offset: self.at - first.size(), reason });
            }
            let left = self.bytes.len() - self.at;
            let bytes = (number as usize).checked_mul(property.kind.size()).filter(|bytes| *bytes <= left);
            self.at += bytes.ok_or_else(|| self.cut(element, item))?;
        }
        Ok(())
    }
}
