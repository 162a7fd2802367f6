//! Same task, same world: random programs in both modes end alike, and in CDTN mode every irreversible action starts in the
//! order, and with the inputs, of HSM mode.

#![allow(clippy::unwrap_used, clippy::print_stderr, reason = "a test may panic and print its seed")]

use ratn_executive::protocol::{Command, LogEntry, Mode, Note};
use ratn_model::id::InstanceId;
use ratn_model::program::{Nature, Program, State, StateKind};
use ratn_model::resource::ResourceClass;
use ratn_simulation::random::{HashOracle, RESOURCES, program};
use ratn_simulation::run::{Run, Setup, run};
use ratn_world::tolerance::Tolerance;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

fn execute(program: &Arc<Program>, seed: u64, mode: Mode, failures_percent: u64) -> Result<Run, String> {
    let setup = Setup {
        program: program.clone(),
        mode,
        parameters: BTreeMap::new(),
        seed,
        resources: RESOURCES.iter().map(|(kind, class, units)| ((*kind).to_owned(), *class, *units)).collect::<Vec<(
            String,
            ResourceClass,
            u32,
        )>>(),
        world: Vec::new(),
        tolerance: Tolerance::EXACT,
        latency: if seed.is_multiple_of(2) { Duration::ZERO } else { Duration::from_millis(1500) },
    };
    let mut oracle = HashOracle { program, seed, failures_percent, crashes_percent: 10 };
    run(setup, &mut oracle).map_err(|e| format!("{mode:?}: {e}"))
}

/// Every goal of an irreversible action, in the order started; and the paths retired.
fn story(program: &Program, run: &Run) -> (Vec<String>, Vec<String>) {
    let mut paths: BTreeMap<InstanceId, (String, bool)> = BTreeMap::new();
    let (mut started, mut retired) = (Vec::new(), Vec::new());
    for line in &run.log {
        match &line.entry {
            LogEntry::Command(Command::Note(Note::Expanded { instance, state, path, .. })) => {
                let irreversible = program.state(*state).annotations.nature == Nature::Irreversible;
                paths.insert(*instance, (path.clone(), irreversible));
            }
            LogEntry::Command(Command::Start { instance, goal, .. }) if paths[instance].1 => {
                started.push(format!("{} {:?}", paths[instance].0, goal.inputs));
            }
            LogEntry::Command(Command::Note(Note::Retired { instance })) => retired.push(paths[instance].0.clone()),
            _ => {}
        }
    }
    (started, retired)
}

fn compare(seed: u64) -> Result<(f64, f64), String> {
    let program = Arc::new(program(seed));
    let failures_percent = if seed.is_multiple_of(3) { 4 } else { 0 };
    let hsm = execute(&program, seed, Mode::Hsm, failures_percent)?;
    let cdtn = execute(&program, seed, Mode::Cdtn, failures_percent)?;
    let differ = |what: &str, a: String, b: String| Err(format!("{what} differ:\n hsm  {a}\n cdtn {b}"));
    if hsm.outcome != cdtn.outcome {
        return differ(
            "outcomes",
            format!("{} {}", hsm.outcome, hsm.reason),
            format!("{} {}", cdtn.outcome, cdtn.reason),
        );
    }
    if hsm.outputs != cdtn.outputs {
        return differ("outputs", format!("{:?}", hsm.outputs), format!("{:?}", cdtn.outputs));
    }
    let facts = |run: &Run| -> Vec<String> { run.world.iter().map(|(k, f)| format!("{k} = {}", f.value)).collect() };
    if facts(&hsm) != facts(&cdtn) {
        return differ("worlds", format!("{:?}", facts(&hsm)), format!("{:?}", facts(&cdtn)));
    }
    if hsm.units != cdtn.units {
        return differ("task resources", format!("{:?}", hsm.units), format!("{:?}", cdtn.units));
    }
    let ((hsm_started, mut hsm_retired), (cdtn_started, mut cdtn_retired)) =
        (story(&program, &hsm), story(&program, &cdtn));
    if hsm_started != cdtn_started {
        return differ("irreversible actions", format!("{hsm_started:#?}"), format!("{cdtn_started:#?}"));
    }
    // What a routine contains retires with it: as one instance in CDTN mode, one by one in HSM mode.
    let in_routine = |state: &State| {
        std::iter::successors(Some(state), |s| s.parent.map(|id| program.state(id))).any(|s| s.annotations.routine)
    };
    let action = |path: &String| {
        let state = program.states.iter().find(|s| s.path == plain(path));
        state.is_some_and(|s| matches!(s.kind, StateKind::Action { .. }) && !in_routine(s))
    };
    hsm_retired.retain(action);
    cdtn_retired.retain(action);
    if hsm.outcome == "success" && hsm_retired != cdtn_retired {
        return differ("retired instances", format!("{hsm_retired:?}"), format!("{cdtn_retired:?}"));
    }
    Ok((hsm.end_s, cdtn.end_s))
}

