//! TLS of both sides: a server's certificate and the authorities of its clients; the authorities that a client trusts, and its certificate.
//!
//! A client gets its [`ClientTls`] when it is made ([`crate::client::Channels::new`]): two clients of one process may trust different
//! authorities. A program reads its own once, at its start, from the environment ([`ClientTls::from_environment`]: `RATN_TLS_CA`,
//! `RATN_TLS_CERT`, `RATN_TLS_KEY`, which the workers of a process manager inherit). All files are PEM.
//!
//! ```text
//!   files ── read ──▶ LiveServerTls ──▶ every handshake of a server        (accept)
//!     ▲        └────▶ ClientTls ──────▶ every connection that is made      (connect)
//!     └── read_again: both, or neither
//! ```
//! A connection keeps the settings with which it was made until it ends.

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

/// The environment variable with the file of the certificate authorities that a client trusts.
pub const CA_VARIABLE: &str = "RATN_TLS_CA";
/// The environment variable with the file of a client's certificate.
pub const CERT_VARIABLE: &str = "RATN_TLS_CERT";
/// The environment variable with the file of the client's private key.
pub const KEY_VARIABLE: &str = "RATN_TLS_KEY";

/// TLS files of a server.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ServerTls {
    /// Its certificate, followed by the intermediate certificates up to the authority.
    pub cert: PathBuf,
    /// Its private key.
    pub key: PathBuf,
    /// The authorities of clients: only clients with a certificate that one of them signed are admitted.
    pub client_ca: PathBuf,
}

/// TLS files of a server, and their content when they were last read. A handle: clones share everything.
#[derive(Clone)]
pub struct LiveServerTls {
    files: ServerTls,
    config: Arc<RwLock<Option<Arc<ServerConfig>>>>,
}

/// The authorities that a client trusts and the certificate that it presents. A handle: clones share everything, so that files which are
/// read again apply to every connection that any of them makes afterwards.
#[derive(Clone)]
pub struct ClientTls {
    /// `None` if no server is trusted.
    live: Option<Arc<LiveClientTls>>,
}

/// TLS files of a client, and their content when they were last read.
struct LiveClientTls {
    authorities: PathBuf,
    /// The files of its certificate and key.
    shown: Option<(PathBuf, PathBuf)>,
    config: RwLock<Arc<ClientConfig>>,
}

/// A file that cannot be read, or holds nothing usable.
#[derive(Debug, thiserror::Error)]
#[error("cannot read the TLS file {} ({what})", file.display())]
pub struct TlsError {
    /// The file.
    pub file: PathBuf,
    /// The purpose of the file.
    pub what: &'static str,
    /// The cause.
    #[source]
    pub source: io::Error,
}

impl LiveServerTls {
    /// For these files, which are not read yet.
    pub fn new(files: ServerTls) -> LiveServerTls {
        LiveServerTls { files, config: Arc::default() }
    }

    /// Reads the files: every handshake from now on uses their content.
    ///
    /// # Errors
    /// [`TlsError`] of the first file that cannot be read or holds nothing usable; then the previous content stays in use.
    pub fn load(&self) -> Result<(), TlsError> {
        self.replace(self.files.config()?);
        Ok(())
    }

    /// The content read last; `None` before the first [`LiveServerTls::load`].
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
    /// Trusts no server: connections with TLS are refused. For systems without TLS.
    pub fn none() -> ClientTls {
        ClientTls { live: None }
    }

    /// Reads the files: the authorities, and the client's certificate and key, if any.
    ///
    /// # Errors
    /// [`TlsError`] of the first file that cannot be read or holds nothing usable.
    pub fn read(authorities: &Path, shown: Option<(&Path, &Path)>) -> Result<ClientTls, TlsError> {
        let shown = shown.map(|(cert, key)| (cert.to_owned(), key.to_owned()));
        let config = RwLock::new(Arc::new(client_config(authorities, shown.as_ref())?));
        Ok(ClientTls { live: Some(Arc::new(LiveClientTls { authorities: authorities.to_owned(), shown, config })) })
    }

