//! Lists that are cheap to copy and to append to: a loop that collects a value of each iteration makes one list per iteration, each with one
//! element more than the one before.
//!
//! All these lists share one buffer; each list uses a prefix of it. The first append takes the next free slot. If another list has already stored
//! a different element there, or no slot is left, the elements are copied into a buffer of twice the size.
//!
//! ```text
//! [a, b]      ─┐
//! [a, b, c]   ─┼─► a b c · · ·          [a, b, d]  ──► a b d · · ·
//! ```

use crate::value::Value;
use serde::de::{Deserialize, Deserializer, SeqAccess, Visitor};
use serde::{Serialize, Serializer};
use std::fmt;
use std::iter::repeat_with;
use std::ops::Index;
use std::sync::{Arc, OnceLock};

/// Smallest capacity of the buffer of a list that is appended to.
const LEAST_ROOM: usize = 4;

/// Limit of the initial capacity of a list that is deserialized, whatever length the data claims.
const MOST_TRUSTED: usize = 4096;

/// The elements of a [`Value::List`]. Copies share them.
#[derive(Clone)]
pub struct List {
    /// The elements of this list and of longer ones that share the buffer; no element follows an empty slot.
    slots: Arc<[OnceLock<Value>]>,
    len: usize,
}

impl List {
    /// An empty list.
    #[must_use]
    pub fn new() -> List {
        List::with_room(Vec::new(), 0)
    }

    /// Number of elements.
    #[must_use]
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether the list is empty.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// The elements in order.
    #[must_use]
    pub fn iter(&self) -> Iter<'_> {
        Iter(self.slots[..self.len].iter())
    }

    /// The element at an index.
    #[must_use]
    pub fn get(&self, index: usize) -> Option<&Value> {
        self.slots[..self.len].get(index)?.get()
    }

    /// The first element.
    #[must_use]
    pub fn first(&self) -> Option<&Value> {
        self.get(0)
    }

    /// Appends an element; other copies of the list do not change.
    pub fn push(&mut self, element: Value) {
        let Some(next) = self.slots.get(self.len) else { return self.push_into_a_copy(element) };
        match next.set(element) {
            Ok(()) => self.len += 1,
            // Another copy has stored an equal element there, so the slot can be shared.
            Err(element) if next.get().is_some_and(|there| there.total_order(&element).is_eq()) => self.len += 1,
            Err(element) => self.push_into_a_copy(element),
        }
    }

    fn push_into_a_copy(&mut self, element: Value) {
        let elements: Vec<Value> = self.iter().cloned().chain([element]).collect();
        let room = elements.len().max(LEAST_ROOM);
        *self = List::with_room(elements, room);
    }

    fn with_room(elements: Vec<Value>, room: usize) -> List {
        let len = elements.len();
        let slots = elements.into_iter().map(OnceLock::from).chain(repeat_with(OnceLock::new).take(room));
        List { slots: slots.collect(), len }
    }
}

impl Default for List {
    fn default() -> List {
        List::new()
    }
}

impl From<Vec<Value>> for List {
    fn from(elements: Vec<Value>) -> List {
        List::with_room(elements, 0)
    }
}

impl From<List> for Vec<Value> {
    fn from(mut list: List) -> Vec<Value> {
        match Arc::get_mut(&mut list.slots) {
            Some(slots) => slots[..list.len].iter_mut().filter_map(OnceLock::take).collect(),
            None => list.iter().cloned().collect(),
        }
    }
}

impl FromIterator<Value> for List {
    fn from_iter<I: IntoIterator<Item = Value>>(elements: I) -> List {
        elements.into_iter().collect::<Vec<_>>().into()
    }
}

impl Extend<Value> for List {
    fn extend<I: IntoIterator<Item = Value>>(&mut self, elements: I) {
        elements.into_iter().for_each(|element| self.push(element));
    }
}

impl IntoIterator for List {
    type Item = Value;
    type IntoIter = std::vec::IntoIter<Value>;

    fn into_iter(self) -> Self::IntoIter {
        Vec::from(self).into_iter()
    }
}

impl<'a> IntoIterator for &'a List {
    type Item = &'a Value;
    type IntoIter = Iter<'a>;

    fn into_iter(self) -> Iter<'a> {
        self.iter()
    }
}

impl Index<usize> for List {
    type Output = Value;

    fn index(&self, index: usize) -> &Value {
        match self.get(index) {
            Some(element) => element,
            None => panic!("index {index} is outside a list of {}", self.len),
        }
    }
}

impl PartialEq for List {
    fn eq(&self, other: &List) -> bool {
        self.len == other.len && self.iter().eq(other)
    }
}

