//! `ratn actions [PROVIDER[/ACTION]]`: the actions that tasks can use, with ports, types, defaults and outcomes, and the origin of
//! each.

use super::blocking_here;
use crate::columns::columns;
use crate::failure::Failure;
use crate::output;
use crate::system::config::SystemConfig;
use crate::system::workers::Offered;
use crate::system::{System, catalogue, public_directory};
use clap::Args;
use ratn_model::catalogue::{ActionSignature, Catalogue, Provider};
use ratn_model::value::Type;
use ratn_worker::tls::ClientTls;
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::PathBuf;

#[derive(Debug, Clone, Args)]
pub(crate) struct ActionsArguments {
    /// Only those of this provider, `arm`, or this action with all that is known of it, `arm/follow`
    #[arg(value_name = "PROVIDER[/ACTION]")]
    which: Option<String>,
    /// The system's config; without it the one that runs in the runtime directory, else the built-in default
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// A catalogue that extends the config's; may be repeated
    #[arg(long, value_name = "FILE")]
    catalogue: Vec<PathBuf>,
    /// Where a running system's endpoint files are, whose workers are asked
    #[arg(long, value_name = "DIR")]
    runtime_dir: Option<PathBuf>,
    /// Print one JSON array on standard output
    #[arg(long)]
    json: bool,
}

/// An action in the list.
#[derive(Debug, Clone, PartialEq, Serialize)]
struct Listed {
    /// `provider/action`.
    action: String,
    /// The kind of resource that a state blocks for it.
    resource: String,
    /// Origin: `built in`, a file, or a worker.
    from: String,
    #[serde(flatten)]
    signature: ActionSignature,
}

/// Lists the actions.
pub(crate) fn run(arguments: &ActionsArguments, tls: &ClientTls) -> Result<(), Failure> {
    let mut all = listed(arguments, tls)?;
    if let Some(which) = arguments.which.as_deref() {
        let known: Vec<String> = all.iter().map(|one| one.action.clone()).collect();
        let of_provider = format!("{which}/");
        all.retain(|one| one.action == which || one.action.starts_with(&of_provider));
        if all.is_empty() {
            let known = known.join(", ");
            return Err(Failure::Refused(format!(
                "ratn: there is no action and no provider `{which}`; there are: {known}"
            )));
        }
    }
    if arguments.json {
        return Ok(output::result(serde_json::to_string_pretty(&all)?)?);
    }
    match all.as_slice() {
        [one] => output::result(one.whole())?,
        many => output::result(table(many))?,
    }
    Ok(())
}

fn listed(arguments: &ActionsArguments, tls: &ClientTls) -> Result<Vec<Listed>, Failure> {
    let given = arguments.config.as_deref().map(|file| SystemConfig::load(Some(file))).transpose()?;
    let tls = &given.as_ref().map_or_else(|| Ok(tls.clone()), |config| config.client_tls(tls))?;
    let mut system = None;
    if given.is_none() || arguments.runtime_dir.is_some() {
        let directory = public_directory(arguments.runtime_dir.as_deref())?;
        blocking_here(async {
            system = Box::pin(System::find(&directory, given.clone(), tls)).await?;
            Ok(())
        })?;
        if system.is_none() && arguments.runtime_dir.is_some() {
            return Err(Failure::Refused(format!("ratn: no system runs in {}", directory.display())));
        }
    }
    let (mut catalogue, offered) = match system {
        Some(system) => (system.config.catalogue, system.offered),
        None => (given.map_or_else(|| SystemConfig::load(None), Ok)?.catalogue, Offered::default()),
    };
    let mut files = BTreeMap::new();
    for file in &arguments.catalogue {
        let said = catalogue::read(file).map_err(|error| Failure::Refused(format!("ratn: {error:#}")))?;
        for (provider, action) in said.providers.iter().flat_map(|(name, p)| p.actions.keys().map(move |a| (name, a))) {
            files.insert(format!("{provider}/{action}"), file.display().to_string());
        }
        catalogue::extend(&mut catalogue, said);
    }
    let standard = Catalogue::standard();
    let from = |name: &str, provider: &str, action: &str, signature: &ActionSignature| {
        if let Some(file) = files.get(name) {
            return file.clone();
        }
        if standard.action(provider, action) == Some(signature) {
            return catalogue::BUILT_IN.replace('-', " ");
        }
        let says = offered.workers.iter().find(|worker| {
            let said = worker.description.as_ref().ok().filter(|said| said.provider == provider);
            said.is_some_and(|said| said.actions.get(action).is_some_and(|said| said.as_ref() == Some(signature)))
        });
        says.map_or_else(|| "config".to_owned(), |worker| format!("worker {}", worker.id))
    };
    let of_provider = |(provider, known): (&String, &Provider)| -> Vec<Listed> {
        let listed = |(action, signature): (&String, &ActionSignature)| {
            let name = format!("{provider}/{action}");
            let from = from(&name, provider, action, signature);
            Listed { action: name, resource: known.resource.clone(), from, signature: signature.clone() }
        };
        known.actions.iter().map(listed).collect()
    };
    Ok(catalogue.providers.iter().flat_map(of_provider).collect())
}

