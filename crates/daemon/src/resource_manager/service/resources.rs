//! Calls on the resources themselves: create, consume, delete, and reading them.

use super::requests::{Requests, odd_reply, optional_session, session};
use crate::access::{Caller, speaker};
use crate::details::status;
use crate::paging::{self, Filled, Page};
use crate::resource_manager::actor::Message;
use crate::resource_manager::wire;
use ratn_model::resource::{Requirement, ResourceClass};
use ratn_proto::convert::{all, kind, name, required};
use ratn_proto::types::{ENDPOINT_ATTRIBUTE, Recalled, Resource, ResourceFilter};
use ratn_proto::v1;
use ratn_resources::{Reply, Request, ResourceSpec, Search};
use std::collections::BTreeSet;
use tonic::{Code, Status};

/// Maximum number of resources examined in one turn for a list.
const LISTED_AT_ONCE: usize = 4_096;
/// Maximum number of resources examined in one turn by a search.
const SEARCHED_AT_ONCE: usize = 10_000;
/// Maximum number of ids in an answer.
const MOST_IDS: usize = 1_000;

pub(super) async fn create(
    requests: &Requests,
    caller: &Caller,
    request: v1::CreateRequest,
) -> Result<v1::CreateResponse, Status> {
    let resource: Resource = required(request.resource, "resource")?;
    if !caller.may_create(resource.class) {
        let message = format!("{caller} may not create resources of the class {}", resource.class);
        return Err(status(Code::PermissionDenied, "ROLE_MISSING", message));
    }
    // Goals are sent to the endpoint of a granted resource: only providers may set it.
    if !caller.may_create(ResourceClass::Module) && resource.attributes.contains_key(ENDPOINT_ATTRIBUTE) {
        let message = format!(
            "{caller} may not create a resource with the attribute `{ENDPOINT_ATTRIBUTE}`: goals would be given there, and only agents \
             and operators offer who performs them"
        );
        return Err(status(Code::PermissionDenied, "ROLE_MISSING", message));
    }
    let spec = ResourceSpec {
        id: Some(resource.id).filter(|id| !id.is_empty()),
        class: resource.class,
        kind: resource.kind,
        attributes: resource.attributes,
        capacity: resource.capacity,
        divisible: resource.divisible,
        renewable: resource.renewable,
        host: resource.host,
    };
    let session = optional_session(&request.session_id)?;
    let (reply, _) = requests.perform(caller, request.request_id, Request::Create { session, spec }).await?;
    let Reply::Created { id, .. } = reply else { return Err(odd_reply(&reply)) };
    let Some(view) = requests.actor().ask(|answer| Message::Get { id: id.clone(), answer }).await? else {
        let message = format!("`{id}` was created by this request and is gone since");
        return Err(status(Code::NotFound, "RESOURCE_UNKNOWN", message));
    };
    Ok(v1::CreateResponse { resource: Some(wire::resource(&view).into()) })
}

pub(super) async fn consume(
    requests: &Requests,
    caller: &Caller,
    request: v1::ConsumeRequest,
) -> Result<v1::ConsumeResponse, Status> {
    let requirement: Requirement = required(request.requirement, "requirement")?;
    let session = session(&request.session_id)?;
    let resource = Some(request.resource_id).filter(|id| !id.is_empty());
    resource.as_ref().map_or(Ok(()), |id| name(id, "resource_id"))?;
    let consume = Request::Consume { session, requirement, resource };
    let (reply, revision) = requests.perform(caller, request.request_id, consume).await?;
    let (resource_ids, consumed) = operated(reply)?;
    Ok(v1::ConsumeResponse { resource_ids, revision, consumed })
}

/// The ids of the resources, and the amount for each; no amounts if an earlier version performed the request.
fn operated(reply: Reply) -> Result<(Vec<String>, Vec<v1::OperatedUnits>), Status> {
    match reply {
        Reply::Operated(units) => {
            let ids = units.iter().map(|one| one.resource.clone()).collect();
            Ok((ids, all(units)))
        }
        Reply::Touched(ids) => Ok((ids, Vec::new())),
        odd => Err(odd_reply(&odd)),
    }
}

