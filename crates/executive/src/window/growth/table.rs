//! A persistent table: copied in constant time, changed in time logarithmic in its size.
//!
//! A radix tree over small numbers (states, predicates) whose copies share structure. Every instance keeps the tables
//! of its place in the program, and neighbours share all nodes that did not change between them.

mod checkpoint;

pub(super) use checkpoint::{NodeForm, Nodes};
use std::sync::Arc;

const BITS: usize = 3;
const WIDTH: usize = 1 << BITS;

/// A persistent map from indices below a fixed bound to values.
#[derive(Debug, Clone)]
pub(crate) struct Table<T> {
    depth: usize,
    root: Option<Arc<Node<T>>>,
}

#[derive(Debug, Clone)]
enum Node<T> {
    Leaf([Option<T>; WIDTH]),
    Inner([Option<Arc<Node<T>>>; WIDTH]),
}

impl<T> Default for Table<T> {
    fn default() -> Table<T> {
        Table { depth: 0, root: None }
    }
}

impl<T: Clone> Table<T> {
    /// An empty table for indices below `bound`.
    pub(crate) fn new(bound: usize) -> Table<T> {
        let mut depth = 0;
        while bound > WIDTH << (BITS * depth) {
            depth += 1;
        }
        Table { depth, root: None }
    }

    pub(crate) fn get(&self, index: usize) -> Option<&T> {
        let mut node = self.root.as_deref()?;
        let mut level = self.depth;
        loop {
            match node {
                Node::Leaf(slots) => return slots[index & (WIDTH - 1)].as_ref(),
                Node::Inner(slots) => node = slots[(index >> (BITS * level)) & (WIDTH - 1)].as_deref()?,
            }
            level -= 1;
        }
    }

    pub(crate) fn set(&mut self, index: usize, value: Option<T>) {
        set(&mut self.root, self.depth, index, value);
    }

    /// Every value with its index, in order.
    pub(crate) fn iter(&self) -> Vec<(usize, &T)> {
        let mut all = Vec::new();
        if let Some(root) = &self.root {
            collect(root, 0, &mut all);
        }
        all
    }
}

fn set<T: Clone>(at: &mut Option<Arc<Node<T>>>, level: usize, index: usize, value: Option<T>) {
    let node = at.get_or_insert_with(|| {
        Arc::new(if level == 0 {
            Node::Leaf(std::array::from_fn(|_| None))
        } else {
            Node::Inner(std::array::from_fn(|_| None))
        })
    });
    match Arc::make_mut(node) {
        Node::Leaf(slots) => slots[index & (WIDTH - 1)] = value,
        Node::Inner(slots) => set(&mut slots[(index >> (BITS * level)) & (WIDTH - 1)], level - 1, index, value),
    }
}

fn collect<'a, T>(node: &'a Node<T>, prefix: usize, all: &mut Vec<(usize, &'a T)>) {
    match node {
        Node::Leaf(slots) => {
            all.extend(slots.iter().enumerate().filter_map(|(i, slot)| Some((prefix << BITS | i, slot.as_ref()?))));
        }
        Node::Inner(slots) => {
            for (i, inner) in slots.iter().enumerate() {
                if let Some(inner) = inner {
                    collect(inner, prefix << BITS | i, all);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;

    #[test]
    fn a_copy_keeps_what_it_had() {
        let mut table = Table::new(10_000);
        let mut model = BTreeMap::new();
        let mut copies = Vec::new();
        for step in 0_usize..2_000 {
            let index = step * 7919 % 10_000;
            table.set(index, Some(step));
            model.insert(index, step);
            if step % 400 == 0 {
                copies.push((table.clone(), model.clone()));
            }
        }
        table.set(0, None);
        for (copy, model) in copies {
            assert_eq!(copy.iter(), model.iter().map(|(i, v)| (*i, v)).collect::<Vec<_>>());
            assert_eq!(copy.get(7919), model.get(&7919));
        }
        assert_eq!(table.get(0), None);
    }
}
