//! `ratn certs DIR HOST…`: the certificate authority of a system and a certificate for each of its hosts, for mutual TLS.
//!
//! ```text
//!   DIR/ca.pem, ca.key (made once) ──signs──▶ DIR/HOST.pem, HOST.key
//! ```
//! A host needs `ca.pem` and its own two files; `ca.key` stays where it was made. Existing files are kept, unless a renewal is
//! requested.
//! X.509 version 3 with ECDSA on P-256 (RFC 5280), by rcgen.

use crate::arguments::CertsArguments;
use crate::failure::Failure;
use crate::output;
use anyhow::Context;
use rcgen::{
    BasicConstraints, CertificateParams, DistinguishedName, DnType, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair,
    KeyUsagePurpose, SanType,
};
use rustls_pki_types::CertificateDer;
use rustls_pki_types::pem::PemObject;
use serde::Serialize;
use std::collections::BTreeSet;
use std::fs;
use std::io::Write;
use std::net::IpAddr;
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use time::{Date, Duration, OffsetDateTime};

/// The authority's name in the certificates.
const AUTHORITY: &str = "ratn authority";
/// Validity of the authority's certificate, in days: ten years.
const AUTHORITY_DAYS: i64 = 3650;
/// Certificates are backdated, so that hosts whose clocks are behind accept a new one.
const BACKDATED: Duration = Duration::DAY;
/// Maximum length of a host name (RFC 1035).
const MAX_NAME: usize = 253;

/// A host and its additional names and addresses.
#[derive(Debug, PartialEq)]
struct Host {
    name: String,
    also: Vec<String>,
}

/// The result for a host.
#[derive(Debug, Serialize)]
struct HostCertificate {
    host: String,
    names: Vec<String>,
    cert: String,
    key: String,
    /// Expiry date; `None` where the existing certificate was kept.
    until: Option<String>,
}

/// Makes the files that do not exist yet.
pub(super) fn run(arguments: &CertsArguments) -> Result<(), Failure> {
    let hosts = arguments.hosts.iter().map(|text| host(text)).collect::<Result<Vec<_>, _>>();
    let hosts = hosts.map_err(|why| Failure::Refused(format!("ratn: {why}")))?;
    let mut names = BTreeSet::from(["ca"]);
    if let Some(twice) = hosts.iter().find(|host| !names.insert(&host.name)) {
        return Err(Failure::Refused(format!(
            "ratn: the host `{}` is named twice, or as the authority is",
            twice.name
        )));
    }
    let now = OffsetDateTime::now_utc();
    let directory = &arguments.directory;
    fs::create_dir_all(directory).with_context(|| format!("cannot make {}", directory.display()))?;
    let authority = authority(directory, now)?;
    let until = now + Duration::days(arguments.days.into());
    let made = hosts.iter().map(|host| certify(directory, &authority, host, now, until, arguments.renew));
    let made = made.collect::<anyhow::Result<Vec<_>>>()?;
    output::result(match arguments.json {
        true => serde_json::to_string(&made).context("cannot write the result")?,
        false => table(directory, &made),
    })?;
    Ok(())
}

/// Parses `HOST` or `HOST=NAME,ADDRESS`.
fn host(text: &str) -> Result<Host, String> {
    let (name, also) = text.split_once('=').unwrap_or((text, ""));
    let also: Vec<String> = also.split(',').filter(|part| !part.is_empty()).map(str::to_owned).collect();
    for name in std::iter::once(name).chain(also.iter().map(String::as_str)) {
        let label = |label: &str| {
            let inside = label.chars().all(|c| c.is_ascii_alphanumeric() || c == '-');
            inside && !label.is_empty() && !label.starts_with('-') && !label.ends_with('-')
        };
        let is_name = name.len() <= MAX_NAME && name.split('.').all(label);
        if !is_name && name.parse::<IpAddr>().is_err() {
            return Err(format!(
                "`{name}` in `{text}` is no name of a host: letters, digits, `-` and `.`; or an address after `=`"
            ));
        }
    }
    if name.parse::<IpAddr>().is_ok() {
        return Err(format!("`{name}` is an address: name the host, as `compute={name}`"));
    }
    Ok(Host { name: name.to_owned(), also })
}

fn authority_params(now: OffsetDateTime) -> CertificateParams {
    let mut params = CertificateParams::default();
    params.distinguished_name = named(AUTHORITY);
    params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
    params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
    params.not_before = now - BACKDATED;
    params.not_after = now + Duration::days(AUTHORITY_DAYS);
    params
}

fn named(name: &str) -> DistinguishedName {
    let mut distinguished = DistinguishedName::new();
    distinguished.push(DnType::CommonName, name);
    distinguished
}

