//! Reads Collada (.dae): the geometries in the scene, transformed by their nodes, in metres according to the file's `unit`.
//!
//! As in ROS, `up_axis` is not applied: the axes are those of the file. Triangles and polygons are read; normals, textures and cameras are not.
//! Skinned meshes, polygons with holes, and faces that do not use their whole list of corners are refused. A geometry is read once, however
//! often the scene contains it. Of materials only the diffuse colour is read; an error in a material costs only the colour, because it does not
//! affect the shape.

use crate::mesh::{Colour, MAX_TRIANGLES, MeshError, Part};
use crate::polygon;
use crate::xml_text;
use std::collections::BTreeMap;
use std::rc::Rc;
use xml::reader::XmlEvent;

type Matrix = [[f64; 4]; 3];
type Triangle = [[f64; 3]; 3];

/// Maximum depth of nested nodes, including instances.
const DEEPEST: usize = 64;

/// Maximum number of elements in the scene, where those of a node count for each instance; a long text counts for more.
const MOST_SHOWN: usize = 1_000_000;
const LONG_TEXT: usize = 1_000;

/// Maximum number of elements in a file.
const MOST_ELEMENTS: usize = 1_000_000;

/// Maximum number of positions in all sources: three for each triangle.
const MOST_POSITIONS: usize = 3 * MAX_TRIANGLES;

/// Maximum `offset` of an input and `stride` of an accessor.
const MOST_APART: usize = 1_000;

const IDENTITY: Matrix = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];

/// The triangles of a file, with the colours of their materials.
pub(crate) fn parts(bytes: &[u8]) -> Result<Vec<Part>, MeshError> {
    let root = read(bytes)?;
    let mut by_id = BTreeMap::new();
    collect(&root, &mut by_id);
    let meter = match root.child("asset").and_then(|asset| asset.child("unit")) {
        Some(unit) => meter(unit)?,
        None => 1.0,
    };
    let mut file = File {
        by_id,
        geometries: BTreeMap::new(),
        positions: BTreeMap::new(),
        read: 0,
        arrays: BTreeMap::new(),
        shown: Vec::new(),
        triangles: 0,
        elements: 0,
    };
    let scene = root.child("scene").and_then(|scene| scene.child("instance_visual_scene"));
    match scene {
        Some(instance) => {
            let shown = file.named(instance, "url")?;
            for node in shown.children_named("node") {
                file.node(node, &IDENTITY, 0)?;
            }
        }
        // Without a scene, all geometries are shown.
        None => {
            for library in root.children_named("library_geometries") {
                for geometry in library.children_named("geometry") {
                    file.show(geometry, None, &IDENTITY)?;
                }
            }
        }
    }
    for corner in file.shown.iter_mut().flat_map(|part| &mut part.triangles).flatten() {
        *corner = corner.map(|c| c * meter);
    }
    Ok(file.shown)
}

/// The length of the file's unit, in metres.
fn meter(unit: &Element) -> Result<f64, MeshError> {
    let text = unit.attribute("meter").unwrap_or("1").trim();
    let meter = text.parse::<f64>().ok().filter(|meter| *meter > 0.0 && meter.is_finite());
    meter.ok_or_else(|| unit.wrong(format!("the `meter` of its `unit` is `{text}`: expected a number above zero")))
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

    /// An attribute that is a whole number; `other` where it is missing.
    fn count(&self, name: &str, other: usize) -> Result<usize, MeshError> {
        let parse = |text: &str| text.trim().parse().map_err(|_| self.wrong(format!("`{name}` is no whole number")));
        self.attribute(name).map_or(Ok(other), parse)
    }

    /// As [`Element::count`], from `least` to [`MOST_APART`].
    fn bounded(&self, name: &str, other: usize, least: usize) -> Result<usize, MeshError> {
        let count = self.count(name, other)?;
        if !(least..=MOST_APART).contains(&count) {
            return Err(self.wrong(format!("its `{name}` is {count}: expected {least} to {MOST_APART}")));
        }
        Ok(count)
    }
}

fn determinant(m: &Matrix) -> f64 {
    let minor = |i: usize, j: usize| m[1][i] * m[2][j] - m[1][j] * m[2][i];
    m[0][0] * minor(1, 2) - m[0][1] * minor(0, 2) + m[0][2] * minor(0, 1)
}

