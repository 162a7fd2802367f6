//! Choosing the cluster of etcd where the configured members are not all of one: one of them was made anew and empty, as a cluster of its
//! own, or an address leads to another etcd.
//!
//! A client is of one cluster for good. Where several answer when it begins, the one that has the log counts. A log is only begun where
//! no other cluster could have it: more than half of the members have answered, all of one cluster, and none of them has the log.

use super::client::{Client, cluster_of};
use super::keys::{Keys, found_one, get, look};
use crate::error::ReadError;
use std::collections::BTreeSet;
use std::time::Duration;

/// A member that answers later is taken for one that is not there.
const PATIENCE: Duration = Duration::from_millis(900);

/// What a member says.
struct Said {
    address: String,
    cluster: u64,
    has_log: bool,
}

/// Those that answered, and how many were asked.
fn survey(client: &Client, keys: &Keys) -> (Vec<Said>, usize) {
    let answers = client.survey(&look(vec![get(keys.meta())]), PATIENCE);
    let asked = answers.len();
    let said = answers.into_iter().filter_map(|(address, answer)| {
        let answer = answer?;
        let cluster = cluster_of(answer.header.as_ref());
        let has_log = found_one(answer.responses.into_iter().next()).is_some();
        Some(Said { address, cluster, has_log })
    });
    (said.collect(), asked)
}

/// Tells a client that has asked nothing yet which cluster counts. Where nobody answers the client finds that out itself.
///
/// # Errors
/// Where several clusters answer, and it cannot be told which of them has the log.
pub(super) fn recognise(client: &Client, keys: &Keys) -> Result<(), ReadError> {
    if client.cluster().is_some() {
        return Ok(());
    }
    let (said, _) = survey(client, keys);
    let clusters: BTreeSet<u64> = said.iter().map(|said| said.cluster).collect();
    let with_log: BTreeSet<u64> = said.iter().filter(|said| said.has_log).map(|said| said.cluster).collect();
    let found = match (clusters.len(), with_log.len()) {
        (0, _) => return Ok(()),
        (1, _) => clusters.first(),
        (_, 1) => with_log.first(),
        _ => return Err(refused(client, keys, &several(&said))),
    };
    if clusters.len() > 1 {
        tracing::warn!(place = keys.prefix(), "{}; the one that has the log counts", several(&said));
    }
    found.into_iter().for_each(|cluster| client.pin(*cluster));
    Ok(())
}

/// Refuses to begin a log that may be somewhere else.
///
/// # Errors
/// Why it may be.
pub(super) fn may_begin(client: &Client, keys: &Keys) -> Result<(), ReadError> {
    let (said, asked) = survey(client, keys);
    let cluster = client.cluster();
    let what = if said.iter().any(|said| Some(said.cluster) != cluster) {
        several(&said)
    } else if let Some(said) = said.iter().find(|said| said.has_log) {
        format!("{} has a log there by now", said.address)
    } else if 2 * said.len() <= asked {
        format!("only {} of {asked} members answer", said.len())
    } else {
        return Ok(());
    };
    Err(refused(client, keys, &what))
}

fn several(said: &[Said]) -> String {
    let each = |said: &Said| {
        let log = if said.has_log { "has" } else { "has not" };
        format!("{} is of {:x} and {log} the log", said.address, said.cluster)
    };
    let each: Vec<String> = said.iter().map(each).collect();
    format!("the members are of several clusters of etcd ({})", each.join(", "))
}

fn refused(client: &Client, keys: &Keys, what: &str) -> ReadError {
    let prefix = keys.prefix();
    let what = format!(
        "{what}: no log is begun in {prefix}, for there may be one; take out of `endpoints` what is not of its cluster"
    );
    ReadError::Remote { place: client.place(), what }
}