/// The existing authority, or a new one where there is none.
fn authority(directory: &Path, now: OffsetDateTime) -> anyhow::Result<Issuer<'static, KeyPair>> {
    let (cert, key) = (directory.join("ca.pem"), directory.join("ca.key"));
    let params = authority_params(now);
    match (cert.exists(), key.exists()) {
        (false, false) => {
            let pair = KeyPair::generate()?;
            let signed = params.self_signed(&pair)?;
            write(&key, &pair.serialize_pem(), 0o600)?;
            write(&cert, &signed.pem(), 0o644)?;
            Ok(Issuer::new(params, pair))
        }
        (true, true) => {
            let text = ratn_regular_file::read_text(&key, ratn_regular_file::USUAL)
                .with_context(|| format!("cannot read {}", key.display()))?;
            let pair = KeyPair::from_pem(&text).with_context(|| format!("{} is no private key", key.display()))?;
            let there = CertificateDer::from_pem_file(&cert)
                .with_context(|| format!("{} is no certificate in PEM", cert.display()))?;
            let ours = params.self_signed(&pair)?;
            let (there, ours) =
                (webpki::anchor_from_trusted_cert(&there)?, webpki::anchor_from_trusted_cert(ours.der())?);
            anyhow::ensure!(
                there.subject == ours.subject && there.subject_public_key_info == ours.subject_public_key_info,
                "{} is not the authority of {} as `ratn certs` makes it: name another folder, or sign with the tools \
                 that made this authority",
                cert.display(),
                key.display()
            );
            Ok(Issuer::new(params, pair))
        }
        (has_cert, _) => {
            let (there, missing) = if has_cert { (&cert, &key) } else { (&key, &cert) };
            anyhow::bail!(
                "{} is there and {} is not: put it there, or name another folder for a new authority",
                there.display(),
                missing.display()
            )
        }
    }
}

fn certify(
    directory: &Path,
    authority: &Issuer<'static, KeyPair>,
    host: &Host,
    now: OffsetDateTime,
    until: OffsetDateTime,
    renew: bool,
) -> anyhow::Result<HostCertificate> {
    let (cert, key) = (directory.join(format!("{}.pem", host.name)), directory.join(format!("{}.key", host.name)));
    let names: Vec<String> = std::iter::once(&host.name).chain(&host.also).cloned().collect();
    let made = |until| HostCertificate {
        host: host.name.clone(),
        names: names.clone(),
        cert: cert.display().to_string(),
        key: key.display().to_string(),
        until,
    };
    if !renew && cert.exists() && key.exists() {
        return Ok(made(None));
    }
    let mut params = CertificateParams::default();
    params.distinguished_name = named(&host.name);
    params.subject_alt_names = names
        .iter()
        .map(|name| match name.parse() {
            Ok(address) => Ok(SanType::IpAddress(address)),
            Err(_) => Ok(SanType::DnsName(name.as_str().try_into()?)),
        })
        .collect::<anyhow::Result<_>>()?;
    params.use_authority_key_identifier_extension = true;
    params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
    params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ServerAuth, ExtendedKeyUsagePurpose::ClientAuth];
    params.not_before = now - BACKDATED;
    params.not_after = until;
    let pair = KeyPair::generate()?;
    let signed = params.signed_by(&pair, authority)?;
    write(&key, &pair.serialize_pem(), 0o600)?;
    write(&cert, &signed.pem(), 0o644)?;
    Ok(made(Some(day(until.date()))))
}

/// Writes a file atomically.
fn write(file: &Path, text: &str, mode: u32) -> anyhow::Result<()> {
    let next = file.with_extension("new");
    let written = fs::OpenOptions::new().write(true).create_new(true).mode(mode).open(&next).and_then(|mut open| {
        open.write_all(text.as_bytes())?;
        open.sync_all()?;
        fs::rename(&next, file)
    });
    if written.is_err() {
        let _ = fs::remove_file(&next);
    }
    written.with_context(|| format!("cannot write {}", file.display()))
}

fn day(date: Date) -> String {
    format!("{:04}-{:02}-{:02}", date.year(), u8::from(date.month()), date.day())
}

