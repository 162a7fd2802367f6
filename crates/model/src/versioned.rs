//! Values as bytes for storage: first the version of their format, then [postcard](https://docs.rs/postcard).
//!
//! For records that later versions of the program read from a log or a snapshot. A format that changes otherwise than by new enum
//! variants at its end gets a new version number, and readers still read the older ones ([`version`]).

use serde::{Deserialize, Serialize};

/// Error: the bytes have another content or an unknown version.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DecodeError {
    /// Written by another version.
    #[error(
        "format {found} of the {of} is not known (this program reads up to {known}): use the version that wrote it"
    )]
    Version {
        /// The kind of record.
        of: &'static str,
        /// The first byte.
        found: u8,
        /// The newest known version.
        known: u8,
    },
    /// The bytes were not written by [`encode`].
    #[error("these are no {of}: {reason}")]
    Broken {
        /// The expected kind of record.
        of: &'static str,
        /// What is wrong.
        reason: String,
    },
}

/// Serializes a value, with its version.
pub fn encode<T: Serialize + ?Sized>(version: u8, value: &T) -> Vec<u8> {
    // Stored types are our own and contain no maps of unknown length, so serialization cannot fail.
    postcard::to_extend(value, vec![version]).unwrap_or_default()
}

/// Checks that the bytes have a version from `oldest` to `newest` and returns it; `of` names the kind of record, for the message.
///
/// # Errors
/// No bytes, or another version.
pub fn version(oldest: u8, newest: u8, of: &'static str, bytes: &[u8]) -> Result<u8, DecodeError> {
    match bytes.first() {
        None => Err(DecodeError::Broken { of, reason: "no bytes".to_owned() }),
        Some(found) if (oldest..=newest).contains(found) => Ok(*found),
        Some(found) => Err(DecodeError::Version { of, found: *found, known: newest }),
    }
}

/// Deserializes bytes written by [`encode`]; `of` names the kind of record, for the message.
///
/// # Errors
/// The bytes were not written by `encode`, or have another version.
pub fn decode<T: for<'a> Deserialize<'a>>(version: u8, of: &'static str, bytes: &[u8]) -> Result<T, DecodeError> {
    let broken = |reason: String| DecodeError::Broken { of, reason };
    let (found, rest) = bytes.split_first().ok_or_else(|| broken("no bytes".to_owned()))?;
    if *found != version {
        return Err(DecodeError::Version { of, found: *found, known: version });
    }
    let (value, rest) = postcard::take_from_bytes(rest).map_err(|error| broken(error.to_string()))?;
    if rest.is_empty() { Ok(value) } else { Err(broken(format!("{} bytes too many", rest.len()))) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_not_written_so_is_refused_with_what_it_should_be() {
        let bytes = encode(3, &(7_u32, "seven"));
        assert_eq!(decode(3, "figures", &bytes), Ok((7_u32, "seven".to_owned())));
        let refusal =
            |version, bytes: &[u8]| decode::<(u32, String)>(version, "figures", bytes).map_err(|e| e.to_string());
        let other = "format 3 of the figures is not known (this program reads up to 4): use the version that wrote it";
        assert_eq!(refusal(4, &bytes), Err(other.to_owned()));
        assert_eq!(refusal(3, &[]), Err("these are no figures: no bytes".to_owned()));
        for end in 1..bytes.len() {
            assert!(refusal(3, &bytes[..end]).is_err());
        }
        assert_eq!((version(1, 3, "figures", &bytes), version(3, 5, "figures", &bytes)), (Ok(3), Ok(3)));
        let known = |oldest, newest| version(oldest, newest, "figures", &bytes).map_err(|e| e.to_string());
        assert_eq!(known(1, 2), Err(other.replace('4', "2")));
        assert_eq!(known(4, 4), Err(other.to_owned()));
        let longer = [bytes.as_slice(), &[0]].concat();
        assert_eq!(refusal(3, &longer), Err("these are no figures: 1 bytes too many".to_owned()));
    }
}
