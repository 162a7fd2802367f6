//! `ratn top`: a whole system at a glance, again and again.

use super::status::Status;
use super::{blocking_on, pool, unanswered};
use crate::arguments::TopArguments;
use crate::colour::Colours;
use crate::failure::Failure;
use crate::repainting;
use crate::system::public_directory;
use ratn_daemon::resource_manager;
use ratn_worker::client::{Channels, ResourceClient};
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::tls::ClientTls;

/// Shows it until the user has seen enough.
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
            Ok::<String, Failure>(format!("{}\n\n{workers}", status.text(&directory, colours)))
        };
        repainting::repeat(!arguments.once, false, look).await
    })
}
