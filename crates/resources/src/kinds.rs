//! Subclasses of kinds: a request for a `Gripper` may get a `VacuumGripper`.
//!
//! ```text
//!   Tool ◀── Gripper ◀── VacuumGripper        one family: a resource may fit requests for several of its kinds
//!     ▲───── Camera
//! ```

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// A hierarchy of kinds. Kinds that are not in it have no relations.
#[derive(Debug, Clone, Default)]
pub struct Kinds(Arc<BTreeMap<Box<str>, Related>>);

#[derive(Debug, Clone, Default)]
struct Related {
    /// All direct and indirect superclasses, ordered by name.
    superclasses: Vec<String>,
    /// The kind itself, then all subclasses, the most general first.
    subclasses: Vec<Box<str>>,
    /// The same for all connected kinds.
    family: Box<str>,
}

/// The hierarchy has a cycle.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("the kind `{kind}` is a subclass of itself: take one of its superclasses away")]
pub struct CyclicKinds {
    /// A kind in the cycle.
    pub kind: String,
}

impl Kinds {
    /// Builds the hierarchy from the direct superclasses of each kind.
    ///
    /// # Errors
    /// A kind is its own superclass.
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

    /// All superclasses of a kind, ordered by name.
    pub fn superclasses(&self, kind: &str) -> &[String] {
        self.0.get(kind).map_or(&[], |related| &related.superclasses)
    }

    /// Whether `kind` is `wanted` or a subclass of it.
    pub fn is_a(&self, kind: &str, wanted: &str) -> bool {
        kind == wanted || self.superclasses(kind).iter().any(|superclass| superclass == wanted)
    }

    /// The kind itself, then all its subclasses.
    pub(crate) fn subclasses<'a>(&'a self, kind: &'a str) -> impl Iterator<Item = &'a str> + 'a {
        let known = self.0.get(kind);
        let alone = known.is_none().then_some(kind);
        alone.into_iter().chain(known.into_iter().flat_map(|related| related.subclasses.iter().map(|below| &**below)))
    }

    /// The family of a kind: kinds of different families share no resource.
    pub(crate) fn family<'a>(&'a self, kind: &'a str) -> &'a str {
        self.0.get(kind).map_or(kind, |related| &related.family)
    }
}

/// The direct and indirect superclasses of a kind; contains the kind itself only if the hierarchy has a cycle.
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
