//! States that are tried again, with something done before each further try: what is done, in which order and when, in both modes.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may panic")]

mod support;

use ratn_executive::protocol::{Goal, Mode};
use ratn_model::value::Value;
use ratn_simulation::run::{Run, run};
use ratn_world::world::World;
use support::{MODES, NoFiles, Providers, facts, load, setup, starts};

/// A run whose goals end so by their paths, each after a second.
fn run_with(states: &str, mode: Mode, end: &dyn Fn(&str) -> (&'static str, Value)) -> Run {
    let task = states
        .replace("MOVE", "action: arm/grasp, pia: true, reads: [], resources: [{ block: Arm }]")
        .replace("TURN", "action: head/turn, pia: true, reads: [], effects: [], resources: [{ block: Head }]")
        .replace("THINK", "action: brain/think, computes: true, reads: [], resources: [{ block: Brain }]");
    let mut providers = Providers(|path: &str, _: u32, _: &Goal, _: &World| end(path));
    run(setup(load(&format!("task: t\n{task}"), "task.yaml", &NoFiles), mode), &mut providers).unwrap()
}

#[test]
fn an_action_is_tried_again_behind_what_makes_it_possible() {
    let text = "
world: ['empty(hand)']
states:
  - grasp: { MOVE, requires: ['empty(hand)'], effects: { success: ['held(cup)', 'not empty(hand)'], aborted: ['not empty(hand)'] },
      retry: { times: 2, before: [ open: { MOVE, effects: ['empty(hand)'] } ] } }
  - note: { action: pen/note, in: { value: grasp.x }, pia: true, reads: [], effects: [], resources: [{ block: Pen }] }
";
    for mode in MODES {
        let run = run_with(text, mode, &|path| match path {
            "grasp/try" | "grasp/try#2" => ("aborted", Value::Null),
            _ => ("success", Value::Int(5)),
        });
        let expected =
            ["0 grasp/try", "1 grasp/before/open", "2 grasp/try#2", "3 grasp/before#2/open", "4 grasp/try#3", "5 note"];
        assert_eq!(starts(&run), expected, "{mode:?}");
        assert_eq!((run.outcome.as_str(), facts(&run)), ("success", vec!["held(cup) = true".to_owned()]), "{mode:?}");
        // Without another try, as the last try ended.
        let run = run_with(text, mode, &|path| match path {
            path if path.starts_with("grasp/try") => ("aborted", Value::Null),
            _ => ("success", Value::Int(5)),
        });
        assert_eq!((run.outcome.as_str(), starts(&run).len()), ("aborted", 5), "{mode:?}");
        // What makes it possible fails.
        let run = run_with(text, mode, &|_| ("aborted", Value::Null));
        assert_eq!(
            (run.outcome.as_str(), starts(&run)),
            ("aborted", vec!["0 grasp/try".into(), "1 grasp/before/open".into()])
        );
    }
}

#[test]
fn a_hierarchy_is_tried_again_after_outcomes_of_its_own_and_pauses_that_double() {
    let text = "
states:
  - find:
      outcomes: [none]
      outputs: { x: look.x }
      retry: { times: 2, on: [none], backoff: 3 }
      transitions: { none: success }
      states:
        - aim: { TURN }
        - look: { action: arm/grasp, pia: true, reads: [], effects: { success: ['seen(cup)'], empty: [increase missed() by 1] },
            resources: [{ block: Arm }], transitions: { empty: none } }
  - note: { action: pen/note, in: { value: find.x }, pia: true, reads: [], effects: [], resources: [{ block: Pen }] }
";
    for mode in MODES {
        let run = run_with(text, mode, &|path| match path {
            "find/try/look" | "find/try#2/look" => ("empty", Value::Null),
            _ => ("success", Value::Int(5)),
        });
        let expected = [
            "0 find/try/aim",
            "1 find/try/look",
            "5 find/try#2/aim",
            "6 find/try#2/look",
            "13 find/try#3/aim",
            "14 find/try#3/look",
            "15 note",
        ];
        assert_eq!(starts(&run), expected, "{mode:?}");
        assert_eq!(facts(&run), ["missed() = 2", "seen(cup) = true"], "{mode:?}");
        // An outcome that is not one of those leads on at once, and so does the last try's.
        for (outcome, count, end) in [("aborted", 2, "aborted"), ("empty", 6, "success")] {
            let run =
                run_with(text, mode, &|path| (if path.ends_with("look") { outcome } else { "success" }, Value::Int(1)));
            assert_eq!((run.outcome.as_str(), starts(&run).len()), (end, count), "{mode:?}: {}", run.reason);
        }
    }
}

/// The first region that ends stops the other in its pause, which then does not go on.
#[test]
fn a_pause_is_stopped_like_a_motion() {
    let text = "
states:
  - race:
      concurrency: preemptive
      regions:
        - slow:
            retry: { times: 5, backoff: 100 }
            states: [ grasp: { MOVE, effects: [] } ]
        - fast: { states: [ one: { TURN }, two: { TURN }, three: { TURN } ] }
";
    for mode in MODES {
        let run =
            run_with(text, mode, &|path| (if path.contains("slow") { "aborted" } else { "success" }, Value::Null));
        assert_eq!(
            (run.outcome.as_str(), run.end_s, starts(&run).len()),
            ("success", 3.0, 4),
            "{mode:?}: {}",
            run.reason
        );
    }
}

/// Nor does it ask for what a hierarchy around it blocks for the states in it.
#[test]
fn a_pause_holds_nothing() {
    let text = "
states:
  - both:
      concurrency: barrier
      regions:
        - left:
            resources: [{ block: Head }]
            states: [ grasp: { MOVE, effects: [], retry: { times: 1, backoff: 10, before: [ open: { MOVE, effects: [] } ] } } ]
        - right: { TURN }
";
    for mode in MODES {
        let run =
            run_with(text, mode, &|path| (if path.ends_with("try") { "aborted" } else { "success" }, Value::Null));
        let expected =
            ["0 both/left/grasp/try", "1 both/right", "11 both/left/grasp/before/open", "12 both/left/grasp/try#2"];
        assert_eq!(starts(&run), expected, "{mode:?}");
    }
}

/// What a retry may come to is not computed ahead; what it comes to if nothing fails is.
#[test]
fn a_plan_behind_a_state_that_may_be_tried_again_is_made_while_that_runs() {
    let text = "
states:
  - grasp: { MOVE, effects: [], duration: 10, retry: { times: 2, before: [ open: { MOVE, effects: [] } ] } }
  - plan: { THINK, duration: 4 }
";
    let run = run_with(text, Mode::Cdtn, &|_| ("success", Value::Null));
    assert_eq!(starts(&run), ["0 grasp/try", "0 plan"]);
    assert_eq!(run.end_s, 10.0);
}

/// One of a region, one in a loop, one within another: names and ports are found as if nothing stood around.
#[test]
fn retries_stand_anywhere_a_state_does() {
    let text = "
variables: { n: 0 }
states:
  - for: k in [1, 2]
    retry: { times: 1, before: [ home: { TURN } ] }
    do:
      - both:
          concurrency: barrier
          regions:
            - left: { MOVE, effects: [], retry: { times: 1, before: [ open: { MOVE, effects: [] } ] } }
            - right: { states: [ turn: { TURN } ], retry: 1 }
          decide: { bad: left.outcome = aborted }
          transitions: { bad: aborted }
          assign: { n: $n + $k }
outputs: { n: $n }
";
    for mode in MODES {
        let run = run_with(text, mode, &|path| match path {
            "for_k/try[1]/both/left/try" | "for_k/try[1]/both/left/try#2" => ("aborted", Value::Null),
            _ => ("success", Value::Null),
        });
        assert_eq!(
            (run.outcome.as_str(), run.outputs["n"].to_string().as_str()),
            ("success", "6"),
            "{mode:?}: {}",
            run.reason
        );
        assert!(starts(&run).iter().any(|start| start.ends_with("for_k/before/home")), "{:?}", starts(&run));
    }
}

#[test]
fn the_time_for_which_a_region_waits_for_its_turn_counts_for_the_limit_around_it() {
    let text = |other: &str| {
        format!(
            "
states:
  - both:
      timeout: 1.5
      states:
        - beside:
            concurrency: barrier
            regions:
              - one: {{ THINK }}
              - other: {{ {other} }}
"
        )
    };
    for mode in MODES {
        // Both block a brain: together they have the most that one of them blocks, which is one.
        let run = run_with(&text("THINK"), mode, &|_| ("success", Value::Int(5)));
        let begun = starts(&run);
        assert_eq!(begun.len(), 2, "{mode:?}: {begun:?}");
        assert!(begun[0].starts_with("0 ") && begun[1].starts_with("1 "), "{mode:?}: {begun:?}");
        assert_eq!((run.outcome.as_str(), run.end_s), ("aborted", 1.5), "{mode:?}: {}", run.reason);
        let run = run_with(&text("TURN"), mode, &|_| ("success", Value::Int(5)));
        assert_eq!((run.outcome.as_str(), run.end_s), ("success", 1.0), "{mode:?}: {}", run.reason);
    }
}

#[test]
fn something_is_done_on_the_way_out_of_what_only_a_cut_ends_preempted() {
    let text = "
states:
  - s:
      states:
        - a: { MOVE, effects: [], transitions: { preempted: success } }
      finally:
        - b: { TURN }
";
    for mode in MODES {
        let run = run_with(text, mode, &|_| ("success", Value::Null));
        assert_eq!(starts(&run), ["0 s/body/a", "1 s/finally/b"], "{mode:?}");
    }
}
