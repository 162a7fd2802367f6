//! Random regions that share facts: what each decides, and computes, is by what the other has really done when it comes to its place, in both
//! modes. They hold motions of two units, with durations that are never over at the same moment, and states that compute on what the motion before
//! them gives: so both modes do the same at the same times, also where motions are imprecise, for each needs the unit that the one before it has.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may panic")]

mod support;

use ratn_executive::protocol::Mode;
use ratn_simulation::run::Run;
use std::fmt::Write;
use support::script::Script;
use support::{MODES, NoFiles, acts, facts, load};

/// A random task, written line by line.
struct Writer {
    dice: u64,
    text: String,
    /// What its providers do.
    script: String,
    names: u64,
    /// The unit with which motions move; without one there are none.
    actuator: Option<usize>,
    /// Whether there are waits, states without an action, and regions inside of regions.
    waits: bool,
}

impl Writer {
    fn below(&mut self, limit: u64) -> u64 {
        self.dice = self.dice.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.dice >> 33) % limit
    }

    fn fact(&mut self) -> String {
        format!("f{}()", self.below(3))
    }

    fn line(&mut self, depth: usize, line: &str) {
        let _ = writeln!(self.text, "{}{line}", "  ".repeat(depth));
    }

    /// A number that no state has yet, and a duration in seconds: no sum of some of them is one of others.
    fn number_and_duration(&mut self) -> (u64, f64) {
        self.names += 1;
        let number = self.names;
        let fraction = 0.000_137 * number as f64 + 0.000_001_9 * (number * number) as f64;
        (number, 0.3 + 0.17 * self.below(20) as f64 + fraction)
    }

    fn motion(&mut self, depth: usize, inputs: &str, effect: &str) {
        let (number, duration) = self.number_and_duration();
        let Some(actuator) = self.actuator else { return self.moment(depth) };
        let [of, unit] = [["arm/move", "Arm"], ["head/turn", "Head"]][actuator];
        let exceptions = if self.below(3) == 0 { "exceptions: imprecise, " } else { "" };
        let what = format!(
            "out: {{ x: any }}, pia: true, {exceptions}reads: [], {inputs}effects: ['{effect}'], resources: [{{ block: {unit} }}]"
        );
        self.line(depth, &format!("- m{number}: {{ action: {of}, {what}, duration: {duration:.7} }}"));
    }

    /// A wait, or a change of what is shared, in which nothing moves.
    fn moment(&mut self, depth: usize) {
        let (number, timeout) = self.number_and_duration();
        let (fact, limit) = (self.fact(), self.below(3));
        let what = match self.below(4) {
            0 => format!("wait: {{ seconds: {} }}", 1 + limit),
            1 => format!(
                "wait: {{ for: '{fact} > {limit}', timeout: {timeout:.7} }}, transitions: {{ timeout: success }}"
            ),
            2 => format!("states: [], effects: ['{fact} = {limit}']"),
            _ => format!("states: [], effects: ['increase {fact} by 1']"),
        };
        self.line(depth, &format!("- w{number}: {{ {what} }}"));
    }

    /// States that change something shared when they are left, or with a limit; or regions of which one has the unit, or a race.
    fn around(&mut self, depth: usize, within: u64) {
        self.names += 1;
        let (name, fact, number) = (format!("a{}", self.names), self.fact(), self.below(3));
        self.line(depth, &format!("- {name}:"));
        let inside = depth + 2;
        let kind = self.below(5);
        if kind < 2 {
            let effect = if number == 0 { format!("increase {fact} by 1") } else { format!("{fact} = {}", number - 1) };
            self.line(inside, &format!("effects: ['{effect}']"));
            self.line(inside, "states:");
            return self.parts(inside + 1, within - 1, 2);
        }
        if kind == 2 {
            self.line(inside, "timeout: 1000");
            self.line(inside, "states:");
            return self.parts(inside + 1, within - 1, 2);
        }
        // Of a race nothing moves that could be cut short.
        let (unit, with, is_race) = (self.actuator, self.below(2), kind == 4);
        self.line(inside, if is_race { "concurrency: preemptive" } else { "concurrency: barrier" });
        self.line(inside, "regions:");
        let with = if is_race { 2 } else { with };
        for region in 0..2 {
            self.actuator = unit.filter(|_| region == with);
            self.line(inside + 1, &format!("- {name}_{region}:"));
            self.line(inside + 3, SHARED);
            self.line(inside + 3, "states:");
            self.parts(inside + 4, within - 1, 2);
        }
        self.actuator = unit;
    }

    /// A motion that changes what is shared, or says what it has found.
    fn any_motion(&mut self, depth: usize) {
        let (fact, other, number) = (self.fact(), self.fact(), self.below(3));
        let own = format!("said{}()", self.names + 1);
        match self.below(5) {
            0 => self.motion(depth, "", &format!("{fact} = {number}")),
            1 => self.motion(depth, "", &format!("increase {fact} by 1")),
            2 => self.motion(depth, "", &format!("{fact} = {other}")),
            3 => self.motion(depth, "", &format!("{own} = {fact}")),
            _ => self.motion(depth, &format!("in: {{ a: {fact} }}, "), &format!("{own} = 1")),
        }
    }

    /// A state that computes on what the motion before it gives: it may require something of what is shared, and may be tried again. Where it
    /// leads is said.
    fn computed(&mut self, depth: usize, region: &str) {
        let own = format!("said{}()", self.names + 1);
        self.motion(depth, "", &format!("{own} = 1"));
        let before = self.names;
        let (number, duration) = self.number_and_duration();
        let (_, backoff) = self.number_and_duration();
        let (read, required, limit) = (self.fact(), self.fact(), self.below(4));
        let requires = if self.below(2) == 0 { format!("requires: ['{required} < {limit}'], ") } else { String::new() };
        let retry =
            if self.below(2) == 0 { format!("retry: {{ times: 1, backoff: {backoff:.7} }}, ") } else { String::new() };
        let what = format!(
            "action: brain/think, in: {{ a: m{before}.x }}, computes: true, reads: ['{read}'], {requires}{retry}resources: \
             [{{ block: Brain }}], duration: {duration:.7}, transitions: {{ aborted: otherwise{number} }}"
        );
        self.line(depth, &format!("- think{number}: {{ {what} }}"));
        self.line(depth, &format!("- goes_on{number}: {{ states: [], transitions: {{ success: behind{number} }} }}"));
        self.line(depth, &format!("- otherwise{number}: {{ states: [], effects: ['gave_up{number}()'] }}"));
        self.line(depth, &format!("- behind{number}: {{ states: [] }}"));
        let outcomes = match self.below(3) {
            0 => "[\"success\"]",
            1 => "[\"aborted\", \"success\"]",
            _ => "[\"aborted\", \"aborted\", \"success\"]",
        };
        let _ = writeln!(self.script, "\"both/{region}/think{number}\" = {outcomes}");
    }

    fn part(&mut self, depth: usize, within: u64) {
        if self.waits {
            match self.below(4) {
                0 | 1 => return self.moment(depth),
                2 if within > 0 => return self.around(depth, within),
                _ => {}
            }
        }
        let kind = if within == 0 { 0 } else { self.below(9) };
        if kind < 4 {
            return self.any_motion(depth);
        }
        self.names += 1;
        let (name, fact, limit) = (format!("s{}", self.names), self.fact(), self.below(3));
        self.line(depth, &format!("- {name}:"));
        let inside = depth + 2;
        match kind {
            4 => {
                self.line(inside, &format!("condition: {fact} > {limit}"));
                for branch in ["then:", "else:"] {
                    self.line(inside, branch);
                    self.parts(inside + 1, within - 1, 2);
                }
            }
            5 => {
                self.line(inside, &format!("for: each{} in range(0, {fact})", self.names));
                self.line(inside, "do:");
                self.parts(inside + 1, within - 1, 1);
            }
            6 => {
                self.line(inside, &format!("index: i{}", self.names));
                self.line(inside, &format!("while: $i{} < 3 and {fact} < {}", self.names, limit + 1));
                self.line(inside, "do:");
                self.parts(inside + 1, within - 1, 2);
            }
            7 => {
                self.line(inside, "routine: true");
                self.line(inside, "states:");
                self.parts(inside + 1, within - 1, 2);
            }
            _ => {
                let seen = format!("v{}", self.names);
                self.line(inside, &format!("variables: {{ {seen}: {fact} }}"));
                let given = self.fact();
                self.line(inside, &format!("outputs: {{ v: {{ value: {given} }} }}"));
                self.line(inside, "states:");
                self.parts(inside + 1, within - 1, 2);
                let own = format!("said{}()", self.names + 1);
                self.motion(inside + 1, "", &format!("{own} = ${seen}"));
                let own = format!("said{}()", self.names + 1);
                self.motion(depth, "", &format!("{own} = {name}.v"));
            }
        }
    }

    fn parts(&mut self, depth: usize, within: u64, most: u64) {
        for _ in 0..=self.below(most) {
            self.part(depth, within);
        }
    }
}