impl Listed {
    /// The inputs: `{ start: joints, speed?: float = 1 }`.
    fn inputs(&self) -> String {
        let ActionSignature { inputs, optional, defaults, .. } = &self.signature;
        let required = inputs.iter().map(|(name, of_type)| format!("{name}: {of_type}"));
        let optional = optional.iter().map(|(name, of_type)| {
            let default = defaults.get(name).map(|value| format!(" = {value}")).unwrap_or_default();
            format!("{name}?: {of_type}{default}")
        });
        required.chain(optional).collect::<Vec<_>>().join(", ")
    }

    /// Everything that is known about the action.
    fn whole(&self) -> String {
        let ActionSignature { outputs, outcomes, description, annotations, .. } = &self.signature;
        let mut lines = vec![format!("{} ({}; a state that uses it blocks {})", self.action, self.from, self.resource)];
        let mut line = |head: &str, text: String| {
            if !text.is_empty() {
                lines.push(format!("  {head:<9} {text}"));
            }
        };
        line("does", description.clone());
        line("in", self.inputs());
        line("out", ports(outputs));
        line(
            "outcomes",
            ["success"].into_iter().chain(outcomes.iter().map(String::as_str)).collect::<Vec<_>>().join(", "),
        );
        line("computes", if annotations.computes { "true".to_owned() } else { String::new() });
        annotations.lists().into_iter().for_each(|(key, list)| line(key, list.join("; ")));
        for (input, said) in &annotations.given {
            line("given", format!("`{input}`:"));
            said.lists().into_iter().for_each(|(key, list)| line(key, list.join("; ")));
        }
        lines.join("\n")
    }
}

fn ports(ports: &BTreeMap<String, Type>) -> String {
    ports.iter().map(|(name, of_type)| format!("{name}: {of_type}")).collect::<Vec<_>>().join(", ")
}

fn table(all: &[Listed]) -> String {
    let row = |one: &Listed| {
        let outcomes = one.signature.outcomes.join(", ");
        let required = ports(&one.signature.inputs);
        let optional = match one.signature.optional.len() {
            0 => String::new(),
            n => format!(" (+{n} optional)"),
        };
        let or_dash = |text: String| if text.is_empty() { "-".to_owned() } else { text };
        [
            one.action.clone(),
            one.resource.clone(),
            one.from.clone(),
            or_dash(outcomes),
            or_dash(format!("{required}{optional}").trim_start().to_owned()),
            or_dash(ports(&one.signature.outputs)),
        ]
    };
    let rows = all.iter().map(row).collect();
    format!(
        "{}\n`ratn actions PROVIDER/ACTION` shows one with all its ports",
        columns(&["ACTION", "BLOCKS", "FROM", "OUTCOMES", "IN", "OUT"], rows)
    )
}
