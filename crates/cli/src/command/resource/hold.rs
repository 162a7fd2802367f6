//! `block` and `consume`: the resources are held by a separate session, which ends with the command, in whatever way it ends.
//!
//! A program that is run meanwhile is ended before another client can get the resources: when the manager is not reachable, within
//! the time that the session still lives there. A lease that somebody else ends is over at once, unless the resource has a
//! `standstill_ms`, which then has to be more than [`STOP_MARGIN`].

use super::arguments::HoldArguments;
use super::{Asking, loss, show};
use crate::failure::Failure;
use crate::interrupt::Interrupt;
use crate::output;
use anyhow::Context;
use nix::sys::signal::Signal;
use nix::unistd::Pid;
use ratn_model::resource::{Lease, Requirement, ResourceOperation};
use ratn_worker::client::{AcquireOptions, CallError, ResourceClient, fresh_id};
use ratn_worker::session::Session;
use std::io::IsTerminal;
use std::os::unix::process::ExitStatusExt;
use std::time::{Duration, Instant};
use tokio::process::{Child, Command};

/// Time to live of a session for a program: long enough to outlast short interruptions of the manager, and to end the program in the
/// remaining time.
const PROGRAM_TTL: Duration = Duration::from_secs(10);
/// Time from SIGTERM to SIGKILL.
const STOP_PATIENCE: Duration = Duration::from_secs(2);
/// How long before the session may expire a program is asked to end: its end, by SIGKILL if necessary, comes before another client
/// can get the resources.
const STOP_MARGIN: Duration = Duration::from_secs(3);
/// Pause before a manager that does not answer is asked again.
const AGAIN: Duration = Duration::from_millis(250);
const LEASE_VARIABLE: &str = "RATN_LEASE";
const TOKEN_VARIABLE: &str = "RATN_TOKEN";

