//! Clients of the daemons and of workers, with the types of the cores: one client per service, one channel per endpoint.

mod action;
mod error;
mod health;
mod pattern;
mod process;
mod resource;
mod retry;
mod snapshot;
mod unheard;
mod world;

pub use action::{ActionClient, ActionInfo, DescribeError, Fate, ProviderInfo, Said};
pub use error::CallError;
pub use health::{Health, NOT_SERVING, wait_until_serving};
pub use pattern::{fact, pattern};
pub use process::{LogPieces, ProcessClient, WorkerWatch};
pub use resource::{AcquireOptions, DemandWatch, ResourceClient, ResourceWatch};
pub use retry::{LoadPatience, PAUSE, retry_unanswered, retry_until_answered};
pub use world::{Commit, Early, Projection, ProjectionWatch, WorldClient, WorldWatch};

use crate::endpoint::{Endpoint, Watched, connect_lazily_as};
use crate::multiplex::GoalCalls;
use crate::multiplex::client::Multiplexer;
use crate::tls::ClientTls;
use crate::trace::Traced;
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{SystemTime, UNIX_EPOCH};

/// Maximum number of cached channels; beyond it all are dropped and connected again on demand.
const MAX_CHANNELS: usize = 256;

/// Maximum number of cached goal streams; beyond it the unused ones are dropped.
const MAX_STREAMS: usize = 256;

/// One channel and one stream of goals per endpoint, shared by all clients made with this handle. A channel connects on demand, and again
/// after it broke. A handle: clones share everything.
#[derive(Debug, Clone)]
pub struct Channels {
    tls: ClientTls,
    kept: Kept,
    providers: Kept,
    goals: Arc<Mutex<BTreeMap<Endpoint, Multiplexer<GoalCalls>>>>,
}

type Kept = Arc<Mutex<BTreeMap<Endpoint, Traced>>>;

impl Channels {
    /// An empty cache. Channels to `https://` endpoints use the certificates of `tls` as they are at the time of connecting.
    pub fn new(tls: &ClientTls) -> Channels {
        Channels { tls: tls.clone(), kept: Arc::default(), providers: Arc::default(), goals: Arc::default() }
    }

    /// The channel to the daemon at `endpoint`. Its calls carry the trace of the tokio task that makes them, and the protocol version. Needs a tokio runtime.
    ///
    /// # Errors
    /// [`CallError::Broken`] if the endpoint makes no URI.
    pub fn get(&self, endpoint: &Endpoint) -> Result<Traced, CallError> {
        self.kept_or_made(&self.kept, endpoint, Watched::ByPings)
    }

    /// As [`Channels::get`], to a provider. A provider may be written in any language, so it is not pinged: servers of other gRPC libraries
    /// treat pings as abuse.
    ///
    /// # Errors
    /// As [`Channels::get`].
    pub fn to_provider(&self, endpoint: &Endpoint) -> Result<Traced, CallError> {
        self.kept_or_made(&self.providers, endpoint, Watched::BySystem)
    }

    fn kept_or_made(&self, kept: &Kept, endpoint: &Endpoint, watched: Watched) -> Result<Traced, CallError> {
        let mut kept = kept.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(channel) = kept.get(endpoint) {
            return Ok(channel.clone());
        }
        if kept.len() >= MAX_CHANNELS {
            kept.clear();
        }
        let channel = connect_lazily_as(endpoint, &self.tls, watched)
            .map_err(|error| CallError::Broken { endpoint: endpoint.clone(), reason: chain(&error) })?;
        kept.insert(endpoint.clone(), channel.clone());
        Ok(channel)
    }

    /// The stream for goals of the provider at `endpoint`.
    fn goals(&self, endpoint: &Endpoint) -> Multiplexer<GoalCalls> {
        let mut streams = self.goals.lock().unwrap_or_else(PoisonError::into_inner);
        if streams.len() >= MAX_STREAMS {
            streams.retain(|_, stream| stream.is_used());
        }
        streams.entry(endpoint.clone()).or_default().clone()
    }

    /// Forgets the channel to an endpoint that is gone for good.
    pub fn forget(&self, endpoint: &Endpoint) {
        for kept in [&self.kept, &self.providers] {
            kept.lock().unwrap_or_else(PoisonError::into_inner).remove(endpoint);
        }
    }
}

/// A unique id for requests, sessions and goals.
pub fn fresh_id(prefix: &str) -> String {
    static COUNTER: AtomicU64 = AtomicU64::new(0);
    #[expect(clippy::disallowed_methods, reason = "only has to differ from other processes of the same number")]
    let now = SystemTime::now();
    let started = now.duration_since(UNIX_EPOCH).map_or(0, |d| d.as_nanos());
    let number = COUNTER.fetch_add(1, Ordering::Relaxed);
    format!("{prefix}-{:x}-{started:x}-{number:x}", std::process::id())
}

/// An error and its sources in one line.
pub(crate) fn chain(error: &dyn std::error::Error) -> String {
    let mut line = error.to_string();
    let mut source = error.source();
    while let Some(error) = source {
        let text = error.to_string();
        if !line.ends_with(&text) {
            line = format!("{line}: {text}");
        }
        source = error.source();
    }
    line
}
