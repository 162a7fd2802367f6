//! The config of the system in a runtime directory, for a command that outlasts systems and workers: its catalogue is extended by the
//! workers' descriptions, as in `ratn run`.
//!
//! The last answer is cached with its age. So a page that checks at every keystroke does not ask the workers each time.

use super::config::SystemConfig;
use super::workers::Offered;
use super::{CONFIG_FILE, running};
use ratn_worker::tls::ClientTls;
use std::fmt::{self, Debug, Formatter};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};
use tokio::runtime::Handle;

/// How long an answer is valid.
const KEPT: Duration = Duration::from_secs(5);
/// Timeout of a system; without its answer only its config is known.
const PATIENCE: Duration = Duration::from_secs(6);

type Look = dyn Fn() -> Result<SystemConfig, String> + Send + Sync;

/// The known config of the system in a runtime directory.
#[derive(Clone)]
pub(crate) struct KnownSystem(Arc<Inner>);

struct Inner {
    look: Box<Look>,
    last: Mutex<Option<(Instant, Arc<SystemConfig>)>>,
}

impl KnownSystem {
    /// For the system that runs, or ran, in a directory; without one, the built-in config.
    pub(crate) fn of(directory: PathBuf, tls: ClientTls) -> KnownSystem {
        KnownSystem::by(move || look(&directory, &tls))
    }

    fn by(look: impl Fn() -> Result<SystemConfig, String> + Send + Sync + 'static) -> KnownSystem {
        KnownSystem(Arc::new(Inner { look: Box::new(look), last: Mutex::new(None) }))
    }

    /// The config as known now. Waits for the system: call it only on a thread that may block.
    ///
    /// # Errors
    /// Why there is not even the built-in config, as a sentence.
    pub(crate) fn config(&self) -> Result<Arc<SystemConfig>, String> {
        let mut last = self.0.last.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((when, config)) = &*last
            && when.elapsed() < KEPT
        {
            return Ok(Arc::clone(config));
        }
        let config = Arc::new((self.0.look)()?);
        *last = Some((Instant::now(), Arc::clone(&config)));
        Ok(config)
    }
}

impl Debug for KnownSystem {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        f.write_str("KnownSystem(…)")
    }
}

/// The config without the workers' descriptions.
///
/// # Errors
/// As [`KnownSystem::config`].
pub(crate) fn on_disk(directory: &Path) -> Result<SystemConfig, String> {
    let own = SystemConfig::read(&directory.join(CONFIG_FILE)).ok();
    own.map_or_else(|| SystemConfig::load(None), Ok).map_err(|failure| failure.to_string())
}

fn look(directory: &Path, tls: &ClientTls) -> Result<SystemConfig, String> {
    let mut config = on_disk(directory)?;
    let asked = async {
        let endpoints = running(directory, tls).await.ok().flatten()?;
        Some(Box::pin(Offered::known(tls, &endpoints.resource_manager)).await)
    };
    let offered = Handle::current().block_on(async { tokio::time::timeout(PATIENCE, asked).await });
    if let Ok(Some(offered)) = offered {
        offered.extend(&mut config.catalogue);
    }
    Ok(config)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use std::sync::atomic::{AtomicUsize, Ordering};

    #[test]
    fn a_system_is_asked_once_in_a_while_and_asked_again_after_a_refusal() {
        let asked = Arc::new(AtomicUsize::new(0));
        let count = Arc::clone(&asked);
        let known = KnownSystem::by(move || match count.fetch_add(1, Ordering::Relaxed) {
            0 => Err("not yet".to_owned()),
            _ => on_disk(Path::new("nowhere")),
        });
        assert_eq!(known.config().unwrap_err(), "not yet");
        let (first, second) = (known.config().unwrap(), known.config().unwrap());
        assert!(Arc::ptr_eq(&first, &second));
        assert_eq!(asked.load(Ordering::Relaxed), 2);
        // An old answer is replaced.
        let old = Instant::now().checked_sub(KEPT).unwrap();
        *known.0.last.lock().unwrap() = Some((old, first));
        known.config().unwrap();
        assert_eq!(asked.load(Ordering::Relaxed), 3);
    }

    #[test]
    fn without_a_system_the_built_in_config_is_known() {
        let directory = tempfile::tempdir().unwrap();
        let known = KnownSystem::of(directory.path().to_owned(), ClientTls::none());
        let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().unwrap();
        let config = runtime.block_on(async { tokio::task::spawn_blocking(move || known.config()).await.unwrap() });
        assert_eq!(config.unwrap().catalogue, SystemConfig::load(None).unwrap().catalogue);
    }
}
