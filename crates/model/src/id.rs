//! Ids as newtypes, all from one macro, so that one kind is never passed for another.

/// Defines a `u64` id newtype with `Display` as `prefix` + number.
#[macro_export]
macro_rules! number_id {
    ($(#[$doc:meta])* $name:ident, $prefix:literal) => {
        $(#[$doc])*
        #[derive(
            Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash, serde::Serialize, serde::Deserialize,
        )]
        #[serde(transparent)]
        pub struct $name(pub u64);

        impl std::fmt::Display for $name {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                write!(f, concat!($prefix, "{}"), self.0)
            }
        }
    };
}

number_id!(
    /// A state of a program: its index in [`crate::program::Program::states`].
    StateId, "s"
);
number_id!(
    /// One visit of a state in one run; numbered in the order of expansion.
    InstanceId, "i"
);
number_id!(
    /// A lease of the resource manager, held by one instance.
    LeaseId, "lease-"
);
number_id!(
    /// A strictly growing number that fences a lease: who does the work refuses an older one.
    FencingToken, "token-"
);
number_id!(
    /// A projection in the world pool.
    ProjectionId, "projection-"
);
number_id!(
    /// A revision of the root world model or of the resource pool; 0 is the empty one.
    Revision, "r"
);
