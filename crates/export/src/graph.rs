//! Graphs for Graphviz and Mermaid: the network of instances, each with what it waited for, or the hierarchy of states.
//!
//! The network is written line by line. In Graphviz's language a cluster can be continued later, so the graph shows the hierarchy; in
//! Mermaid's language it cannot, and the paths show it. The task graph is written at the end: it has as many nodes as the task has states.

use super::Writer;
use ratn_event_log::without_visits;
use ratn_executive::protocol::{Command, LogEntry, LogLine};
use ratn_model::id::InstanceId;
use ratn_model::readable::readable;
use ratn_report::timeline::{Activity, Cause, Changed, Instance, Timeline};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::io::{self, Write};

/// The language of the graph.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Language {
    /// Graphviz's language, DOT.
    Dot,
    /// Mermaid's language.
    Mermaid,
}

/// Why an instance waited for another one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Bond {
    /// It began when the other one had a result.
    Result,
    /// Its projection shows an effect of the other one.
    World,
    /// The other one held a resource that it wanted.
    Resource,
}

impl Bond {
    fn name(self) -> &'static str {
        match self {
            Bond::Result => "result",
            Bond::World => "world",
            Bond::Resource => "resource",
        }
    }

    fn colour(self) -> &'static str {
        match self {
            Bond::Result => "#1c2430",
            Bond::World => "#2f7d32",
            Bond::Resource => "#c3362b",
        }
    }
}

/// A node, for both languages.
struct Node {
    name: String,
    label: String,
    fill: &'static str,
    is_dashed: bool,
    is_faded: bool,
}

pub(crate) fn writer<'w, W: Write + 'w>(out: W, language: Language, drawing: super::Drawing) -> Box<dyn Writer + 'w> {
    match drawing {
        super::Drawing::Network => Box::new(Network { out, language, has_begun: false, edges: BTreeSet::new() }),
        super::Drawing::Task => Box::new(Task { out, language, states: BTreeMap::new(), edges: BTreeMap::new() }),
    }
}

struct Network<W> {
    out: W,
    language: Language,
    has_begun: bool,
    /// Edges that were written and could occur again.
    edges: BTreeSet<(InstanceId, InstanceId, Bond)>,
}

impl<W: Write> Network<W> {
    fn edge(&mut self, from: InstanceId, to: InstanceId, bond: Bond) -> io::Result<()> {
        if from == to || !self.edges.insert((to, from, bond)) {
            return Ok(());
        }
        let label = bond.name();
        writeln!(self.out, "{}", edge(self.language, &format!("i{}", from.0), &format!("i{}", to.0), bond, label))
    }

    fn nodes(&mut self, left: &[Instance]) -> io::Result<()> {
        for one in left {
            for wait in &one.waits {
                let last = wait.behind.iter().filter(|behind| behind.released).max_by(|a, b| a.to_s.total_cmp(&b.to_s));
                if let Some(behind) = last {
                    self.edge(behind.instance, one.id, Bond::Resource)?;
                }
            }
            for phase in one.awaited() {
                if let Cause::Result(of, _) = &phase.ended_by {
                    self.edge(*of, one.id, Bond::Result)?;
                }
            }
            let took = one.jobs.iter().map(|job| job.length_s()).fold(0.0, |all, one| all + one);
            let node = Node {
                name: format!("i{}", one.id.0),
                label: if one.jobs.is_empty() {
                    last_name(&one.path).to_owned()
                } else {
                    format!("{}\n{took:.1} s", last_name(&one.path))
                },
                fill: one.jobs.last().map_or("#eceff3", |job| fill(job.activity)),
                is_dashed: one.speculative,
                is_faded: one.squashed,
            };
            writeln!(self.out, "{}", placed(self.language, &one.path, &node))?;
            // There is no more news about this instance: its edges cannot occur again.
            let of_it: Vec<_> = self
                .edges
                .range((one.id, InstanceId(0), Bond::Result)..(InstanceId(one.id.0 + 1), InstanceId(0), Bond::Result))
                .copied()
                .collect();
            of_it.iter().for_each(|edge| _ = self.edges.remove(edge));
        }
        Ok(())
    }

    fn begin(&mut self, run: &Timeline) -> io::Result<()> {
        if !std::mem::replace(&mut self.has_begun, true) {
            writeln!(self.out, "{}", head(self.language, &run.task))?;
        }
        Ok(())
    }
}

