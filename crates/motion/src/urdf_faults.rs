//! Finds errors in the text of a URDF, with their place: elements that are not closed, missing attributes, invalid numbers, contradictory limits,
//! links that are not one tree (`urdf_tree`). The reader of the whole description ([`urdf_rs`]) does not keep the lines.

use crate::urdf_tree::{JointText, Place, Tree};
use crate::xml_text;
use std::collections::BTreeMap;
use xml::attribute::OwnedAttribute;
use xml::common::Position;
use xml::reader::XmlEvent;

/// The first error in a URDF.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("line {line}, column {column}: {reason}")]
pub struct UrdfFault {
    /// The line, from 1.
    pub line: u64,
    /// The column, from 1.
    pub column: u64,
    /// The error.
    pub reason: String,
}

/// The expected value of an attribute. The count is the number of values, separated by blanks.
#[derive(Debug, Clone, Copy)]
enum Value {
    Text,
    /// Lengths, angles and direction vectors.
    Numbers(usize),
    /// Sizes, in metres.
    Sizes(usize),
    /// Factors along x, y and z.
    Scale,
    /// A maximum of size or speed; infinite for no limit, 0 for unknown.
    Most,
    /// A position.
    Limit,
    /// A number that is parsed, but not used.
    Unused,
    /// Red, green, blue and opacity; values outside of 0 to 1, or NaN, are corrected when they are shown.
    Colour,
}

use Value::{Colour, Limit, Most, Numbers, Scale, Sizes, Text, Unused};

/// Maximum position and size: larger ones are not in metres. Shapes are computed in single precision, which allows for little more.
const FARTHEST: f64 = 1e6;

/// Minimum length of an axis.
const SHORTEST_AXIS: f64 = 1e-9;

/// The checked attributes: the parent element, the element, the attribute, its value, and whether it is required.
const ATTRIBUTES: &[(&str, &str, &str, Value, bool)] = &[
    ("", "robot", "name", Text, true),
    ("robot", "link", "name", Text, true),
    ("robot", "joint", "name", Text, true),
    ("robot", "joint", "type", Text, true),
    ("joint", "parent", "link", Text, true),
    ("joint", "child", "link", Text, true),
    ("joint", "axis", "xyz", Numbers(3), true),
    ("joint", "origin", "xyz", Numbers(3), false),
    ("joint", "origin", "rpy", Numbers(3), false),
    ("joint", "limit", "lower", Limit, false),
    ("joint", "limit", "upper", Limit, false),
    ("joint", "limit", "velocity", Most, true),
    ("joint", "limit", "acceleration", Most, false),
    ("joint", "limit", "deceleration", Most, false),
    ("joint", "limit", "jerk", Most, false),
    ("joint", "limit", "effort", Limit, false),
    ("joint", "dynamics", "damping", Unused, false),
    ("joint", "dynamics", "friction", Unused, false),
    ("joint", "mimic", "joint", Text, true),
    ("joint", "mimic", "multiplier", Numbers(1), false),
    ("joint", "mimic", "offset", Numbers(1), false),
    ("inertial", "origin", "xyz", Numbers(3), false),
    ("inertial", "origin", "rpy", Numbers(3), false),
    ("inertial", "mass", "value", Most, true),
    ("inertial", "inertia", "ixx", Unused, true),
    ("inertial", "inertia", "ixy", Unused, true),
    ("inertial", "inertia", "ixz", Unused, true),
    ("inertial", "inertia", "iyy", Unused, true),
    ("inertial", "inertia", "iyz", Unused, true),
    ("inertial", "inertia", "izz", Unused, true),
    ("collision", "origin", "xyz", Numbers(3), false),
    ("collision", "origin", "rpy", Numbers(3), false),
    ("visual", "origin", "xyz", Numbers(3), false),
    ("visual", "origin", "rpy", Numbers(3), false),
    ("geometry", "box", "size", Sizes(3), true),
    ("geometry", "sphere", "radius", Sizes(1), true),
    ("geometry", "cylinder", "radius", Sizes(1), true),
    ("geometry", "cylinder", "length", Sizes(1), true),
    ("geometry", "capsule", "radius", Sizes(1), true),
    ("geometry", "capsule", "length", Sizes(1), true),
    ("geometry", "mesh", "filename", Text, true),
    ("geometry", "mesh", "scale", Scale, false),
    ("visual", "material", "name", Text, true),
    ("material", "color", "rgba", Colour, false),
];

/// The result for a text without errors.
#[derive(Debug, Default)]
pub(crate) struct Checked {
    /// The places of its joints.
    pub(crate) joints: BTreeMap<String, JointText>,
    /// Whether [`is_empty_material`] is true for any element.
    pub(crate) has_empty_materials: bool,
}

