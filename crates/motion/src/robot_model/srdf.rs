//! Reads the SRDF of a robot: the pairs of links that are not checked against each other.

use super::Link;
use crate::mechanism::MechanismError;
use crate::xml_text;
use std::collections::{BTreeMap, BTreeSet};
use xml::reader::XmlEvent;

/// The pairs of links, lower index first, that an SRDF excepts from collision checks.
///
/// # Errors
/// [`MechanismError::Srdf`] gives the place where the text is not XML.
pub(crate) fn excepted(text: &str, links: &[Link]) -> Result<BTreeSet<(usize, usize)>, MechanismError> {
    let index: BTreeMap<&str, usize> = links.iter().enumerate().map(|(i, l)| (l.name.as_str(), i)).collect();
    let mut pairs = BTreeSet::new();
    let mut reader = xml_text::reader(text.as_bytes());
    loop {
        let event = reader.next().map_err(|error| MechanismError::Srdf(error.to_string()))?;
        let (name, attributes) = match event {
            XmlEvent::StartElement { name, attributes, .. } => (name, attributes),
            XmlEvent::EndDocument => return Ok(pairs),
            _ => continue,
        };
        if reader.doctype().is_some() {
            return Err(MechanismError::Srdf(xml_text::NO_DOCUMENT_TYPE.to_owned()));
        }
        if name.local_name != "disable_collisions" {
            continue;
        }
        let link = |key: &str| attributes.iter().find(|a| a.name.local_name == key).map(|a| a.value.as_str());
        // An SRDF may contain links that this variant of the robot does not have.
        let pair = (link("link1").and_then(|l| index.get(l)), link("link2").and_then(|l| index.get(l)));
        if let (Some(&a), Some(&b)) = pair {
            pairs.insert((a.min(b), a.max(b)));
        }
    }
}
