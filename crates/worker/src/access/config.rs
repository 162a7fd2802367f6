//! Which roles callers have, by the identity that their connection proves: a user of this machine, or the holder of a certificate.

use super::Role::{Agent, Operator, Task, Viewer};
use super::{Caller, Role};
use crate::gate::Identity;
use rustls_pki_types::CertificateDer;
use serde::{Deserialize, Serialize};
use webpki::EndEntityCert;

/// Which roles callers have. Over a Unix socket, root and the user who runs the daemon are operators, unless `users` names them otherwise.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AccessConfig {
    /// Roles over TCP without TLS, where no caller proves an identity.
    pub anonymous: Vec<Role>,
    /// Roles of users of this machine that are not named below.
    pub others: Vec<Role>,
    /// Roles of single users of this machine.
    #[serde(rename = "user")]
    pub users: Vec<UserAccess>,
    /// Roles of certificate holders; a certificate that is not named here gives the role `viewer`.
    #[serde(rename = "certificate")]
    pub certificates: Vec<CertificateAccess>,
}

/// Roles of a user.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct UserAccess {
    /// The user id.
    pub uid: u32,
    /// The user's roles.
    pub roles: Vec<Role>,
}

/// Roles of the holder of a certificate: of one certificate, or of any that the certificate authority issued for a host.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CertificateAccess {
    /// SHA-256 of the certificate in hex, colons allowed, as `openssl x509 -noout -fingerprint -sha256` prints it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fingerprint: Option<String>,
    /// A host name in the certificate: a new certificate of the same host needs no new config.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub host: Option<String>,
    /// A name for people and for the audit log; by default the host's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// The holder's roles.
    pub roles: Vec<Role>,
}

impl CertificateAccess {
    fn name(&self) -> &str {
        self.name.as_deref().or(self.host.as_deref()).unwrap_or_default()
    }
}

impl Default for AccessConfig {
    fn default() -> Self {
        AccessConfig {
            anonymous: vec![Viewer, Task, Agent],
            others: vec![Viewer],
            users: Vec::new(),
            certificates: Vec::new(),
        }
    }
}

impl AccessConfig {
    /// The first fault of this config, if any: the key, and the rule that it breaks.
    pub fn fault(&self) -> Option<(String, &'static str)> {
        for (i, certificate) in self.certificates.iter().enumerate() {
            let key = |name: &str| format!("access.certificate[{i}]{name}");
            if certificate.fingerprint.is_some() == certificate.host.is_some() {
                return Some((key(""), "either by `fingerprint` or by `host`"));
            }
            let digits = certificate.fingerprint.as_deref().map(hex_digits);
            if !digits.is_none_or(|d| d.len() == 64 && d.bytes().all(|b| b.is_ascii_hexdigit())) {
                return Some((key(".fingerprint"), "64 hex digits (SHA-256)"));
            }
            let name = certificate.name();
            if name.is_empty() || name.chars().any(char::is_control) {
                return Some((key(".name"), "given, or the host's; no control characters"));
            }
        }
        None
    }

    /// The caller at the other end of a connection, for a daemon that runs as `own_uid`.
    pub fn caller(&self, identity: &Identity, own_uid: u32) -> Caller {
        let (name, roles): (String, &[Role]) = match identity {
            Identity::User { uid, .. } => {
                let named = self.users.iter().find(|user| user.uid == *uid).map(|user| user.roles.as_slice());
                let own = (*uid == own_uid || *uid == 0).then_some(&[Operator] as &[Role]);
                (format!("uid {uid}"), named.or(own).unwrap_or(&self.others))
            }
            Identity::Certificate { der } => {
                let (shown, hosts) = (fingerprint(der), hosts(der));
                let same =
                    |known: &&CertificateAccess| known.fingerprint.as_deref().map(hex_digits) == Some(shown.clone());
                let of_host = |known: &&CertificateAccess| known.host.as_ref().is_some_and(|host| hosts.contains(host));
                let known = self.certificates.iter().find(same).or_else(|| self.certificates.iter().find(of_host));
                match known {
                    Some(known) => (format!("{} (certificate)", known.name()), &known.roles),
                    None => (format!("certificate {shown}"), &[Viewer]),
                }
            }
            Identity::Anonymous => ("anonymous".to_owned(), &self.anonymous),
        };
        Caller { name: name.into(), roles: roles.into() }
    }
}