/// The facts that the regions share.
const SHARED: &str = "shared: ['f0()', 'f1()', 'f2()']";

/// A task and its script.
fn task(seed: u64, waits: bool) -> (String, String) {
    let dice = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15);
    let (text, script) = (String::new(), "[outcomes]\n".to_owned());
    let mut writer = Writer { dice, text, script, names: 0, actuator: None, waits };
    writer.line(0, "task: t\nworld: ['f0() = 0', 'f1() = 1', 'f2() = 2']\nstates:\n  - both:");
    writer.line(3, "concurrency: barrier");
    writer.line(3, "regions:");
    for (actuator, region) in ["left", "right"].into_iter().enumerate() {
        writer.actuator = Some(actuator);
        writer.line(4, &format!("- {region}:"));
        writer.line(6, SHARED);
        writer.line(6, "states:");
        for _ in 0..4 {
            if writer.below(4) == 0 {
                writer.computed(7, region);
            } else {
                writer.part(7, 2);
            }
        }
    }
    writer.line(1, "- all:");
    writer.line(3, "outputs: { v: { value: 'f0() + 10 * f1() + 100 * f2()' } }");
    writer.line(3, "states: []");
    writer.motion(1, "", "found() = all.v");
    (writer.text, writer.script)
}

fn end_alike(waits: bool, programs: u64) {
    let first: u64 = std::env::var("RATN_FIRST").map_or(0, |first| first.parse().unwrap());
    let count: u64 = std::env::var("RATN_PROGRAMS").map_or(programs, |count| count.parse().unwrap());
    for seed in first..first + count {
        let (text, script) = task(seed, waits);
        let program = load(&text, "task.yaml", &NoFiles);
        let end = |mode: Mode| {
            let run: Run = Script::from_toml(&script)
                .run(&program, mode)
                .unwrap_or_else(|problem| panic!("{seed}: {problem}\n{text}"));
            let acts = acts(&program, &run);
            (run.outcome.clone(), run.reason.clone(), facts(&run), acts)
        };
        let [hsm, cdtn] = MODES.map(end);
        assert_eq!(hsm.0, "success", "{seed}: {}\n{text}", hsm.1);
        assert_eq!(hsm, cdtn, "{seed}\n{text}\n{script}");
    }
}

#[test]
fn regions_that_share_facts_end_alike_in_both_modes() {
    end_alike(false, 150);
}

#[test]
fn regions_that_wait_for_each_other_end_alike_in_both_modes() {
    end_alike(true, 60);
}
