//! TLS of both sides: a server's own certificate and the authorities whose clients it lets in; what a client trusts and shows.
//!
//! A process has one set of [`ClientTls`], given once at its start ([`install`]) or by the environment
//! (`RATN_TLS_CA`, `RATN_TLS_CERT`, `RATN_TLS_KEY`, which the workers of a process manager inherit). All files are PEM.
//!
//! ```text
//!   files ── read ──▶ LiveServerTls ──▶ every handshake of a server        (accept)
//!     ▲        └────▶ ClientTls ──────▶ every connection that is made      (connect)
//!     └── read_again: both, or neither
//! ```
//! A connection has what was there when it was made, until it ends.

pub(crate) mod accept;
pub(crate) mod connect;

use serde::{Deserialize, Serialize};
use std::fmt;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, PoisonError, RwLock};
use tokio_rustls::rustls::crypto::{CryptoProvider, ring};
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio_rustls::rustls::server::WebPkiClientVerifier;
use tokio_rustls::rustls::{ClientConfig, RootCertStore, ServerConfig};

/// The protocol that both sides agree upon in their handshake: HTTP/2.
const ALPN_H2: &[u8] = b"h2";

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

/// Files of a server and what was in them when they were last read. A handle: clones share everything.
#[derive(Clone)]
pub struct LiveServerTls {
    files: ServerTls,
    config: Arc<RwLock<Option<Arc<ServerConfig>>>>,
}

/// What a client trusts and shows.
#[derive(Clone)]
pub struct ClientTls {
    authorities: PathBuf,
    shown: Option<(PathBuf, PathBuf)>,
    config: Arc<ClientConfig>,
}

/// A file that cannot be read, or holds nothing usable.
#[derive(Debug, thiserror::Error)]
#[error("cannot read the TLS file {} ({what})", file.display())]
pub struct TlsError {
    /// Which.
    pub file: PathBuf,
    /// What it is for.
    pub what: &'static str,
    /// Why.
    #[source]
    pub source: io::Error,
}

static CLIENT: RwLock<Option<ClientTls>> = RwLock::new(None);

impl LiveServerTls {
    /// Of these files, which are not read yet.
    pub fn new(files: ServerTls) -> LiveServerTls {
        LiveServerTls { files, config: Arc::default() }
    }

    /// Reads the files: every handshake from now on is with what is in them.
    ///
    /// # Errors
    /// [`TlsError`] of the first that cannot be read or holds nothing usable; then what was there before stays.
    pub fn load(&self) -> Result<(), TlsError> {
        self.replace(self.files.config()?);
        Ok(())
    }

    /// What was read last; none before.
    fn current(&self) -> Option<Arc<ServerConfig>> {
        self.config.read().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn replace(&self, config: ServerConfig) {
        *self.config.write().unwrap_or_else(PoisonError::into_inner) = Some(Arc::new(config));
    }
}

impl From<ServerTls> for LiveServerTls {
    fn from(files: ServerTls) -> LiveServerTls {
        LiveServerTls::new(files)
    }
}

impl fmt::Debug for LiveServerTls {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("LiveServerTls").field("files", &self.files).finish_non_exhaustive()
    }
}

impl ServerTls {
    fn config(&self) -> Result<ServerConfig, TlsError> {
        let (cert, key) = identity((&self.cert, "cert"), (&self.key, "key"))?;
        let roots = Arc::new(roots(&self.client_ca, "client_ca")?);
        let clients = WebPkiClientVerifier::builder_with_provider(roots, provider()).build();
        let clients = clients.map_err(|error| unusable(&self.client_ca, "client_ca", &error))?;
        let builder = ServerConfig::builder_with_provider(provider()).with_safe_default_protocol_versions();
        let builder = builder.map_err(|error| unusable(&self.cert, "cert", &error))?;
        let config = builder.with_client_cert_verifier(clients).with_single_cert(cert, key);
        let mut config = config.map_err(|error| unusable(&self.key, "key", &error))?;
        config.alpn_protocols.push(ALPN_H2.into());
        Ok(config)
    }
}

