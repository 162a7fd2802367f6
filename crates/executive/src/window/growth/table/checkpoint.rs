//! Serialized tables: every node that tables share is written once, after its children.

use super::{Node, Table, WIDTH};
use crate::checkpoint::{Broken, Pool, at};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// A node of a tree; its children are given by their places.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(in super::super) enum NodeForm<T> {
    Leaf([Option<T>; WIDTH]),
    Inner([Option<u32>; WIDTH]),
}

/// The nodes read so far, each with its level above the leaves.
pub(in super::super) struct Nodes<T>(Vec<(usize, Arc<Node<T>>)>);

impl<T: Clone> Table<T> {
    /// The place of the root; `None` for an empty table.
    pub(in super::super) fn form<'a, U>(
        &'a self,
        pool: &mut Pool<NodeForm<U>>,
        of: &mut impl FnMut(&'a T) -> U,
    ) -> Option<u32> {
        self.root.as_ref().map(|root| place(root, pool, of))
    }

    /// Restores a table of the size of `empty` from the place of its root.
    pub(in super::super) fn of_form(empty: Table<T>, root: Option<u32>, nodes: &Nodes<T>) -> Result<Table<T>, Broken> {
        let mut table = empty;
        if let Some(root) = root {
            let (level, root) = at(&nodes.0, root, "a table without its root")?;
            if level != table.depth {
                return Err("a table of another size");
            }
            table.root = Some(root);
        }
        Ok(table)
    }
}

impl<T: Clone> Nodes<T> {
    pub(in super::super) fn of_forms<U>(
        forms: Vec<NodeForm<U>>,
        of: impl Fn(U) -> Result<T, Broken>,
    ) -> Result<Nodes<T>, Broken> {
        let mut all: Vec<(usize, Arc<Node<T>>)> = Vec::with_capacity(forms.len());
        for form in forms {
            let node = match form {
                NodeForm::Leaf(slots) => {
                    let mut leaf = std::array::from_fn(|_| None);
                    for (slot, value) in leaf.iter_mut().zip(slots) {
                        *slot = value.map(&of).transpose()?;
                    }
                    (0, Node::Leaf(leaf))
                }
                NodeForm::Inner(slots) => {
                    let mut inner = std::array::from_fn(|_| None);
                    let mut level = None;
                    for (slot, place) in inner.iter_mut().zip(slots) {
                        let Some(place) = place else { continue };
                        let (below, node) = at(&all, place, "a node of a table that stands behind what leads to it")?;
                        if level.is_some_and(|level| level != below) {
                            return Err("a table that is deeper here than there");
                        }
                        level = Some(below);
                        *slot = Some(node);
                    }
                    (level.ok_or("a node of a table that leads nowhere")? + 1, Node::Inner(inner))
                }
            };
            all.push((node.0, Arc::new(node.1)));
        }
        Ok(Nodes(all))
    }
}

fn place<'a, T, U>(node: &'a Arc<Node<T>>, pool: &mut Pool<NodeForm<U>>, of: &mut impl FnMut(&'a T) -> U) -> u32 {
    if let Some(place) = pool.find(node) {
        return place;
    }
    let form = match &**node {
        Node::Leaf(slots) => NodeForm::Leaf(std::array::from_fn(|slot| slots[slot].as_ref().map(&mut *of))),
        Node::Inner(slots) => {
            NodeForm::Inner(std::array::from_fn(|slot| slots[slot].as_ref().map(|below| place(below, pool, of))))
        }
    };
    pool.add(node, form)
}
