//! Killing a daemon again and again, from a seed.

use super::{Place, Started};
use anyhow::{Context, ensure};
use nix::sys::signal::Signal;
use ratn_worker::endpoint::Endpoint;
use std::os::unix::fs::FileExt;
use std::path::PathBuf;
use std::time::{Duration, Instant};
use tokio::task::JoinSet;

/// After this long without what is waited for something is wrong.
pub(crate) const PATIENCE: Duration = Duration::from_secs(60);
/// The pause before something is looked at again.
pub(crate) const AGAIN: Duration = Duration::from_millis(5);

/// Numbers from a seed (xorshift64*).
pub(crate) struct Random(pub(crate) u64);

impl Random {
    pub(crate) fn below(&mut self, bound: u64) -> u64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        (self.0.wrapping_mul(0x2545_F491_4F6C_DD1D) >> 32) % bound
    }
}

/// A daemon that keeps a state, to be killed and started again at the same place.
pub(crate) struct Daemon {
    role: &'static str,
    place: Place,
    pub(crate) endpoint: Endpoint,
    process: Option<Started>,
}

impl Daemon {
    pub(crate) fn new(role: &'static str) -> anyhow::Result<Daemon> {
        let place = Place::new()?;
        let endpoint = format!("unix:{}", place.path().join("daemon.sock").display()).parse()?;
        let mut daemon = Daemon { role, place, endpoint, process: None };
        daemon.start()?;
        Ok(daemon)
    }

    fn log(&self) -> PathBuf {
        self.place.path().join("state").join(self.role)
    }

    pub(crate) fn start(&mut self) -> anyhow::Result<()> {
        let (listen, state) = (self.endpoint.to_string(), self.place.path().join("state"));
        let state = state.to_str().context("a path")?;
        let arguments = [self.role, "--listen", &listen, "--state-dir", state, "--durability", "group"];
        self.process = Some(self.place.start(&arguments)?);
        Ok(())
    }

    pub(crate) fn kill(&mut self) -> anyhow::Result<()> {
        let mut process = self.process.take().context("it runs")?;
        process.signal(Signal::SIGKILL)?;
        let status = process.child.wait()?;
        ensure!(!status.success(), "it ended by itself: {}", process.said());
        Ok(())
    }

    /// Puts behind the log what a write leaves that was stopped in the middle.
    pub(crate) fn tear(&self, random: &mut Random) -> anyhow::Result<()> {
        let entries: Vec<PathBuf> =
            std::fs::read_dir(self.log())?.map(|entry| Ok(entry?.path())).collect::<anyhow::Result<_>>()?;
        let segments = entries.into_iter().filter(|path| path.extension().is_some_and(|extension| extension == "log"));
        let last = segments.max().context("a segment")?;
        let torn: Vec<u8> = (0..=random.below(300)).map(|_| random.below(256) as u8).collect();
        let written = std::fs::read(&last)?.iter().rposition(|byte| *byte != 0).map_or(0, |at| at + 1);
        // Not right behind it: the last record may end in zeros of its own.
        let file = std::fs::OpenOptions::new().write(true).open(last)?;
        Ok(file.write_all_at(&torn, (written + 64) as u64)?)
    }

    pub(crate) fn said(&self) -> String {
        self.process.as_ref().map(Started::said).unwrap_or_default()
    }
}

/// What a variable of the environment says.
pub(crate) fn number(variable: &str, otherwise: u64) -> u64 {
    std::env::var(variable).ok().and_then(|text| text.parse().ok()).unwrap_or(otherwise)
}

/// Waits until the clients have come so far; none may end before it is told to.
pub(crate) async fn wait_until(
    clients: &mut JoinSet<anyhow::Result<()>>,
    far_enough: impl Fn() -> bool,
) -> anyhow::Result<()> {
    let begin = Instant::now();
    while !far_enough() {
        ensure!(begin.elapsed() < PATIENCE, "the clients come to nothing");
        if let Some(ended) = clients.try_join_next() {
            ended??;
        }
        tokio::time::sleep(AGAIN).await;
    }
    Ok(())
}