    /// Reads the files that the environment names ([`CA_VARIABLE`], [`CERT_VARIABLE`] and [`KEY_VARIABLE`]); [`ClientTls::none`] if it
    /// names no authorities.
    ///
    /// # Errors
    /// [`TlsError`] if a file that the environment names cannot be read.
    pub fn from_environment() -> Result<ClientTls, TlsError> {
        let Some(authorities) = variable(CA_VARIABLE) else { return Ok(ClientTls::none()) };
        let shown = variable(CERT_VARIABLE).zip(variable(KEY_VARIABLE));
        ClientTls::read(&authorities, shown.as_ref().map(|(cert, key)| (cert.as_path(), key.as_path())))
    }

    /// Whether no server is trusted ([`ClientTls::none`]).
    pub fn is_none(&self) -> bool {
        self.live.is_none()
    }

    /// The content read last; `None` if no server is trusted.
    fn current(&self) -> Option<Arc<ClientConfig>> {
        Some(self.live.as_ref()?.config.read().unwrap_or_else(PoisonError::into_inner).clone())
    }
}

impl LiveClientTls {
    fn replace(&self, config: ClientConfig) {
        *self.config.write().unwrap_or_else(PoisonError::into_inner) = Arc::new(config);
    }
}

impl fmt::Debug for ClientTls {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ClientTls")
            .field("authorities", &self.live.as_ref().map(|live| &live.authorities))
            .field("shows", &self.live.as_ref().is_some_and(|live| live.shown.is_some()))
            .finish_non_exhaustive()
    }
}

fn client_config(authorities: &Path, shown: Option<&(PathBuf, PathBuf)>) -> Result<ClientConfig, TlsError> {
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
    Ok(config)
}

/// TLS files of a server without a config: the client certificate that the environment names, for clients of the same authority.
pub fn server_from_environment() -> Option<ServerTls> {
    let (cert, key) = (variable(CERT_VARIABLE)?, variable(KEY_VARIABLE)?);
    Some(ServerTls { cert, key, client_ca: variable(CA_VARIABLE)? })
}

fn variable(name: &str) -> Option<PathBuf> {
    std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from)
}

/// TLS files of a server and of a client that were read again and are not in use yet.
#[must_use = "nothing changes before it is taken over"]
pub struct Renewed {
    server: Option<(LiveServerTls, ServerConfig)>,
    client: Option<(Arc<LiveClientTls>, ClientConfig)>,
}

/// Reads the files of a server, if it has loaded them, and those of `client` again.
///
/// # Errors
/// [`TlsError`] of the first file that cannot be read or holds nothing usable.
pub fn read_again(server: Option<&LiveServerTls>, client: &ClientTls) -> Result<Renewed, TlsError> {
    let server = server.filter(|server| server.current().is_some());
    let server = server.map(|server| Ok((server.clone(), server.files.config()?))).transpose()?;
    let client = client.live.as_ref();
    let client = client.map(|live| Ok((live.clone(), client_config(&live.authorities, live.shown.as_ref())?)));
    Ok(Renewed { server, client: client.transpose()? })
}

impl Renewed {
    /// Makes every handshake from now on use these files, for the server and for every clone of the client's handle.
    pub fn take_over(self) {
        if let Some((server, config)) = self.server {
            server.replace(config);
        }
        if let Some((client, config)) = self.client {
            client.replace(config);
        }
    }
}

impl fmt::Debug for Renewed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Renewed { server, client } = self;
        f.debug_struct("Renewed").field("server", &server.is_some()).field("client", &client.is_some()).finish()
    }
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
    ratn_regular_file::read(file, ratn_regular_file::USUAL).map_err(|source| TlsError {
        file: file.to_owned(),
        what,
        source,
    })
}

fn unusable(file: &Path, what: &'static str, why: &dyn fmt::Display) -> TlsError {
    let source = io::Error::new(io::ErrorKind::InvalidData, why.to_string());
    TlsError { file: file.to_owned(), what, source }
}
