//! Takes the place of the one process that serves a role, and stands by while another process has it.
//!
//! ```text
//!   log in files: open the state ──▶ bind ──▶ serve
//!   etcd:         bind ──▶ open the state ──▶ serve
//!                   │          ▲ the leader is gone
//!                   └─ held ───┴── standing by: health NOT_SERVING, every call refused, with the address of the leader
//! ```
//! A service manager considers a standby ready. Clients that know several addresses use the one that is SERVING.

use crate::access::{Caller, RoleGate};
use crate::config::{Engine, StorageConfig};
use crate::details::retry_later;
use crate::durable_actor::{Journal, JournalError};
use anyhow::Context;
use ratn_panic_point::panic_point;
use ratn_storage::etcd::{Connect, Holder};
use ratn_storage::{Etcd, EtcdOptions, OpenError, ReadError, Store};
use ratn_worker::endpoint::{Endpoint, connect_lazily};
use ratn_worker::gate::{Gate, Identity};
use ratn_worker::panic::{exit_on_panic, exit_on_panic_blocking};
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::server::{Bound, Phase, ServeError, Services, Serving, bind_as};
use ratn_worker::tls::ClientTls;
use ratn_worker::trace::Traced;
use ratn_worker::vitals::Vitals;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tonic::codegen::http;
use tonic::transport::{Certificate, Channel, ClientTlsConfig, Identity as Shown};
use tonic::{Code, Status};

/// Retry delay of a client that a standby refused.
const RETRY_DELAY: Duration = Duration::from_millis(200);
/// Pause before etcd is asked again where it did not answer.
const AGAIN: Duration = Duration::from_millis(500);
/// Timeout of a connection attempt to an etcd member.
const CONNECT_TIMEOUT: Duration = Duration::from_millis(500);
/// Interval of keepalive pings to an etcd member and their timeout; without an answer the connection is opened anew.
const KEEPALIVE: (Duration, Duration) = (Duration::from_secs(2), Duration::from_secs(2));

/// A role that is to be served.
pub(crate) struct Place<'a> {
    pub(crate) role: &'static str,
    pub(crate) storage: &'a StorageConfig,
    pub(crate) listen: &'a Endpoint,
    pub(crate) directory: &'a RuntimeDirectory,
    pub(crate) serving: &'a Serving,
}

impl Place<'_> {
    /// The state, and the bound address; `None` where `shutdown` came while another process had the place.
    pub(crate) async fn take<T: Send + 'static>(
        self,
        open: impl Fn(Arc<dyn Store>) -> Result<T, JournalError> + Clone + Send + 'static,
        shutdown: &CancellationToken,
    ) -> anyhow::Result<Option<(T, Bound)>> {
        let listen = self.directory.listen(self.listen, self.role)?;
        if self.storage.engine == Engine::Log {
            let directory = self.storage.directory_of(self.role, self.directory.path());
            let kept = open(Arc::new(Journal::log(self.storage, &directory)))?;
            return Ok(Some((kept, bind_as(&listen, &self.serving.exposure).await?)));
        }
        let bound = bind_as(&listen, &self.serving.exposure).await?;
        let mark = self.storage.directory_of(self.role, self.directory.path()).join("seen-in-etcd");
        let store: Arc<dyn Store> = Arc::new(etcd(self.storage, self.role, &bound.endpoint().to_string(), Some(mark))?);
        let kept = self.await_place(store, &bound, open, shutdown).await?;
        Ok(kept.map(|kept| (kept, bound)))
    }

    async fn await_place<T: Send + 'static>(
        &self,
        store: Arc<dyn Store>,
        bound: &Bound,
        open: impl Fn(Arc<dyn Store>) -> Result<T, JournalError> + Clone + Send + 'static,
        shutdown: &CancellationToken,
    ) -> anyhow::Result<Option<T>> {
        let elected = CancellationToken::new();
        // Whatever the result, calls are no longer refused afterwards.
        let _elected = elected.clone().drop_guard();
        let mut standby: Option<(Arc<NotTheLeader>, JoinHandle<()>)> = None;
        let news = |standby: &Option<(Arc<NotTheLeader>, _)>, why: &String| {
            standby.as_ref().is_none_or(|(gate, _)| gate.says() != *why)
        };
        loop {
            let attempt = {
                let (store, open) = (store.clone(), open.clone());
                let opening = move || {
                    panic_point("open-state");
                    open(store)
                };
                tokio::task::spawn_blocking(|| exit_on_panic_blocking("what opens the state", opening))
            };
            let opened = tokio::select! {
                opened = attempt => opened.context("the state could not be opened")?,
                // A place that was just taken is given up when the attempt has ended.
                () = shutdown.cancelled() => return Ok(None),
            };
            let why = match opened {
                Ok(kept) => {
                    elected.cancel();
                    // From now on no new connection is told that this process stands by.
                    if let Some((_, refusing)) = standby {
                        let _ = refusing.await;
                    }
                    return Ok(Some(kept));
                }
                Err(JournalError::Open { source: OpenError::Held { holder, .. }, .. }) => format!("{holder} leads"),
                // etcd may be unreachable for a while; a standby waits for it.
                Err(JournalError::Open { source: OpenError::Read(error @ ReadError::Remote { .. }), .. }) => {
                    let why = format!("nobody is known to lead: {error}");
                    if news(&standby, &why) {
                        tracing::warn!(role = self.role, "{why}");
                    }
                    tokio::time::sleep(AGAIN).await;
                    why
                }
                // Another host may accept the restored state, which then counts for all hosts.
                Err(JournalError::Open { source: error @ OpenError::Restored { .. }, .. }) => {
                    let why = error.to_string();
                    if news(&standby, &why) {
                        tracing::error!(role = self.role, "{why}");
                    }
                    tokio::time::sleep(AGAIN).await;
                    why
                }
                Err(error) => return Err(error.into()),
            };
            match &standby {
                Some((gate, _)) => gate.say(why),
                None => {
                    tracing::info!(role = self.role, why, "standing by");
                    let gate = Arc::new(NotTheLeader::new(self.role, why));
                    let refusing = self.stand_by(bound, gate.clone(), elected.clone())?;
                    standby = Some((gate, refusing));
                }
            }
        }
    }

    /// Refuses every call until `elected`, and then closes every connection.
    fn stand_by(
        &self,
        bound: &Bound,
        gate: Arc<NotTheLeader>,
        elected: CancellationToken,
    ) -> anyhow::Result<JoinHandle<()>> {
        let bound = bound.again().context("cannot listen while standing by")?;
        let vitals = gate.vitals.clone();
        let (phase, drain) = (watch::Sender::new(Phase::Starting), Duration::ZERO);
        let serving = Serving { gate, vitals, phase, drain, ..self.serving.clone() };
        self.serving.phase.send_replace(Phase::StandingBy);
        let refuse = async move {
            panic_point("standby");
            if let Err(error) = bound.serve_as(Services::new(), serving, elected).await {
                tracing::warn!(%error, "nobody is told any more who leads");
            }
        };
        Ok(tokio::spawn(exit_on_panic("the server of a standby", refuse)))
    }
}

