//! Reading Collada (.dae): the geometries that the scene shows, moved as its nodes say, in metres by its `unit`.
//!
//! As in ROS the `up_axis` is not applied: the axes are those of the file. Triangles and polygons are read; materials, normals, textures
//! and cameras say nothing of the shape. Skinned meshes are refused.

use crate::mesh::MeshError;
use std::collections::BTreeMap;
use xml::reader::{EventReader, XmlEvent};

type Matrix = [[f64; 4]; 3];

/// Nodes in nodes at the most, also where they are instances.
const DEEPEST: usize = 64;

/// Elements of a file at the most.
const MOST_ELEMENTS: usize = 1_000_000;

const IDENTITY: Matrix = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];

/// The triangles of a file.
pub(crate) fn triangles(bytes: &[u8], most: usize) -> Result<Vec<[[f64; 3]; 3]>, MeshError> {
    let root = read(bytes)?;
    let mut by_id = BTreeMap::new();
    collect(&root, &mut by_id);
    let unit = root.child("asset").and_then(|asset| asset.child("unit"));
    let meter = unit.and_then(|unit| unit.attribute("meter")).map_or(Ok(1.0), |text| {
        text.trim().parse::<f64>().map_err(|_| root.wrong("the `meter` of its `unit` is no number"))
    })?;
    let mut file = File { by_id, triangles: Vec::new(), most };
    let scene = root.child("scene").and_then(|scene| scene.child("instance_visual_scene"));
    match scene {
        Some(instance) => {
            let shown = file.named(instance, "url")?;
            for node in shown.children_named("node") {
                file.node(node, &IDENTITY, 0)?;
            }
        }
        // Without a scene everything is shown.
        None => {
            for library in root.children_named("library_geometries") {
                for geometry in library.children_named("geometry") {
                    file.geometry(geometry, &IDENTITY)?;
                }
            }
        }
    }
    for corner in file.triangles.iter_mut().flatten() {
        *corner = corner.map(|c| c * meter);
    }
    Ok(file.triangles)
}

/// An element of the file.
#[derive(Debug, Default)]
struct Element {
    name: String,
    line: usize,
    attributes: Vec<(String, String)>,
    text: String,
    children: Vec<Element>,
}

impl Element {
    fn child(&self, name: &str) -> Option<&Element> {
        self.children.iter().find(|child| child.name == name)
    }

    fn children_named<'e>(&'e self, name: &'e str) -> impl Iterator<Item = &'e Element> {
        self.children.iter().filter(move |child| child.name == name)
    }

    fn attribute(&self, name: &str) -> Option<&str> {
        self.attributes.iter().find(|(key, _)| key == name).map(|(_, value)| value.as_str())
    }

    fn wrong(&self, reason: impl Into<String>) -> MeshError {
        MeshError::Text { line: self.line, reason: reason.into() }
    }

    fn numbers<T: std::str::FromStr>(&self) -> Result<Vec<T>, MeshError> {
        let parse = |word: &str| {
            word.parse().map_err(|_| self.wrong(format!("`{word}` in `{}` is not a number of this kind", self.name)))
        };
        self.text.split_whitespace().map(parse).collect()
    }

    fn floats<const N: usize>(&self) -> Result<[f64; N], MeshError> {
        let numbers: Vec<f64> = self.numbers()?;
        let count = numbers.len();
        numbers.try_into().map_err(|_| self.wrong(format!("`{}` has {count} numbers: expected {N}", self.name)))
    }

    /// A whole number in an attribute.
    fn count(&self, name: &str, other: usize) -> Result<usize, MeshError> {
        let parse = |text: &str| text.trim().parse().map_err(|_| self.wrong(format!("`{name}` is no whole number")));
        self.attribute(name).map_or(Ok(other), parse)
    }
}

