//! Subclasses of kinds: a request for a `Gripper` may be granted a `VacuumGripper`.
//!
//! ```text
//!   Tool ◀── Gripper ◀── VacuumGripper        one family: what fits a request for one kind may fit one for another
//!     ▲───── Camera
//! ```

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// A hierarchy of kinds. A kind that it does not name stands alone.
#[derive(Debug, Clone, Default)]
pub struct Kinds(Arc<BTreeMap<Box<str>, Related>>);

#[derive(Debug, Clone, Default)]
struct Related {
    /// All above it, near and far, in the order of names.
    superclasses: Vec<String>,
    /// Itself, then all below it, the most general first.
    subclasses: Vec<Box<str>>,
    /// The same for all that are connected.
    family: Box<str>,
}

/// A hierarchy in which a kind is above itself.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("the kind `{kind}` is a subclass of itself: take one of its superclasses away")]
pub struct CyclicKinds {
    /// One of those in the circle.
    pub kind: String,
}

impl Kinds {
    /// From the direct superclasses of each kind.
    ///
    /// # Errors
    /// Where a kind is above itself.
    pub fn new(direct: &BTreeMap<String, Vec<String>>) -> Result<Kinds, CyclicKinds> {
        let named: BTreeSet<&str> =
            direct.iter().flat_map(|(kind, above)| above.iter().chain([kind])).map(String::as_str).collect();
        let above: BTreeMap<&str, BTreeSet<&str>> = named.iter().map(|kind| (*kind, reached(direct, kind))).collect();
        if let Some((kind, _)) = above.iter().find(|(kind, above)| above.contains(*kind)) {
            return Err(CyclicKinds { kind: (*kind).to_owned() });
        }
        let mut family: BTreeMap<&str, &str> = named.iter().map(|kind| (*kind, *kind)).collect();
        for (kind, superclasses) in &above {
            for superclass in superclasses {
                let (one, other) = (family[kind], family[superclass]);
                family.values_mut().filter(|name| **name == other).for_each(|name| *name = one);
            }
        }
        let related = |kind: &&str| {
            let mut below: Vec<&str> = named.iter().copied().filter(|other| above[other].contains(kind)).collect();
            below.sort_by_key(|other| above[other].len());
            let subclasses = std::iter::once(*kind).chain(below).map(Into::into).collect();
            let superclasses = above[kind].iter().map(|&superclass| superclass.to_owned()).collect();
            (Box::from(*kind), Related { superclasses, subclasses, family: family[kind].into() })
        };
        Ok(Kinds(Arc::new(named.iter().map(related).collect())))
    }

    /// All kinds above one, in the order of names.
    pub fn superclasses(&self, kind: &str) -> &[String] {
        self.0.get(kind).map_or(&[], |related| &related.superclasses)
    }

    /// Whether one is the other or below it.
    pub fn is_a(&self, kind: &str, wanted: &str) -> bool {
        kind == wanted || self.superclasses(kind).iter().any(|superclass| superclass == wanted)
    }

    /// The kind itself, then all below it.
    pub(crate) fn subclasses<'a>(&'a self, kind: &'a str) -> impl Iterator<Item = &'a str> + 'a {
        let known = self.0.get(kind);
        let alone = known.is_none().then_some(kind);
        alone.into_iter().chain(known.into_iter().flat_map(|related| related.subclasses.iter().map(|below| &**below)))
    }

    /// The family of a kind: kinds of different families have no resource in common.
    pub(crate) fn family<'a>(&'a self, kind: &'a str) -> &'a str {
        self.0.get(kind).map_or(kind, |related| &related.family)
    }
}

/// What is above a kind, near and far; itself only where the hierarchy is a circle.
fn reached<'a>(direct: &'a BTreeMap<String, Vec<String>>, kind: &str) -> BTreeSet<&'a str> {
    let mut reached = BTreeSet::new();
    let mut open: Vec<&str> = direct.get(kind).into_iter().flatten().map(String::as_str).collect();
    while let Some(superclass) = open.pop() {
        if reached.insert(superclass) {
            open.extend(direct.get(superclass).into_iter().flatten().map(String::as_str));
        }
    }
    reached
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    fn kinds(lines: &[(&str, &[&str])]) -> Result<Kinds, CyclicKinds> {
        let owned = |names: &[&str]| names.iter().map(|&name| name.to_owned()).collect();
        Kinds::new(&lines.iter().map(|(kind, above)| ((*kind).to_owned(), owned(above))).collect())
    }

    #[test]
    fn a_kind_is_everything_above_it_and_a_family_is_what_is_connected() {
        let kinds =
            kinds(&[("Vacuum", &["Gripper", "Pneumatic"]), ("Gripper", &["Tool"]), ("Camera", &["Tool"])]).unwrap();
        assert_eq!(kinds.superclasses("Vacuum"), ["Gripper", "Pneumatic", "Tool"]);
        assert_eq!(kinds.subclasses("Tool").collect::<Vec<_>>(), ["Tool", "Camera", "Gripper", "Vacuum"]);
        assert_eq!(kinds.subclasses("Arm").collect::<Vec<_>>(), ["Arm"]);
        assert!(kinds.is_a("Vacuum", "Tool") && !kinds.is_a("Tool", "Vacuum") && kinds.is_a("Arm", "Arm"));
        assert_eq!(kinds.family("Camera"), kinds.family("Pneumatic"));
        assert_ne!(kinds.family("Camera"), kinds.family("Arm"));
    }

    #[test]
    fn a_circle_is_refused_with_one_of_its_kinds() {
        let refused = kinds(&[("A", &["B"]), ("B", &["C"]), ("C", &["A"])]).unwrap_err();
        assert!(refused.to_string().contains("`A` is a subclass of itself"), "{refused}");
    }
}
