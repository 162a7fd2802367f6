//! Connects to a group of servers of which one leads and the others stand by: the connection goes to the leader, and moves with it.
//!
//! ```text
//!   connect ── which server is SERVING? ─────▶ connection ◀── it is SERVING again ────┐
//!      ▲                                        │    └── no answer, or NOT_SERVING ──▶ in doubt: the others are asked, too
//!      └──────────── connect again ◀── broken ──┴───────────── another one is SERVING ◀──┘
//! ```
//! Servers are asked by gRPC health only: a standby answers NOT_SERVING. The user of the connection sees a change of the leader as a broken
//! connection.

use crate::client::chain;
use crate::endpoint::{Endpoint, connect_to_ask};
use crate::panic::exit_on_panic;
use crate::tls::ClientTls;
use crate::tls::connect::Connector;
use crate::trace::Traced;
use crate::unix_stream::UnixStream;
use futures::StreamExt;
use futures::stream::FuturesUnordered;
use hyper_util::rt::TokioIo;
use ratn_panic_point::panic_point;
use std::collections::BTreeMap;
use std::future::Future;
use std::io;
use std::pin::Pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll};
use std::time::{Duration, Instant};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::TcpStream;
use tokio_util::sync::{CancellationToken, DropGuard, WaitForCancellationFutureOwned};
use tonic::codegen::{Service, StdError, http::Uri};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;

/// Time limit for finding the leader; it ends before the connection attempt is given up ([`crate::endpoint::CONNECT_TIMEOUT`]).
const FIND_DEADLINE: Duration = Duration::from_millis(2_800);
/// Interval between two health checks of the leader.
const ASK_INTERVAL: Duration = Duration::from_millis(200);
/// Time limit for an answer to a health check.
const ANSWER_DEADLINE: Duration = Duration::from_millis(500);
/// If a health check takes longer than this, the leader is in doubt.
const PATIENCE: Duration = Duration::from_millis(300);
/// How long a leader that was found is connected to without another health check.
const FOUND_FOR: Duration = Duration::from_secs(1);
/// Pause between two health checks of a server that does not lead; it grows from the first value to the second. Short, because these checks
/// happen only while no leader is known.
const LOOK_INTERVALS: (Duration, Duration) = (Duration::from_millis(25), Duration::from_millis(100));

/// Connects to the leader of several servers.
#[derive(Debug, Clone)]
pub(crate) struct LeaderConnector {
    members: Arc<[Endpoint]>,
    tls: ClientTls,
    found: Found,
}

/// The leader that was found when the previous connection was broken for it, and the time: the next connection goes there without a check.
type Found = Arc<Mutex<Option<(Endpoint, Instant)>>>;

impl LeaderConnector {
    pub(crate) fn among(members: &[Endpoint], tls: &ClientTls) -> LeaderConnector {
        LeaderConnector { members: members.into(), tls: tls.clone(), found: Found::default() }
    }
}

impl Service<Uri> for LeaderConnector {
    type Response = TokioIo<ToLeader>;
    type Error = StdError;
    type Future = Pin<Box<dyn Future<Output = Result<Self::Response, StdError>> + Send>>;

    fn poll_ready(&mut self, _: &mut Context<'_>) -> Poll<Result<(), StdError>> {
        Poll::Ready(Ok(()))
    }

    fn call(&mut self, _: Uri) -> Self::Future {
        let (members, tls, found) = (self.members.clone(), self.tls.clone(), self.found.clone());
        Box::pin(async move {
            let hint = found.lock().unwrap_or_else(PoisonError::into_inner).take();
            if let Some((leader, at)) = hint
                && at.elapsed() < FOUND_FOR
                && let Ok(stream) = open(&leader, &tls).await
            {
                return Ok(watched(stream, members, tls, leader, found));
            }
            let said = Said::default();
            let leader = tokio::time::timeout(FIND_DEADLINE, find(&members, &tls, None, &said)).await;
            let leader = leader.map_err(|_| {
                let said = said.lock().unwrap_or_else(PoisonError::into_inner);
                let each = |member: &Endpoint| {
                    let what = said.get(member).map_or("no answer", String::as_str);
                    format!("{member} ({what})")
                };
                let members: Vec<String> = members.iter().map(each).collect();
                io::Error::new(io::ErrorKind::NotConnected, format!("none of these leads: {}", members.join(", ")))
            })?;
            let stream = open(&leader, &tls).await?;
            Ok(watched(stream, members, tls, leader, found))
        })
    }
}

/// The connection; it breaks when another server leads.
fn watched(
    stream: Box<dyn Stream>,
    members: Arc<[Endpoint]>,
    tls: ClientTls,
    leader: Endpoint,
    found: Found,
) -> TokioIo<ToLeader> {
    let (broken, watched) = (CancellationToken::new(), CancellationToken::new());
    let watch = watch(members, tls, leader, found, broken.clone());
    let watching = watched.clone().run_until_cancelled_owned(watch);
    tokio::spawn(exit_on_panic("the watch of which server leads", watching));
    TokioIo::new(ToLeader { stream, broken: Box::pin(broken.cancelled_owned()), _watched: watched.drop_guard() })
}

