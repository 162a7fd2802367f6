//! Shows a run in progress from its growing event log: on a terminal as a few repainted lines, for programs as the lines of the log.
//!
//! It reads in a separate thread what the run has written, so watching does not slow the run down. What is painted comes from the one
//! projection of the log; this file only does the layout. While a question to the operator is open nothing is repainted, so that the typed
//! text stays visible ([`answers`]).

mod answers;

use crate::colour::Colours;
use crate::fitted;
use crate::output;
use answers::Questions;
use ratn_event_log::Tail;
use ratn_executive::protocol::LogLine;
use ratn_model::readable::in_line;
use ratn_report::statistics::mode_name;
use ratn_report::timeline::{Instance, Speculation, Stage, Timeline};
use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

const PERIOD: Duration = Duration::from_millis(100);
/// Maximum number of instances that are kept after they have left the window.
const KEPT: usize = 64;
/// Maximum number of lines for running and for waiting instances.
const MOST_RUNNING: usize = 8;
const MOST_WAITING: usize = 6;
const BAR: usize = 20;
/// Maximum number of characters of a line: no terminal is wider.
const MOST_CHARACTERS: usize = 4_096;

/// How a growing log is shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Way {
    /// Painted on the terminal at standard error.
    Painted,
    /// Each line on standard output.
    Lines,
}