/// Whether an element is a colour or a texture without a value: it has no meaning, and other URDF readers ignore it.
pub(crate) fn is_empty_material(parent: &str, element: &str, attributes: &[OwnedAttribute]) -> bool {
    let lacks = |key: &str| !attributes.iter().any(|attribute| attribute.name.local_name == key);
    parent == "material" && (element == "texture" && lacks("filename") || element == "color" && lacks("rgba"))
}

/// The message for a text that is not XML, with advice for a known error.
fn not_xml(message: &str) -> String {
    match message.strip_suffix(" prefix is unbound").and_then(|name| name.split_once(' ')) {
        Some((_, name)) => {
            let prefix = name.split(':').next().unwrap_or(name);
            format!(
                "{message}: declare it at the outermost element, `<robot xmlns:{prefix}=\"{prefix}\" ...>`, or take the attributes and elements \
                 with `{prefix}:` out"
            )
        }
        None => message.to_owned(),
    }
}

/// The types of joints in URDF.
const TYPES: [&str; 7] = ["revolute", "continuous", "prismatic", "fixed", "floating", "planar", "spherical"];

/// Finds the first error; without one, returns the result.
///
/// # Errors
/// [`UrdfFault`].
pub(crate) fn check(text: &str) -> Result<Checked, UrdfFault> {
    let mut reader = xml_text::reader(text.as_bytes());
    let (mut open, mut tree, mut has_limits): (Vec<String>, _, _) = (Vec::new(), Tree::default(), false);
    // The name of the current link or joint, and whether a joint moves.
    let (mut named, mut moves) = (String::new(), false);
    let mut has_empty_materials = false;
    loop {
        let event = reader.next();
        let at = reader.position();
        let at = Place { line: at.row + 1, column: at.column + 1 };
        let fault = |reason: String| at.fault(reason);
        match event {
            Err(error) => {
                let at = error.position();
                return Err(Place { line: at.row + 1, column: at.column + 1 }.fault(not_xml(error.msg())));
            }
            Ok(XmlEvent::StartElement { name, attributes, .. }) => {
                let element = name.local_name;
                let parent = open.last().map_or("", String::as_str);
                if reader.doctype().is_some() {
                    return Err(fault(xml_text::NO_DOCUMENT_TYPE.to_owned()));
                }
                if parent.is_empty() && element != "robot" {
                    return Err(fault(format!("the outermost element is `{element}` instead of `robot`")));
                }
                let value_of = |key: &str| {
                    attributes.iter().find(|a| a.name.local_name == key).map(|attribute| attribute.value.as_str())
                };
                let text = |key: &str| value_of(key).unwrap_or_default();
                if open.len() == 1 {
                    named = format!(" (in the {element} `{}`)", text("name"));
                }
                let place = if open.len() > 1 { named.as_str() } else { "" };
                for (_, _, key, value, needed) in
                    ATTRIBUTES.iter().filter(|row| (row.0, row.1) == (parent, &element[..]))
                {
                    let wrong = wrong(&element, key, value_of(key), *value, *needed);
                    wrong.map_or(Ok(()), |reason| Err(fault(reason + place)))?;
                }
                has_empty_materials |= is_empty_material(parent, &element, &attributes);
                match (parent, &element[..]) {
                    ("robot", "link") => tree.link(text("name"), at)?,
                    ("robot", "joint") => {
                        let kind = text("type");
                        if !TYPES.contains(&kind) {
                            return Err(fault(format!("a joint of type `{kind}`: there is {}", TYPES.join(", "))));
                        }
                        has_limits = ["revolute", "prismatic"].contains(&kind);
                        moves = has_limits || kind == "continuous";
                        tree.joint(text("name"), at)?;
                    }
                    ("joint", "parent" | "child") if open.len() == 2 => tree.end(&element, text("link"), at),
                    ("joint", "axis") if moves && !points(text("xyz")) => {
                        let xyz = text("xyz");
                        return Err(fault(format!(
                            "the joint `{}`: its axis `{xyz}` has no length; write the direction that it slides along or turns about, as `0 0 1`",
                            tree.last_joint()
                        )));
                    }
                    ("joint", "mimic") if open.len() == 2 => tree.follows(text("joint"), at),
                    ("joint", "limit") if has_limits => {
                        tree.limited();
                        contradiction(text("lower"), text("upper")).map_or(Ok(()), |reason| {
                            Err(fault(format!("the joint `{}`: {reason}", tree.last_joint())))
                        })?;
                    }
                    _ => {}
                }
                open.push(element);
            }
            Ok(XmlEvent::EndElement { .. }) => {
                open.pop();
            }
            Ok(XmlEvent::EndDocument) => {
                return tree.check().map(|()| Checked { joints: tree.joints(), has_empty_materials });
            }
            Ok(_) => {}
        }
    }
}

