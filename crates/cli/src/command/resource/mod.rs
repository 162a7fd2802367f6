//! `ratn resource …`: the operations of the resource manager for people and scripts.
//!
//! Each is one call in the name of the user who types it. Operations that need a session (`block`, `consume`) have one for as
//! long as the command runs; what is created without a session stays until it is deleted. The output is a table, or one JSON
//! document each.

mod arguments;
mod hold;
mod loss;
mod show;
mod watch;

pub(crate) use arguments::ResourceArguments;

use super::{blocking_on, leader, unanswered};
use crate::failure::Failure;
use crate::output;
use crate::repainting::{self, json_text};
use crate::system::public_directory;
use anyhow::Context;
use arguments::{ResourceCommand, Selector};
use ratn_model::resource::{Quantity, Requirement, ResourceOperation};
use ratn_proto::types::{Resource, ResourceFilter};
use ratn_worker::client::{Channels, ResourceClient};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::session::Session;
use ratn_worker::tls::ClientTls;
use ratn_worker::trace::{self, TraceContext};
use std::time::Duration;

const ROLE: &str = ratn_daemon::resource_manager::ROLE;
/// Timeout of opening a session.
const SESSION_DEADLINE: Duration = Duration::from_secs(5);
const SESSION_TTL: Duration = Duration::from_secs(3);

/// The client of the resource manager, and the output format.
struct Asking {
    channels: Channels,
    endpoint: Endpoint,
    client: ResourceClient,
    json: bool,
}

/// Performs an operation.
pub(super) fn run(arguments: &ResourceArguments, tls: &ClientTls) -> Result<(), Failure> {
    blocking_on(tokio::runtime::Builder::new_current_thread(), async {
        let endpoint = match &arguments.manager {
            Some(endpoint) => endpoint.clone(),
            None => RuntimeDirectory::at(public_directory(arguments.runtime_dir.as_deref())?)
                .find(ROLE)
                .map_err(|error| Failure::Refused(format!("ratn: {error}")))?,
        };
        // With JSON, the document is the only output.
        if !arguments.json {
            let managers = leader::ask(&endpoint, tls).await;
            if !managers.is_empty() {
                output::progress(leader::line(ROLE, &managers));
            }
        }
        let channels = Channels::new(tls);
        let client = ResourceClient::new(&channels, &endpoint, "")?;
        let asking = Asking { channels, endpoint, client, json: arguments.json };
        let performed = trace::within(TraceContext::fresh(), asking.perform(&arguments.command)).await;
        performed.map_err(unanswered)
    })
}

impl Asking {
    async fn perform(&self, command: &ResourceCommand) -> Result<(), Failure> {
        let client = &self.client;
        match command {
            ResourceCommand::Create(create) => {
                let wanted = create.resource()?;
                self.not_there_otherwise(create, &wanted).await?;
                let created = client.create(wanted).await.context("not created")?;
                self.show(&show::resource_json(&created), || created.id.clone())?;
            }
            ResourceCommand::Delete { ids, kind: None } => {
                return self.delete(ids).await;
            }
            ResourceCommand::Delete { kind: Some(kind), .. } => {
                let requirement = Selector { kind: kind.clone(), count: Quantity::ONE, ..Selector::default() };
                let requirement = requirement.requirement(ResourceOperation::Delete)?;
                let (session, client) = self.session("delete", SESSION_TTL).await?;
                let deleted = client.delete_matching(requirement).await;
                session.close().await;
                let deleted = deleted.context("not deleted")?;
                self.show(&deleted.as_slice().into(), || lines(&deleted))?;
            }
            ResourceCommand::Block(held) => return hold::block(self, held).await,
            ResourceCommand::Consume(held) => return hold::consume(self, held).await,
            ResourceCommand::Release { lease } => {
                let released = client.release(*lease).await.context("not released")?;
                if !released {
                    return Err(anyhow::anyhow!("lease {lease} had ended before, or never was").into());
                }
                self.show(&serde_json::json!({ "released": lease }), || format!("lease {lease} is released"))?;
            }
            ResourceCommand::Exists(selector) => {
                let requirement = selector.requirement(ResourceOperation::Exists)?;
                let exists = client.exists(requirement.clone()).await;
                let exists = exists.map_err(|error| Failure::Refused(format!("ratn: {error}")))?;
                let word = if exists { "yes" } else { "no" };
                self.show(&serde_json::json!({ "exists": exists }), || word.to_owned())?;
                if !exists {
                    return Err(anyhow::anyhow!("there is not what would satisfy `{requirement}`").into());
                }
            }
            ResourceCommand::List { kinds, conditions, watch } => {
                let (kinds, conditions) = (kinds.clone(), conditions.clone());
                let filter = ResourceFilter { kinds, conditions, ..ResourceFilter::default() };
                let look = async || {
                    let resources = client.list_where(filter.clone()).await?;
                    Ok::<String, Failure>(match self.json {
                        true => json_text(&resources.iter().map(show::resource_json).collect::<Vec<_>>(), *watch)?,
                        false => show::table(&resources),
                    })
                };
                repainting::repeat(*watch, self.json, look).await?;
            }
            ResourceCommand::Get { id } => {
                let found = client.get(id).await?;
                self.show(&show::resource_json(&found), || show::in_full(&found))?;
            }
            ResourceCommand::Explain { request } => {
                let waiting = client.explain(request).await?;
                self.show(&waiting.iter().map(show::waiting_json).collect(), || show::waiting(&waiting))?;
            }
            ResourceCommand::Sessions => {
                let sessions = client.sessions().await?;
                self.show(&sessions.iter().map(show::session_json).collect(), || show::sessions(&sessions))?;
            }
            ResourceCommand::Watch { kinds } => {
                let kinds: Vec<&str> = kinds.iter().map(String::as_str).collect();
                watch::watch(self, &kinds).await?;
            }
        }
        Ok(())
    }