/// Serves until `shutdown`. `over` is cancelled as soon as no call is in progress any more: a successor need not wait until every
/// connection is closed.
pub(crate) async fn serve(
    bound: Bound,
    services: Services,
    serving: Serving,
    shutdown: CancellationToken,
    over: &CancellationToken,
) -> Result<(), ServeError> {
    let mut phase = serving.phase.subscribe();
    let drained = async move {
        if phase.wait_for(|phase| *phase == Phase::Drained).await.is_err() {
            std::future::pending::<()>().await;
        }
    };
    // Boxed, because the future is large.
    let mut served = Box::pin(bound.serve_as(services, serving, shutdown));
    tokio::select! {
        biased;
        served = &mut served => return served,
        () = drained => over.cancel(),
    }
    served.await
}

/// Refuses every caller, and says who leads.
struct NotTheLeader {
    role: &'static str,
    why: Mutex<String>,
    vitals: Vitals,
}

impl NotTheLeader {
    fn new(role: &'static str, why: String) -> NotTheLeader {
        let gate = NotTheLeader { role, why: Mutex::default(), vitals: Vitals::default() };
        gate.say(why);
        gate
    }

    fn say(&self, why: String) {
        self.vitals.unwell(format!("standing by: {why}"));
        *self.why.lock().unwrap_or_else(PoisonError::into_inner) = why;
    }

    fn says(&self) -> String {
        self.why.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

impl Gate for NotTheLeader {
    fn caller(&self, identity: &Identity) -> Caller {
        RoleGate::default().caller(identity)
    }

    fn admit(&self, _: &Caller, path: &str, _: &mut http::Extensions) -> Result<(), Status> {
        if path.starts_with("/grpc.") {
            return Ok(());
        }
        let message = format!("this {} stands by: {}", self.role, self.says());
        Err(retry_later(Code::Unavailable, "NOT_THE_LEADER", message, RETRY_DELAY))
    }

    fn answered(&self, _: &str, _: Code, _: Duration) {}
}

/// The log of a role in etcd.
pub(crate) fn etcd(config: &StorageConfig, role: &str, address: &str, mark: Option<PathBuf>) -> anyhow::Result<Etcd> {
    let read = |file: &Path| {
        ratn_regular_file::read(file, ratn_regular_file::USUAL)
            .with_context(|| format!("cannot read {}", file.display()))
    };
    let mut tls = ClientTlsConfig::new();
    if let Some(ca) = &config.ca {
        tls = tls.ca_certificate(Certificate::from_pem(read(ca)?));
    }
    if let (Some(cert), Some(key)) = (&config.cert, &config.key) {
        tls = tls.identity(Shown::from_pem(read(cert)?, read(key)?));
    }
    let connect: Connect = Arc::new(move |address| connect(address, &tls));
    Ok(Etcd::new(EtcdOptions {
        endpoints: config.endpoints.iter().map(Endpoint::to_string).collect(),
        connect,
        prefix: format!("{}/{role}", config.prefix.trim_end_matches('/')),
        holder: Holder { address: address.to_owned(), about: format!("process {}", std::process::id()) },
        bounds: Journal::bounds(),
        mark,
        accept_restored: config.accept_restored,
    })?)
}

fn connect(address: &str, tls: &ClientTlsConfig) -> Result<Channel, String> {
    let endpoint: Endpoint = address.parse().map_err(|error| format!("{error}"))?;
    let (Endpoint::Tcp { .. } | Endpoint::Tls { .. }) = endpoint else {
        return connect_lazily(&endpoint, &ClientTls::none())
            .map(Traced::into_channel)
            .map_err(|error| error.to_string());
    };
    let mut configured =
        tonic::transport::Endpoint::from_shared(address.to_owned()).map_err(|error| error.to_string())?;
    if let Endpoint::Tls { .. } = endpoint {
        configured = configured.tls_config(tls.clone()).map_err(|error| error.to_string())?;
    }
    let (interval, timeout) = KEEPALIVE;
    Ok(configured
        .connect_timeout(CONNECT_TIMEOUT)
        .tcp_nodelay(true)
        .http2_keep_alive_interval(interval)
        .keep_alive_timeout(timeout)
        .connect_lazy())
}