impl ClientTls {
    /// Reads the files: the authorities, and the certificate and the key that are shown, if any.
    ///
    /// # Errors
    /// [`TlsError`] of the first that cannot be read or holds nothing usable.
    pub fn read(authorities: &Path, shown: Option<(&Path, &Path)>) -> Result<ClientTls, TlsError> {
        let roots = roots(authorities, "a client's ca")?;
        let builder = ClientConfig::builder_with_provider(provider()).with_safe_default_protocol_versions();
        let builder = builder.map_err(|error| unusable(authorities, "a client's ca", &error))?;
        let builder = builder.with_root_certificates(roots);
        let mut config = match shown {
            Some((cert, key)) => {
                let (shown, secret) = identity((cert, "a client's cert"), (key, "a client's key"))?;
                let config = builder.with_client_auth_cert(shown, secret);
                config.map_err(|error| unusable(key, "a client's key", &error))?
            }
            None => builder.with_no_client_auth(),
        };
        config.alpn_protocols.push(ALPN_H2.into());
        let shown = shown.map(|(cert, key)| (cert.to_owned(), key.to_owned()));
        Ok(ClientTls { authorities: authorities.to_owned(), shown, config: Arc::new(config) })
    }

    fn read_again(&self) -> Result<ClientTls, TlsError> {
        let shown = self.shown.as_ref().map(|(cert, key)| (cert.as_path(), key.as_path()));
        ClientTls::read(&self.authorities, shown)
    }
}

impl fmt::Debug for ClientTls {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ClientTls").field("shows", &self.shown.is_some()).finish_non_exhaustive()
    }
}

/// What every connection of this process uses from now on; false where it has some already.
pub fn install(tls: ClientTls) -> bool {
    let mut client = CLIENT.write().unwrap_or_else(PoisonError::into_inner);
    let is_first = client.is_none();
    client.get_or_insert(tls);
    is_first
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

/// Files of this process that were read again, and are not in use yet.
#[must_use = "nothing changes before it is taken over"]
#[derive(Debug)]
pub struct Renewed {
    server: Option<(LiveServerTls, ServerConfig)>,
    client: Option<ClientTls>,
}

/// Reads the files of a server, where it has loaded them, and those of the clients of this process again.
///
/// # Errors
/// [`TlsError`] of the first that cannot be read or holds nothing usable.
pub fn read_again(server: Option<&LiveServerTls>) -> Result<Renewed, TlsError> {
    let server = server.filter(|server| server.current().is_some());
    let server = server.map(|server| Ok((server.clone(), server.files.config()?))).transpose()?;
    Ok(Renewed { server, client: client().as_ref().map(ClientTls::read_again).transpose()? })
}

impl Renewed {
    /// Every handshake from now on, of the server and of clients, is with these.
    pub fn take_over(self) {
        if let Some((server, config)) = self.server {
            server.replace(config);
        }
        if let Some(tls) = self.client {
            *CLIENT.write().unwrap_or_else(PoisonError::into_inner) = Some(tls);
        }
    }
}

fn client() -> Option<ClientTls> {
    CLIENT.read().unwrap_or_else(PoisonError::into_inner).clone()
}

fn provider() -> Arc<CryptoProvider> {
    Arc::new(ring::default_provider())
}

type Identity = (Vec<CertificateDer<'static>>, PrivateKeyDer<'static>);

fn identity(cert: (&Path, &'static str), key: (&Path, &'static str)) -> Result<Identity, TlsError> {
    let (shown, secret) = (certificates(cert.0, cert.1)?, read(key.0, key.1)?);
    let secret = PrivateKeyDer::from_pem_slice(&secret).map_err(|error| unusable(key.0, key.1, &error))?;
    Ok((shown, secret))
}

fn roots(file: &Path, what: &'static str) -> Result<RootCertStore, TlsError> {
    let mut roots = RootCertStore::empty();
    let (added, _) = roots.add_parsable_certificates(certificates(file, what)?);
    if added == 0 {
        return Err(unusable(file, what, &"no certificate in it is one of an authority"));
    }
    Ok(roots)
}

fn certificates(file: &Path, what: &'static str) -> Result<Vec<CertificateDer<'static>>, TlsError> {
    let text = read(file, what)?;
    let certificates = CertificateDer::pem_slice_iter(&text).collect::<Result<Vec<_>, _>>();
    let certificates = certificates.map_err(|error| unusable(file, what, &error))?;
    if certificates.is_empty() {
        return Err(unusable(file, what, &"no certificate is in it"));
    }
    Ok(certificates)
}

fn read(file: &Path, what: &'static str) -> Result<Vec<u8>, TlsError> {
    std::fs::read(file).map_err(|source| TlsError { file: file.to_owned(), what, source })
}

fn unusable(file: &Path, what: &'static str, why: &dyn fmt::Display) -> TlsError {
    let source = io::Error::new(io::ErrorKind::InvalidData, why.to_string());
    TlsError { file: file.to_owned(), what, source }
}