pub(super) async fn recall(
    requests: &Requests,
    caller: &Caller,
    request: v1::RecallRequest,
) -> Result<v1::RecallResponse, Status> {
    let session = session(&request.session_id)?;
    request.request_ids.iter().try_for_each(|id| name(id, "request_ids"))?;
    if request.request_ids.len() > MOST_IDS {
        let message = format!("request_ids: there are more than {MOST_IDS}");
        return Err(status(Code::InvalidArgument, "MALFORMED", message));
    }
    let mut seen = BTreeSet::new();
    if let Some(twice) = request.request_ids.iter().find(|id| !seen.insert(*id)) {
        return Err(status(Code::InvalidArgument, "MALFORMED", format!("request_ids: {twice} is there twice")));
    }
    let (speaker, request_ids) = (speaker(caller), request.request_ids);
    let recall = |answer| Message::Recall { speaker, session, request_ids, answer };
    let recalled = requests.actor().request(recall).await?;
    let recalled = recalled.into_iter().map(|reply| {
        reply.map(|reply| match reply {
            Reply::Created { id, .. } => Recalled { created: Some(id), ..Recalled::default() },
            Reply::Operated(operated) => Recalled { operated, ..Recalled::default() },
            _ => Recalled::default(),
        })
    });
    Ok(v1::RecallResponse { requests: recalled.map(Into::into).collect() })
}

pub(super) async fn delete(
    requests: &Requests,
    caller: &Caller,
    request: v1::DeleteRequest,
) -> Result<v1::DeleteResponse, Status> {
    use v1::delete_request::Target;
    let target = request
        .target
        .ok_or_else(|| status(Code::InvalidArgument, "MALFORMED", "target: resource_id or requirement is missing"))?;
    let (resource_ids, revision, deleted) = match target {
        Target::ResourceId(id) => {
            name(&id, "resource_id")?;
            let session = optional_session(&request.session_id)?;
            let delete = Request::Delete { session, id: id.clone() };
            let (_, revision) = requests.perform(caller, request.request_id, delete).await?;
            (vec![id], revision, Vec::new())
        }
        Target::Requirement(requirement) => {
            let requirement = Requirement::try_from(requirement).map_err(|m| m.within("requirement"))?;
            let delete = Request::DeleteUnits { session: session(&request.session_id)?, requirement };
            let (reply, revision) = requests.perform(caller, request.request_id, delete).await?;
            let (ids, deleted) = operated(reply)?;
            (ids, revision, deleted)
        }
    };
    Ok(v1::DeleteResponse { resource_ids, revision, deleted })
}

pub(super) async fn exists(requests: &Requests, request: v1::ExistsRequest) -> Result<v1::ExistsResponse, Status> {
    let requirement: Requirement = required(request.requirement, "requirement")?;
    kind(&requirement.kind, "requirement.kind")?;
    let wanted = requirement.count;
    let mut search = Search::new(requirement, MOST_IDS);
    loop {
        let go_on = |answer| Message::Search { search, resources: SEARCHED_AT_ONCE, answer };
        let (found, finished) = requests.actor().ask(go_on).await?;
        if finished {
            return Ok(v1::ExistsResponse { exists: found.units() >= wanted, resource_ids: found.into_ids() });
        }
        search = found;
    }
}

pub(super) async fn get(
    requests: &Requests,
    request: v1::ResourceServiceGetRequest,
) -> Result<v1::ResourceServiceGetResponse, Status> {
    let id = request.resource_id;
    name(&id, "resource_id")?;
    let Some(view) = requests.actor().ask(|answer| Message::Get { id: id.clone(), answer }).await? else {
        return Err(status(Code::NotFound, "RESOURCE_UNKNOWN", format!("there is no resource `{id}`")));
    };
    Ok(v1::ResourceServiceGetResponse { resource: Some(wire::resource(&view).into()) })
}

pub(super) async fn list(requests: &Requests, mut request: v1::ListRequest) -> Result<v1::ListResponse, Status> {
    let (bytes, token) = (std::mem::take(&mut request.page_bytes), std::mem::take(&mut request.page_token));
    let (page, asked) = (Page::of(bytes, &token), request.clone());
    let filter = ResourceFilter::try_from(request)?;
    let mut after = paging::behind(&token, &asked)?.to_owned();
    let (mut filled, mut first) = (Filled::default(), None);
    loop {
        let from = after.clone();
        let listed = requests.actor().ask(|answer| Message::List { after: from, most: LISTED_AT_ONCE, answer });
        let (views, revision) = listed.await?;
        let revision = *first.get_or_insert(revision);
        let passing = views.iter().filter(|view| wire::passes(view, &filter));
        let more = page.fill(passing.map(|view| wire::resource(view).into()), &mut filled)?;
        match views.last().filter(|_| views.len() == LISTED_AT_ONCE) {
            Some(last) if !more => after.clone_from(&last.id),
            _ => {
                let last = filled.items.last().filter(|_| more).map(|last: &v1::Resource| last.id.as_str());
                let next_page_token = paging::token_behind(last, &asked);
                let resources = filled.items;
                return Ok(v1::ListResponse { resources, revision: revision.0, next_page_token });
            }
        }
    }
}
