//! TLS of both sides: a server's own certificate and the authorities whose clients it lets in; what a client trusts and shows.
//!
//! A process has one set of [`ClientTls`], given once at its start ([`install`]) or by the environment
//! (`RATN_TLS_CA`, `RATN_TLS_CERT`, `RATN_TLS_KEY`, which the workers of a process manager inherit). All files are PEM.

use serde::{Deserialize, Serialize};
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use tonic::transport::{Certificate, ClientTlsConfig, Identity, ServerTlsConfig};

/// The environment variable with the file of the authorities that a client trusts.
pub const CA_VARIABLE: &str = "RATN_TLS_CA";
/// The environment variable with the file of a client's certificate.
pub const CERT_VARIABLE: &str = "RATN_TLS_CERT";
/// The environment variable with the file of its private key.
pub const KEY_VARIABLE: &str = "RATN_TLS_KEY";

/// Files of a server.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ServerTls {
    /// Its certificate, with those between it and the authority.
    pub cert: PathBuf,
    /// Its private key.
    pub key: PathBuf,
    /// The authorities of clients: only who shows a certificate of theirs gets in.
    pub client_ca: PathBuf,
}

/// What a client trusts and shows.
#[derive(Clone)]
pub struct ClientTls {
    authorities: Vec<u8>,
    shown: Option<(Vec<u8>, Vec<u8>)>,
}

/// A file that cannot be read.
#[derive(Debug, thiserror::Error)]
#[error("cannot read the TLS file {} ({what})", file.display())]
pub struct TlsError {
    /// Which.
    pub file: PathBuf,
    /// What it is for.
    pub what: &'static str,
    /// Why.
    #[source]
    pub source: std::io::Error,
}

static CLIENT: OnceLock<ClientTls> = OnceLock::new();

impl ServerTls {
    /// Reads the files.
    ///
    /// # Errors
    /// [`TlsError`] of the first that cannot be read. What is in them is looked at when serving begins.
    pub fn read(&self) -> Result<ServerTlsConfig, TlsError> {
        let identity = Identity::from_pem(read(&self.cert, "cert")?, read(&self.key, "key")?);
        let authorities = Certificate::from_pem(read(&self.client_ca, "client_ca")?);
        Ok(ServerTlsConfig::new().identity(identity).client_ca_root(authorities))
    }
}

impl ClientTls {
    /// Reads the files: the authorities, and the certificate and the key that are shown, if any.
    ///
    /// # Errors
    /// [`TlsError`] of the first that cannot be read.
    pub fn read(authorities: &Path, shown: Option<(&Path, &Path)>) -> Result<ClientTls, TlsError> {
        let shown = match shown {
            Some((cert, key)) => Some((read(cert, "a client's cert")?, read(key, "a client's key")?)),
            None => None,
        };
        Ok(ClientTls { authorities: read(authorities, "a client's ca")?, shown })
    }
}

impl fmt::Debug for ClientTls {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ClientTls").field("shows", &self.shown.is_some()).finish_non_exhaustive()
    }
}

/// What every connection of this process uses from now on; false where it has some already.
pub fn install(tls: ClientTls) -> bool {
    CLIENT.set(tls).is_ok()
}

/// As [`install`], from the environment; does nothing where that names no authorities.
///
/// # Errors
/// [`TlsError`] of a file that it names and that cannot be read.
pub fn install_from_environment() -> Result<(), TlsError> {
    let variable = |name| std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
    let Some(authorities) = variable(CA_VARIABLE) else { return Ok(()) };
    let shown = variable(CERT_VARIABLE).zip(variable(KEY_VARIABLE));
    install(ClientTls::read(&authorities, shown.as_ref().map(|(cert, key)| (cert.as_path(), key.as_path())))?);
    Ok(())
}

/// What a server shows that has no config: the certificate that clients of this process show, to clients of the same authority.
pub fn server_from_environment() -> Option<ServerTls> {
    let variable = |name| std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
    let (cert, key) = (variable(CERT_VARIABLE)?, variable(KEY_VARIABLE)?);
    Some(ServerTls { cert, key, client_ca: variable(CA_VARIABLE)? })
}

/// The config of a connection to `host`. Without anything installed no server is trusted.
pub(crate) fn of_client(host: &str) -> ClientTlsConfig {
    let config = ClientTlsConfig::new().domain_name(host);
    let Some(tls) = CLIENT.get() else { return config };
    let config = config.ca_certificate(Certificate::from_pem(&tls.authorities));
    match &tls.shown {
        Some((cert, key)) => config.identity(Identity::from_pem(cert, key)),
        None => config,
    }
}

fn read(file: &Path, what: &'static str) -> Result<Vec<u8>, TlsError> {
    std::fs::read(file).map_err(|source| TlsError { file: file.to_owned(), what, source })
}
