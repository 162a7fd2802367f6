//! The identity of callers, and the gate that every call of a server passes before any of its content is read.
//!
//! ```text
//!   connection ─▶ Identity ─▶ Gate::caller ─▶ Gate::admit(caller, path) ─┬─▶ service (finds the Caller in the request)
//!   (uid, certificate)                                                   └─▶ PERMISSION_DENIED, RESOURCE_EXHAUSTED
//!                            Gate::answered(path, code, duration) ◀─ answer
//!                                 Gate::unread(caller, bytes) ◀─ each part of it, until the connection has written it
//! ```
//! If a call carries a trace context (`traceparent`), everything done for the call belongs to that trace. The gate decides which calls are
//! admitted.
//!
//! A server that drains refuses new calls ([`ending`]) and tracks the calls under way: a call ends with the last byte of its answer. Health
//! and reflection are answered to the end, and draining does not wait for them.

use crate::access::{Caller, HEALTH_CHECK};
use crate::connections::{Link, LinkInfo, OutOfConnections};
use crate::protocol;
use crate::trace::{self, TraceContext};
use crate::under_way::{Answer, Held, Revocation, Unread};
use std::any::Any;
use std::fmt;
use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::{Duration, Instant};
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;
use tokio_util::task::task_tracker::TaskTrackerToken;
use tonic::body::Body;
use tonic::codegen::{Service, http};
use tonic::transport::server::{TcpConnectInfo, TlsConnectInfo, UdsConnectInfo};
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt};
use tower_layer::Layer;
use tracing::Instrument;

/// Delay after which a client that was refused because the process ends should retry.
const ENDING_RETRY: Duration = Duration::from_millis(500);

/// The other end of a connection, as far as the connection itself proves it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Identity {
    /// A user of this machine, over a Unix socket.
    User {
        /// The user id, from the kernel.
        uid: u32,
        /// The process that connected, if the kernel tells.
        pid: Option<i32>,
    },
    /// The holder of the private key of a certificate that the server's certificate authority signed.
    Certificate {
        /// The certificate as presented, in DER.
        der: Arc<[u8]>,
    },
    /// Unknown: TCP without TLS.
    Anonymous,
}

/// Decides about calls. Shared by all connections of a server.
pub trait Gate: Send + Sync + 'static {
    /// The caller at the other end of a connection.
    fn caller(&self, identity: &Identity) -> Caller;

    /// Whether a call may go on. The service finds in the request what this method puts into the extensions.
    ///
    /// # Errors
    /// The status that the caller gets instead.
    fn admit(&self, caller: &Caller, path: &str, extensions: &mut http::Extensions) -> Result<(), Status>;

    /// Notifies when [`Gate::caller`] may answer differently. Calls under way end if their caller has lost a permission.
    fn changes(&self) -> Option<watch::Receiver<()>> {
        None
    }

    /// Called about once a second, even without calls.
    fn look_again(&self) {}

    /// Records the answer to a call (for a stream: the beginning of the answer).
    fn answered(&self, path: &str, code: Code, took: Duration);

    /// Called when bytes of an answer wait for their reader; the permit is dropped when the reader has taken them.
    ///
    /// # Errors
    /// The status that the caller gets instead of the rest of the answer.
    fn unread(&self, _caller: &Caller, _bytes: usize) -> Result<Option<Permit>, Status> {
        Ok(None)
    }

    /// Records that a connection was not accepted, or a call refused, because of too many connections.
    fn out_of_connections(&self, _why: &OutOfConnections) {}
}

/// A guard that a gate puts into the extensions of an admitted call. It is dropped when the last byte of the answer has been sent, or the
/// caller does not want the answer any more.
#[derive(Clone)]
pub struct Permit {
    _held: Arc<dyn Any + Send + Sync>,
}

impl fmt::Debug for Permit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Permit")
    }
}

impl Permit {
    /// Holds `held` for as long as the call is under way.
    pub fn new(held: impl Send + Sync + 'static) -> Permit {
        Permit { _held: Arc::new(held) }
    }
}

/// The identity of a request's sender.
pub fn identity_of(extensions: &http::Extensions) -> Identity {
    if let Some(LinkInfo { info, .. }) = extensions.get::<LinkInfo<UdsConnectInfo>>() {
        return match info.peer_cred {
            Some(peer) => Identity::User { uid: peer.uid(), pid: peer.pid() },
            None => Identity::Anonymous,
        };
    }
    let shown = extensions.get::<TlsConnectInfo<LinkInfo<TcpConnectInfo>>>();
    let shown = shown.and_then(TlsConnectInfo::peer_certs);
    match shown.as_deref().and_then(|chain| chain.first()) {
        Some(certificate) => Identity::Certificate { der: certificate.as_ref().into() },
        None => Identity::Anonymous,
    }
}

/// The connection that a request came over.
fn link_of(extensions: &http::Extensions) -> Option<&Link> {
    let over_unix = extensions.get::<LinkInfo<UdsConnectInfo>>().map(|known| &known.link);
    let over_tcp = || extensions.get::<LinkInfo<TcpConnectInfo>>();
    let over_tls = || extensions.get::<TlsConnectInfo<LinkInfo<TcpConnectInfo>>>().map(TlsConnectInfo::get_ref);
    over_unix.or_else(|| over_tcp().or_else(over_tls).map(|known| &known.link))
}

/// The refusal of new calls by a process that ends.
pub fn ending() -> Status {
    let mut details = ErrorDetails::with_error_info("ENDING", "ratn", []);
    details.set_retry_info(Some(ENDING_RETRY));
    Status::with_error_details(Code::Unavailable, "the process is ending: ask its successor", details)
}

