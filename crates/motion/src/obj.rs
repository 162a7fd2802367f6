//! Reads Wavefront OBJ: vertices and faces; normals, textures and groups do not affect the shape. Of materials the diffuse colour is read; an error
//! in a material only loses the colour.

use crate::mesh::{Colour, MAX_TRIANGLES, MeshError, Part};
use crate::polygon;
use std::borrow::Cow;
use std::collections::BTreeMap;

/// Maximum number of materials of a file, and maximum number of material files.
const MOST_MATERIALS: usize = 4_096;
const MOST_LIBRARIES: usize = 16;

/// The triangles of a file; faces with more corners are cut ([`polygon`]). `library` returns the content of a material file that it names, if colours
/// are wanted.
pub(crate) fn parts(bytes: &[u8], library: &mut dyn FnMut(&str) -> Option<Vec<u8>>) -> Result<Vec<Part>, MeshError> {
    let text = std::str::from_utf8(bytes).map_err(|error| {
        let line = bytes[..error.valid_up_to()].iter().filter(|b| **b == b'\n').count() + 1;
        MeshError::Text { line, reason: "it is no text in UTF-8".to_owned() }
    })?;
    let (mut vertices, mut triangles) = (Vec::new(), 0);
    let mut parts = vec![Part { colour: None, triangles: Vec::new() }];
    let (mut materials, mut libraries) = (BTreeMap::new(), 0);
    let mut lines = text.lines().enumerate();
    while let Some((index, line)) = lines.next() {
        let wrong = |reason: String| MeshError::Text { line: index + 1, reason };
        let line = continued(line, &mut lines).map_err(wrong)?;
        let mut words = line.split('#').next().unwrap_or("").split_whitespace();
        match words.next() {
            Some("v") => {
                let numbers: Vec<f64> = words.map_while(|word| word.parse().ok()).take(3).collect();
                let vertex = <[f64; 3]>::try_from(numbers);
                vertices.push(vertex.map_err(|_| wrong("a vertex `v` has three numbers".to_owned()))?);
            }
            Some("f") => {
                let corner = |word: &str| corner(word, vertices.len()).map(|i| vertices[i]).map_err(wrong);
                let corners = words.map(corner).collect::<Result<Vec<[f64; 3]>, _>>()?;
                if corners.len() < 3 {
                    return Err(wrong(format!("a face `f` has at least three corners, this has {}", corners.len())));
                }
                let face = polygon::triangles(&corners).map_err(wrong)?;
                triangles += face.len();
                if triangles > MAX_TRIANGLES {
                    return Err(MeshError::Count { triangles });
                }
                if let Some(part) = parts.last_mut() {
                    part.triangles.extend(face);
                }
            }
            Some("mtllib") if libraries < MOST_LIBRARIES => {
                libraries += 1;
                let name = words.collect::<Vec<&str>>().join(" ");
                library(&name).into_iter().for_each(|bytes| colours(&bytes, &mut materials));
            }
            Some("usemtl") => {
                let colour = materials.get(&words.collect::<Vec<&str>>().join(" ")).copied();
                if parts.last().is_some_and(|part| part.colour != colour) {
                    parts.push(Part { colour, triangles: Vec::new() });
                }
            }
            _ => {}
        }
    }
    Ok(parts)
}

/// Adds the diffuse colours of the materials of a file, by name.
fn colours(bytes: &[u8], materials: &mut BTreeMap<String, Colour>) {
    let mut material = None;
    for line in String::from_utf8_lossy(bytes).lines() {
        let mut words = line.split('#').next().unwrap_or("").split_whitespace();
        match words.next() {
            Some("newmtl") => material = Some(words.collect::<Vec<&str>>().join(" ")),
            Some("Kd") if materials.len() < MOST_MATERIALS => {
                let numbers: Vec<f64> = words.map_while(|word| word.parse().ok()).collect();
                if let (Some(name), Some(colour)) = (material.take(), numbers.first_chunk()) {
                    materials.insert(name, *colour);
                }
            }
            _ => {}
        }
    }
}

/// A line with its continuation lines: those after a backslash at its end.
fn continued<'t>(line: &'t str, lines: &mut impl Iterator<Item = (usize, &'t str)>) -> Result<Cow<'t, str>, String> {
    // A comment ends with its line.
    if !line.ends_with('\\') || line.contains('#') {
        return Ok(Cow::Borrowed(line));
    }
    let mut whole = line.to_owned();
    while whole.ends_with('\\') {
        whole.pop();
        let Some((_, next)) = lines.next() else {
            return Err("the line goes on after its `\\`, but the file ends: it was cut off".to_owned());
        };
        let is_apart = whole.ends_with(char::is_whitespace) || next.starts_with(char::is_whitespace);
        if !is_apart && !whole.is_empty() && !next.is_empty() {
            return Err("whether a number goes on after the `\\` cannot be told: put a blank before it".to_owned());
        }
        whole.push(' ');
        whole.push_str(next);
        if next.contains('#') {
            break;
        }
    }
    Ok(Cow::Owned(whole))
}

/// The vertex that a corner `7`, `7/1` or `7//2` names; negative numbers count from the last vertex so far.
fn corner(word: &str, vertices: usize) -> Result<usize, String> {
    let number = word.split('/').next().unwrap_or("");
    let named: i64 = number.parse().map_err(|_| format!("`{word}` names no vertex by a number"))?;
    let index = if named < 0 { named + vertices as i64 } else { named - 1 };
    let found = usize::try_from(index).ok().filter(|i| *i < vertices);
    found.ok_or_else(|| format!("the face names vertex {named}, there are {vertices} before it"))
}