/// The error in an attribute, if any, with advice.
fn wrong(element: &str, key: &str, found: Option<&str>, value: Value, needed: bool) -> Option<String> {
    let Some(text) = found else { return needed.then(|| format!("`{element}` has no attribute `{key}`")) };
    let count = match value {
        Text => return None,
        Numbers(count) | Sizes(count) => count,
        Colour => 4,
        Scale => 3,
        Most | Limit | Unused => 1,
    };
    let is = format!("`{key}` of `{element}` is `{text}`");
    let numbers: Option<Vec<f64>> = text.split_whitespace().map(|word| word.parse().ok()).collect();
    let may_be = |number: &f64| !number.is_nan() || matches!(value, Colour);
    let Some(numbers) = numbers.filter(|numbers| numbers.len() == count && numbers.iter().all(may_be)) else {
        let plural = if count == 1 { "a number".to_owned() } else { format!("{count} numbers") };
        return Some(format!("{is} instead of {plural}"));
    };
    let any = |is_wrong: fn(f64) -> bool| numbers.iter().any(|n| is_wrong(*n));
    let far = match value {
        Text | Limit | Colour => return None,
        Most => {
            return any(|n| n < 0.0)
                .then(|| format!("{is}: that is never below 0; leave out the sign, or write 0 where it is not known"));
        }
        Unused => return any(f64::is_infinite).then(|| format!("{is}: write a finite number")),
        Scale if any(|n| n == 0.0) => {
            return Some(format!(
                "{is}: a factor of 0 leaves nothing of the mesh; write by what its numbers become metres"
            ));
        }
        Sizes(_) if any(|n| n < 0.0) => {
            return Some(format!("{is}: no size is below 0; write it in metres, without a sign"));
        }
        Numbers(_) | Sizes(_) | Scale => any(|n| n.abs() > FARTHEST),
    };
    far.then(|| format!("{is}: write finite numbers of at most {FARTHEST:e}, in metres and radians"))
}

/// Whether an axis has a direction.
fn points(xyz: &str) -> bool {
    let square: f64 = xyz.split_whitespace().filter_map(|word| word.parse::<f64>().ok()).map(|c| c * c).sum();
    square.sqrt() > SHORTEST_AXIS
}

/// The error in a range, if any; a missing end is 0.
fn contradiction(lower: &str, upper: &str) -> Option<String> {
    let [lower, upper] = [lower, upper].map(|text| text.trim().parse().unwrap_or(0.0));
    if lower > upper {
        return Some(format!("its lower limit {lower} is above its upper limit {upper}"));
    }
    let nowhere = lower == f64::INFINITY || upper == f64::NEG_INFINITY;
    nowhere.then(|| format!("its limits are {lower} to {upper}: nothing is there"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fault_is_found_with_its_line() {
        let fault = |text: &str| check(text).err().map(|fault| fault.to_string()).unwrap_or_default();
        assert!(check("<robot name='r'><link name='l'/></robot>").is_ok());
        assert_eq!(fault("<robot name='r'>\n <link/>\n</robot>"), "line 2, column 2: `link` has no attribute `name`");
        let joint = |inner: &str| {
            format!("<robot name='r'><link name='l'/>\n<joint name='j' type='revolute'>\n{inner}</joint></robot>")
        };
        let read = check(&joint("<axis xyz='0 0 1'/>")).unwrap_or_default().joints;
        assert_eq!(read.get("j"), Some(&JointText { line: 2, has_limit: false }));
        let said = fault(&joint("<axis xyz='0 0'/>"));
        assert_eq!(said, "line 3, column 1: `xyz` of `axis` is `0 0` instead of 3 numbers (in the joint `j`)");
        let said = fault(&joint("<limit lower='low' velocity='1'/>"));
        assert_eq!(said, "line 3, column 1: `lower` of `limit` is `low` instead of a number (in the joint `j`)");
        assert!(
            fault("<robot name='r'>\n<joint name='j' type='hinge'/></robot>")
                .contains("line 2, column 1: a joint of type `hinge`")
        );
        assert!(fault("<robot name='r'>\n\n</robt>").starts_with("line 3"));
        assert!(fault("<sdf/>").contains("`sdf` instead of `robot`"));
    }

    #[test]
    fn a_prefix_that_is_not_declared_is_told_with_its_declaration() {
        let text = "<robot name='r'><link name='a'/><link name='b'/>\n<joint name='j' type='revolute'><parent link='a'/>\
                    <child link='b'/>\n<limit lower='0' upper='1' velocity='1' effort='1' drake:acceleration='3'/></joint></robot>";
        let said = check(text).err().map(|fault| fault.to_string()).unwrap_or_default();
        assert!(said.starts_with("line 3, ") && said.contains("`<robot xmlns:drake=\"drake\" ...>`"), "{said}");
        assert!(check(&text.replace("<robot ", "<robot xmlns:drake='drake' ")).is_ok());
    }
}
