//! Access control: only pages that this program itself has served, on this machine, with the token of its user, get answers.
//!
//! A foreign page cannot ask: it does not know the token, has another `Origin`, and a host name that was rebound to this machine by DNS is
//! not one of the accepted names. Pure.

use hyper::header::{AUTHORIZATION, HOST, HeaderMap, HeaderValue, ORIGIN};
use ring::rand::{SecureRandom, SystemRandom};

const TOKEN_BYTES: usize = 24;
/// The names by which a browser may address this machine.
const NAMES: [&str; 3] = ["127.0.0.1", "localhost", "[::1]"];
const SCHEME: &str = "Bearer ";

/// Headers of every answer: the browser may run nothing foreign, send nothing elsewhere, show no page in a frame, and store nothing.
pub(crate) const HEADERS: [(&str, &str); 7] = [
    (
        "content-security-policy",
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self'; base-uri 'none'; \
         form-action 'none'; frame-ancestors 'none'; require-trusted-types-for 'script'; trusted-types 'none'",
    ),
    ("x-content-type-options", "nosniff"),
    ("referrer-policy", "no-referrer"),
    ("cross-origin-opener-policy", "same-origin"),
    ("cross-origin-resource-policy", "same-origin"),
    ("cache-control", "no-store"),
    ("permissions-policy", "camera=(), microphone=(), geolocation=()"),
];

/// The secret token of the user. No message of this crate contains it.
pub(crate) struct Token(String);

/// Why a request is refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(crate) enum Refused {
    /// The request's host name is not one of this machine's.
    #[error("this is served as 127.0.0.1 or localhost only")]
    Host,
    /// Another page asks.
    #[error("pages of others are not answered")]
    Origin,
    /// The token is wrong or missing.
    #[error("the token is not the one of this dashboard: open the address that `ratn dashboard` printed")]
    Token,
}

impl std::fmt::Debug for Token {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Token(…)")
    }
}

impl Token {
    /// A new token; `None` if the system provides no random bytes.
    pub(crate) fn random() -> Option<Token> {
        let mut bytes = [0; TOKEN_BYTES];
        SystemRandom::new().fill(&mut bytes).ok()?;
        Some(Token(bytes.iter().map(|byte| format!("{byte:02x}")).collect()))
    }

    /// The text, for the address that the user opens.
    pub(crate) fn text(&self) -> &str {
        &self.0
    }

    /// Compares in constant time.
    fn is(&self, other: &[u8]) -> bool {
        let own = self.0.as_bytes();
        own.len() == other.len() && own.iter().zip(other).fold(0, |all, (a, b)| all | (a ^ b)) == 0
    }
}

/// Checks access to the pages themselves, which contain no data. Returns the host.
pub(crate) fn asks_here(headers: &HeaderMap) -> Result<&str, Refused> {
    let host = only(headers, &HOST).and_then(|host| host.to_str().ok()).ok_or(Refused::Host)?;
    let name = match host.rsplit_once(':') {
        Some((name, port)) if !port.is_empty() && port.bytes().all(|byte| byte.is_ascii_digit()) => name,
        _ => host,
    };
    if !NAMES.iter().any(|own| own.eq_ignore_ascii_case(name)) {
        return Err(Refused::Host);
    }
    let foreign = |value: &HeaderValue| value.as_bytes() != format!("http://{host}").as_bytes();
    let elsewhere = |site: &HeaderValue| site != "same-origin" && site != "none";
    let is_elsewhere = headers.get_all("sec-fetch-site").iter().any(elsewhere);
    if headers.get_all(ORIGIN).iter().any(foreign) || is_elsewhere {
        return Err(Refused::Origin);
    }
    Ok(host)
}

/// Checks access to runs and systems.
pub(crate) fn may_look(headers: &HeaderMap, token: &Token) -> Result<(), Refused> {
    asks_here(headers)?;
    let shown = only(headers, &AUTHORIZATION).map(HeaderValue::as_bytes);
    let shown = shown.and_then(|shown| shown.strip_prefix(SCHEME.as_bytes())).ok_or(Refused::Token)?;
    if token.is(shown) { Ok(()) } else { Err(Refused::Token) }
}

/// The value of a header that occurs exactly once.
fn only<'h>(headers: &'h HeaderMap, name: &hyper::header::HeaderName) -> Option<&'h HeaderValue> {
    let mut all = headers.get_all(name).iter();
    let first = all.next()?;
    all.next().is_none().then_some(first)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    fn headers(all: &[(&'static str, &str)]) -> HeaderMap {
        let mut headers = HeaderMap::new();
        for (name, value) in all {
            headers.append(*name, HeaderValue::from_str(value).unwrap());
        }
        headers
    }

    #[test]
    fn only_this_machine_by_its_own_names_is_answered() {
        for host in ["127.0.0.1:80", "localhost:4711", "LOCALHOST:1", "[::1]:9", "127.0.0.1"] {
            assert!(asks_here(&headers(&[("host", host)])).is_ok(), "{host}");
        }
        for host in
            ["evil.example:80", "127.0.0.1.evil.example:80", "localhost.evil.example", "", "10.0.0.1:80", "127.0.0.1:x"]
        {
            assert_eq!(asks_here(&headers(&[("host", host)])), Err(Refused::Host), "{host}");
        }
        assert_eq!(asks_here(&headers(&[])), Err(Refused::Host));
        assert_eq!(asks_here(&headers(&[("host", "localhost"), ("host", "localhost")])), Err(Refused::Host));
    }

    #[test]
    fn a_page_of_somebody_else_is_refused_also_on_this_machine() {
        let from = |origin: &str| asks_here(&headers(&[("host", "localhost:80"), ("origin", origin)])).map(drop);
        assert_eq!(from("http://localhost:80"), Ok(()));
        for origin in
            ["http://localhost:81", "https://localhost:80", "http://evil.example", "null", "http://localhost:80.evil"]
        {
            assert_eq!(from(origin), Err(Refused::Origin), "{origin}");
        }
        let site = |site: &str| asks_here(&headers(&[("host", "localhost:80"), ("sec-fetch-site", site)])).map(drop);
        assert_eq!((site("same-origin"), site("none")), (Ok(()), Ok(())));
        assert_eq!((site("cross-site"), site("same-site")), (Err(Refused::Origin), Err(Refused::Origin)));
        let twice = [("host", "localhost:80"), ("sec-fetch-site", "none"), ("sec-fetch-site", "cross-site")];
        assert_eq!(asks_here(&headers(&twice)).map(drop), Err(Refused::Origin));
    }

    #[test]
    fn only_the_token_opens() {
        let token = Token::random().unwrap();
        assert_ne!(token.text(), Token::random().unwrap().text());
        let with = |shown: &str| may_look(&headers(&[("host", "localhost"), ("authorization", shown)]), &token);
        assert_eq!(with(&format!("Bearer {}", token.text())), Ok(()));
        let short = &token.text()[1..];
        for shown in ["", "Bearer ", token.text(), &format!("Bearer {short}"), &format!("bearer {}", token.text())] {
            assert_eq!(with(shown), Err(Refused::Token), "{shown}");
        }
        assert_eq!(may_look(&headers(&[("host", "localhost")]), &token), Err(Refused::Token));
    }
}
