//! `ratn world …`: the root world model for people and scripts.
//!
//! Queries are answered here, over the facts that the pool sends: they cost the pool only a view. The output is a table, or one JSON
//! document each, in which values are exact. A dump contains all facts exactly, in JSON or in Turtle; loading one is one commit.

mod arguments;
mod dump;
mod show;
#[cfg(feature = "sparql")]
mod sparql;
mod task_text;
mod turtle;

pub(crate) use arguments::WorldArguments;

use super::{blocking_on, unanswered};
use crate::failure::Failure;
use crate::output;
use crate::repainting::{self, json_text};
use crate::system::public_directory;
use anyhow::Context;
use arguments::{Format, WorldCommand};
use ratn_model::fact::{Change, FactPattern};
use ratn_model::id::Revision;
use ratn_model::load::suggestion;
use ratn_proto::MAX_MESSAGE_BYTES;
use ratn_proto::types::{FactRecord, WorldUpdate};
use ratn_worker::client::{CallError, Channels, Commit, WorldClient, fresh_id};
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::tls::ClientTls;
use ratn_worker::trace::{self, TraceContext};
use ratn_world::query::Query;
use ratn_world::world::World;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

const ROLE: &str = ratn_daemon::world_pool::ROLE;
/// Maximum size of a dump; JSON is longer than the message that it becomes.
const MAX_DUMP: usize = 8 * MAX_MESSAGE_BYTES;
/// The writer of loaded facts.
const WRITER: &str = "ratn world load";

/// Why `--sparql` is refused by a `ratn` that was built without it.
#[cfg(not(feature = "sparql"))]
const NO_SPARQL: &str = "ratn: --sparql: this ratn was built without the feature `sparql`. Build it with \
    `cargo install --path crates/cli --features sparql`, or ask with the conditions of task files: \
    `ratn world query 'at(?box) = ?pose'`";

/// The client of the world pool, and the output format.
struct Asking {
    client: WorldClient,
    json: bool,
}

/// Performs an operation.
pub(super) fn run(arguments: &WorldArguments, tls: &ClientTls) -> Result<(), Failure> {
    #[cfg(not(feature = "sparql"))]
    if matches!(arguments.command, WorldCommand::Query { sparql: true, .. }) {
        return Err(Failure::Refused(NO_SPARQL.to_owned()));
    }
    blocking_on(tokio::runtime::Builder::new_current_thread(), async {
        let endpoint = match &arguments.pool {
            Some(endpoint) => endpoint.clone(),
            None => RuntimeDirectory::at(public_directory(arguments.runtime_dir.as_deref())?)
                .find(ROLE)
                .map_err(|error| Failure::Refused(format!("ratn: {error}")))?,
        };
        let client = WorldClient::new(&Channels::new(tls), &endpoint)?;
        let asking = Asking { client, json: arguments.json };
        let performed = trace::within(TraceContext::fresh(), asking.perform(&arguments.command)).await;
        performed.map_err(unanswered)
    })
}

/// Reports predicates without any facts: an empty answer may come from a typing error.
fn unheard_of<'a>(asked: impl Iterator<Item = &'a str>, facts: &[FactRecord]) {
    let known: BTreeSet<&str> = facts.iter().map(|fact| fact.key.predicate.as_str()).collect();
    for predicate in asked.filter(|predicate| !known.contains(predicate)).collect::<BTreeSet<_>>() {
        let help = suggestion(predicate, known.iter().copied(), "", "`ratn world facts` shows what there is");
        output::progress(format_args!("no fact of this world is about `{predicate}`: {help}"));
    }
}

impl Asking {
    async fn perform(&self, command: &WorldCommand) -> Result<(), Failure> {
        let client = &self.client;
        match command {
            WorldCommand::Facts { patterns, task, watch: true, .. } => {
                let look = async || {
                    let (revision, facts) = client.root_at(None, patterns).await?;
                    Ok::<String, Failure>(match (self.json, task) {
                        (true, _) => json_text(&dump::json(revision, &facts), true)?,
                        (false, true) => task_text::world(&facts),
                        (false, false) => show::facts(&facts),
                    })
                };
                repainting::repeat(true, self.json, look).await?;
            }
            WorldCommand::Facts { patterns, at, task, watch: false } => {
                let (revision, facts) = client.root_at(*at, patterns).await?;
                let text = || if *task { task_text::world(&facts) } else { show::facts(&facts) };
                self.show(&dump::json(revision, &facts), text)?;
                if facts.is_empty() && !patterns.is_empty() {
                    let (_, all) = client.root_at(*at, &[]).await?;
                    unheard_of(patterns.iter().map(|pattern| pattern.predicate.as_str()), &all);
                }
            }
            #[cfg(feature = "sparql")]
            WorldCommand::Query { query, sparql: true, at, limit } => {
                self.sparql(query, *at, *limit).await?;
            }
            WorldCommand::Query { query, at, limit, .. } => {
                self.query(query, *at, *limit).await?;
            }
            WorldCommand::Diff { from, to, patterns } => {
                let (differences, to) = client.diff(*from, *to, patterns).await?;
                let json = show::differences_json(*from, to, &differences);
                self.show(&json, || show::differences(&differences))?;
            }
            WorldCommand::History { fact } => {
                let (versions, oldest) = client.history(fact.clone()).await?;
                let json = show::versions_json(oldest, &versions);
                self.show(&json, || show::versions(fact, oldest, &versions))?;
            }
            WorldCommand::Watch { patterns, after } => self.watch(patterns, *after).await?,
            WorldCommand::Dump { format, at } => {
                let (revision, facts) = client.root_at(*at, &[]).await?;
                output::result(match format {
                    Format::Json => serde_json::to_string_pretty(&dump::json(revision, &facts)).context("the facts")?,
                    Format::Turtle => turtle::write(&facts)?.trim_end().to_owned(),
                })?;
            }
            WorldCommand::Load { file, replace } => self.load(file, *replace).await?,
        }
        Ok(())
    }

