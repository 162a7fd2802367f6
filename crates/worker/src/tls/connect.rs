//! A client's side of handshakes: each connection is made with what the process trusts and shows at that time.

use super::{ALPN_H2, client, provider};
use crate::endpoint::CONNECT_TIMEOUT;
use hyper_util::client::legacy::connect::HttpConnector;
use hyper_util::rt::TokioIo;
use std::future::Future;
use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;
use tokio_rustls::rustls::pki_types::ServerName;
use tokio_rustls::rustls::{ClientConfig, RootCertStore};
use tonic::codegen::{Service, StdError, http::Uri};

/// Connects over TCP, then with TLS to the host of its certificate.
#[derive(Debug, Clone)]
pub(crate) struct Connector {
    tcp: HttpConnector,
    host: String,
}

impl Connector {
    /// To `host`, as it is in the server's certificate.
    pub(crate) fn to(host: &str) -> Connector {
        let mut tcp = HttpConnector::new();
        tcp.enforce_http(false);
        tcp.set_nodelay(true);
        tcp.set_connect_timeout(Some(CONNECT_TIMEOUT));
        Connector { tcp, host: host.to_owned() }
    }
}

impl Service<Uri> for Connector {
    type Response = TokioIo<TlsStream<TcpStream>>;
    type Error = StdError;
    type Future = Pin<Box<dyn Future<Output = Result<Self::Response, StdError>> + Send>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), StdError>> {
        self.tcp.poll_ready(context).map_err(StdError::from)
    }

    fn call(&mut self, address: Uri) -> Self::Future {
        let connected = self.tcp.call(address);
        let host = self.host.clone();
        Box::pin(async move {
            let stream = connected.await?.into_inner();
            let stream = TlsConnector::from(config()?).connect(ServerName::try_from(host)?, stream).await?;
            if stream.get_ref().1.alpn_protocol() != Some(ALPN_H2) {
                return Err(io::Error::new(io::ErrorKind::Unsupported, "who serves there does not speak HTTP/2").into());
            }
            Ok(TokioIo::new(stream))
        })
    }
}

/// Without anything installed no server is trusted.
fn config() -> Result<Arc<ClientConfig>, StdError> {
    if let Some(tls) = client() {
        return Ok(tls.config);
    }
    let builder = ClientConfig::builder_with_provider(provider()).with_safe_default_protocol_versions()?;
    let mut config = builder.with_root_certificates(RootCertStore::empty()).with_no_client_auth();
    config.alpn_protocols.push(ALPN_H2.into());
    Ok(Arc::new(config))
}
