//! Values as bytes that are kept: the version of their form first, then [postcard](https://docs.rs/postcard).
//!
//! For what is written into a log or a snapshot and read by later versions of the program. What changes in a form otherwise than by
//! new variants of an enum at its end takes a new number, and readers still read the older ones ([`version`]).

use serde::{Deserialize, Serialize};

/// Bytes that are not what is expected, or of a version that is not known here.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DecodeError {
    /// Written by another version.
    #[error(
        "format {found} of the {of} is not known (this program reads up to {known}): use the version that wrote it"
    )]
    Version {
        /// Of what.
        of: &'static str,
        /// The first byte.
        found: u8,
        /// The newest that is known.
        known: u8,
    },
    /// Not what [`encode`] writes.
    #[error("these are no {of}: {reason}")]
    Broken {
        /// What was expected.
        of: &'static str,
        /// What is wrong.
        reason: String,
    },
}

/// A value as bytes, of a version.
pub fn encode<T: Serialize + ?Sized>(version: u8, value: &T) -> Vec<u8> {
    // What is kept is made for it: no maps of unknown length, no foreign types, so nothing in it can fail to serialise.
    postcard::to_extend(value, vec![version]).unwrap_or_default()
}

/// The version that bytes say they are of, where it is one from `oldest` to `newest`; `of` says what they are, for the message.
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

/// Reads what [`encode`] wrote; `of` says what it is, for the message.
///
/// # Errors
/// Bytes that it did not write, or another version did.
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