/// `ratn resource block`.
pub(super) async fn block(asking: &Asking, held: &HoldArguments) -> Result<(), Failure> {
    let requirement = held.selector.requirement(ResourceOperation::Block)?;
    let interrupt = Interrupt::listen()?;
    let (session, client) = asking.session("block", ttl_for(held)).await?;
    let options = AcquireOptions {
        request: fresh_id("block"),
        priority: held.priority,
        deadline: held.wait,
        holder: format!("ratn resource block, process {}", std::process::id()),
        ..AcquireOptions::default()
    };
    let granted = tokio::select! {
        granted = granted(&session, &client, requirement, options) => granted.context("not blocked"),
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
    let lost = loss::of(&client, &lease);
    let outcome = hold(&session, &interrupt, held, &environment, lost).await;
    if let Err(Failure::Lost(_)) = &outcome {
        confirm_standstill(&client, &lease).await;
    }
    session.close().await;
    outcome
}

/// Asks until there is an answer or the time is over: a manager that restarts keeps holders, but not waiters, and the request id
/// makes all attempts one request.
async fn granted(
    session: &Session,
    client: &ResourceClient,
    requirement: Requirement,
    options: AcquireOptions,
) -> Result<Lease, CallError> {
    let until = Instant::now() + options.deadline;
    let mut broke = false;
    loop {
        let left = until.saturating_duration_since(Instant::now()).max(Duration::from_millis(1));
        let asked = AcquireOptions { deadline: left, ..options.clone() };
        let error = match client.block(requirement.clone(), asked).await {
            Ok(lease) => return Ok(lease),
            Err(error) => error,
        };
        // A manager that came back without its state learns of the session at the next ping.
        let forgotten = broke && error.code() == Some(tonic::Code::FailedPrecondition);
        if !(error.is_crash() || forgotten) || until.saturating_duration_since(Instant::now()) < AGAIN {
            return Err(error);
        }
        if !std::mem::replace(&mut broke, true) {
            output::progress("the resource manager does not answer; it is asked again");
        }
        tokio::time::sleep(AGAIN).await;
        let _ = session.alive(until.saturating_duration_since(Instant::now())).await;
    }
}

/// `ratn resource consume`.
pub(super) async fn consume(asking: &Asking, held: &HoldArguments) -> Result<(), Failure> {
    let requirement = held.selector.requirement(ResourceOperation::Consume)?;
    let interrupt = Interrupt::listen()?;
    let (session, client) = asking.session("consume", ttl_for(held)).await?;
    let consumed = client.consume(requirement).await;
    let consumed = match consumed {
        Ok(consumed) => consumed,
        Err(error) => {
            session.close().await;
            return Err(anyhow::Error::from(error).context("not consumed").into());
        }
    };
    asking.show(&consumed.as_slice().into(), || consumed.join("\n"))?;
    let outcome = hold(&session, &interrupt, held, &[], std::future::pending()).await;
    session.close().await;
    outcome
}

fn ttl_for(held: &HoldArguments) -> Duration {
    if held.program.is_empty() { super::SESSION_TTL } else { PROGRAM_TTL }
}

/// The program has ended: confirms the standstill of resources that still wait for it and have no provider to confirm it.
async fn confirm_standstill(client: &ResourceClient, lease: &Lease) {
    for held in &lease.resources {
        let confirming = async {
            let resource = client.get(&held.id).await?;
            let is_ending = resource.ending.iter().any(|ending| ending.lease == lease.id);
            if is_ending && resource.session.is_empty() {
                client.confirm_standstill(lease.id, &held.id).await
            } else {
                Ok(false)
            }
        };
        // If the manager does not answer, the resource is free after its bound.
        let _ = tokio::time::timeout(AGAIN, confirming).await;
    }
}

/// Holds until the time is over, or the user, the program, the resource manager or an operator ends it; `lost` resolves with the
/// reason if the lease ends. The program has ended when this returns.
async fn hold(
    session: &Session,
    interrupt: &Interrupt,
    held: &HoldArguments,
    environment: &[(&str, String)],
    lost: impl Future<Output = String>,
) -> Result<(), Failure> {
    let mut program = match held.program.split_first() {
        None => None,
        Some((program, arguments)) => {
            let mut command = Command::new(program);
            command.args(arguments).kill_on_drop(true);
            command.envs(environment.iter().map(|(name, value)| (name, value)));
            // A separate process group, so that the processes that the program starts end with it; at a terminal it stays in the
            // group that receives the keys.
            if !std::io::stdin().is_terminal() {
                command.process_group(0);
            }
            Some(command.spawn().with_context(|| format!("cannot start `{program}`"))?)
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
            // The exit code of a program ended by a signal, as in shells.
            status => {
                let code = status.code().or_else(|| status.signal().map(|signal| 128 + signal)).unwrap_or(1);
                Err(Failure::Program(u8::try_from(code).unwrap_or(1)))
            }
        },
        () = over => Ok(()),
        () = interrupt.asked_times(1) => Ok(()),
        unheard = unheard(session, held) => Err(Failure::Lost(unheard)),
        why = lost => Err(Failure::Lost(format!("{why}; others may have the resources now"))),
    };
    if let (Err(Failure::Lost(why)), Some(_)) = (&outcome, &program) {
        output::progress(format_args!("ratn: lost: {why}: the program is asked to end"));
    }
    if let Some(mut child) = program {
        stop(&mut child).await;
    }
    outcome
}

/// Resolves when the session may expire, or earlier where a program has to be ended first. Returns a message about it.
async fn unheard(session: &Session, held: &HoldArguments) -> String {
    if held.program.is_empty() {
        session.lost().await;
        let seconds = super::SESSION_TTL.as_secs();
        return format!("the resource manager was not heard for {seconds} s, others may have the resources now");
    }
    session.nearly_lost(STOP_MARGIN).await;
    let (seconds, left) = ((PROGRAM_TTL - STOP_MARGIN).as_secs(), STOP_MARGIN.as_secs());
    format!("the resource manager was not heard for {seconds} s, others may have the resources in {left} s")
}

/// Asks a running program to end, and kills it when it does not.
async fn stop(child: &mut Child) {
    let Some(pid) = child.id().and_then(|pid| i32::try_from(pid).ok()).map(Pid::from_raw) else { return };
    let leads = nix::unistd::getpgid(Some(pid)) == Ok(pid);
    let signal = |signal| {
        // An error means that no process is left.
        let _ = if leads { nix::sys::signal::killpg(pid, signal) } else { nix::sys::signal::kill(pid, signal) };
    };
    signal(Signal::SIGTERM);
    let overdue = tokio::time::timeout(STOP_PATIENCE, child.wait()).await.is_err();
    if overdue {
        output::progress("the program did not end in time and is killed");
    }
    // This also reaches what the program has left in its group; without a group the id of an ended process may be reused.
    if overdue || leads {
        signal(Signal::SIGKILL);
    }
    let _ = child.wait().await;
}