    async fn query(&self, text: &str, at: Option<Revision>, limit: usize) -> Result<(), Failure> {
        let refused = |error| Failure::Refused(format!("ratn: {error}"));
        let asked = Query::parse(text).map_err(refused)?;
        let query = asked.prepare(None).map_err(refused)?;
        let (revision, facts) = self.client.root_at(at, &[]).await?;
        unheard_of(asked.predicates().into_iter(), &facts);
        let world = World::from_facts(facts.into_iter().map(|fact| (fact.key, fact.value)), revision);
        let rows = query.run(&world, &BTreeMap::new(), limit).map_err(refused)?;
        Ok(self.show(&show::rows_json(revision, &rows), || show::rows(&rows))?)
    }

    #[cfg(feature = "sparql")]
    async fn sparql(&self, text: &str, at: Option<Revision>, limit: usize) -> Result<(), Failure> {
        let (revision, facts) = self.client.root_at(at, &[]).await?;
        let answer = sparql::answer(text, &facts, limit);
        let answer = answer.map_err(|error| Failure::Refused(format!("ratn: {error:#}")))?;
        Ok(self.show(&sparql::json(revision, &answer), || sparql::table(&answer))?)
    }

    async fn load(&self, file: &Path, replace: bool) -> Result<(), Failure> {
        let name = file.display();
        let refused = |error: &dyn std::fmt::Display| Failure::Refused(format!("ratn: {name}: {error}"));
        let text = ratn_regular_file::read_text(file, MAX_DUMP).map_err(|error| refused(&error))?;
        let is_turtle = file.extension().is_some_and(|extension| extension == "ttl");
        let read = if is_turtle { turtle::read(&text) } else { dump::read(&text) };
        let facts = read.map_err(|error| refused(&format!("{error:#}")))?;
        let (mut changes, mut revision) = (Vec::new(), None);
        if replace {
            // Refused where another client commits in between: its facts would be deleted unnoticed.
            let (root, before) = self.client.root_at(None, &[]).await?;
            revision = Some(Revision(root.0 + 1));
            let every = |fact: FactRecord| FactPattern {
                arguments: fact.key.arguments.iter().map(|_| None).collect(),
                predicate: fact.key.predicate,
            };
            let every: BTreeSet<FactPattern> = before.into_iter().map(every).collect();
            changes.extend(every.into_iter().map(|pattern| Change::Delete { pattern }));
        }
        let count = facts.len();
        let measured = facts.iter().filter_map(|fact| Some((fact.key.clone(), fact.measured.as_deref()?.clone())));
        let evidence = measured.collect();
        changes.extend(facts.into_iter().map(|fact| Change::Set { fact: fact.key, value: fact.value }));
        let commit = Commit { id: fresh_id("load"), changes, revision, writer: WRITER.to_owned(), evidence };
        let (revision, _) = self.client.commit_as(commit).await.with_context(|| format!("{name} is not loaded"))?;
        let json = serde_json::json!({ "revision": revision.0, "facts": count });
        Ok(self.show(&json, || format!("{count} facts, revision {}", revision.0))?)
    }

    /// Runs until the reader closes, or the pool ends.
    async fn watch(&self, patterns: &[FactPattern], after: Option<Revision>) -> anyhow::Result<()> {
        let mut watch = self.client.watch(after, patterns).await?;
        let mut ended: Result<(), CallError> = Ok(());
        loop {
            let update = match watch.next().await {
                Ok(Some(update)) => update,
                Ok(None) => break,
                Err(error) => {
                    ended = Err(error);
                    break;
                }
            };
            let shown = match (&update, self.json) {
                (update, true) => output::line(show::update_json(update))?,
                (WorldUpdate::Snapshot { facts, .. }, false) => output::line(show::facts(facts))?,
                (WorldUpdate::Changed(change), false) => output::line(show::change(change))?,
            };
            if !shown {
                return Ok(());
            }
        }
        ended.context("the watch ended")?;
        anyhow::bail!("the world pool ended the watch")
    }

    fn show(&self, json: &serde_json::Value, text: impl FnOnce() -> String) -> anyhow::Result<()> {
        if self.json { output::result(serde_json::to_string_pretty(json)?) } else { output::result(text()) }
    }
}
