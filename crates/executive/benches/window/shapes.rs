//! The programs whose windows are measured. Every shape is a task with nested loops around a few nodes, whose window is as large as
//! its horizon says.

use ratn_model::catalogue::Catalogue;
use ratn_model::expression::{Expr, Function};
use ratn_model::id::StateId;
use ratn_model::program::{Annotations, Exceptions, Location, Nature, Program, SUCCESS, State, StateKind};
use ratn_model::value::{Type, Value};
use std::collections::BTreeMap;

/// One shape of window.
pub trait Shape {
    /// The largest window that is measured: a larger one takes minutes.
    const LARGEST: usize = 1_000_000;

    /// A task with this shape and horizon.
    fn program(horizon: usize) -> Program;
}

/// Each node reads the one before it.
pub struct Chain;
/// Nodes that read nothing: all run.
pub struct FanOut;
/// Each node reads four others.
pub struct RandomDag;
/// Pairs in a row.
pub struct NestedLoops;
/// One world read, one effect and one resource per node. The fact was written by an older node, a hundred nodes before.
pub struct World;
/// As [`World`], but no instance of the window writes the fact that is read.
pub struct WorldMiss;
/// PIAs that count, and between them readers of the count.
pub struct Counter;
/// Readers of a whole predicate over writers of ten different keys.
pub struct Wildcard;
/// Conditions on facts that nobody writes, between writers of others: decided when they are expanded.
pub struct Conditions;
/// Conditions on what the node before them writes: decided in order, so the speculation width bounds the window.
pub struct Decisions;
/// One resource per node.
pub struct Resources;

impl Shape for Chain {
    fn program(horizon: usize) -> Program {
        looped(horizon, &[vec![0]])
    }
}

impl Shape for FanOut {
    fn program(horizon: usize) -> Program {
        looped(horizon, &[vec![]])
    }
}

impl Shape for RandomDag {
    fn program(horizon: usize) -> Program {
        let reads = |i: usize| (0..4).map(|k| (i * 5 + k * 3 + 1) % 8).collect();
        looped(horizon, &(0..8).map(reads).collect::<Vec<Vec<usize>>>())
    }
}

impl Shape for NestedLoops {
    fn program(horizon: usize) -> Program {
        looped(horizon, &[vec![], vec![0]])
    }
}

impl Shape for World {
    const LARGEST: usize = 100_000;

    fn program(horizon: usize) -> Program {
        task(
            horizon,
            100,
            r#"
- s: { THINK_ON_WORLD, reads: [at($j)], effects: ["at($j) = $i"] }"#,
        )
    }
}

impl Shape for WorldMiss {
    const LARGEST: usize = 1_000;

    fn program(horizon: usize) -> Program {
        task(
            horizon,
            100,
            r#"
- s: { THINK_ON_WORLD, reads: [at(table)], effects: ["at($j) = $i"] }"#,
        )
    }
}

impl Shape for Counter {
    const LARGEST: usize = 20;

    fn program(horizon: usize) -> Program {
        task(
            horizon,
            100,
            r#"
- count: { action: arm/move, pia: true, reads: [], effects: ["n() = n() + 1"], resources: [{ block: Arm }] }
- read: { THINK_ON_WORLD, reads: [n()] }"#,
        )
    }
}

impl Shape for Wildcard {
    const LARGEST: usize = 1_000;

    fn program(horizon: usize) -> Program {
        task(
            horizon,
            100,
            r#"
- for: k in range(10)
  do:
    - write: { THINK, reads: [], effects: ["at($k) = $j"] }
- read: { THINK_ON_WORLD, reads: ["at(?)"] }"#,
        )
    }
}

impl Shape for Conditions {
    const LARGEST: usize = 10_000;

    fn program(horizon: usize) -> Program {
        task(
            horizon,
            100,
            r#"
- write: { THINK, reads: [], effects: ["at($j) = $i"] }
- look:
    condition: exists at(table)
    then:
      - yes_node: { THINK, reads: [] }
    else:
      - no_node: { THINK, reads: [] }"#,
        )
    }
}