impl<W: Write> Writer for Network<W> {
    fn line(&mut self, line: &LogLine, run: &Timeline, changed: &Changed) -> io::Result<()> {
        self.begin(run)?;
        if let LogEntry::Command(Command::Project { instance, writers, .. }) = &line.entry {
            for path in writers {
                let writer = run.instances().rfind(|one| one.id < *instance && one.path == *path).map(|one| one.id);
                if let Some(writer) = writer {
                    self.edge(writer, *instance, Bond::World)?;
                }
            }
        }
        self.nodes(&changed.left)
    }

    fn end(&mut self, run: &Timeline, changed: &Changed) -> io::Result<()> {
        self.begin(run)?;
        self.nodes(&changed.left)?;
        tail(&mut self.out, self.language)
    }
}

struct Task<W> {
    out: W,
    language: Language,
    states: BTreeMap<String, Visits>,
    edges: BTreeMap<(String, String, Bond), usize>,
}

/// The visits of one state.
#[derive(Default)]
struct Visits {
    all: usize,
    squashed: usize,
    took_s: f64,
    activity: Option<Activity>,
}

impl<W: Write> Task<W> {
    fn add(&mut self, left: &[Instance]) {
        for one in left {
            let state = without_visits(&one.path);
            for phase in one.awaited() {
                if let Cause::Result(of, path) = &phase.ended_by
                    && *of != one.id
                {
                    *self.edges.entry((without_visits(path), state.clone(), Bond::Result)).or_default() += 1;
                }
            }
            for behind in one.waits.iter().flat_map(|wait| &wait.behind).filter(|behind| behind.released) {
                *self.edges.entry((without_visits(&behind.holder), state.clone(), Bond::Resource)).or_default() += 1;
            }
            for writer in &one.writers {
                *self.edges.entry((without_visits(writer), state.clone(), Bond::World)).or_default() += 1;
            }
            let visits = self.states.entry(state).or_default();
            visits.all += 1;
            visits.squashed += usize::from(one.squashed);
            visits.took_s += one.jobs.iter().map(|job| job.length_s()).fold(0.0, |all, one| all + one);
            visits.activity = visits.activity.or(one.jobs.last().map(|job| job.activity));
        }
    }
}

impl<W: Write> Writer for Task<W> {
    fn line(&mut self, _: &LogLine, _: &Timeline, changed: &Changed) -> io::Result<()> {
        self.add(&changed.left);
        Ok(())
    }

    fn end(&mut self, run: &Timeline, changed: &Changed) -> io::Result<()> {
        self.add(&changed.left);
        writeln!(self.out, "{}", head(self.language, &run.task))?;
        let numbers: BTreeMap<&str, usize> = self.states.keys().map(String::as_str).zip(1..).collect();
        for (state, visits) in &self.states {
            let times = if visits.all == 1 { String::new() } else { format!(" × {}", visits.all) };
            let took = if visits.activity.is_some() { format!("\n{:.1} s", visits.took_s) } else { String::new() };
            let node = Node {
                name: format!("s{}", numbers[state.as_str()]),
                label: format!("{}{times}{took}", last_name(state)),
                fill: visits.activity.map_or("#eceff3", fill),
                is_dashed: visits.squashed > 0,
                is_faded: visits.squashed == visits.all,
            };
            writeln!(self.out, "{}", placed(self.language, state, &node))?;
        }
        for ((from, to, bond), times) in &self.edges {
            // The state that wrote may not occur in the log.
            if let (Some(from), Some(to)) = (numbers.get(from.as_str()), numbers.get(to.as_str())) {
                let label = if *times == 1 { bond.name().to_owned() } else { format!("{} × {times}", bond.name()) };
                writeln!(self.out, "{}", edge(self.language, &format!("s{from}"), &format!("s{to}"), *bond, &label))?;
            }
        }
        tail(&mut self.out, self.language)
    }
}

fn fill(activity: Activity) -> &'static str {
    match activity {
        Activity::Motion => "#b3d0f2",
        Activity::Detection => "#b4e0bb",
        Activity::Other => "#ddd0ef",
        Activity::Planning => "#fad79c",
    }
}

fn last_name(path: &str) -> &str {
    path.rsplit('/').next().unwrap_or(path)
}

fn head(language: Language, task: &str) -> String {
    match language {
        Language::Dot => format!(
            "digraph {} {{\n  rankdir=LR; compound=true; node [shape=box, style=\"rounded,filled\", fontname=\"sans-serif\"];",
            dot_text(task)
        ),
        Language::Mermaid => "flowchart LR".to_owned(),
    }
}

fn tail(out: &mut impl Write, language: Language) -> io::Result<()> {
    match language {
        Language::Dot => writeln!(out, "}}"),
        Language::Mermaid => Ok(()),
    }
}

