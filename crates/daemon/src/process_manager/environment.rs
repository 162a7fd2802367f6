//! The environment of a worker: clean, but for what programs need to run at all and what its template names.

use std::collections::BTreeMap;
use std::ffi::OsString;

/// Passed on from the process manager's own environment, where set; and whatever begins with `RATN_`.
pub(super) const PASSED: [&str; 11] = [
    "PATH",
    "HOME",
    "USER",
    "LOGNAME",
    "LANG",
    "LC_ALL",
    "TZ",
    "TMPDIR",
    "RUST_BACKTRACE",
    "RUST_LOG",
    "SSL_CERT_FILE",
];
/// And these: how a client reaches the daemons.
const PREFIX: &str = "RATN_";

/// What of `own` a worker gets that is to get `also`.
pub(super) fn passed(own: impl Iterator<Item = (OsString, OsString)>, also: &[String]) -> BTreeMap<OsString, OsString> {
    let passes =
        |name: &str| PASSED.contains(&name) || name.starts_with(PREFIX) || also.iter().any(|known| known == name);
    own.filter(|(name, _)| name.to_str().is_some_and(passes)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_is_named_is_passed_on() {
        let own = ["PATH", "RATN_TLS_CA", "AWS_SECRET_ACCESS_KEY", "DISPLAY", "NOTIFY_SOCKET"];
        let own = || own.iter().map(|name| (OsString::from(name), OsString::from("x")));
        let names = |also: &[String]| passed(own(), also).into_keys().collect::<Vec<_>>();
        assert_eq!(names(&[]), ["PATH", "RATN_TLS_CA"]);
        assert_eq!(names(&["DISPLAY".to_owned()]), ["DISPLAY", "PATH", "RATN_TLS_CA"]);
    }
}