/// SHA-256 in lower-case hex.
fn fingerprint(der: &[u8]) -> String {
    use std::fmt::Write;
    let digest = ring::digest::digest(&ring::digest::SHA256, der);
    digest.as_ref().iter().fold(String::with_capacity(64), |mut text, byte| {
        // Writing to a string does not fail.
        let _ = write!(text, "{byte:02x}");
        text
    })
}

/// The host names in a certificate. Its signature was checked when the connection was accepted.
fn hosts(der: &[u8]) -> Vec<String> {
    let der = CertificateDer::from(der);
    let Ok(certificate) = EndEntityCert::try_from(&der) else { return Vec::new() };
    certificate.valid_dns_names().map(str::to_owned).collect()
}

fn hex_digits(fingerprint: &str) -> String {
    fingerprint.chars().filter(|c| *c != ':').map(|c| c.to_ascii_lowercase()).collect()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use std::sync::Arc;

    #[test]
    fn callers_have_the_roles_of_what_they_prove() {
        let der: Arc<[u8]> = b"a certificate".as_slice().into();
        let colons = fingerprint(&der)
            .to_ascii_uppercase()
            .as_bytes()
            .chunks(2)
            .map(|pair| String::from_utf8_lossy(pair).into_owned())
            .collect::<Vec<_>>()
            .join(":");
        let access = AccessConfig {
            users: vec![UserAccess { uid: 7, roles: vec![Task] }],
            certificates: vec![CertificateAccess {
                fingerprint: Some(colons),
                host: None,
                name: Some("control".to_owned()),
                roles: vec![Agent],
            }],
            ..AccessConfig::default()
        };
        assert_eq!(access.fault(), None);
        let of = |identity| access.caller(&identity, 1000);
        let user = |uid| of(Identity::User { uid, pid: None });
        assert_eq!((&*user(1000).name, &*user(1000).roles), ("uid 1000", &[Operator] as &[Role]));
        assert_eq!(&*user(0).roles, [Operator]);
        assert_eq!(&*user(7).roles, [Task]);
        assert_eq!(&*user(8).roles, [Viewer]);
        let known = of(Identity::Certificate { der });
        assert_eq!((&*known.name, &*known.roles), ("control (certificate)", &[Agent] as &[Role]));
        assert_eq!(&*of(Identity::Certificate { der: b"another".as_slice().into() }).roles, [Viewer]);
        assert!(!of(Identity::Anonymous).is_operator());
    }

    #[test]
    fn a_certificate_is_named_by_its_fingerprint_or_its_host_else_it_is_refused_with_its_place() {
        let refused = |certificate: &str| {
            let text = format!("[[certificate]]\nroles = [\"viewer\"]\n{certificate}");
            let access: AccessConfig = toml::from_str(&text).unwrap();
            access.fault().map(|(key, rule)| format!("{key}: {rule}"))
        };
        let says = |certificate: &str, what: &str| {
            let said = refused(certificate).unwrap_or_default();
            assert!(said.contains(what), "{said}");
        };
        says("fingerprint = \"12:34\"\nname = \"x\"", "access.certificate[0].fingerprint");
        says("name = \"x\"", "either by `fingerprint` or by `host`");
        says("host = \"control\"\nfingerprint = \"12\"", "either by");
        says(&format!("fingerprint = \"{}\"", "ab".repeat(32)), "access.certificate[0].name");
        assert_eq!(refused("host = \"control\""), None);
    }

    #[test]
    fn a_certificate_has_the_roles_of_the_host_it_is_for() {
        let sign = |names: &[&str]| {
            let key = rcgen::KeyPair::generate().unwrap();
            let names: Vec<String> = names.iter().map(|name| (*name).to_owned()).collect();
            let signed = rcgen::CertificateParams::new(names).unwrap().self_signed(&key).unwrap();
            Identity::Certificate { der: signed.der().to_vec().into() }
        };
        let access: AccessConfig = toml::from_str("[[certificate]]\nhost = \"control\"\nroles = [\"task\"]").unwrap();
        let control = access.caller(&sign(&["elsewhere", "control"]), 0);
        assert_eq!((&*control.name, &*control.roles), ("control (certificate)", &[Task] as &[Role]));
        assert_eq!(&*access.caller(&sign(&["control.example"]), 0).roles, [Viewer]);
    }
}
