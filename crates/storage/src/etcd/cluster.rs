//! Chooses the cluster of etcd if not all configured members belong to one: a member was set up anew and empty, as a cluster of its own, or
//! an address leads to another etcd.
//!
//! A client belongs to one cluster for good. If several answer when it starts, the one that has the log counts. A log is begun only if no
//! other cluster can have it: more than half of the members have answered, all of one cluster, and none of them has the log.

use super::client::{Client, cluster_of};
use super::keys::{Keys, found_one, get, look};
use crate::error::ReadError;
use std::collections::BTreeSet;
use std::time::Duration;

/// A member that answers later counts as absent.
const PATIENCE: Duration = Duration::from_millis(900);

/// The answer of a member.
struct Said {
    address: String,
    cluster: u64,
    has_log: bool,
}

/// The answers, and the number of members asked.
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

/// Tells a client that has not asked yet which cluster counts. If no member answers, the client finds that out itself.
///
/// # Errors
/// Several clusters answer, and it is unclear which of them has the log.
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

/// Refuses to begin a log that may exist elsewhere.
///
/// # Errors
/// Why it may exist elsewhere.
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