fn plain(path: &str) -> String {
    path.split('[').map(|part| part.split_once(']').map_or(part, |(_, rest)| rest)).collect()
}

/// The program, a line per state.
fn listing(program: &Program) -> String {
    let mut text = format!("horizon {}\n", program.horizon);
    for state in &program.states {
        let kind = match &state.kind {
            StateKind::Action { inputs, .. } => {
                let inputs: Vec<String> = inputs.iter().map(|(port, e)| format!("{port}: {e}")).collect();
                format!("act({})", inputs.join(", "))
            }
            StateKind::Sequence { children, outputs } => {
                let outputs: Vec<String> = outputs.iter().map(|o| format!("{}: {}", o.name, o.value)).collect();
                format!("sequence of {} → {}", children.len(), outputs.join(", "))
            }
            StateKind::While { predicate, .. } => format!("while {predicate}"),
            StateKind::Concurrency { regions, .. } => format!("{} regions", regions.len()),
            StateKind::ForEach { variable, collection, .. } => format!("for {variable} in {collection}"),
            StateKind::Condition { predicate, then, .. } => format!("if {predicate}, then {} states", then.len()),
        };
        let a = &state.annotations;
        let reads = a.reads.as_ref().map(|r| r.iter().map(ToString::to_string).collect::<Vec<_>>());
        let effects: Vec<String> = a
            .effects
            .iter()
            .map(|(o, e)| format!("{o}: {:?}", e.iter().map(ToString::to_string).collect::<Vec<_>>()))
            .collect();
        let nature = match &a.nature {
            Nature::Irreversible => "pia".to_owned(),
            Nature::Computes => "computes".to_owned(),
            Nature::Senses(f) => format!("senses {:?}", f.iter().map(ToString::to_string).collect::<Vec<_>>()),
        };
        let requires: Vec<String> = a.requires.iter().map(ToString::to_string).collect();
        text += &format!(
            "{:>4} {} {kind} | {nature}{} reads {reads:?} effects {effects:?} requires {requires:?} {:?}\n",
            state.id.to_string(),
            state.path,
            if a.routine { " routine" } else { "" },
            a.resources.iter().map(|r| r.kind.as_str()).collect::<Vec<_>>()
        );
    }
    text
}

#[test]
fn random_programs_leave_the_same_world_in_both_modes() {
    let (mut hsm_s, mut cdtn_s, mut slower) = (0.0, 0.0, 0);
    let programs = std::env::var("RATN_PROGRAMS").ok().and_then(|n| n.parse().ok()).unwrap_or(2000);
    for seed in 0..programs {
        match compare(seed) {
            Ok((hsm, cdtn)) => {
                hsm_s += hsm;
                cdtn_s += cdtn;
                slower += usize::from(cdtn > hsm + 1e-6);
            }
            Err(problem) => panic!("seed {seed}: {problem}\n{}", listing(&program(seed))),
        }
    }
    eprintln!("{programs} programs: HSM {hsm_s:.0} s, CDTN {cdtn_s:.0} s; {slower} slower in CDTN mode");
    assert!(cdtn_s < 0.9 * hsm_s, "the network gains nothing: {cdtn_s} of {hsm_s} s");
}
