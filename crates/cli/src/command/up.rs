//! `ratn up`: a whole system in the foreground.

use super::{blocking, dashboard, roles::startable, run::starting};
use crate::arguments::UpArguments;
use crate::failure::Failure;
use crate::interrupt::Interrupt;
use crate::output;
use crate::system::config::SystemConfig;
use crate::system::{System, public_directory, running};
use anyhow::Context;
use ratn_daemon::supervisor;
use ratn_worker::shutdown;
use ratn_worker::tls::ClientTls;
use tokio_util::sync::CancellationToken;

/// Starts the system and keeps it running until the user or one of its processes ends it, or until the parent ends with which
/// it has to end.
pub(crate) fn run(arguments: &UpArguments, tls: &ClientTls) -> Result<(), Failure> {
    let mut config = SystemConfig::load_for(arguments.config.as_deref(), arguments.system.robot.as_deref())?;
    config.apply(&arguments.system);
    startable(&config)?;
    let tls = &config.client_tls(tls)?;
    blocking(async {
        let interrupt = Interrupt::listen()?;
        let parent_gone = CancellationToken::new();
        if arguments.exit_with_parent {
            shutdown::exit_with_parent(&parent_gone).context("cannot watch standard input")?;
        }
        let directory = public_directory(arguments.runtime_dir.as_deref())?;
        if running(&directory, tls).await?.is_some() {
            return Err(Failure::Refused(format!("ratn: a system runs in {} already", directory.display())));
        }
        let mut system = starting(Box::pin(System::start_public(config, &directory, tls)), &interrupt).await?;
        output::progress(format_args!(
            "the system is ready in {}; Ctrl-C ends it",
            system.directory().path().display()
        ));
        let dashboard = match arguments.dashboard {
            true => Some(dashboard::of_system(&directory, tls).await),
            false => None,
        };
        let shown = async {
            match dashboard {
                Some(Ok(dashboard)) => dashboard.serve().await,
                // The system runs without the dashboard, too.
                Some(Err(error)) => output::progress(format_args!("there is no dashboard: {error}")),
                None => {}
            }
            std::future::pending::<()>().await;
        };
        supervisor::ready();
        let ended = tokio::select! {
            () = shown => Ok(()),
            () = interrupt.asked_times(1) => Ok(()),
            () = parent_gone.cancelled() => Ok(()),
            error = system.one_ended() => Err(error.into()),
        };
        supervisor::stopping();
        system.stop().await;
        ended
    })
}
