//! The TLS files: readable, private to their owner, of one authority, not expired, and valid for the names of the
//! listen addresses.

use super::Findings;
use crate::system::config::SystemConfig;
use crate::system::variable;
use ratn_worker::endpoint::Endpoint;
use ratn_worker::tls::{CA_VARIABLE, CERT_VARIABLE, KEY_VARIABLE};
use rcgen::{KeyPair, PublicKeyData};
use rustls_pki_types::pem::PemObject;
use rustls_pki_types::{CertificateDer, ServerName, UnixTime};
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::time::Duration;
use time::OffsetDateTime;
use webpki::{ALL_VERIFICATION_ALGS, EndEntityCert, KeyUsage, anchor_from_trusted_cert};

/// A certificate that expires within this time causes a warning.
const SOON: Duration = Duration::from_secs(30 * 86_400);
const HOW_TO_RENEW: &str = "`ratn certs DIR HOST --renew` makes a new one; daemons read it when they start";

pub(super) fn check(findings: &mut Findings, config: &SystemConfig) {
    let listens = listens(config);
    match &config.service.tls {
        Some(files) => trio(findings, "[service.tls]", &files.client_ca, &files.cert, &files.key, &names(&listens)),
        None => {
            let reached = listens.iter().filter(|(_, endpoint)| is_reached(endpoint) && !config.service.insecure);
            for (section, endpoint) in reached {
                findings.problem(
                    format!("[{section}] listen"),
                    format!("{endpoint} can be reached from other machines, and there is no [service.tls]"),
                    "`ratn certs DIR HOST...` makes certificates; or listen on `local`",
                );
            }
        }
    }
    let [ca, cert, key] = [CA_VARIABLE, CERT_VARIABLE, KEY_VARIABLE].map(variable);
    match (ca, cert, key) {
        (Some(ca), Some(cert), Some(key)) => trio(findings, "environment", &ca, &cert, &key, &[]),
        (None, None, None) => {}
        (ca, cert, key) => {
            let missing = [(ca, CA_VARIABLE), (cert, CERT_VARIABLE), (key, KEY_VARIABLE)];
            let missing = missing.iter().filter(|(path, _)| path.is_none()).map(|(_, name)| *name).collect::<Vec<_>>();
            findings.warning(
                "environment",
                format!("of the variables of TLS {} is not set", missing.join(", ")),
                "set all three: who shows no certificate is not let in",
            );
        }
    }
}