/// The last answer of each server that does not lead.
type Said = Mutex<BTreeMap<Endpoint, String>>;

/// The first server, other than `apart_from`, that says that it leads.
async fn find(members: &[Endpoint], tls: &ClientTls, apart_from: Option<&Endpoint>, said: &Said) -> Endpoint {
    let others = members.iter().filter(|member| Some(*member) != apart_from);
    let mut seeking: FuturesUnordered<_> = others
        .map(|member| async move {
            let mut asked = Asked { member, tls, client: None };
            let mut pause = LOOK_INTERVALS.0;
            while let Err(what) = asked.leads().await {
                said.lock().unwrap_or_else(PoisonError::into_inner).insert(member.clone(), what);
                tokio::time::sleep(pause).await;
                pause = (2 * pause).min(LOOK_INTERVALS.1);
            }
            member.clone()
        })
        .collect();
    match seeking.next().await {
        Some(leader) => leader,
        None => std::future::pending().await,
    }
}

/// Breaks a connection if its server does not lead any more, or does not answer, and another server leads.
async fn watch(members: Arc<[Endpoint]>, tls: ClientTls, leader: Endpoint, found: Found, broken: CancellationToken) {
    let mut asked = Asked { member: &leader, tls: &tls, client: None };
    loop {
        tokio::time::sleep(ASK_INTERVAL).await;
        panic_point("leader-watch");
        // Connecting again counts into the time limit.
        if let Ok(Ok(())) = tokio::time::timeout(PATIENCE, asked.leads()).await {
            continue;
        }
        // In doubt. A leader that is only slow is not abandoned: as long as it leads, no other server says that it does.
        let said = Said::default();
        tokio::select! {
            () = asked.leads_again() => {}
            other = find(&members, &tls, Some(&leader), &said) => {
                tracing::info!(from = %leader, to = %other, "another server leads");
                *found.lock().unwrap_or_else(PoisonError::into_inner) = Some((other, Instant::now()));
                broken.cancel();
                return;
            }
        }
    }
}

struct Asked<'a> {
    member: &'a Endpoint,
    tls: &'a ClientTls,
    client: Option<HealthClient<Traced>>,
}

impl Asked<'_> {
    /// Returns when the server says that it leads.
    async fn leads_again(&mut self) {
        while !matches!(tokio::time::timeout(ANSWER_DEADLINE, self.leads()).await, Ok(Ok(()))) {
            tokio::time::sleep(ASK_INTERVAL).await;
        }
    }

    /// Checks whether the server says that it leads; the error is its other answer.
    async fn leads(&mut self) -> Result<(), String> {
        let had_one = self.client.is_some();
        let asked = self.ask().await;
        // A standby closes its connections when it begins to lead.
        if had_one && self.client.is_none() { self.ask().await } else { asked }
    }

    async fn ask(&mut self) -> Result<(), String> {
        let mut client = match self.client.take() {
            Some(client) => client,
            None => HealthClient::new(connect_to_ask(self.member, self.tls).await.map_err(|error| chain(&error))?),
        };
        let question = client.check(HealthCheckRequest { service: String::new() });
        let answer = tokio::time::timeout(ANSWER_DEADLINE, question).await;
        let answer = answer.map_err(|_| "no answer".to_owned())?.map_err(|status| status.message().to_owned())?;
        // Keep the client for the next check, because it has answered.
        self.client = Some(client);
        let leads = answer.into_inner().status() == ServingStatus::Serving;
        if leads { Ok(()) } else { Err("it stands by, or cannot serve: NOT_SERVING".to_owned()) }
    }
}

async fn open(endpoint: &Endpoint, tls: &ClientTls) -> Result<Box<dyn Stream>, StdError> {
    Ok(match endpoint {
        Endpoint::Tcp { host, port } => {
            let stream = TcpStream::connect((host.as_str(), *port)).await?;
            stream.set_nodelay(true)?;
            Box::new(stream)
        }
        Endpoint::Tls { host, port } => {
            let address = Endpoint::Tcp { host: host.clone(), port: *port }.to_string().parse()?;
            Box::new(Connector::to(host, tls).call(address).await?.into_inner())
        }
        Endpoint::Unix(path) => Box::new(UnixStream::connect(path.clone()).await?),
        Endpoint::AnyOf(_) => return Err("a server of several is one server".into()),
    })
}

trait Stream: AsyncRead + AsyncWrite + Unpin + Send {}
impl<S: AsyncRead + AsyncWrite + Unpin + Send> Stream for S {}

/// A connection that breaks when its server does not lead any more.
pub(crate) struct ToLeader {
    stream: Box<dyn Stream>,
    broken: Pin<Box<WaitForCancellationFutureOwned>>,
    _watched: DropGuard,
}

impl AsyncRead for ToLeader {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        if self.broken.as_mut().poll(context).is_ready() {
            return Poll::Ready(Err(io::Error::new(io::ErrorKind::ConnectionAborted, "another server leads")));
        }
        Pin::new(&mut self.stream).poll_read(context, buffer)
    }
}

impl AsyncWrite for ToLeader {
    fn poll_write(mut self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write(context, bytes)
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }
}
