//! `ratn dashboard [LOG…]`: runs and a system as pages in a browser.

use super::blocking;
use crate::arguments::DashboardArguments;
use crate::failure::Failure;
use crate::interrupt::Interrupt;
use crate::output;
use crate::system::public_directory;
use ratn_dashboard::{Dashboard, DashboardError, Options};
use ratn_worker::tls::ClientTls;

/// Serves the pages until the user has seen enough.
pub(crate) fn run(arguments: &DashboardArguments, tls: &ClientTls) -> Result<(), Failure> {
    let directory = public_directory(arguments.runtime_dir.as_deref())?;
    let options = Options {
        address: arguments.listen,
        logs: arguments.logs.clone(),
        control: arguments.control,
        ..Options::of(directory, tls.clone())
    };
    blocking(async {
        let interrupt = Interrupt::listen()?;
        let dashboard = Dashboard::bind(options).await.map_err(refused)?;
        output::result(dashboard.url())?;
        let what = if arguments.control { "the pages may pause and end runs" } else { "the pages only look" };
        output::progress(format_args!("open this address in a browser on this machine; {what}; Ctrl-C ends it"));
        tokio::select! {
            () = dashboard.serve() => {}
            () = interrupt.asked_times(1) => {}
        }
        Ok(())
    })
}

/// What was asked for cannot be, or what it needs is not there.
fn refused(error: DashboardError) -> Failure {
    match error {
        DashboardError::Exposed { .. } | DashboardError::TooMany { .. } => Failure::Refused(format!("ratn: {error}")),
        other => Failure::Failed(other.into()),
    }
}