fn read(bytes: &[u8]) -> Result<Element, MeshError> {
    use xml::common::Position;
    let mut reader = xml_text::reader(bytes);
    let mut open = vec![Element::default()];
    let mut elements = 0;
    loop {
        let event = reader.next();
        let line = reader.position().row as usize + 1;
        let wrong = |reason: String| MeshError::Text { line, reason };
        match event.map_err(|error| wrong(format!("it is not valid XML: {}", error.msg())))? {
            XmlEvent::StartElement { name, attributes, .. } => {
                if reader.doctype().is_some() {
                    return Err(wrong(xml_text::NO_DOCUMENT_TYPE.to_owned()));
                }
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
    /// What has been read so far, by the address of its element: geometries as in the file,
    geometries: BTreeMap<*const Element, Rc<[Painted<'e>]>>,
    /// and positions of `vertices` and of sources.
    positions: BTreeMap<*const Element, Rc<[[f64; 3]]>>,
    /// Number of these positions, and the arrays of numbers, which several sources may share.
    read: usize,
    arrays: BTreeMap<*const Element, Rc<[f64]>>,
    /// The scene, and its number of triangles and elements so far.
    shown: Vec<Part>,
    triangles: usize,
    elements: usize,
}

/// Triangles of a geometry with their material's symbol, which is resolved where the geometry is instanced.
struct Painted<'e> {
    material: Option<&'e str>,
    triangles: Vec<Triangle>,
}

impl<'e> File<'e> {
    /// The element that an attribute refers to.
    fn named(&self, element: &Element, attribute: &str) -> Result<&'e Element, MeshError> {
        let name = element.attribute(attribute).and_then(|url| url.strip_prefix('#'));
        let name =
            name.ok_or_else(|| element.wrong(format!("`{}` has no `{attribute}` of this file", element.name)))?;
        self.by_id.get(name).copied().ok_or_else(|| element.wrong(format!("there is no element with the id `{name}`")))
    }

    fn count(&mut self, element: &Element) -> Result<(), MeshError> {
        self.elements += 1 + element.text.len() / LONG_TEXT;
        if self.elements > MOST_SHOWN {
            let reason = "the scene shows too many nodes, or instances of them";
            return Err(element.wrong(format!("{reason}: at most {MOST_SHOWN} elements are supported, export it flat")));
        }
        Ok(())
    }

    fn node(&mut self, node: &'e Element, above: &Matrix, depth: usize) -> Result<(), MeshError> {
        self.count(node)?;
        if depth > DEEPEST {
            return Err(node.wrong("its nodes are instances of each other without end, or too deep"));
        }
        let mut place = *above;
        for child in &node.children {
            self.count(child)?;
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
                "instance_geometry" => self.show(self.named(child, "url")?, Some(child), &place)?,
                "instance_controller" => {
                    return Err(child.wrong("skinned meshes are not supported: export it without controllers"));
                }
                _ => {}
            }
        }
        Ok(())
    }

    /// Adds the triangles of a geometry to the scene, with the materials of that instance.
    fn show(&mut self, geometry: &'e Element, instance: Option<&'e Element>, place: &Matrix) -> Result<(), MeshError> {
        self.count(geometry)?;
        let painted = match self.geometries.get(&std::ptr::from_ref(geometry)) {
            Some(read) => read.clone(),
            None => {
                let read: Rc<[Painted<'e>]> = self.geometry(geometry)?.into();
                self.geometries.insert(geometry, read.clone());
                read
            }
        };
        self.triangles += painted.iter().map(|part| part.triangles.len()).sum::<usize>();
        if self.triangles > MAX_TRIANGLES {
            return Err(MeshError::Count { triangles: self.triangles });
        }
        // A mirrored part gets the reverse order of corners, so that the same side is outside.
        let is_mirrored = determinant(place) < 0.0;
        for part in painted.iter() {
            let colour = part.material.and_then(|symbol| self.colour(symbol, instance));
            let moved = part.triangles.iter().map(|triangle| {
                let [a, b, c] = triangle.map(|corner| apply(place, corner));
                if is_mirrored { [a, c, b] } else { [a, b, c] }
            });
            match self.shown.last_mut() {
                Some(last) if last.colour == colour => last.triangles.extend(moved),
                _ => self.shown.push(Part { colour, triangles: moved.collect() }),
            }
        }
        Ok(())
    }

    /// The diffuse colour of the material to which an instance binds a symbol.
    fn colour(&self, symbol: &str, instance: Option<&'e Element>) -> Option<Colour> {
        let bound = instance?.child("bind_material")?.child("technique_common")?;
        let is_meant = |one: &&Element| one.attribute("symbol") == Some(symbol);
        let material = self.named(bound.children_named("instance_material").find(is_meant)?, "target").ok()?;
        let effect = self.named(material.child("instance_effect")?, "url").ok()?;
        let shading = effect.child("profile_COMMON")?.child("technique")?;
        let diffuse = shading.children.iter().find_map(|model| model.child("diffuse"))?;
        let colour: Vec<f64> = diffuse.child("color")?.numbers().ok()?;
        colour.first_chunk().copied()
    }

    fn geometry(&mut self, geometry: &'e Element) -> Result<Vec<Painted<'e>>, MeshError> {
        let mesh = geometry.child("mesh").ok_or_else(|| geometry.wrong("a geometry that is no `mesh`"))?;
        let (mut painted, mut count) = (Vec::new(), 0);
        for part in &mesh.children {
            match part.name.as_str() {
                "triangles" | "polylist" | "polygons" => {
                    let mut triangles = Vec::new();
                    self.faces(part, &mut triangles)?;
                    count += triangles.len();
                    if count > MAX_TRIANGLES {
                        return Err(MeshError::Count { triangles: count });
                    }
                    painted.push(Painted { material: part.attribute("material"), triangles });
                }
                "trifans" | "tristrips" => {
                    return Err(part.wrong(format!("`{}` are not supported: export triangles", part.name)));
                }
                _ => {}
            }
        }
        Ok(painted)
    }

    fn faces(&mut self, part: &'e Element, triangles: &mut Vec<Triangle>) -> Result<(), MeshError> {
        let (mut stride, mut source) = (0, None);
        for input in part.children_named("input") {
            let offset = input.bounded("offset", 0, 0)?;
            stride = stride.max(offset + 1);
            if input.attribute("semantic") == Some("VERTEX") {
                source = Some((offset, self.named(input, "source")?));
            }
        }
        let (offset, vertices) = source.ok_or_else(|| part.wrong("it has no input of the semantic VERTEX"))?;
        let positions = self.positions(vertices)?;
        let faces = Faces { part, positions: &positions, stride, offset };
        let count = faces.read(triangles)?;
        if part.attribute("count").is_some() && part.count("count", 0)? != count {
            let announced = part.attribute("count").unwrap_or("");
            return Err(part.wrong(format!("its `count` is {announced}, but it has {count} faces: it is not whole")));
        }
        Ok(())
    }

    /// The positions of `vertices`.
    fn positions(&mut self, vertices: &'e Element) -> Result<Rc<[[f64; 3]]>, MeshError> {
        if let Some(read) = self.positions.get(&std::ptr::from_ref(vertices)) {
            return Ok(read.clone());
        }
        let mut inputs = vertices.children_named("input");
        let input = inputs.find(|input| input.attribute("semantic") == Some("POSITION"));
        let input = input.ok_or_else(|| vertices.wrong("it has no input of the semantic POSITION"))?;
        let source = self.named(input, "source")?;
        let read = match self.positions.get(&std::ptr::from_ref(source)) {
            Some(read) => read.clone(),
            None => self.source(source)?.into(),
        };
        self.positions.insert(source, read.clone());
        self.positions.insert(vertices, read.clone());
        Ok(read)
    }

    fn source(&mut self, source: &'e Element) -> Result<Vec<[f64; 3]>, MeshError> {
        let accessor = source.child("technique_common").and_then(|common| common.child("accessor"));
        let array = match accessor {
            Some(accessor) => Some(self.named(accessor, "source")?),
            None => source.child("float_array"),
        };
        let array = array.filter(|array| array.name == "float_array");
        let array = array.ok_or_else(|| source.wrong("it has no `float_array`"))?;
        let numbers = match self.arrays.get(&std::ptr::from_ref(array)) {
            Some(numbers) => numbers.clone(),
            None => {
                let numbers: Rc<[f64]> = array.numbers()?.into();
                self.arrays.insert(array, numbers.clone());
                numbers
            }
        };
        let positions = positions(source, accessor, &numbers)?;
        self.read += positions.len();
        if self.read > MOST_POSITIONS {
            return Err(
                source.wrong(format!("with it all sources have more than {MOST_POSITIONS} positions: simplify it"))
            );
        }
        Ok(positions)
    }
}

/// The faces of one `triangles`, `polylist` or `polygons`.
struct Faces<'e> {
    part: &'e Element,
    positions: &'e [[f64; 3]],
    /// Numbers per corner, and which of them is the vertex's index.
    stride: usize,
    offset: usize,
}

impl Faces<'_> {
    /// Adds the triangles of all faces; returns the number of faces.
    fn read(&self, triangles: &mut Vec<Triangle>) -> Result<usize, MeshError> {
        let part = self.part;
        if part.child("ph").is_some() {
            return Err(part.wrong("polygons with holes (`ph`) are not supported: export triangles"));
        }
        let mut count = 0;
        if part.name == "polygons" {
            for list in part.children_named("p") {
                self.face(&self.corners(list)?, triangles)?;
                count += 1;
            }
            return Ok(count);
        }
        let mut corners = Vec::new();
        for list in part.children_named("p") {
            corners.extend(self.corners(list)?);
        }
        let sizes: Vec<usize> = match part.child("vcount") {
            Some(vcount) if part.name == "polylist" => vcount.numbers()?,
            None if part.name == "polylist" && !corners.is_empty() => {
                return Err(part.wrong("a `polylist` without `vcount`: how many corners its faces have is not said"));
            }
            _ => vec![3; corners.len().div_ceil(3)],
        };
        let mut rest = &corners[..];
        for size in sizes {
            let (face, others) = rest.split_at_checked(size).ok_or_else(|| {
                part.wrong(format!(
                    "a face of `{}` has {size} corners, but the list of corners ends too early",
                    part.name
                ))
            })?;
            self.face(face, triangles)?;
            rest = others;
            count += 1;
        }
        match rest.len() {
            0 => Ok(count),
            left => Err(part.wrong(format!("{left} corners of `{}` belong to no face by its `vcount`", part.name))),
        }
    }

    /// The vertex indices in a list.
    fn corners(&self, list: &Element) -> Result<Vec<usize>, MeshError> {
        let indices: Vec<usize> = list.numbers()?;
        if !indices.len().is_multiple_of(self.stride) {
            let (count, stride, name) = (indices.len(), self.stride, &self.part.name);
            return Err(list.wrong(format!("{count} numbers in a `p` of `{name}`: expected a multiple of {stride}")));
        }
        Ok(indices.chunks_exact(self.stride).map(|corner| corner[self.offset]).collect())
    }

    fn face(&self, indices: &[usize], triangles: &mut Vec<Triangle>) -> Result<(), MeshError> {
        let part = self.part;
        if indices.len() < 3 {
            return Err(part.wrong(format!("a face of `{}` has fewer than three corners", part.name)));
        }
        let corner = |index: &usize| {
            let beyond = || part.wrong(format!("a face names vertex {index}, there are {}", self.positions.len()));
            self.positions.get(*index).copied().ok_or_else(beyond)
        };
        let face = indices.iter().map(corner).collect::<Result<Vec<[f64; 3]>, _>>()?;
        triangles.extend(polygon::triangles(&face).map_err(|reason| part.wrong(reason))?);
        if triangles.len() > MAX_TRIANGLES {
            return Err(MeshError::Count { triangles: triangles.len() });
        }
        Ok(())
    }
}

/// The positions in an array of numbers, according to an accessor; parameters without a name are skipped.
fn positions(source: &Element, accessor: Option<&Element>, numbers: &[f64]) -> Result<Vec<[f64; 3]>, MeshError> {
    let Some(accessor) = accessor else {
        return Ok(numbers.chunks_exact(3).map(|at| [at[0], at[1], at[2]]).collect());
    };
    let stride = accessor.bounded("stride", 3, 1)?;
    let named = |(_, param): &(usize, &Element)| param.attribute("name").is_some_and(|name| !name.is_empty());
    let mut places: Vec<usize> =
        accessor.children_named("param").enumerate().filter(named).map(|(place, _)| place).collect();
    if accessor.child("param").is_none() {
        places = (0..stride.min(3)).collect();
    }
    let (Some([x, y, z]), true) = (places.first_chunk::<3>().copied(), places.iter().all(|place| *place < stride))
    else {
        return Err(source.wrong("a position has three coordinates: its accessor names fewer, or more than its stride"));
    };
    let offset = accessor.count("offset", 0)?;
    let all = numbers.get(offset..).unwrap_or(&[]);
    let count = accessor.count("count", all.len() / stride)?;
    // The last position may end before its stride.
    let last = [x, y, z].into_iter().max().unwrap_or(0);
    let needed = count.checked_sub(1).map_or(Some(0), |others| others.checked_mul(stride)?.checked_add(last + 1));
    if needed.is_none_or(|needed| needed > all.len()) {
        let there = numbers.len();
        return Err(
            accessor.wrong(format!("{count} positions of stride {stride} are announced, there are {there} numbers"))
        );
    }
    Ok((0..count).map(|i| [all[i * stride + x], all[i * stride + y], all[i * stride + z]]).collect())
}

fn matrix(rows: &[f64; 16]) -> Matrix {
    std::array::from_fn(|row| std::array::from_fn(|column| rows[4 * row + column]))
}

/// A rotation about an axis, in degrees (Rodrigues).
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