fn read(bytes: &[u8]) -> Result<Element, MeshError> {
    use xml::common::Position;
    let mut reader = EventReader::new(bytes);
    let mut open = vec![Element::default()];
    let mut elements = 0;
    loop {
        let event = reader.next();
        let line = reader.position().row as usize + 1;
        let wrong = |reason: String| MeshError::Text { line, reason };
        match event.map_err(|error| wrong(format!("it is not valid XML: {}", error.msg())))? {
            XmlEvent::StartElement { name, attributes, .. } => {
                elements += 1;
                if elements > MOST_ELEMENTS || open.len() > 2 * DEEPEST {
                    return Err(wrong("it has too many elements; simplify it".to_owned()));
                }
                let attributes = attributes.into_iter().map(|a| (a.name.local_name, a.value)).collect();
                open.push(Element { name: name.local_name, line, attributes, ..Element::default() });
            }
            XmlEvent::Characters(text) | XmlEvent::CData(text) => {
                if let Some(element) = open.last_mut() {
                    element.text += &text;
                }
            }
            XmlEvent::EndElement { .. } => {
                if let (Some(element), Some(parent)) = (open.pop(), open.last_mut()) {
                    parent.children.push(element);
                }
            }
            XmlEvent::EndDocument => break,
            _ => {}
        }
    }
    let root = open.pop().and_then(|document| document.children.into_iter().next());
    let collada = root.filter(|root| root.name == "COLLADA");
    collada.ok_or_else(|| MeshError::Text { line: 1, reason: "its root element is not `COLLADA`".to_owned() })
}

fn collect<'e>(element: &'e Element, by_id: &mut BTreeMap<&'e str, &'e Element>) {
    if let Some(id) = element.attribute("id") {
        by_id.insert(id, element);
    }
    element.children.iter().for_each(|child| collect(child, by_id));
}

struct File<'e> {
    by_id: BTreeMap<&'e str, &'e Element>,
    triangles: Vec<[[f64; 3]; 3]>,
    most: usize,
}

impl<'e> File<'e> {
    /// The element that an attribute refers to.
    fn named(&self, element: &Element, attribute: &str) -> Result<&'e Element, MeshError> {
        let name = element.attribute(attribute).and_then(|url| url.strip_prefix('#'));
        let name =
            name.ok_or_else(|| element.wrong(format!("`{}` has no `{attribute}` of this file", element.name)))?;
        self.by_id.get(name).copied().ok_or_else(|| element.wrong(format!("there is no element with the id `{name}`")))
    }

    fn node(&mut self, node: &'e Element, above: &Matrix, depth: usize) -> Result<(), MeshError> {
        if depth > DEEPEST {
            return Err(node.wrong("its nodes are instances of each other without end, or too deep"));
        }
        let mut place = *above;
        for child in &node.children {
            let step = match child.name.as_str() {
                "matrix" => matrix(&child.floats::<16>()?),
                "translate" => {
                    let [x, y, z] = child.floats()?;
                    [[1.0, 0.0, 0.0, x], [0.0, 1.0, 0.0, y], [0.0, 0.0, 1.0, z]]
                }
                "scale" => {
                    let [x, y, z] = child.floats()?;
                    [[x, 0.0, 0.0, 0.0], [0.0, y, 0.0, 0.0], [0.0, 0.0, z, 0.0]]
                }
                "rotate" => rotation(child)?,
                "lookat" | "skew" => return Err(child.wrong(format!("`{}` is not supported", child.name))),
                _ => continue,
            };
            place = times(&place, &step);
        }
        for child in &node.children {
            match child.name.as_str() {
                "node" => self.node(child, &place, depth + 1)?,
                "instance_node" => self.node(self.named(child, "url")?, &place, depth + 1)?,
                "instance_geometry" => self.geometry(self.named(child, "url")?, &place)?,
                "instance_controller" => {
                    return Err(child.wrong("skinned meshes are not supported: export it without controllers"));
                }
                _ => {}
            }
        }
        Ok(())
    }

    fn geometry(&mut self, geometry: &'e Element, place: &Matrix) -> Result<(), MeshError> {
        let mesh = geometry.child("mesh").ok_or_else(|| geometry.wrong("a geometry that is no `mesh`"))?;
        for part in &mesh.children {
            match part.name.as_str() {
                "triangles" | "polylist" | "polygons" => self.faces(part, place)?,
                "trifans" | "tristrips" => {
                    return Err(part.wrong(format!("`{}` are not supported: export triangles", part.name)));
                }
                _ => {}
            }
        }
        Ok(())
    }

    fn faces(&mut self, part: &'e Element, place: &Matrix) -> Result<(), MeshError> {
        let (mut stride, mut source) = (0, None);
        for input in part.children_named("input") {
            let offset = input.count("offset", 0)?;
            stride = stride.max(offset + 1);
            if input.attribute("semantic") == Some("VERTEX") {
                source = Some((offset, self.named(input, "source")?));
            }
        }
        let (offset, vertices) = source.ok_or_else(|| part.wrong("it has no input of the semantic VERTEX"))?;
        let mut inputs = vertices.children_named("input");
        let input = inputs.find(|input| input.attribute("semantic") == Some("POSITION"));
        let input = input.ok_or_else(|| vertices.wrong("it has no input of the semantic POSITION"))?;
        let positions = positions(self.named(input, "source")?)?;
        let indices = part.children_named("p").map(Element::numbers).collect::<Result<Vec<Vec<usize>>, _>>()?;
        let sizes: Vec<usize> = match part.name.as_str() {
            "polygons" => indices.iter().map(|indices| indices.len() / stride).collect(),
            "polylist" => part.child("vcount").map_or(Ok(Vec::new()), Element::numbers)?,
            _ => vec![3; indices.iter().map(Vec::len).sum::<usize>() / (3 * stride)],
        };
        let indices = indices.concat();
        let mut corners = indices.chunks_exact(stride).map(|corner| corner[offset]);
        for size in sizes {
            let face: Vec<usize> = corners.by_ref().take(size).collect();
            if face.len() < size || size < 3 {
                return Err(part.wrong("a face has fewer than three corners, or the list of corners ends too early"));
            }
            let place = |index: &usize| {
                let corner = positions.get(*index);
                corner
                    .map(|corner| apply(place, *corner))
                    .ok_or_else(|| part.wrong(format!("a face names vertex {index}, there are {}", positions.len())))
            };
            let face = face.iter().map(place).collect::<Result<Vec<[f64; 3]>, _>>()?;
            self.triangles.extend((1..size - 1).map(|i| [face[0], face[i], face[i + 1]]));
            if self.triangles.len() > self.most {
                return Err(MeshError::Count { triangles: self.triangles.len() });
            }
        }
        Ok(())
    }
}

