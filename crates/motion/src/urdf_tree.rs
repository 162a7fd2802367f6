//! Checks the links and joints of a URDF before anything else is read: every name is unique, every reference is to an existing link or joint, and one
//! tree contains all links.
//!
//! A violation is refused with its line. A reader that continued would lose the links that are not connected to the root.

use crate::urdf_faults::UrdfFault;
use ratn_model::load::suggestion;
use std::collections::{BTreeMap, BTreeSet};

/// A place in the text.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Place {
    pub(crate) line: u64,
    pub(crate) column: u64,
}

impl Place {
    pub(crate) fn fault(self, reason: String) -> UrdfFault {
        UrdfFault { line: self.line, column: self.column, reason }
    }
}

/// An end of a joint: a link, and the place of the reference.
type End = (String, Place);

#[derive(Debug)]
struct Joint {
    name: String,
    parent: Option<End>,
    child: Option<End>,
    /// The joint that it mimics, and the place of the reference.
    follows: Option<End>,
    at: Place,
    has_limit: bool,
}

/// Where a joint begins in the text, and whether it has limits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct JointText {
    /// From 1.
    pub(crate) line: u64,
    /// Whether it has an element `limit`.
    pub(crate) has_limit: bool,
}

/// Links and joints in the order of the text.
#[derive(Debug, Default)]
pub(crate) struct Tree {
    links: Vec<End>,
    joints: Vec<Joint>,
    /// The place of each name, for links and for joints.
    link_places: BTreeMap<String, Place>,
    joint_places: BTreeMap<String, Place>,
}

impl Tree {
    /// Adds a link.
    ///
    /// # Errors
    /// [`UrdfFault`] if there is one with this name.
    pub(crate) fn link(&mut self, name: &str, at: Place) -> Result<(), UrdfFault> {
        self.links.push((name.to_owned(), at));
        is_first(&mut self.link_places, "link", name, at)
    }

    /// Adds a joint; its ends are not known yet.
    ///
    /// # Errors
    /// [`UrdfFault`] if there is one with this name.
    pub(crate) fn joint(&mut self, name: &str, at: Place) -> Result<(), UrdfFault> {
        let (parent, child, follows) = (None, None, None);
        self.joints.push(Joint { name: name.to_owned(), parent, child, follows, at, has_limit: false });
        is_first(&mut self.joint_places, "joint", name, at)
    }

    /// Sets an end of the last joint: its `parent` or its `child`.
    pub(crate) fn end(&mut self, which: &str, link: &str, at: Place) {
        if let Some(joint) = self.joints.last_mut() {
            let end = if which == "parent" { &mut joint.parent } else { &mut joint.child };
            *end = Some((link.to_owned(), at));
        }
    }

    /// Records that the last joint mimics another one.
    pub(crate) fn follows(&mut self, joint: &str, at: Place) {
        if let Some(last) = self.joints.last_mut() {
            last.follows = Some((joint.to_owned(), at));
        }
    }

    /// Records that the last joint has limits.
    pub(crate) fn limited(&mut self) {
        if let Some(last) = self.joints.last_mut() {
            last.has_limit = true;
        }
    }

    /// The places of the joints, by name.
    pub(crate) fn joints(self) -> BTreeMap<String, JointText> {
        let text = |joint: Joint| (joint.name, JointText { line: joint.at.line, has_limit: joint.has_limit });
        self.joints.into_iter().map(text).collect()
    }

    /// The name of the last joint.
    pub(crate) fn last_joint(&self) -> &str {
        self.joints.last().map_or("", |joint| &joint.name)
    }

    /// Checks that all links are one tree.
    ///
    /// # Errors
    /// [`UrdfFault`] gives the link or joint that is not part of it, and the likely cause.
    pub(crate) fn check(&self) -> Result<(), UrdfFault> {
        let mut parents: BTreeMap<&str, (&Joint, Place)> = BTreeMap::new();
        for joint in &self.joints {
            if let Some((followed, at)) = &joint.follows {
                self.is_followed(joint, followed, *at)?;
            }
            for (which, end) in [("parent", &joint.parent), ("child", &joint.child)] {
                if let Some((link, at)) = end {
                    self.is_there(joint, which, link, *at)?;
                }
            }
            let Some((child, at)) = &joint.child else { continue };
            if let Some((first, place)) = parents.insert(child, (joint, *at)) {
                return Err(at.fault(format!(
                    "the link `{child}` is the child of two joints, `{}` at line {} and `{}`: a link has one parent",
                    first.name, place.line, joint.name
                )));
            }
        }
        let mut roots = self.links.iter().filter(|(name, _)| !parents.contains_key(name.as_str()));
        let Some((root, first)) = roots.next() else {
            let Some((link, at)) = self.links.first() else {
                return Err(Place { line: 1, column: 1 }.fault("the robot has no link".to_owned()));
            };
            return Err(at.fault(format!(
                "the links hang on each other in a circle, also `{link}`: a robot has one root, a link that is the child of no joint"
            )));
        };
        if let Some((second, at)) = roots.next() {
            return Err(at.fault(format!(
                "neither the link `{second}` nor `{root}` at line {} is the child of a joint, but a robot has one root: is a joint \
                 between them missing, or a link left over?",
                first.line
            )));
        }
        let mut children: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
        for joint in &self.joints {
            if let (Some((parent, _)), Some((child, _))) = (&joint.parent, &joint.child) {
                children.entry(parent).or_default().push(child);
            }
        }
        let (mut reached, mut open) = (BTreeSet::from([root.as_str()]), vec![root.as_str()]);
        while let Some(link) = open.pop() {
            let below = children.get(link).into_iter().flatten();
            // Each link has one parent, so none is reached twice.
            below.for_each(|child| {
                reached.insert(child);
                open.push(child);
            });
        }
        match self.links.iter().find(|(link, _)| !reached.contains(link.as_str())) {
            None => Ok(()),
            Some((link, at)) => Err(at.fault(format!(
                "the link `{link}` does not hang on the root `{root}`: the joints towards it go in a circle"
            ))),
        }
    }

    fn is_followed(&self, joint: &Joint, followed: &str, at: Place) -> Result<(), UrdfFault> {
        if self.joint_places.contains_key(followed) {
            return Ok(());
        }
        let known = self.joint_places.keys().map(String::as_str);
        let help = suggestion(followed, known, "", "is its name misspelt?");
        let name = &joint.name;
        Err(at.fault(format!("the joint `{name}` mimics `{followed}`: the robot has no such joint; {help}")))
    }

    fn is_there(&self, joint: &Joint, which: &str, link: &str, at: Place) -> Result<(), UrdfFault> {
        if self.link_places.contains_key(link) {
            return Ok(());
        }
        let known = self.link_places.keys().map(String::as_str);
        let help = suggestion(link, known, "", "is its name misspelt?");
        let name = &joint.name;
        Err(at.fault(format!("the {which} of the joint `{name}`: the robot has no link `{link}`; {help}")))
    }
}

fn is_first(places: &mut BTreeMap<String, Place>, what: &str, name: &str, at: Place) -> Result<(), UrdfFault> {
    match places.insert(name.to_owned(), at) {
        None => Ok(()),
        Some(first) => {
            let reason = format!("there is a {what} `{name}` at line {} already: names are given once", first.line);
            Err(at.fault(reason))
        }
    }
}
