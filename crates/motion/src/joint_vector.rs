//! One value for each joint of a robot, for any number of joints.
//!
//! [`JointVector`] is the type for positions, velocities and limits in double precision: for an arm with six joints, one with seven, a base with
//! three. It is stored inline, so copying it allocates nothing. The search uses its own type for vector registers, [`State`](crate::space::State).

use crate::mechanism::MAX_JOINTS;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::fmt;
use std::ops::{Deref, DerefMut};

/// Positions in radians (metres for prismatic joints), or velocities, in the order of the joints.
pub type JointVector = PerJoint<f64>;

/// At most [`MAX_JOINTS`] values, one per joint.
#[derive(Clone, Copy)]
pub struct PerJoint<T> {
    values: [T; MAX_JOINTS],
    count: u8,
}

/// There are more values than a robot can have joints.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{count} joints: at most {MAX_JOINTS} are supported")]
pub struct TooManyJoints {
    /// Number of values.
    pub count: usize,
}

impl<T: Copy + Default> PerJoint<T> {
    /// A value for each of `count` joints, from the index of the joint.
    ///
    /// # Panics
    /// With more than [`MAX_JOINTS`]: robots with more joints are refused when they are read.
    pub fn from_fn(count: usize, mut value: impl FnMut(usize) -> T) -> PerJoint<T> {
        assert!(count <= MAX_JOINTS, "a robot that was read has at most {MAX_JOINTS} joints");
        let mut values = [T::default(); MAX_JOINTS];
        for (j, slot) in values.iter_mut().enumerate().take(count) {
            *slot = value(j);
        }
        PerJoint { values, count: count as u8 }
    }

    /// The same value for each of `count` joints.
    pub fn all(count: usize, value: T) -> PerJoint<T> {
        PerJoint::from_fn(count, |_| value)
    }

    /// Applies a function to each value.
    #[must_use]
    pub fn map<U: Copy + Default>(&self, mut of: impl FnMut(T) -> U) -> PerJoint<U> {
        PerJoint::from_fn(self.len(), |j| of(self.values[j]))
    }

    /// Takes the values of a slice.
    ///
    /// # Errors
    /// [`TooManyJoints`] if there are more than [`MAX_JOINTS`].
    pub fn read(values: &[T]) -> Result<PerJoint<T>, TooManyJoints> {
        if values.len() > MAX_JOINTS {
            return Err(TooManyJoints { count: values.len() });
        }
        Ok(PerJoint::from_fn(values.len(), |j| values[j]))
    }
}

impl PerJoint<f64> {
    /// A vector of known values, also in a constant.
    pub const fn of<const N: usize>(known: [f64; N]) -> JointVector {
        assert!(N <= MAX_JOINTS, "too many joints");
        let mut values = [0.0; MAX_JOINTS];
        let mut j = 0;
        while j < N {
            values[j] = known[j];
            j += 1;
        }
        PerJoint { values, count: N as u8 }
    }

    /// All values zero.
    pub const fn zeros(count: usize) -> JointVector {
        assert!(count <= MAX_JOINTS, "too many joints");
        PerJoint { values: [0.0; MAX_JOINTS], count: count as u8 }
    }

    /// The values as an array of `N`; missing joints are zero.
    pub(crate) fn padded<const N: usize>(&self) -> [f64; N] {
        std::array::from_fn(|j| self.get(j).copied().unwrap_or_default())
    }
}

impl<T> Deref for PerJoint<T> {
    type Target = [T];

    fn deref(&self) -> &[T] {
        &self.values[..usize::from(self.count)]
    }
}

impl<T> DerefMut for PerJoint<T> {
    fn deref_mut(&mut self) -> &mut [T] {
        &mut self.values[..usize::from(self.count)]
    }
}

impl<T> AsRef<[T]> for PerJoint<T> {
    fn as_ref(&self) -> &[T] {
        self
    }
}

impl<'a, T> IntoIterator for &'a PerJoint<T> {
    type Item = &'a T;
    type IntoIter = std::slice::Iter<'a, T>;

    fn into_iter(self) -> std::slice::Iter<'a, T> {
        self.iter()
    }
}

impl<const N: usize> From<[f64; N]> for JointVector {
    fn from(values: [f64; N]) -> JointVector {
        JointVector::of(values)
    }
}

impl<T: PartialEq> PartialEq for PerJoint<T> {
    fn eq(&self, other: &PerJoint<T>) -> bool {
        **self == **other
    }
}

impl<const N: usize> PartialEq<[f64; N]> for JointVector {
    fn eq(&self, other: &[f64; N]) -> bool {
        **self == *other
    }
}

impl<T: fmt::Debug> fmt::Debug for PerJoint<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        (**self).fmt(f)
    }
}

impl<T: Serialize> Serialize for PerJoint<T> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        (**self).serialize(serializer)
    }
}

impl<'de, T: Copy + Default + Deserialize<'de>> Deserialize<'de> for PerJoint<T> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<PerJoint<T>, D::Error> {
        PerJoint::read(&Vec::<T>::deserialize(deserializer)?).map_err(serde::de::Error::custom)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_has_as_many_values_as_joints_and_refuses_more_than_it_holds() {
        let six = JointVector::of([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
        assert_eq!(six.len(), 6);
        assert_ne!(six, JointVector::from([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 0.0]));
        assert_eq!(six.padded::<7>(), [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 0.0]);
        assert_eq!(JointVector::read(&[0.0; 17]), Err(TooManyJoints { count: 17 }));
    }
}