fn positions(source: &Element) -> Result<Vec<[f64; 3]>, MeshError> {
    let array = source.child("float_array").ok_or_else(|| source.wrong("it has no `float_array`"))?;
    let accessor = source.child("technique_common").and_then(|common| common.child("accessor"));
    let stride = accessor.map_or(Ok(3), |accessor| accessor.count("stride", 3))?;
    if stride < 3 {
        return Err(source.wrong("a position has at least three coordinates"));
    }
    let numbers: Vec<f64> = array.numbers()?;
    Ok(numbers.chunks_exact(stride).map(|at| [at[0], at[1], at[2]]).collect())
}

fn matrix(rows: &[f64; 16]) -> Matrix {
    std::array::from_fn(|row| std::array::from_fn(|column| rows[4 * row + column]))
}

/// About an axis, in degrees (Rodrigues).
fn rotation(element: &Element) -> Result<Matrix, MeshError> {
    let [x, y, z, degrees] = element.floats()?;
    let length = f64::sqrt(x * x + y * y + z * z);
    if length < 1e-12 {
        return Err(element.wrong("the axis of `rotate` has no length"));
    }
    let axis = [x / length, y / length, z / length];
    let (s, c) = degrees.to_radians().sin_cos();
    let [x, y, z] = axis;
    let skew = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]];
    Ok(std::array::from_fn(|i| {
        std::array::from_fn(|j| match j {
            3 => 0.0,
            _ => (if i == j { c } else { 0.0 }) + s * skew[i][j] + (1.0 - c) * axis[i] * axis[j],
        })
    }))
}

fn times(a: &Matrix, b: &Matrix) -> Matrix {
    std::array::from_fn(|i| {
        std::array::from_fn(|j| (0..3).map(|k| a[i][k] * b[k][j]).sum::<f64>() + if j == 3 { a[i][3] } else { 0.0 })
    })
}

fn apply(place: &Matrix, [x, y, z]: [f64; 3]) -> [f64; 3] {
    place.map(|row| row[0] * x + row[1] * y + row[2] * z + row[3])
}