/// A node; in Graphviz's language, within the clusters of its path.
fn placed(language: Language, path: &str, node: &Node) -> String {
    if language == Language::Mermaid {
        let label = format!("{}\n{}", path, node.label.split_once('\n').map_or("", |(_, rest)| rest));
        let mut style = format!("fill:{}", node.fill);
        style.push_str(if node.is_dashed { ",stroke-dasharray:4 3" } else { "" });
        style.push_str(if node.is_faded { ",opacity:0.4" } else { "" });
        return format!("  {name}[\"{}\"]\n  style {name} {style}", mermaid_text(label.trim_end()), name = node.name);
    }
    let style = if node.is_dashed { "rounded,filled,dashed" } else { "rounded,filled" };
    let colours = if node.is_faded { ", fontcolor=\"#8a93a3\", color=\"#b8bfca\"" } else { "" };
    let (mut clusters, mut cluster, mut depth) = ("  ".to_owned(), FNV_BASIS, 0);
    for parent in path.rsplit_once('/').into_iter().flat_map(|(parents, _)| parents.split('/')) {
        cluster =
            parent.bytes().chain([b'/']).fold(cluster, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(FNV_PRIME));
        depth += 1;
        _ = write!(clusters, "subgraph cluster_{cluster:016x} {{ label={}; ", dot_text(parent));
    }
    format!(
        "{clusters}{} [label={}, fillcolor=\"{}\", style=\"{style}\"{colours}];{}",
        node.name,
        dot_text(&node.label),
        node.fill,
        " }".repeat(depth)
    )
}

/// The id of a cluster is a hash of its path (FNV-1a): writing the paths themselves would take the square of their depth.
const FNV_BASIS: u64 = 0xcbf2_9ce4_8422_2325;
const FNV_PRIME: u64 = 0x0100_0000_01b3;

fn edge(language: Language, from: &str, to: &str, bond: Bond, label: &str) -> String {
    match (language, bond) {
        (Language::Dot, _) => {
            let style = if bond == Bond::Result { "solid" } else { "dashed" };
            format!(
                "  {from} -> {to} [color=\"{}\", style={style}, tooltip={}, label={}];",
                bond.colour(),
                dot_text(label),
                dot_text(if bond == Bond::Result { "" } else { label })
            )
        }
        (Language::Mermaid, Bond::Result) => format!("  {from} --> {to}"),
        (Language::Mermaid, _) => format!("  {from} -. \"{}\" .-> {to}", mermaid_text(label)),
    }
}

/// A quoted string in Graphviz's language. Only the quote and the backslash are special there.
fn dot_text(text: &str) -> String {
    format!("\"{}\"", readable(text).replace('\\', "\\\\").replace('"', "\\\"").replace('\n', "\\n"))
}

/// A quoted text in Mermaid: characters that are special there or in HTML, as numeric entities.
fn mermaid_text(text: &str) -> String {
    let mut out = String::new();
    for c in readable(text).chars() {
        match c {
            '\n' => out.push_str("<br/>"),
            '"' | '#' | '<' | '>' | '&' | ';' | '`' => _ = write!(out, "#{};", u32::from(c)),
            c => out.push(c),
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_users_do_nothing_in_a_graph() {
        assert_eq!(dot_text("a\"];b -> c\\"), r#""a\"];b -> c\\""#);
        assert_eq!(mermaid_text("a\"]\n<script>"), "a#34;]<br/>#60;script#62;");
        assert_eq!(dot_text("\u{1b}[2J\u{202e}"), r#""\\u{1b}[2J\\u{202e}""#);
        assert_eq!(mermaid_text("\u{1b}[2J\u{202e}"), r"\u{1b}[2J\u{202e}");
    }

    #[test]
    fn a_deep_path_takes_room_for_each_of_its_names_once() {
        let node =
            Node { name: "n".to_owned(), label: "n".to_owned(), fill: "#eee", is_dashed: false, is_faded: false };
        let drawn = |depth: usize| placed(Language::Dot, &vec!["a"; depth].join("/"), &node);
        assert!(drawn(20_000).len() < 20_000 * 60);
        // Nodes in the same state are in the same cluster, and only those.
        let (one, other) = (placed(Language::Dot, "a/b/x", &node), placed(Language::Dot, "a/c/x", &node));
        let clusters = |text: &str| {
            text.split(' ').filter(|word| word.starts_with("cluster_")).map(str::to_owned).collect::<Vec<_>>()
        };
        let (one, other) = (clusters(&one), clusters(&other));
        assert!(one.len() == 2 && one[0] == other[0] && one[1] != other[1], "{one:?} {other:?}");
        assert_ne!(
            clusters(&placed(Language::Dot, "ab/x", &node)),
            clusters(&placed(Language::Dot, "a/b/x", &node))[1..]
        );
    }
}
