//! Resuming a run whose session has ended: asks the resource manager which of the run's operations are done, makes again what went with the session,
//! and performs the rest.
//!
//! Nothing that is made again outlasts the new session, and an operation that is done for the first time is done under its own request id. It may take
//! of what was made again, so the log says the new ids before. So a resumption that dies or is refused on the way leaves nothing that the next one does
//! not find.

use super::Performer;
use crate::decided::{Unanswered, Undone, insist};
use crate::ledger::{Account, Answers, Created, Ledger, Settled, Unfinished, UsedUp, operation_request};
use crate::record::{operate_once, recorded};
use anyhow::bail;
use ratn_executive::protocol::Event;
use ratn_model::resource::{OperatedUnits, Requirement, ResourceOperation};
use ratn_worker::client::retry_unanswered;
use std::collections::BTreeMap;

/// Reason code: the resource does not exist.
const GONE: &str = "RESOURCE_UNKNOWN";

/// The resources that the run had created: old id to new id.
type Renamed = BTreeMap<String, String>;

/// The operations that are left to do, when all else has been made again under these ids.
pub(super) struct Rest {
    renamed: Renamed,
    open: Vec<Unfinished>,
}

impl Performer {
    /// Settles the operations without an answer of a run whose session has ended; if the session lives, they are simply requested again.
    pub(super) async fn settle(&self, ledger: &Ledger) -> anyhow::Result<Settled> {
        let requests = ledger.unheard_requests();
        let answers = match retry_unanswered(|| self.resources.recall(&requests)).await {
            Ok(answers) => requests.into_iter().zip(answers).collect(),
            // A manager of an earlier version, which has no such call.
            Err(error) if error.code() == Some(tonic::Code::Unimplemented) => Answers::new(),
            Err(error) => return Err(error.into()),
        };
        Ok(ledger.settle(&answers)?)
    }

    /// Makes again what the run had created and used up in its old session. Others' resources that the run deleted stay deleted, as does some of what
    /// it used up. Returns the events for the log, which has to have them before the rest is done.
    pub(super) async fn make_anew(&self, settled: Settled, before: &Ledger) -> anyhow::Result<(Vec<Event>, Rest)> {
        let Settled { account, done, open } = settled;
        if let Some(operation) = account.unknown() {
            bail!(
                "what `{operation}` has come to is not in the log, as the resource manager did not say it (one of an earlier version does \
                 not): it went with the run's session and cannot be made so again; run the task again"
            );
        }
        let renamed = self.create_anew(&account).await?;
        self.use_up_anew(&account, &renamed).await?;
        let last = done.last().map_or(before.recorded, |(number, _)| *number);
        let known =
            |(number, units): (u64, Vec<_>)| recorded(number, before.session, units.into_iter().map(Some).collect());
        let mut told: Vec<Event> = done.into_iter().map(known).collect();
        told.push(Event::Recorded {
            operation: last,
            session: self.number,
            units: Vec::new(),
            renamed: renamed.clone(),
        });
        Ok((told, Rest { renamed, open }))
    }

    /// Performs the open operations. Returns the events for the log.
    pub(super) async fn do_the_rest(&self, Rest { renamed, open }: Rest) -> anyhow::Result<Vec<Event>> {
        let mut told = Vec::new();
        for unfinished in open {
            told.push(self.operate_anew(unfinished, &renamed).await?);
        }
        Ok(told)
    }

    /// Creates the run's resources again; returns the new ids by the old ones.
    async fn create_anew(&self, account: &Account) -> anyhow::Result<Renamed> {
        let mut renamed = BTreeMap::new();
        for (index, Created { resource, left }) in account.created().iter().enumerate() {
            let request = format!("{}/again-{}.{index}", self.run, self.resumptions);
            match operate_once(&self.resources, &self.trust, &request, left).await {
                Ok(made) => renamed.extend(made.into_iter().flatten().map(|made| (resource.clone(), made.resource))),
                Err(undone) => bail!("`{left}` was so before and cannot be made so again: {undone}"),
            }
        }
        Ok(renamed)
    }

    /// Uses up again, of the same resources, what the run had used up of units that have returned and of resources that exist again. If a resource has
    /// gone since, its consumption has gone with it.
    async fn use_up_anew(&self, account: &Account, renamed: &Renamed) -> anyhow::Result<()> {
        for (index, (resource, UsedUp { kind, units })) in account.used_up().enumerate() {
            let resource = renamed.get(resource).map_or(resource, String::as_str);
            let request = format!("{}/used-again-{}.{index}", self.run, self.resumptions);
            let used_up = Requirement { count: *units, ..Requirement::new(ResourceOperation::Consume, kind) };
            let ask = || self.resources.consume_units_once(&request, used_up.clone(), resource);
            match insist(&self.trust, Unanswered::Waits, ask).await {
                Ok(_) => {}
                Err(Undone::Failed(error)) if error.reason() == GONE => {}
                Err(undone) => bail!("`{used_up}` of {resource} was so before and cannot be made so again: {undone}"),
            }
        }
        Ok(())
    }

    /// Performs the rest of an operation.
    async fn operate_anew(&self, unfinished: Unfinished, renamed: &Renamed) -> anyhow::Result<Event> {
        let Unfinished { number, instance, operations, done } = unfinished;
        let first = done.len();
        let mut units: Vec<_> = done.into_iter().map(|done| Some(under_new_ids(done, renamed))).collect();
        for (index, operation) in operations.iter().enumerate().skip(first) {
            let request = operation_request(&self.run, instance, number, index);
            match operate_once(&self.resources, &self.trust, &request, operation).await {
                Ok(done) => units.push(done),
                Err(undone) => bail!("`{operation}` was not done before, and cannot be done now: {undone}"),
            }
        }
        Ok(recorded(number, self.number, units))
    }
}

fn under_new_ids(mut units: Vec<OperatedUnits>, renamed: &Renamed) -> Vec<OperatedUnits> {
    for one in &mut units {
        if let Some(new) = renamed.get(&one.resource) {
            one.resource.clone_from(new);
        }
    }
    units
}