impl Shape for Decisions {
    const LARGEST: usize = 1_000;

    fn program(horizon: usize) -> Program {
        task(
            horizon,
            100,
            r#"
- write: { THINK, reads: [], effects: ["at($j) = x"] }
- look:
    condition: exists at($j)
    then:
      - yes_node: { THINK, reads: [] }
    else:
      - no_node: { THINK, reads: [] }"#,
        )
    }
}

impl Shape for Resources {
    fn program(horizon: usize) -> Program {
        task(
            horizon,
            100,
            r#"
- s: { THINK_WITH_EYE, reads: [] }"#,
        )
    }
}

const CATALOGUE: &str = r#"
[resources]
Brain = { class = "process", count = 2 }
Eye = { class = "process", count = 2 }
Arm = { class = "module", count = 1, actuates = true }
WorldModel = { class = "world", count = 8 }

[providers.brain]
resource = "Brain"
actions.think = { optional = { a = "int", b = "int" }, outputs = { x = "int" } }

[providers.arm]
resource = "Arm"
actions.move = {}
"#;

/// Loops around a body: `$i` (10,000 rounds), `$h` (100) and `$j`, in which facts are counted through.
fn task(horizon: usize, facts: usize, body: &str) -> Program {
    let body = body.replace('\n', "\n              ");
    load(&format!(
        "task: bench
horizon: {horizon}
world: [\"n() = 0\", \"at(table) = 1\"]
states:
  - for: i in range(10000)
    do:
      - for: h in range(100)
        do:
          - for: j in range({facts})
            do:{body}
"
    ))
}

/// A PIA that writes one fact, `at(written)`, and readers of all facts about `at`.
pub fn watched(written: i64, readers: usize) -> Program {
    let reader = |number| format!("  - r{number}: {{ THINK_ON_WORLD, reads: [\"at(?)\"] }}\n");
    let readers: String = (0..readers).map(reader).collect();
    load(&format!(
        "task: bench
horizon: 1000
states:
  - move: {{ action: arm/move, pia: true, reads: [], effects: [\"at({written}) = 1\"], resources: [{{ block: Arm }}] }}
{readers}"
    ))
}

/// A PIA that writes `at(0)`, a reader of it, and a chain of readers of that one's output and of each other.
pub fn cascade(horizon: usize) -> Program {
    load(&format!(
        "task: bench
horizon: {horizon}
states:
  - move: {{ action: arm/move, pia: true, reads: [], effects: [\"at(0) = 1\"], resources: [{{ block: Arm }}] }}
  - first: {{ THINK_ON_WORLD, reads: [at(0)] }}
  - for: i in range(10000)
    do:
      - for: j in range(10000)
        do:
          - s: {{ THINK, reads: [], in: {{ a: first.x, b: t.x }} }}
          - t: {{ THINK, reads: [], in: {{ a: s.x }}, out: {{ x: {{ default: 0 }} }} }}
"
    ))
}

/// A million rounds of a node that reads and writes the world.
pub fn million() -> Program {
    load(
        "task: bench
horizon: 120
states:
  - for: i in range(1000)
    do:
      - for: j in range(1000)
        do:
          - s: { THINK_ON_WORLD, reads: [at($j)], effects: [\"at($j) = $i\"] }
",
    )
}

/// Nodes are written short: `THINK` only computes, `THINK_ON_WORLD` has room for a projection, `THINK_WITH_EYE` another resource.
fn load(text: &str) -> Program {
    let node = |resources| format!("action: brain/think, computes: true, resources: [{{ block: Brain }}{resources}]");
    let text = text
        .replace("THINK_ON_WORLD", &node(", world_model"))
        .replace("THINK_WITH_EYE", &node(", { block: Eye }"))
        .replace("THINK", &node(""));
    let catalogue = Catalogue::from_toml(CATALOGUE).unwrap();
    let loaded = ratn_model::load::load(&text, "bench.yaml", &catalogue).unwrap_or_else(|problems| {
        panic!("{}", problems.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n"))
    });
    let mut program = loaded.program;
    // The loader wants a provider to be blocked. Here that is one event more, which most shapes do without.
    for state in &mut program.states {
        state.annotations.resources.retain(|resource| resource.kind != "Brain");
    }
    program
}

fn state(id: usize, name: &str, path: &str, parent: Option<u64>, kind: StateKind) -> State {
    State {
        id: StateId(id as u64),
        name: name.to_owned(),
        path: path.to_owned(),
        parent: parent.map(StateId),
        kind,
        outcomes: Vec::new(),
        transitions: BTreeMap::new(),
        variables: Vec::new(),
        assign: Vec::new(),
        defaults: BTreeMap::from([("x".to_owned(), Value::Int(0))]),
        annotations: Annotations::default(),
        location: Location::default(),
    }
}

fn action(id: usize, parent: u64, prefix: &str, reads: &[usize]) -> State {
    let inputs = reads.iter().enumerate().map(|(number, from)| {
        (format!("in{number}"), Expr::Port { state: StateId(*from as u64), port: "x".to_owned() })
    });
    let kind = StateKind::Action {
        provider: "brain".to_owned(),
        action: "think".to_owned(),
        inputs: inputs.collect(),
        outputs: BTreeMap::from([("x".to_owned(), Type::Int)]),
    };
    let name = format!("s{id}");
    let mut state = state(id, &name, &format!("{prefix}{name}"), Some(parent), kind);
    state.annotations = Annotations {
        nature: Nature::Computes,
        reads: Some(Vec::new()),
        effects: BTreeMap::from([(SUCCESS.to_owned(), Vec::new())]),
        ..Annotations::default()
    };
    state
}

fn program(states: Vec<State>, horizon: usize) -> Program {
    Program {
        name: "bench".to_owned(),
        horizon,
        speculation_width: Program::DEFAULT_SPECULATION_WIDTH,
        deadline_s: None,
        exceptions: Exceptions::Precise,
        parameters: Vec::new(),
        outputs: Vec::new(),
        initial: Vec::new(),
        tolerances: Default::default(),
        ontology: None,
        kinds: Default::default(),
        states,
        digest: String::new(),
    }
}

/// Two nested loops around nodes, each of which reads the latest outputs of the given others.
fn looped(horizon: usize, reads: &[Vec<usize>]) -> Program {
    let range = |n: i64| Expr::Call(Function::Range, vec![Expr::Literal(Value::Int(n))]);
    let for_each = |variable: &str, n: i64, body: Vec<StateId>| StateKind::ForEach {
        variable: variable.to_owned(),
        index: None,
        collection: range(n),
        body,
        outputs: Vec::new(),
    };
    let first = 3;
    let body: Vec<StateId> = (first..first + reads.len()).map(|id| StateId(id as u64)).collect();
    let children = vec![StateId(1)];
    let mut states = vec![
        state(0, "bench", "", None, StateKind::Sequence { children, outputs: Vec::new() }),
        state(1, "outer", "outer", Some(0), for_each("i", 10_000, vec![StateId(2)])),
        state(2, "inner", "outer/inner", Some(1), for_each("j", 10_000, body)),
    ];
    for (number, from) in reads.iter().enumerate() {
        let from: Vec<usize> = from.iter().map(|other| first + other).collect();
        states.push(action(first + number, 2, "outer/inner/", &from));
    }
    program(states, horizon)
}

/// One long list of nodes, each of which reads what the one before it has put out.
pub fn flat(count: usize) -> Program {
    let children = (1..=count).map(|id| StateId(id as u64)).collect();
    let mut states = vec![state(0, "bench", "", None, StateKind::Sequence { children, outputs: Vec::new() })];
    for id in 1..=count {
        let reads: Vec<usize> = if id > 1 { vec![id - 1] } else { Vec::new() };
        states.push(action(id, 0, "", &reads));
    }
    program(states, count)
}