fn table(directory: &Path, made: &[HostCertificate]) -> String {
    let of = |what: &str| directory.join(what).display().to_string();
    let mut lines = vec![format!("authority  {}  (its key, {}, stays here)", of("ca.pem"), of("ca.key"))];
    for HostCertificate { host, names, cert, key, until } in made {
        let until =
            until.as_ref().map_or("kept as it is: --renew makes a new one".to_owned(), |day| format!("until {day}"));
        lines.push(format!("{host}  {cert}, {key}  for {}, {until}", names.join(", ")));
    }
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use std::os::unix::fs::PermissionsExt;
    use webpki::{EndEntityCert, KeyUsage, anchor_from_trusted_cert};

    fn certs(directory: &Path, hosts: &[&str], renew: bool) -> Result<(), Failure> {
        run(&CertsArguments {
            directory: directory.to_owned(),
            hosts: hosts.iter().map(|host| (*host).to_owned()).collect(),
            days: 30,
            renew,
            json: false,
        })
    }

    /// Whether a certificate is signed by the authority in the same directory, for client and server, and names the host.
    fn holds(directory: &Path, host: &str, name: &str) -> bool {
        let authority = CertificateDer::from_pem_file(directory.join("ca.pem")).unwrap();
        let der = CertificateDer::from_pem_file(directory.join(format!("{host}.pem"))).unwrap();
        let anchor = anchor_from_trusted_cert(&authority).unwrap();
        let certificate = EndEntityCert::try_from(&der).unwrap();
        let now = rustls_pki_types::UnixTime::since_unix_epoch(std::time::Duration::from_secs(
            OffsetDateTime::now_utc().unix_timestamp() as u64,
        ));
        let algorithms = [webpki::ring::ECDSA_P256_SHA256];
        let signed = [KeyUsage::server_auth(), KeyUsage::client_auth()].into_iter().all(|usage| {
            let anchors = [anchor.clone()];
            certificate.verify_for_usage(&algorithms, &anchors, &[], now, usage, None, None).is_ok()
        });
        let name = rustls_pki_types::ServerName::try_from(name).unwrap();
        signed && certificate.verify_is_valid_for_subject_name(&name).is_ok()
    }

    #[test]
    fn every_host_gets_a_certificate_of_one_authority_and_keys_are_their_owners_alone() {
        let parent = tempfile::tempdir().unwrap();
        let directory = parent.path().join("tls");
        certs(&directory, &["compute=10.0.0.2,compute.lan"], false).unwrap();
        certs(&directory, &["control"], false).unwrap();
        for (host, name) in
            [("compute", "compute"), ("compute", "10.0.0.2"), ("compute", "compute.lan"), ("control", "control")]
        {
            assert!(holds(&directory, host, name), "{host} {name}");
        }
        assert!(!holds(&directory, "control", "compute"));
        for key in ["ca.key", "compute.key", "control.key"] {
            let mode = fs::metadata(directory.join(key)).unwrap().permissions().mode();
            assert_eq!(mode & 0o777, 0o600, "{key}");
        }
        assert_eq!(fs::read_dir(&directory).unwrap().count(), 6);
    }

    #[test]
    fn what_is_there_is_kept_until_it_is_renewed() {
        let directory = tempfile::tempdir().unwrap();
        let read = || fs::read_to_string(directory.path().join("sim.pem")).unwrap();
        certs(directory.path(), &["sim"], false).unwrap();
        let first = read();
        certs(directory.path(), &["sim"], false).unwrap();
        assert_eq!(read(), first);
        certs(directory.path(), &["sim"], true).unwrap();
        assert_ne!(read(), first);
        assert!(holds(directory.path(), "sim", "sim"));
    }

    #[test]
    fn an_authority_of_others_or_half_of_one_is_refused_and_left_as_it_is() {
        let directory = tempfile::tempdir().unwrap();
        let refused = |what: &str| {
            let error = certs(directory.path(), &["sim"], false).unwrap_err();
            let said = match error {
                Failure::Failed(error) => format!("{error:#}"),
                other => format!("{other:?}"),
            };
            assert!(said.contains(what), "{said}");
        };
        let pair = KeyPair::generate().unwrap();
        let other = CertificateParams::new(["other".to_owned()]).unwrap().self_signed(&pair).unwrap();
        fs::write(directory.path().join("ca.pem"), other.pem()).unwrap();
        refused("ca.key is not: put it there");
        fs::write(directory.path().join("ca.key"), "no key").unwrap();
        refused("ca.key is no private key");
        fs::write(directory.path().join("ca.key"), pair.serialize_pem()).unwrap();
        refused("is not the authority");
        assert_eq!(fs::read_dir(directory.path()).unwrap().count(), 2);
    }

    #[test]
    fn names_that_are_none_are_refused() {
        assert_eq!(host("a=10.0.0.1,b.c").unwrap().also, ["10.0.0.1", "b.c"]);
        for bad in ["", "../x", "a b", "a=b/c", "-a", "10.0.0.1", "a..b", "a_b", &"x".repeat(300)] {
            assert!(host(bad).is_err(), "{bad}");
        }
        let directory = tempfile::tempdir().unwrap();
        for twice in [["a", "a"], ["b", "ca"]] {
            assert!(matches!(certs(directory.path(), &twice, false), Err(Failure::Refused(_))));
        }
    }
}
