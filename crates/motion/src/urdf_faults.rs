//! What is wrong with the text of a URDF, and where: the line of an element that is not closed, an attribute that is missing, a number that is
//! none, limits that contradict themselves, links that are not one tree (`urdf_tree`). The reader of the whole description ([`urdf_rs`])
//! loses the lines.

use crate::urdf_tree::{Place, Tree};
use crate::xml_text;
use xml::common::Position;
use xml::reader::XmlEvent;

/// The first thing that is wrong with a URDF.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("line {line}, column {column}: {reason}")]
pub struct UrdfFault {
    /// Of the text, from 1.
    pub line: u64,
    /// From 1.
    pub column: u64,
    /// What is wrong there.
    pub reason: String,
}

/// What the value of an attribute must be.
#[derive(Debug, Clone, Copy)]
enum Value {
    Text,
    /// So many numbers, separated by blanks.
    Numbers(usize),
}

use Value::{Numbers, Text};

/// Attributes of the elements that are read, the element that holds them, and whether they must be there.
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
    ("joint", "limit", "lower", Numbers(1), false),
    ("joint", "limit", "upper", Numbers(1), false),
    ("joint", "limit", "velocity", Numbers(1), true),
    ("joint", "limit", "effort", Numbers(1), false),
    ("joint", "mimic", "joint", Text, true),
    ("joint", "mimic", "multiplier", Numbers(1), false),
    ("joint", "mimic", "offset", Numbers(1), false),
    ("collision", "origin", "xyz", Numbers(3), false),
    ("collision", "origin", "rpy", Numbers(3), false),
    ("visual", "origin", "xyz", Numbers(3), false),
    ("visual", "origin", "rpy", Numbers(3), false),
    ("geometry", "box", "size", Numbers(3), true),
    ("geometry", "sphere", "radius", Numbers(1), true),
    ("geometry", "cylinder", "radius", Numbers(1), true),
    ("geometry", "cylinder", "length", Numbers(1), true),
    ("geometry", "capsule", "radius", Numbers(1), true),
    ("geometry", "capsule", "length", Numbers(1), true),
    ("geometry", "mesh", "filename", Text, true),
    ("geometry", "mesh", "scale", Numbers(3), false),
];

/// The types of joints that there are.
const TYPES: [&str; 7] = ["revolute", "continuous", "prismatic", "fixed", "floating", "planar", "spherical"];

/// Looks for the first fault.
///
/// # Errors
/// [`UrdfFault`].
pub(crate) fn check(text: &str) -> Result<(), UrdfFault> {
    let mut reader = xml_text::reader(text.as_bytes());
    let (mut open, mut tree, mut has_limits): (Vec<String>, _, _) = (Vec::new(), Tree::default(), false);
    loop {
        let event = reader.next();
        let at = reader.position();
        let at = Place { line: at.row + 1, column: at.column + 1 };
        let fault = |reason: String| at.fault(reason);
        match event {
            Err(error) => {
                let at = error.position();
                return Err(Place { line: at.row + 1, column: at.column + 1 }.fault(error.msg().to_owned()));
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
                for (_, _, key, value, needed) in
                    ATTRIBUTES.iter().filter(|row| (row.0, row.1) == (parent, &element[..]))
                {
                    wrong(&element, key, value_of(key), *value, *needed).map_or(Ok(()), |reason| Err(fault(reason)))?;
                }
                let text = |key: &str| value_of(key).unwrap_or_default();
                match (parent, &element[..]) {
                    ("robot", "link") => tree.link(text("name"), at)?,
                    ("robot", "joint") => {
                        let kind = text("type");
                        if !TYPES.contains(&kind) {
                            return Err(fault(format!("a joint of type `{kind}`: there is {}", TYPES.join(", "))));
                        }
                        has_limits = ["revolute", "prismatic"].contains(&kind);
                        tree.joint(text("name"), at)?;
                    }
                    ("joint", "parent" | "child") if open.len() == 2 => tree.end(&element, text("link"), at),
                    ("joint", "limit") if has_limits => {
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
            Ok(XmlEvent::EndDocument) => return tree.check(),
            Ok(_) => {}
        }
    }
}

/// What is wrong with an attribute.
fn wrong(element: &str, key: &str, found: Option<&str>, value: Value, needed: bool) -> Option<String> {
    match (found, value) {
        (None, _) => needed.then(|| format!("`{element}` has no attribute `{key}`")),
        (Some(_), Text) => None,
        (Some(text), Numbers(count)) => {
            let numbers: Option<Vec<f64>> = text.split_whitespace().map(|word| word.parse().ok()).collect();
            // A limit that is omitted may be written as infinite.
            let good = |n: &f64| n.is_finite() || (element == "limit" && !n.is_nan());
            let good = numbers.is_some_and(|numbers| numbers.len() == count && numbers.iter().all(good));
            let plural = if count == 1 { "a number".to_owned() } else { format!("{count} numbers") };
            (!good).then(|| format!("`{key}` of `{element}` is `{text}` instead of {plural}"))
        }
    }
}

/// What is wrong with a range; where one end is not given it is 0.
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
        assert_eq!(check("<robot name='r'><link name='l'/></robot>"), Ok(()));
        assert_eq!(fault("<robot name='r'>\n <link/>\n</robot>"), "line 2, column 2: `link` has no attribute `name`");
        let joint = |inner: &str| {
            format!("<robot name='r'><link name='l'/>\n<joint name='j' type='revolute'>\n{inner}</joint></robot>")
        };
        assert_eq!(check(&joint("<axis xyz='0 0 1'/>")), Ok(()));
        let said = fault(&joint("<axis xyz='0 0'/>"));
        assert_eq!(said, "line 3, column 1: `xyz` of `axis` is `0 0` instead of 3 numbers");
        let said = fault(&joint("<limit lower='low' velocity='1'/>"));
        assert_eq!(said, "line 3, column 1: `lower` of `limit` is `low` instead of a number");
        assert!(
            fault("<robot name='r'>\n<joint name='j' type='hinge'/></robot>")
                .contains("line 2, column 1: a joint of type `hinge`")
        );
        assert!(fault("<robot name='r'>\n\n</robt>").starts_with("line 3"));
        assert!(fault("<sdf/>").contains("`sdf` instead of `robot`"));
    }
}