    /// Deletes what can be deleted; reports each resource that cannot.
    async fn delete(&self, ids: &[String]) -> Result<(), Failure> {
        let (mut deleted, mut kept) = (Vec::new(), Vec::new());
        for id in ids {
            match self.client.delete(id).await {
                Ok(()) => deleted.push(id.clone()),
                Err(error) if error.is_crash() => {
                    self.show(&deleted.as_slice().into(), || lines(&deleted))?;
                    return Err(anyhow::Error::from(error).context(format!("`{id}` is not deleted")).into());
                }
                Err(error) => kept.push(format!("`{id}` is not deleted: {error}")),
            }
        }
        if !deleted.is_empty() || self.json {
            self.show(&deleted.as_slice().into(), || lines(&deleted))?;
        }
        if kept.is_empty() { Ok(()) } else { Err(anyhow::anyhow!(kept.join("\nratn: ")).into()) }
    }

    /// An existing resource with other attributes is only changed on request.
    async fn not_there_otherwise(&self, create: &arguments::CreateArguments, wanted: &Resource) -> Result<(), Failure> {
        if create.id.is_empty() || create.update {
            return Ok(());
        }
        let there = match self.client.get(&create.id).await {
            Err(error) if error.code() == Some(tonic::Code::NotFound) => return Ok(()),
            there => there.context("not created")?,
        };
        if there.attributes == wanted.attributes && there.capacity == wanted.capacity && there.host == wanted.host {
            return Ok(());
        }
        let is = there.attributes.iter().map(|(name, value)| format!(", {name}={value}"));
        let message = format!(
            "not created: `{}` is there: capacity {}{}: `--update` replaces that",
            create.id,
            there.capacity,
            is.collect::<String>()
        );
        Err(anyhow::anyhow!(message).into())
    }

    /// A session, and a client in its name.
    async fn session(&self, what: &str, ttl: Duration) -> anyhow::Result<(Session, ResourceClient)> {
        let name = format!("ratn resource {what}");
        let session = Session::open(&self.channels, &self.endpoint, &name, ttl);
        if let Err(error) = session.alive(SESSION_DEADLINE).await {
            // The manager's answer to a plain request tells more than a timeout.
            self.client.list(&["-"]).await?;
            return Err(
                anyhow::Error::from(error).context("it opens no session: `block` and `consume` need the role `task`")
            );
        }
        let client = ResourceClient::new(&self.channels, &self.endpoint, session.id())?;
        Ok((session, client))
    }

    fn show(&self, json: &serde_json::Value, text: impl FnOnce() -> String) -> anyhow::Result<()> {
        if self.json { output::result(serde_json::to_string_pretty(json)?) } else { output::result(text()) }
    }
}

fn lines(ids: &[String]) -> String {
    ids.join("\n")
}

impl arguments::CreateArguments {
    fn resource(&self) -> Result<Resource, Failure> {
        Ok(Resource {
            attributes: arguments::attributes(&self.attributes)?,
            host: self.host.clone(),
            divisible: self.divisible,
            renewable: !self.non_renewable,
            ..Resource::new(&self.id, self.class, &self.kind).with_capacity(self.capacity)
        })
    }
}

impl Selector {
    fn requirement(&self, operation: ResourceOperation) -> Result<Requirement, Failure> {
        Ok(Requirement {
            class: self.class,
            attributes: arguments::attributes(&self.attributes)?,
            count: self.count,
            conditions: self.conditions.clone(),
            ..Requirement::new(operation, &self.kind)
        })
    }
}