/// Fires when the server of a request drains; stored in the request's extensions.
#[derive(Debug, Clone)]
pub(crate) struct Draining(pub(crate) CancellationToken);

/// The calls of a server.
#[derive(Debug, Clone)]
pub(crate) struct Calls {
    under_way: TaskTracker,
    draining: CancellationToken,
}

impl Calls {
    /// The calls of a server that drains when this token fires.
    pub(crate) fn until(draining: CancellationToken) -> Calls {
        let under_way = TaskTracker::new();
        // Closed from the start: a wait while no call is under way returns at once.
        under_way.close();
        Calls { under_way, draining }
    }

    /// Returns when no call is under way.
    pub(crate) async fn ended(&self) {
        self.under_way.wait().await;
    }

    /// Begins a call; it is not tracked if `counted` is false.
    fn begin(&self, counted: bool) -> Result<Option<TaskTrackerToken>, Status> {
        if !counted {
            return Ok(None);
        }
        // Count the call before checking: either draining waits for it, or it sees that it comes too late.
        let call = self.under_way.token();
        if self.draining.is_cancelled() { Err(ending()) } else { Ok(Some(call)) }
    }
}

/// Streams that carry many calls; each of those calls has a span of its own.
const CARRIERS: [&str; 3] =
    ["/ratn.v1.ResourceService/Session", "/ratn.v1.ActionService/Perform", "/ratn.v1.WorldPoolService/Calls"];

/// Whether a call belongs to the daemon's own services (not to gRPC's).
fn is_counted(path: &str) -> bool {
    !path.starts_with("/grpc.")
}

#[derive(Clone)]
pub(crate) struct Gated {
    pub(crate) gate: Arc<dyn Gate>,
    pub(crate) calls: Calls,
}

#[derive(Clone)]
pub(crate) struct GatedService<S> {
    gated: Gated,
    inner: S,
}

impl<S> Layer<S> for Gated {
    type Service = GatedService<S>;

    fn layer(&self, inner: S) -> GatedService<S> {
        GatedService { gated: self.clone(), inner }
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
        let Gated { gate, calls } = self.gated.clone();
        let admitted = admit(&gate, &calls, &mut request);
        let mut held = match admitted {
            Ok(held) => held,
            Err(status) => {
                gate.answered(path.path(), status.code(), began.elapsed());
                return Box::pin(std::future::ready(Ok(status.into_http())));
            }
        };
        let caller = TraceContext::from_headers(request.headers());
        let own = caller.map(TraceContext::child);
        let traced = caller.zip(own).filter(|_| !CARRIERS.contains(&path.path()));
        let mut span = traced.and_then(|(caller, own)| trace::answering(path.path(), caller, own));
        let mut ended_with = move |code| span.take().into_iter().for_each(|mut span| span.ended(code));
        request.extensions_mut().insert(Draining(calls.draining));
        let answer = self.inner.call(request);
        let answered = async move {
            let answer = match held.until(answer).await {
                Ok(Ok(answer)) => answer,
                Ok(Err(error)) => return Err(error),
                Err(ended) => {
                    gate.answered(path.path(), ended.code(), began.elapsed());
                    ended_with(ended.code());
                    return Ok(ended.into_http());
                }
            };
            let (head, body) = answer.into_parts();
            let code = code_of(&head.headers);
            let answer = Answer::begin(body, held).await;
            let refused = answer.refusal().cloned();
            let code = refused.as_ref().map_or(code, Status::code);
            gate.answered(path.path(), code, began.elapsed());
            ended_with(code);
            Ok(match refused {
                // On a stream of many calls some may be under way: it has been opened, and ends.
                Some(refused) if !CARRIERS.contains(&path.path()) => refused.into_http(),
                _ => http::Response::from_parts(head, Body::new(answer)),
            })
        };
        match own {
            None => Box::pin(answered),
            Some(own) => Box::pin(trace::within(own, answered).instrument(own.entered())),
        }
    }
}

/// Admits a call: returns the values to hold as long as the call lasts, or the reason why it may not begin.
fn admit(gate: &Arc<dyn Gate>, calls: &Calls, request: &mut http::Request<Body>) -> Result<Held, Status> {
    let path = request.uri().clone();
    let counted = is_counted(path.path());
    if counted {
        protocol::check(request.headers())?;
    }
    // Subscribe first, so that no change of the roles is missed.
    let changes = gate.changes();
    let identity = identity_of(request.extensions());
    let caller = gate.caller(&identity);
    gate.admit(&caller, path.path(), request.extensions_mut())?;
    let permit = request.extensions_mut().remove::<Permit>();
    let in_use = match link_of(request.extensions()) {
        // A health check is answered even if the caller's share of connections is used up.
        Some(link) if path.path() == HEALTH_CHECK => {
            link.touch();
            None
        }
        Some(link) => {
            let begun = link.begin(&caller).inspect_err(|why| gate.out_of_connections(why));
            Some(begun.map_err(|why| why.status())?)
        }
        None => None,
    };
    let call = calls.begin(counted)?;
    let revocation = changes.map(|changes| Revocation::new(gate.clone(), changes, identity, caller.clone(), path));
    let unread = Unread::of(gate.clone(), caller.clone(), link_of(request.extensions()).cloned());
    request.extensions_mut().insert(caller);
    Ok(Held { _call: call, _permit: permit, _in_use: in_use, revocation, unread })
}

/// The status code of an answer that consists of headers only; an answer with a body may still end with another code.
fn code_of(headers: &http::HeaderMap) -> Code {
    headers.get("grpc-status").map_or(Code::Ok, |code| Code::from_bytes(code.as_bytes()))
}
