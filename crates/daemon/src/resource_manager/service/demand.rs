//! Calls of providers: they watch which kinds are wanted, and report what they cannot provide.

use super::Streamed;
use super::requests::{Requests, session};
use crate::access::{Caller, speaker};
use crate::audit::{self, Mutation};
use crate::resource_manager::actor::Message;
use crate::resource_manager::providers::Provisions;
use futures::StreamExt;
use ratn_proto::convert::{all, few, label, name, ports};
use ratn_proto::types::Provision;
use ratn_proto::v1;
use tokio_util::sync::CancellationToken;
use tonic::Status;

pub(super) async fn watch(
    requests: &Requests,
    caller: &Caller,
    request: v1::WatchDemandRequest,
    shutdown: CancellationToken,
) -> Result<Streamed<v1::WatchDemandResponse>, Status> {
    let session = session(&request.session_id)?;
    few(request.provisions.len(), "provisions")?;
    for (index, provision) in request.provisions.iter().enumerate() {
        name(&provision.kind, &format!("provisions[{index}].kind"))?;
    }
    let provisions = Provisions {
        kinds: request.provisions.into_iter().map(kind).collect(),
        attributes: ports(request.attributes, "attributes")?,
    };
    let speaker = speaker(caller);
    let watch = |answer| Message::WatchDemand { speaker, session, provisions, answer };
    let mut demand = requests.counted("watch_demand", requests.actor().request(watch).await)?;
    demand.mark_changed();
    let stream = futures::stream::unfold(demand, async |mut demand| {
        demand.changed().await.ok()?;
        let demands = all(demand.borrow_and_update().iter().cloned());
        Some((Ok(v1::WatchDemandResponse { demands }), demand))
    });
    Ok(Box::pin(stream.take_until(shutdown.cancelled_owned())))
}

fn kind(provision: v1::Provision) -> (String, Provision) {
    (provision.kind, Provision { most: provision.most, grows: provision.grows })
}

pub(super) async fn report_shortage(
    requests: &Requests,
    caller: &Caller,
    request: v1::ReportShortageRequest,
) -> Result<v1::ReportShortageResponse, Status> {
    let v1::ReportShortageRequest { session_id, kind, reason, most } = request;
    name(&kind, "kind")?;
    label(&reason, "reason")?;
    let session = session(&session_id)?;
    let shortage =
        || Mutation::ReportShortage { session: session_id, kind: kind.clone(), most, reason: reason.clone() };
    let pending = audit::begin(caller, "", shortage);
    let report = |speaker, answer| Message::ReportShortage { speaker, session, kind, most, reason, answer };
    requests.change("report_shortage", pending, caller, report).await?;
    Ok(v1::ReportShortageResponse {})
}
