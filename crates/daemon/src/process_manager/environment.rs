//! The environment of a worker: only variables that programs need to run at all, and those that its template
//! names.

use std::collections::BTreeMap;
use std::ffi::OsString;

/// Variables that are passed on from the process manager's own environment, where set.
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
/// Variables with this prefix are passed on as well: they tell a client how to reach the daemons.
const PREFIX: &str = "RATN_";

/// The variables of `own` that a worker gets whose template names `also`.
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
