//! The command line of `ratn world`.

use clap::{Args, Subcommand, ValueEnum};
use ratn_model::fact::{FactKey, FactPattern};
use ratn_model::id::Revision;
use ratn_worker::client::{fact, pattern};
use ratn_worker::endpoint::Endpoint;
use std::path::PathBuf;

#[derive(Debug, Clone, Args)]
pub(crate) struct WorldArguments {
    #[command(subcommand)]
    pub(super) command: WorldCommand,
    /// Where endpoint files are; $RATN_RUNTIME_DIR, $XDG_RUNTIME_DIR/ratn or /tmp/ratn-UID unless given
    #[arg(long, value_name = "DIR", global = true)]
    pub(super) runtime_dir: Option<PathBuf>,
    /// Where the world pool is, instead: `unix:/path`, `https://host:port`
    #[arg(long, value_name = "ADDRESS", global = true)]
    pub(super) pool: Option<Endpoint>,
    /// Print JSON on standard output: one document, or with `watch` one a line
    #[arg(long, global = true)]
    pub(super) json: bool,
}

#[derive(Debug, Clone, Subcommand)]
pub(super) enum WorldCommand {
    /// Show the facts, who wrote them when, and what measured them
    Facts {
        /// Only those that match one of these, `at(box_1)`, `on(?, table)`
        #[arg(value_name = "PATTERN", value_parser = pattern)]
        patterns: Vec<FactPattern>,
        /// As they were at this revision
        #[arg(long, value_name = "REVISION")]
        at: Option<Revision>,
        /// As the `world` of a task file
        #[arg(long)]
        task: bool,
        /// Show them again whenever they change, until Ctrl-C
        #[arg(long, conflicts_with = "at")]
        watch: bool,
    },
    /// Answer a query, `at(?box) = ?pose, not in_gripper(?box)`
    Query {
        /// The conditions, as in a task file; with `--sparql` a SELECT or an ASK over what `dump --format turtle` writes
        #[arg(value_name = "QUERY")]
        query: String,
        /// The query is SPARQL; for a `ratn` that is built with the feature `sparql`
        #[arg(long)]
        sparql: bool,
        /// Of the root as it was at this revision
        #[arg(long, value_name = "REVISION")]
        at: Option<Revision>,
        /// Show at most so many answers
        #[arg(long, value_name = "N", default_value_t = 1_000)]
        limit: usize,
    },
    /// Show which facts differ between two revisions
    Diff {
        /// The one
        #[arg(value_name = "FROM")]
        from: Revision,
        /// The other; the root as it is unless given
        #[arg(value_name = "TO")]
        to: Option<Revision>,
        /// Only facts that match, `at(?)`; may be repeated
        #[arg(long = "only", value_name = "PATTERN", value_parser = pattern)]
        patterns: Vec<FactPattern>,
    },
    /// Show what one fact was, the newest first
    History {
        /// Which, `at(box_1)`
        #[arg(value_name = "FACT", value_parser = fact)]
        fact: FactKey,
    },
    /// Show the facts, then every revision
    Watch {
        /// Only of facts that match one of these
        #[arg(value_name = "PATTERN", value_parser = pattern)]
        patterns: Vec<FactPattern>,
        /// Every revision after this instead, without the facts
        #[arg(long, value_name = "REVISION")]
        after: Option<Revision>,
    },
    /// Write all facts to standard output, exactly
    Dump {
        /// JSON or Turtle
        #[arg(long, value_name = "FORMAT", default_value = "json")]
        format: Format,
        /// As they were at this revision
        #[arg(long, value_name = "REVISION")]
        at: Option<Revision>,
    },
    /// Commit the facts of a dump, all as one revision or none
    Load {
        /// What `dump` wrote; Turtle where its name ends in `.ttl`
        #[arg(value_name = "FILE")]
        file: PathBuf,
        /// Remove all other facts
        #[arg(long)]
        replace: bool,
    },
}

/// What a dump is written in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(super) enum Format {
    /// One document
    Json,
    /// RDF
    #[value(alias = "ttl")]
    Turtle,
}