/// Follows a log until it is dropped.
#[derive(Debug)]
pub(crate) struct Live {
    end: Option<Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl Live {
    /// Follows a log that is about to be written. `speed` is the robot's seconds per second. Text typed on a terminal answers the questions of
    /// the run in `directory`.
    pub(crate) fn follow(log: &Path, way: Way, speed: f64, directory: &Path) -> Live {
        let (end, ends) = channel();
        let log: PathBuf = log.to_owned();
        let is_typed_on = way == Way::Painted && std::io::stdin().is_terminal();
        let answered = is_typed_on.then(|| directory.to_owned());
        let follow = move || {
            let run = Timeline::following(KEPT);
            let questions = Questions::new(answered);
            let mut painter = Painter { way, speed, run, questions, heard: (Instant::now(), 0.0) };
            let mut tail = Tail::of(&log);
            loop {
                let is_over = !matches!(ends.recv_timeout(PERIOD), Err(RecvTimeoutError::Timeout));
                // Lines that cannot be read are reported by their writer, or when the log is read as a whole afterwards.
                if !painter.take(tail.more().unwrap_or_default()) || is_over {
                    break;
                }
                painter.paint();
            }
            output::clear_area();
        };
        let thread = std::thread::Builder::new().name("live view".to_owned()).spawn(follow).ok();
        Live { end: Some(end), thread }
    }
}

impl Drop for Live {
    fn drop(&mut self) {
        self.end.take();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

struct Painter {
    way: Way,
    speed: f64,
    run: Timeline,
    questions: Questions,
    /// When the last line came, and its time in the run.
    heard: (Instant, f64),
}

impl Painter {
    /// Returns false once nobody reads the output.
    fn take(&mut self, lines: Vec<LogLine>) -> bool {
        for line in &lines {
            self.heard = (Instant::now(), line.at.seconds());
            match self.way {
                Way::Painted => {
                    drop(self.run.apply(line));
                    self.questions.follow(line);
                }
                Way::Lines => {
                    let text = serde_json::to_string(line).unwrap_or_default();
                    if !matches!(output::line(text), Ok(true)) {
                        return false;
                    }
                }
            }
        }
        true
    }

    fn paint(&mut self) {
        if self.way != Way::Painted || self.run.task.is_empty() {
            return;
        }
        if self.questions.keep_still() {
            return;
        }
        let (heard, at_s) = self.heard;
        self.run.wait_until(at_s + heard.elapsed().as_secs_f64() * self.speed);
        let size = terminal_size::terminal_size_of(std::io::stderr());
        let (width, height) = size.map_or((80, 24), |(width, height)| (usize::from(width.0), usize::from(height.0)));
        let path = |id| self.run.instance(id).map_or_else(|| String::from("?"), |one| one.path.to_string());
        let asked = self.questions.lines(path);
        // Questions come before running and waiting instances, because the run stands still for them.
        let asked = &asked[..asked.len().min(MOST_WAITING).min(height.saturating_sub(4))];
        let mut lines = page(&self.run, width, height - asked.len(), Colours::of_errors());
        lines.extend(asked.iter().map(|line| cut(line, width)));
        output::paint_area(&lines);
    }
}

/// A page about the run as it is now, within this width and with fewer lines than this height.
fn page(run: &Timeline, width: usize, height: usize, colours: Colours) -> Vec<String> {
    let room = height.saturating_sub(4).max(1);
    let running = run.running();
    let runs = running.len().min(MOST_RUNNING).min(room);
    let waits = MOST_WAITING.min(room - runs);
    let mut lines = vec![colours.bold(&cut(&head(run), width))];
    for (instance, job) in running.iter().take(runs) {
        let on = if job.resources.is_empty() { String::new() } else { format!("  on {}", job.resources.join(", ")) };
        let text = format!("  runs   {} for {:.1} s{on}", instance.path, (run.end_s - job.from_s).max(0.0));
        lines.push(colours.green(&cut(&text, width)));
    }
    lines.extend(more(running.len(), runs, "run").map(|line| cut(&line, width)));
    // Instances that have asked for resources have a visible cause; the others come after them.
    let mut waiting: Vec<&Instance> = run.waiting().collect();
    waiting.sort_by_key(|one| (one.stage != Stage::Asking, one.id));
    for sentence in waiting.iter().take(waits).filter_map(|one| run.explain(one.id)) {
        lines.push(colours.yellow(&cut(&format!("  waits  {sentence}"), width)));
    }
    lines.extend(more(waiting.len(), waits, "wait").map(|line| cut(&line, width)));
    lines
}

/// `fetch_boxes in CDTN mode: 12.3 s  [#####...............] 12 of 35 states have ended; ahead of time: 3 of use (8.0 s), 1 discarded (2.0 s)`
fn head(run: &Timeline) -> String {
    let (ended, known) = (run.count.retired, run.count.expanded - run.count.squashed);
    let full = (BAR * ended).checked_div(known).unwrap_or(0).min(BAR);
    let bar = format!("{}{}", "#".repeat(full), ".".repeat(BAR - full));
    let paused = if run.is_paused() { ", paused" } else { "" };
    let Speculation { useful, useful_s, wasted, wasted_s, .. } = run.speculation();
    let ahead = match useful + wasted {
        0 => String::new(),
        _ => format!("; ahead of time: {useful} of use ({useful_s:.1} s), {wasted} discarded ({wasted_s:.1} s)"),
    };
    let mode = mode_name(run.mode);
    format!(
        "{} in {mode} mode: {:.1} s{paused}  [{bar}] {ended} of {known} known states have ended{ahead}",
        run.task, run.end_s
    )
}

fn more(all: usize, shown: usize, what: &str) -> Option<String> {
    (all > shown).then(|| format!("  and {} more {what}", all - shown))
}

/// Cuts to fewer columns than the width: a wrapped line would not be painted over.
fn cut(text: &str, width: usize) -> String {
    // More characters than this never fit, however wide the terminal is.
    let end = text.char_indices().nth(MOST_CHARACTERS).map_or(text.len(), |(end, _)| end);
    fitted::cut(&in_line(&text[..end].replace(['\n', '\t'], " ")), width.saturating_sub(1))
}

#[cfg(test)]
mod tests {
    use super::*;
    use insta::assert_snapshot;

    const LOG: &str = r#"{"at":0,"event":"started","task":"sort","digest":"d","mode":"cdtn","parameters":{},"seed":1,"world":[],"revision":0,"capacity":{"PathPlanner":1}}
{"at":0,"command":"note","note":"expanded","instance":1,"state":1,"path":"plan[1]","speculative":false}
{"at":0,"command":"note","note":"expanded","instance":2,"state":1,"path":"plan[2]","speculative":false}
{"at":0,"command":"note","note":"expanded","instance":3,"state":2,"path":"move","speculative":false}
{"at":0,"command":"acquire","instance":1,"requirements":[{"operation":"block","kind":"PathPlanner","class":null,"attributes":{},"count":1}],"priority":2}
{"at":0,"command":"acquire","instance":2,"requirements":[{"operation":"block","kind":"PathPlanner","class":null,"attributes":{},"count":1}],"priority":1}
{"at":1000000000,"event":"granted","instance":1,"lease":{"id":1,"token":1,"resources":[{"id":"p1@compute","kind":"PathPlanner","endpoint":""}]}}
{"at":1000000000,"command":"start","instance":1,"attempt":1,"goal":{"provider":"path_planner","action":"plan","inputs":{},"seed":1,"lease":{"id":1,"token":1,"resources":[{"id":"p1@compute","kind":"PathPlanner","endpoint":""}]},"projection":1,"expected_s":null}}"#;

    fn sort() -> Timeline {
        let mut run = Timeline::following(KEPT);
        for line in LOG.lines() {
            run.apply(&serde_json::from_str(line).expect("a line of a log"));
        }
        run.wait_until(4.5);
        run
    }

    #[test]
    fn what_runs_and_why_others_wait_is_on_the_page() {
        assert_snapshot!(page(&sort(), 120, 24, Colours::default()).join("\n"), @r"
        sort in CDTN mode: 4.5 s  [....................] 0 of 3 known states have ended
          runs   plan[1] for 3.5 s  on p1@compute
          waits  plan[2] waits for PathPlanner: it is held, by plan[1] for 3.5 s
          waits  move waits for what is before it: plan[1] (running for 3.5 s)
        ");
    }

    #[test]
    fn a_small_terminal_has_fewer_and_shorter_lines() {
        for (width, height) in [(30, 6), (10, 3), (2, 2), (1, 1)] {
            let lines = page(&sort(), width, height, Colours::default());
            assert!(lines.len() < height.max(6), "{lines:?}");
            assert!(lines.iter().all(|line| fitted::visible(line) < width), "{lines:?}");
        }
    }

    #[test]
    fn what_a_name_contains_does_nothing_to_the_terminal() {
        assert_eq!(cut("a\u{1b}[2Jb\nc\u{202e}", 80), "a\\u{1b}[2Jb c\\u{202e}");
        assert_eq!(cut(&"漢".repeat(10_000), 20), format!("{}…", "漢".repeat(9)));
    }
}
