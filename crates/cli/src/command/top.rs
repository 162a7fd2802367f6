//! `ratn top`: a whole system at a glance, refreshed repeatedly.

use super::status::{MOST_LINES, Status};
use super::{blocking_on, pool, unanswered};
use crate::arguments::TopArguments;
use crate::colour::Colours;
use crate::failure::Failure;
use crate::fitted::fits;
use crate::repainting;
use crate::system::public_directory;
use ratn_daemon::resource_manager;
use ratn_worker::client::{Channels, ResourceClient};
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::tls::ClientTls;

/// Minimum number of lines of one kind, even where not all fit.
const LEAST_LINES: usize = 2;

/// Shows it until the user ends it.
pub(crate) fn run(arguments: &TopArguments, tls: &ClientTls) -> Result<(), Failure> {
    blocking_on(tokio::runtime::Builder::new_current_thread(), async {
        let directory = public_directory(arguments.runtime_dir.as_deref())?;
        let manager = RuntimeDirectory::at(&directory).find(resource_manager::ROLE);
        let manager = manager.map_err(|error| Failure::Refused(format!("ratn: {error}")))?;
        let channels = Channels::new(tls);
        let client = ResourceClient::new(&channels, &manager, "")?;
        let colours = Colours::of_output();
        let look = async || {
            let status = Status::of(&directory, &channels, &client).await.map_err(unanswered)?;
            let workers = pool::overview(Some(directory.clone()), tls).await.map_err(unanswered)?;
            let text = |most| format!("{}\n\n{workers}", status.text(&directory, colours, most));
            // Where space is short, fewer lines of each kind leave room for the other kinds.
            let most = match repainting::room().filter(|_| !arguments.once) {
                Some((width, height)) => {
                    (LEAST_LINES..=MOST_LINES).rev().find(|most| fits(&text(*most), width, height))
                }
                None => Some(MOST_LINES),
            };
            Ok::<String, Failure>(text(most.unwrap_or(LEAST_LINES)))
        };
        repainting::repeat(!arguments.once, false, look).await
    })
}
