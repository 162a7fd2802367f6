//! `block` and `consume`: what they take is held by a session of their own, which ends with the command however that ends.

use super::arguments::HoldArguments;
use super::{Asking, show};
use crate::failure::Failure;
use crate::interrupt::Interrupt;
use crate::output;
use anyhow::Context;
use ratn_model::resource::ResourceOperation;
use ratn_worker::client::AcquireOptions;
use ratn_worker::session::Session;
use std::os::unix::process::ExitStatusExt;
use std::time::Duration;
use tokio::process::Command;

/// From the loss of the lease to the end of the program that it was for.
const STOP_PATIENCE: Duration = Duration::from_secs(2);
const LEASE_VARIABLE: &str = "RATN_LEASE";
const TOKEN_VARIABLE: &str = "RATN_TOKEN";

/// `ratn resource block`
pub(super) async fn block(asking: &Asking, held: &HoldArguments) -> Result<(), Failure> {
    let interrupt = Interrupt::listen()?;
    let (session, client) = asking.session("block").await?;
    let requirement = held.selector.requirement(ResourceOperation::Block);
    let options = AcquireOptions {
        priority: held.priority,
        deadline: held.wait,
        holder: format!("ratn resource block, process {}", std::process::id()),
        ..AcquireOptions::default()
    };
    let granted = tokio::select! {
        granted = client.block(requirement, options) => granted.context("not blocked"),
        () = interrupt.asked_times(1) => Err(anyhow::anyhow!("not blocked: interrupted while waiting")),
    };
    let lease = match granted {
        Ok(lease) => lease,
        Err(error) => {
            session.close().await;
            return Err(error.into());
        }
    };
    asking.show(&show::lease_json(&lease), || show::lease(&lease))?;
    let environment = [(LEASE_VARIABLE, lease.id.0.to_string()), (TOKEN_VARIABLE, lease.token.0.to_string())];
    hold(session, &interrupt, held, &environment).await
}

/// `ratn resource consume`
pub(super) async fn consume(asking: &Asking, held: &HoldArguments) -> Result<(), Failure> {
    let interrupt = Interrupt::listen()?;
    let (session, client) = asking.session("consume").await?;
    let consumed = client.consume(held.selector.requirement(ResourceOperation::Consume)).await;
    let consumed = match consumed {
        Ok(consumed) => consumed,
        Err(error) => {
            session.close().await;
            return Err(anyhow::Error::from(error).context("not consumed").into());
        }
    };
    asking.show(&consumed.as_slice().into(), || consumed.join("\n"))?;
    hold(session, &interrupt, held, &[]).await
}

/// Until the time, the user, the program or the resource manager ends it.
async fn hold(
    session: Session,
    interrupt: &Interrupt,
    held: &HoldArguments,
    environment: &[(&str, String)],
) -> Result<(), Failure> {
    let mut program = match held.program.split_first() {
        None => None,
        Some((program, arguments)) => {
            let mut command = Command::new(program);
            command.args(arguments).kill_on_drop(true);
            command.envs(environment.iter().map(|(name, value)| (name, value)));
            let started = command.spawn().with_context(|| format!("cannot start `{program}`"));
            match started {
                Ok(child) => Some(child),
                Err(error) => {
                    session.close().await;
                    return Err(error.into());
                }
            }
        }
    };
    let ended = async {
        match &mut program {
            Some(child) => child.wait().await,
            None => std::future::pending().await,
        }
    };
    let over = async {
        match held.ttl {
            Some(ttl) => tokio::time::sleep(ttl).await,
            None => std::future::pending().await,
        }
    };
    let outcome = tokio::select! {
        status = ended => match status.context("cannot wait for the program")? {
            status if status.success() => Ok(()),
            // As shells have it, for one that a signal ended.
            status => {
                let code = status.code().or_else(|| status.signal().map(|signal| 128 + signal)).unwrap_or(1);
                Err(Failure::Program(u8::try_from(code).unwrap_or(1)))
            }
        },
        () = over => Ok(()),
        () = interrupt.asked_times(1) => Ok(()),
        () = session.lost() => Err(Failure::from(anyhow::anyhow!(
            "lost: the resource manager was not heard for {} s, others may have the resources now",
            super::SESSION_TTL.as_secs()
        ))),
    };
    if let Some(mut child) = program {
        stop(&mut child).await;
    }
    session.close().await;
    outcome
}

/// Asks a program that still runs to end, and ends it when it does not.
async fn stop(child: &mut tokio::process::Child) {
    let Some(pid) = child.id().and_then(|pid| i32::try_from(pid).ok()) else { return };
    let _ = nix::sys::signal::kill(nix::unistd::Pid::from_raw(pid), nix::sys::signal::Signal::SIGTERM);
    if tokio::time::timeout(STOP_PATIENCE, child.wait()).await.is_err() {
        output::progress("the program did not end in time and is killed");
        let _ = child.kill().await;
    }
}
