//! The client's side of TLS handshakes: each connection uses the trusted authorities and the certificate of that time.

use super::{ALPN_H2, CA_VARIABLE, ClientTls};
use crate::endpoint::over_tcp;
use hyper_util::client::legacy::connect::HttpConnector;
use hyper_util::rt::TokioIo;
use std::future::Future;
use std::io;
use std::pin::Pin;
use std::task::{Context, Poll};
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;
use tokio_rustls::rustls::pki_types::ServerName;
use tonic::codegen::{Service, StdError, http::Uri};

/// Connects over TCP, then with TLS; the server's certificate must be for the host.
#[derive(Debug, Clone)]
pub(crate) struct Connector {
    tcp: HttpConnector,
    host: String,
    tls: ClientTls,
}

impl Connector {
    /// A connector to `host`, as named in the server's certificate, with the settings of `tls`.
    pub(crate) fn to(host: &str, tls: &ClientTls) -> Connector {
        Connector { tcp: over_tcp(), host: host.to_owned(), tls: tls.clone() }
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
        let (host, tls) = (self.host.clone(), self.tls.clone());
        Box::pin(async move {
            let stream = connected.await?.into_inner();
            let config = tls.current().ok_or_else(|| trusts_nobody(&host))?;
            let stream = TlsConnector::from(config).connect(ServerName::try_from(host)?, stream).await?;
            if stream.get_ref().1.alpn_protocol() != Some(ALPN_H2) {
                return Err(io::Error::new(io::ErrorKind::Unsupported, "who serves there does not speak HTTP/2").into());
            }
            Ok(TokioIo::new(stream))
        })
    }
}

fn trusts_nobody(host: &str) -> io::Error {
    let message = format!(
        "`{host}` serves with TLS, and this client trusts no certificate authority: set {CA_VARIABLE} to the file of the system's authority"
    );
    io::Error::new(io::ErrorKind::NotConnected, message)
}
