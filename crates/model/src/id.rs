//! Ids as newtypes, all from one macro, so that one kind is never passed for another.

/// Defines a `u64` id newtype, displayed as `prefix` + number. It is parsed from that form or from the number alone.
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

        impl std::str::FromStr for $name {
            type Err = String;

            fn from_str(text: &str) -> Result<$name, String> {
                let number = text.strip_prefix($prefix).unwrap_or(text).parse();
                number.map($name).map_err(|_| concat!("expected a number, 17 or ", $prefix, "17").to_owned())
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
    /// A strictly increasing number that fences a lease: a provider refuses a smaller token than it has seen.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_id_is_read_as_messages_write_it_and_as_its_number_alone() {
        assert_eq!(["lease-17", "17"].map(str::parse::<LeaseId>), [Ok(LeaseId(17)), Ok(LeaseId(17))]);
        assert_eq!(Revision(9).to_string().parse::<Revision>(), Ok(Revision(9)));
        for other in ["", "lease-", "lease-x", "projection-17", "-17", "lease-lease-1"] {
            assert_eq!(other.parse::<LeaseId>(), Err("expected a number, 17 or lease-17".to_owned()), "{other}");
        }
    }
}
