//! The interface to the machine's service manager (systemd): `sd_notify(3)` and SIGHUP. Without a service manager nothing is sent, and
//! SIGHUP still reloads.
//!
//! ```text
//!   starting ─▶ READY ─ SIGHUP ─▶ RELOADING ─▶ READY ─ drain ─▶ STOPPING          WATCHDOG, twice per time that systemd waits
//! ```
//! The watchdog pings depend on the turns of the daemon's core: a core that hangs or has ended sends none, and systemd ends the
//! process.

use ratn_worker::server::Phase;
use ratn_worker::vitals::Vitals;
use sd_notify::NotifyState;
use std::io;
use std::path::Path;
use std::time::Duration;
use tokio::process::Command;
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::sync::watch;
use tokio::time::MissedTickBehavior;

/// Variables that a child must not inherit: otherwise it would report to systemd in place of its parent.
const VARIABLES: [&str; 3] = ["NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID"];

/// A command for a program that does not report to systemd for this process.
pub fn command_of(program: &Path) -> Command {
    let mut command = Command::new(program);
    for variable in VARIABLES {
        command.env_remove(variable);
    }
    command
}

/// The link to the service manager.
#[derive(Debug)]
pub struct Supervisor {
    hangups: Signal,
    watchdog: Option<Duration>,
}

impl Supervisor {
    /// From here on SIGHUP does not end the process. Needs a tokio runtime.
    ///
    /// # Errors
    /// Where the signal cannot be caught.
    pub fn start() -> io::Result<Supervisor> {
        let watchdog = sd_notify::watchdog_enabled().map(|patience| patience / 2).filter(|pause| !pause.is_zero());
        Ok(Supervisor { hangups: signal(SignalKind::hangup())?, watchdog })
    }

    /// Reports the phases of the process, and calls `reload` at every SIGHUP while it serves. Returns when the process has ended.
    pub async fn follow(mut self, mut phase: watch::Receiver<Phase>, vitals: Vitals, mut reload: impl FnMut()) {
        let mut condition = vitals.condition();
        let mut beats = None;
        let mut pings = self.watchdog.map(|pause| {
            let mut pings = tokio::time::interval(pause);
            pings.set_missed_tick_behavior(MissedTickBehavior::Delay);
            pings
        });
        loop {
            let ping = async {
                match &mut pings {
                    Some(pings) => drop(pings.tick().await),
                    None => std::future::pending().await,
                }
            };
            tokio::select! {
                changed = phase.changed() => {
                    if changed.is_err() {
                        return;
                    }
                    let now = *phase.borrow_and_update();
                    match now {
                        Phase::Starting => {}
                        Phase::StandingBy => say(&[NotifyState::Ready, NotifyState::Status("standing by")]),
                        Phase::Serving => say(&[NotifyState::Ready, NotifyState::Status("serving")]),
                        // If both come close together, only the second is seen here.
                        Phase::Draining | Phase::Drained => say(&[NotifyState::Stopping, NotifyState::Status("draining")]),
                    }
                }
                Some(()) = self.hangups.recv(), if *phase.borrow() == Phase::Serving => {
                    match NotifyState::monotonic_usec_now() {
                        Ok(now) => say(&[NotifyState::Reloading, now]),
                        Err(error) => tracing::warn!(%error, "systemd does not hear of the reload"),
                    }
                    reload();
                    say(&[NotifyState::Ready]);
                }
                Ok(()) = condition.changed() => {
                    let unwell = condition.borrow_and_update().unwell.clone();
                    if *phase.borrow() == Phase::Serving {
                        say(&[NotifyState::Status(unwell.as_deref().unwrap_or("serving"))]);
                    }
                }
                () = ping => if has_moved(&mut beats, vitals.beats()) {
                    say(&[NotifyState::Watchdog]);
                },
            }
        }
    }
}

/// Whether the core took a turn since the last check. Without a core that counts its turns, it is enough that the runtime works.
fn has_moved(last: &mut Option<u64>, beats: Option<u64>) -> bool {
    let moved = beats.is_none() || beats != *last;
    *last = beats;
    moved
}

/// Reports a process without a server of its own as ready.
pub fn ready() {
    say(&[NotifyState::Ready]);
}

/// Reports that this process is stopping.
pub fn stopping() {
    say(&[NotifyState::Stopping]);
}

fn say(states: &[NotifyState]) {
    if let Err(error) = sd_notify::notify(states) {
        tracing::warn!(%error, "the service manager does not listen");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_core_that_takes_no_turn_is_silent() {
        let (vitals, mut last) = (Vitals::default(), None);
        assert!(has_moved(&mut last, vitals.beats()), "there is no core that beats");
        vitals.beat();
        assert!(has_moved(&mut last, vitals.beats()));
        assert!(!has_moved(&mut last, vitals.beats()));
        vitals.beat();
        assert!(has_moved(&mut last, vitals.beats()));
    }
}
