//! Protocol versions. Both ends of a call may be of different versions of the program: they work together if they have a protocol version
//! in common; otherwise the first call is refused with both versions named.
//!
//! ```text
//!   ratn-protocol: 1-1 0.1.0            oldest and newest version of the protocol, and the program's own
//! ```
//! Every call over a channel of [`crate::endpoint`] carries this header, also the pings of sessions, and every server of [`crate::server`]
//! checks it. A client without the header (another program) is admitted: its author has read the proto files and knows which version it
//! speaks.

use std::fmt;
use std::str::FromStr;
use tonic::codegen::http::{HeaderMap, HeaderValue};
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt};

/// The header and metadata key.
pub const HEADER: &str = "ratn-protocol";
/// The newest protocol version of this program. It is incremented by a change of the proto files that would make an older program do
/// something else than asked; an additional field or method does not need it.
pub const NEWEST: u32 = 1;
/// The oldest protocol version that this program works with.
pub const OLDEST: u32 = 1;
/// The header value of this program.
const OWN: HeaderValue = HeaderValue::from_static(concat!("1-1 ", env!("CARGO_PKG_VERSION")));

/// The protocol versions of a process.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Spoken {
    oldest: u32,
    newest: u32,
    program: String,
}

impl Spoken {
    fn own() -> Spoken {
        Spoken { oldest: OLDEST, newest: NEWEST, program: env!("CARGO_PKG_VERSION").to_owned() }
    }
}

impl fmt::Display for Spoken {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Spoken { oldest, newest, program } = self;
        write!(f, "ratn {program}, which speaks versions {oldest} to {newest} of the protocol")
    }
}

impl FromStr for Spoken {
    type Err = ();

    fn from_str(text: &str) -> Result<Spoken, ()> {
        let (versions, program) = text.split_once(' ').ok_or(())?;
        let (oldest, newest) = versions.split_once('-').ok_or(())?;
        let number = |text: &str| text.parse::<u32>().map_err(drop);
        let spoken = Spoken { oldest: number(oldest)?, newest: number(newest)?, program: program.to_owned() };
        let version = |byte: u8| byte.is_ascii_alphanumeric() || matches!(byte, b'.' | b'-' | b'+');
        let good = spoken.oldest <= spoken.newest && !program.is_empty() && program.bytes().all(version);
        good.then_some(spoken).ok_or(())
    }
}

/// Adds the header to a call.
pub(crate) fn say(headers: &mut HeaderMap) {
    headers.insert(HEADER, OWN);
}

/// Checks whether this program can serve the caller with these headers.
pub(crate) fn check(headers: &HeaderMap) -> Result<(), Status> {
    let Some(said) = headers.get(HEADER) else { return Ok(()) };
    let Some(theirs) = said.to_str().ok().and_then(|text| text.parse::<Spoken>().ok()) else {
        return Err(Status::invalid_argument(format!("`{HEADER}` is no `OLDEST-NEWEST PROGRAM`, as `1-1 0.1.0`")));
    };
    let own = Spoken::own();
    if theirs.oldest <= own.newest && own.oldest <= theirs.newest {
        return Ok(());
    }
    let message = format!("the caller is {theirs}, and this is {own}: use versions of ratn that have one in common");
    let metadata = [("caller", theirs.program.as_str()), ("here", own.program.as_str())];
    let metadata = metadata.map(|(key, value)| (key.to_owned(), value.to_owned()));
    let details = ErrorDetails::with_error_info("PROTOCOL", "ratn", metadata);
    Err(Status::with_error_details(Code::FailedPrecondition, message, details))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    fn said(text: &str) -> Result<(), Status> {
        check(&HeaderMap::from_iter([(HEADER.parse().unwrap(), HeaderValue::from_str(text).unwrap())]))
    }

    #[test]
    fn what_is_said_is_what_is_spoken() {
        assert_eq!(OWN.to_str().unwrap().parse(), Ok(Spoken::own()));
        let mut headers = HeaderMap::new();
        assert!(check(&headers).is_ok(), "a client of another program");
        say(&mut headers);
        assert!(check(&headers).is_ok());
    }

    #[test]
    fn versions_that_overlap_run_and_others_are_refused_with_both_named() {
        for common in
            [format!("{OLDEST}-{NEWEST} 0.1.0"), format!("{NEWEST}-{} 0.2.0", NEWEST + 1), format!("0-{OLDEST} 0.0.9")]
        {
            assert!(said(&common).is_ok(), "{common}");
        }
        for (other, program) in
            [(format!("{}-{} 9.8.7", NEWEST + 1, NEWEST + 1), "9.8.7"), ("0-0 0.0.1".to_owned(), "0.0.1")]
        {
            let refused = said(&other).unwrap_err();
            assert_eq!(refused.code(), Code::FailedPrecondition);
            let named = |program: &str| refused.message().contains(&format!("ratn {program}, which speaks"));
            assert!(named(program) && named(env!("CARGO_PKG_VERSION")), "{refused}");
            assert_eq!(refused.get_details_error_info().unwrap().reason, "PROTOCOL");
        }
    }

    #[test]
    fn what_is_no_version_is_refused() {
        for text in ["", "1", "1-1", "2-1 0.1.0", "1-1 ", "a-b 0.1.0", "1-1 <script>", "-1-1 0.1.0"] {
            assert_eq!(said(text).unwrap_err().code(), Code::InvalidArgument, "{text}");
        }
    }
}