/// The listen addresses of this config's roles.
pub(super) fn listens(config: &SystemConfig) -> [(&'static str, Endpoint); 4] {
    [
        ("resource-manager", config.resource_manager.listen.clone()),
        ("world-pool", config.world_pool.listen.clone()),
        ("process-manager", config.process_manager.listen.clone()),
        ("cell", config.cell.listen.clone()),
    ]
}

fn is_reached(endpoint: &Endpoint) -> bool {
    match endpoint {
        Endpoint::Tcp { host, .. } | Endpoint::Tls { host, .. } => {
            host != "localhost" && host.parse().map_or(true, |address: std::net::IpAddr| !address.is_loopback())
        }
        Endpoint::Unix(_) | Endpoint::AnyOf(_) => false,
    }
}

/// The names of this machine among the listen addresses: the others belong to other hosts.
fn names(listens: &[(&'static str, Endpoint)]) -> Vec<String> {
    let host = |endpoint: &Endpoint| match endpoint {
        Endpoint::Tcp { host, port } | Endpoint::Tls { host, port } => Some((host.clone(), *port)),
        Endpoint::Unix(_) | Endpoint::AnyOf(_) => None,
    };
    let own = |(host, _): &(String, u16)| std::net::TcpListener::bind((host.as_str(), 0)).is_ok();
    let mut names: Vec<String> =
        listens.iter().filter_map(|(_, endpoint)| host(endpoint)).filter(own).map(|(host, _)| host).collect();
    names.sort();
    names.dedup();
    names
}

fn trio(findings: &mut Findings, about: &str, ca: &Path, cert: &Path, key: &Path, names: &[String]) {
    let (authority, certificate) = (read(findings, about, ca), read(findings, about, cert));
    let pair = private_key(findings, about, key);
    let (Some(authority), Some(der)) = (authority, certificate) else { return };
    let shown = cert.display();
    let of = |what: &Path| format!("{about} {}", what.display());
    let Ok(anchor) = anchor_from_trusted_cert(&authority) else {
        return findings.problem(of(ca), "is no certificate of an authority", "put the `ca.pem` of `ratn certs` there");
    };
    let Ok(certificate) = EndEntityCert::try_from(&der) else {
        return findings.problem(of(cert), "is no certificate of a host", "`ratn certs DIR HOST` makes one");
    };
    let now = OffsetDateTime::now_utc().unix_timestamp().unsigned_abs();
    let verified = |at: Duration, usage| {
        let at = UnixTime::since_unix_epoch(at);
        let anchors = [anchor.clone()];
        certificate.verify_for_usage(ALL_VERIFICATION_ALGS, &anchors, &[], at, usage, None, None).map(drop)
    };
    let now = Duration::from_secs(now);
    let both = [KeyUsage::server_auth(), KeyUsage::client_auth()];
    match both.into_iter().find_map(|usage| verified(now, usage).err()) {
        Some(webpki::Error::CertExpired { not_after, .. }) => {
            let days = now.as_secs().saturating_sub(not_after.as_secs()) / 86_400;
            findings.problem(of(cert), format!("is over since {days} days"), HOW_TO_RENEW);
        }
        Some(webpki::Error::CertNotValidYet { .. }) => {
            findings.problem(of(cert), "does not hold yet", "is the clock of this machine right?");
        }
        Some(error) => findings.problem(
            of(cert),
            format!("does not serve for both ends under {}: {error}", ca.display()),
            "one authority is for the whole system: make both with the same `ratn certs DIR`",
        ),
        None => match verified(now + SOON, KeyUsage::server_auth()) {
            Err(webpki::Error::CertExpired { not_after, .. }) => {
                let days = not_after.as_secs().saturating_sub(now.as_secs()) / 86_400;
                findings.warning(of(cert), format!("is over in {days} days"), HOW_TO_RENEW);
            }
            _ => findings.ok(of(cert), "holds for more than 30 days"),
        },
    }
    for name in names {
        let named = ServerName::try_from(name.as_str())
            .is_ok_and(|name| certificate.verify_is_valid_for_subject_name(&name).is_ok());
        if !named {
            findings.problem(
                of(cert),
                format!("is not for `{name}`, which is listened on"),
                format!("`ratn certs DIR HOST={name} --renew`: clients check the name that they connect to"),
            );
        }
    }
    if let Some(pair) = pair {
        let info = certificate.subject_public_key_info();
        if pair.subject_public_key_info() == info.as_ref() {
            findings.ok(of(key), format!("belongs to {shown}"));
        } else {
            findings.problem(of(key), format!("is not the key of {shown}"), "put the two files of one host there");
        }
    }
}

fn read(findings: &mut Findings, about: &str, file: &Path) -> Option<CertificateDer<'static>> {
    match CertificateDer::from_pem_file(file) {
        Ok(der) => Some(der),
        Err(error) => {
            let help = "PEM files, as `ratn certs` makes them, readable by who runs the daemon";
            findings.problem(format!("{about} {}", file.display()), format!("is not read: {error}"), help);
            None
        }
    }
}

fn private_key(findings: &mut Findings, about: &str, file: &Path) -> Option<KeyPair> {
    let at = format!("{about} {}", file.display());
    let text = match ratn_regular_file::read_text(file, ratn_regular_file::USUAL) {
        Ok(text) => text,
        Err(error) => {
            findings.problem(at, format!("is not read: {error}"), "it has to be readable by who runs the daemon");
            return None;
        }
    };
    if let Ok(there) = std::fs::metadata(file)
        && there.mode() & 0o077 != 0
    {
        let found = format!("others may read it (mode {:o})", there.mode() & 0o777);
        findings.problem(at, found, format!("chmod 600 {}", file.display()));
    }
    // A kind of key that is unknown here may still work.
    KeyPair::from_pem(&text).ok()
}
