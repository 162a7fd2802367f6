//! Who calls, and a gate that every call of a server passes before anything of it is read.
//!
//! ```text
//!   connection ─▶ Identity ─▶ Gate::admit(identity, path) ─┬─▶ service (finds the Caller among the request's extensions)
//!   (uid, certificate)                                     └─▶ PERMISSION_DENIED
//!                            Gate::answered(path, code, duration) ◀─ answer
//! ```
//! The trace of a call that carries one (`traceparent`) is that of everything done for it. What is admitted is the gate's business.

use crate::trace::{self, TraceContext};
use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::{Duration, Instant};
use tonic::body::Body;
use tonic::codegen::{Service, http};
use tonic::transport::server::{TcpConnectInfo, TlsConnectInfo, UdsConnectInfo};
use tonic::{Code, Status};
use tower_layer::Layer;
use tracing::Instrument;

/// Who is at the other end of a connection, as far as the connection itself proves it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Identity {
    /// A user of this machine, over a Unix socket.
    User {
        /// As the kernel says.
        uid: u32,
        /// The process that connected, where the kernel says.
        pid: Option<i32>,
    },
    /// Who holds the key of a certificate that the server's authority signed.
    Certificate {
        /// The certificate as it was shown, DER.
        der: Arc<[u8]>,
    },
    /// Nobody in particular: TCP without TLS.
    Anonymous,
}

/// Decides about calls. Shared by all connections of a server.
pub trait Gate: Send + Sync + 'static {
    /// Whether a call may go on; what it leaves in the extensions the service finds in the request.
    ///
    /// # Errors
    /// The status that the caller gets instead.
    fn admit(&self, identity: &Identity, path: &str, extensions: &mut http::Extensions) -> Result<(), Status>;

    /// A call was answered (a stream: began to be).
    fn answered(&self, path: &str, code: Code, took: Duration);
}

/// Lets everybody do everything.
#[derive(Debug, Clone, Copy, Default)]
pub struct Open;

impl Gate for Open {
    fn admit(&self, _: &Identity, _: &str, _: &mut http::Extensions) -> Result<(), Status> {
        Ok(())
    }

    fn answered(&self, _: &str, _: Code, _: Duration) {}
}

/// Who made a request.
pub fn identity_of(extensions: &http::Extensions) -> Identity {
    if let Some(info) = extensions.get::<UdsConnectInfo>() {
        return match info.peer_cred {
            Some(peer) => Identity::User { uid: peer.uid(), pid: peer.pid() },
            None => Identity::Anonymous,
        };
    }
    let shown = extensions.get::<TlsConnectInfo<TcpConnectInfo>>().and_then(TlsConnectInfo::peer_certs);
    match shown.as_deref().and_then(|chain| chain.first()) {
        Some(certificate) => Identity::Certificate { der: certificate.as_ref().into() },
        None => Identity::Anonymous,
    }
}

#[derive(Clone)]
pub(crate) struct Gated(pub(crate) Arc<dyn Gate>);

#[derive(Clone)]
pub(crate) struct GatedService<S> {
    gate: Arc<dyn Gate>,
    inner: S,
}

impl<S> Layer<S> for Gated {
    type Service = GatedService<S>;

    fn layer(&self, inner: S) -> GatedService<S> {
        GatedService { gate: self.0.clone(), inner }
    }
}

impl<S> Service<http::Request<Body>> for GatedService<S>
where
    S: Service<http::Request<Body>, Response = http::Response<Body>>,
    S::Future: Send + 'static,
    S::Error: Send + 'static,
{
    type Response = http::Response<Body>;
    type Error = S::Error;
    type Future = Pin<Box<dyn Future<Output = Result<http::Response<Body>, S::Error>> + Send>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), S::Error>> {
        self.inner.poll_ready(context)
    }

    fn call(&mut self, mut request: http::Request<Body>) -> Self::Future {
        let began = Instant::now();
        let path = request.uri().clone();
        let identity = identity_of(request.extensions());
        let gate = self.gate.clone();
        if let Err(status) = gate.admit(&identity, path.path(), request.extensions_mut()) {
            gate.answered(path.path(), status.code(), began.elapsed());
            return Box::pin(std::future::ready(Ok(status.into_http())));
        }
        let context = TraceContext::from_headers(request.headers());
        let answer = self.inner.call(request);
        let answered = async move {
            let answer = answer.await;
            if let Ok(answer) = &answer {
                gate.answered(path.path(), code_of(answer), began.elapsed());
            }
            answer
        };
        match context {
            None => Box::pin(answered),
            Some(context) => {
                let own = context.child();
                let span = tracing::info_span!("call", trace = %own.trace_id(), span = %own.span_id());
                Box::pin(trace::within(own, answered).instrument(span))
            }
        }
    }
}

/// The code of an answer that is only a status; a body may still end with another.
fn code_of(answer: &http::Response<Body>) -> Code {
    answer.headers().get("grpc-status").map_or(Code::Ok, |code| Code::from_bytes(code.as_bytes()))
}