impl fmt::Debug for List {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_list().entries(self).finish()
    }
}

impl Serialize for List {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_seq(self)
    }
}

impl<'de> Deserialize<'de> for List {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<List, D::Error> {
        struct Elements;

        impl<'de> Visitor<'de> for Elements {
            type Value = List;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("a sequence")
            }

            fn visit_seq<A: SeqAccess<'de>>(self, mut sequence: A) -> Result<List, A::Error> {
                let mut elements = Vec::with_capacity(sequence.size_hint().unwrap_or(0).min(MOST_TRUSTED));
                while let Some(element) = sequence.next_element()? {
                    elements.push(element);
                }
                Ok(elements.into())
            }
        }

        deserializer.deserialize_seq(Elements)
    }
}

/// The elements of a [`List`] in order.
#[derive(Debug, Clone)]
pub struct Iter<'a>(std::slice::Iter<'a, OnceLock<Value>>);

impl<'a> Iterator for Iter<'a> {
    type Item = &'a Value;

    fn next(&mut self) -> Option<&'a Value> {
        self.0.next()?.get()
    }

    fn size_hint(&self) -> (usize, Option<usize>) {
        self.0.size_hint()
    }
}

impl DoubleEndedIterator for Iter<'_> {
    fn next_back(&mut self) -> Option<Self::Item> {
        self.0.next_back()?.get()
    }
}

impl ExactSizeIterator for Iter<'_> {}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]

    use super::*;

    fn ints(range: std::ops::Range<i64>) -> List {
        range.map(Value::Int).collect()
    }

    /// Appends to a copy.
    fn with(list: &List, element: i64) -> List {
        let mut longer = list.clone();
        longer.push(Value::Int(element));
        longer
    }

    fn share(a: &List, b: &List) -> bool {
        Arc::ptr_eq(&a.slots, &b.slots)
    }

    #[test]
    fn each_list_that_was_made_of_another_one_has_its_own_elements() {
        let mut lists = vec![List::new()];
        for n in 0..100 {
            lists.push(with(&lists[lists.len() - 1], n));
        }
        for (n, list) in (0..).zip(&lists) {
            assert_eq!(*list, ints(0..n));
            assert_eq!(list.get(list.len()), None, "what others have behind it is not seen");
        }
        // A second list from each one, which differs in its last element.
        for (n, list) in (0..).zip(&lists[..100]) {
            let other = with(list, -1);
            assert_eq!((other.len(), other.iter().next_back()), (list.len() + 1, Some(&Value::Int(-1))));
            assert_eq!(lists[n + 1].get(n), Some(&Value::Int(n as i64)));
        }
    }

    #[test]
    fn lists_that_grow_one_from_the_other_are_copied_as_often_as_their_length_doubles() {
        let (mut list, mut buffers, mut kept) = (List::new(), 0, Vec::new());
        for n in 0..10_000 {
            let longer = with(&list, n);
            buffers += usize::from(!share(&list, &longer));
            kept.push(std::mem::replace(&mut list, longer));
        }
        assert!(buffers <= 14, "{buffers}");
    }

    #[test]
    fn what_is_appended_twice_to_one_list_shares_the_elements_only_where_it_is_the_same() {
        let list = with(&ints(0..3), 3);
        let (once, again, other) = (with(&list, 4), with(&list, 4), with(&list, 5));
        assert!(share(&list, &once) && share(&once, &again) && !share(&once, &other));
        assert_eq!((once.get(4), other.get(4)), (Some(&Value::Int(4)), Some(&Value::Int(5))));
        let mut float = list.clone();
        float.push(Value::Float(4.0));
        assert_eq!(float.get(4), Some(&Value::Float(4.0)), "a float is no int");
    }

    #[test]
    fn it_is_written_as_a_sequence_and_read_back() {
        let list = Value::List([ints(0..2), List::new()].map(Value::List).into_iter().collect());
        let text = serde_json::to_string(&list).unwrap();
        assert_eq!(text, r#"{"list":[{"list":[{"int":0},{"int":1}]},{"list":[]}]}"#);
        assert_eq!(serde_json::from_str::<Value>(&text).unwrap(), list);
    }

    #[test]
    fn its_elements_are_taken_out_of_it() {
        let list = ints(0..3);
        let longer = with(&list, 3);
        assert_eq!(Vec::from(list.clone()), [0, 1, 2].map(Value::Int));
        drop(list);
        assert_eq!(longer.into_iter().collect::<Vec<_>>(), [0, 1, 2, 3].map(Value::Int));
    }
}
