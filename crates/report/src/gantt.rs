//! A Gantt chart of a run, as in the paper's Fig. 10: one row per resource, or per state; the horizontal axis is robot time in seconds.
//! Several runs are shown one below the other on one time axis.
//!
//! A bar is a job, coloured by its activity (motion, detection, planning), in three shades so that the visits of a loop can be
//! distinguished. Hatched strips below the bars are waits: instances that had requested the resource and did not have it yet. The same
//! timeline gives the same bytes. SVG if the file is named so, else HTML with the statistics below the chart.

use super::lanes::Lanes;
use super::statistics::{Statistics, mode_name};
use super::timeline::{Activity, Ending, Instance, Job, Span, Timeline, Wait};
use ratn_event_log::without_visits;
use ratn_model::readable::readable;
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;

const WIDTH: f64 = 1280.0;
const LEFT: f64 = 190.0;
const RIGHT: f64 = 24.0;
const TOP: f64 = 86.0;
const BOTTOM: f64 = 44.0;
const ROW: f64 = 40.0;
const BAR: f64 = 24.0;
/// Maximum number of waiting instances shown below one row.
const WAIT_LANES: usize = 3;
const WAIT_LANE: f64 = 4.0;
/// Shorter waits are not shown: they are the latency of a request.
const SHORTEST_WAIT_S: f64 = 0.25;
/// Mean width of a character in a bar.
const CHARACTER: f64 = 6.1;
const TICKS: f64 = 14.0;
const PAUSED: &str = "#efe4f7";
const ABSENT: &str = "#f7dedb";
const ELSEWHERE: &str = "no resource";

/// What a row shows.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum By {
    /// A resource.
    #[default]
    Resource,
    /// A state; overlapping visits get a row each.
    Node,
}

/// Writes the chart in the format of the file's name. `scale_s` sets the end of the axis, so that charts of different runs can be compared.
pub fn write(path: &Path, run: &Timeline, scale_s: Option<f64>) -> std::io::Result<()> {
    write_all(path, &[run], By::Resource, scale_s)
}

/// Writes a chart of several runs below each other.
pub fn write_all(path: &Path, runs: &[&Timeline], by: By, scale_s: Option<f64>) -> std::io::Result<()> {
    let chart = stacked(runs, by, scale_s);
    let svg_wanted = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("svg"));
    std::fs::write(path, if svg_wanted { chart } else { html(runs, &chart) })
}

fn html(runs: &[&Timeline], chart: &str) -> String {
    let titles: Vec<String> = runs.iter().map(|run| title(run)).collect();
    let statistics: Vec<String> = runs.iter().map(|run| Statistics::of(run).to_string()).collect();
    format!(
        "<!DOCTYPE html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><title>{title}</title>\n<style>\
         body{{margin:24px auto;max-width:{WIDTH}px;background:#fff;color:#1c2430;font:14px system-ui,sans-serif}}\
         svg{{width:100%;height:auto}}pre{{font:12.5px/1.45 ui-monospace,monospace;background:#f5f6f8;padding:14px 18px;\
         border-radius:6px;overflow-x:auto}}</style></head><body>\n{chart}\n<pre>{statistics}</pre>\n</body></html>\n",
        title = escaped(&titles.join("; ")),
        statistics = escaped(&statistics.join("\n\n")),
    )
}

fn title(run: &Timeline) -> String {
    let end = match run.outcome.as_deref() {
        Some("success") => String::new(),
        Some(outcome) => format!(", {outcome}"),
        None => ", unfinished".into(),
    };
    format!("{} in {} mode: {:.1} s{end}", run.task, mode_name(run.mode), run.end_s)
}

/// The chart as one SVG element.
pub fn svg(run: &Timeline, scale_s: Option<f64>) -> String {
    stacked(&[run], By::Resource, scale_s)
}

/// A chart of several runs below each other, on one time axis, as one SVG element.
pub fn stacked(runs: &[&Timeline], by: By, scale_s: Option<f64>) -> String {
    let end_s = runs.iter().map(|run| run.end_s).fold(scale_s.unwrap_or(0.0), f64::max);
    let axis = Axis { end_s: end_s.max(1e-3) };
    let panels: Vec<(&Timeline, Vec<Row<'_>>)> = runs.iter().map(|run| (*run, rows(run, by))).collect();
    let height = |rows: &[Row<'_>]| TOP + ROW * rows.len() as f64 + BOTTOM;
    let mut out = String::new();
    let _ = write!(
        out,
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {height}\" font-family=\"system-ui,sans-serif\" \
         font-size=\"12\" fill=\"#1c2430\">\n<defs><pattern id=\"wait\" width=\"6\" height=\"6\" \
         patternUnits=\"userSpaceOnUse\" patternTransform=\"rotate(45)\"><rect width=\"6\" height=\"6\" fill=\"#e4e7ec\"/>\
         <rect width=\"2.5\" height=\"6\" fill=\"#7a8699\"/></pattern></defs>\n\
         <rect width=\"{WIDTH}\" height=\"{height}\" fill=\"#ffffff\"/>\n",
        height = panels.iter().map(|(_, rows)| height(rows)).fold(0.0, |all, one| all + one),
    );
    let mut y = 0.0;
    for (run, rows) in &panels {
        if y > 0.0 {
            let _ = writeln!(out, "<g transform=\"translate(0 {y:.1})\">");
        }
        panel(&mut out, run, rows, &axis);
        out.push_str(if y > 0.0 { "</g>\n" } else { "" });
        y += height(rows);
    }
    out.push_str("</svg>");
    out
}

fn panel(out: &mut String, run: &Timeline, rows: &[Row<'_>], axis: &Axis) {
    let bottom = TOP + ROW * rows.len() as f64;
    let _ =
        writeln!(out, "<text x=\"16\" y=\"30\" font-size=\"18\" font-weight=\"600\">{}</text>", escaped(&title(run)));
    legend(out, run);
    for (spans, colour, what) in [(&run.pauses, PAUSED, "paused"), (&run.absences, ABSENT, "task control was gone")] {
        for span in spans {
            band(out, axis, bottom, *span, colour, what);
        }
    }
    axis.draw(out, bottom);
    for (i, row) in rows.iter().enumerate() {
        row.draw(out, axis, TOP + ROW * i as f64, i % 2 == 1);
    }
    // The end of the run, if the axis continues after it.
    let x = axis.x(run.end_s);
    let _ = writeln!(
        out,
        "<line x1=\"{x:.1}\" y1=\"{:.1}\" x2=\"{x:.1}\" y2=\"{bottom:.1}\" stroke=\"#1c2430\" stroke-width=\"1.5\"/>",
        TOP - 6.0
    );
}

/// A band over the whole height for an interval.
fn band(out: &mut String, axis: &Axis, bottom: f64, span: Span, colour: &str, what: &str) {
    let (x, width) = (axis.x(span.from_s), (axis.x(span.to_s) - axis.x(span.from_s)).max(1.0));
    let _ = writeln!(
        out,
        "<rect x=\"{x:.1}\" y=\"{TOP}\" width=\"{width:.1}\" height=\"{:.1}\" fill=\"{colour}\"><title>{what} from {:.1} to \
         {:.1} s</title></rect>",
        bottom - TOP,
        span.from_s,
        span.to_s
    );
}

fn legend(out: &mut String, run: &Timeline) {
    let mut x = 16.0;
    let entries = [
        (colour(Activity::Motion, 0), "motion"),
        (colour(Activity::Detection, 0), "detection"),
        (colour(Activity::Planning, 0), "planning"),
        ("url(#wait)", "waiting for the resource"),
        ("none\" stroke=\"#c3362b\" stroke-width=\"2", "aborted or crashed"),
        ("#c4c9d2", "discarded"),
    ];
    let other = run.jobs().any(|(_, job)| job.activity == Activity::Other);
    let other = other.then(|| (colour(Activity::Other, 0), "other work"));
    let bands = [(!run.pauses.is_empty(), PAUSED, "paused"), (!run.absences.is_empty(), ABSENT, "task control gone")];
    let bands = bands.into_iter().filter_map(|(there, fill, what)| there.then_some((fill, what)));
    for (fill, what) in entries.into_iter().chain(other).chain(bands) {
        let _ = writeln!(
            out,
            "<rect x=\"{x:.0}\" y=\"46\" width=\"16\" height=\"12\" rx=\"2\" fill=\"{fill}\"/>\
             <text x=\"{:.0}\" y=\"56.5\">{what}</text>",
            x + 22.0
        );
        x += 46.0 + 6.6 * what.len() as f64;
    }
}

struct Axis {
    end_s: f64,
}

impl Axis {
    fn x(&self, seconds: f64) -> f64 {
        LEFT + (WIDTH - LEFT - RIGHT) * seconds / self.end_s
    }

    /// The distance of the ticks: 1, 2 or 5 times a power of ten.
    fn step(&self) -> f64 {
        let rough = self.end_s / TICKS;
        let power = 10_f64.powf(rough.log10().floor());
        [1.0, 2.0, 5.0].into_iter().map(|m| m * power).find(|s| *s >= rough).unwrap_or(10.0 * power)
    }

    fn draw(&self, out: &mut String, bottom: f64) {
        let step = self.step();
        let decimals = if step < 1.0 { (-step.log10()).ceil() as usize } else { 0 };
        for i in 0..=(self.end_s / step + 1e-9).floor() as u32 {
            let seconds = f64::from(i) * step;
            let x = self.x(seconds);
            let _ = writeln!(
                out,
                "<line x1=\"{x:.1}\" y1=\"{TOP}\" x2=\"{x:.1}\" y2=\"{:.1}\" stroke=\"#d5d9e0\"/>\
                 <text x=\"{x:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{seconds:.decimals$}</text>",
                bottom + 5.0,
                bottom + 20.0
            );
        }
        let _ = writeln!(
            out,
            "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\" fill=\"#566072\">seconds of the robot's time</text>",
            (LEFT + WIDTH - RIGHT) / 2.0,
            bottom + 38.0
        );
    }
}

struct Row<'a> {
    /// The name of the resource or state.
    name: String,
    jobs: Vec<(&'a Instance, &'a Job)>,
    waits: Vec<(&'a Instance, f64, f64)>,
}

fn rows(run: &Timeline, by: By) -> Vec<Row<'_>> {
    let mut rows = match by {
        By::Resource => by_resource(run),
        By::Node => by_node(run),
    };
    for row in &mut rows {
        row.waits.sort_by(|a, b| a.1.total_cmp(&b.1).then(a.0.id.cmp(&b.0.id)));
    }
    rows
}

/// Rows by activity: motion first, then detection, then planning; within these by name.
fn by_resource(run: &Timeline) -> Vec<Row<'_>> {
    let mut rows: BTreeMap<&str, Row<'_>> = BTreeMap::new();
    for (instance, job) in run.jobs() {
        for resource in &job.resources {
            row_of(&mut rows, resource).jobs.push((instance, job));
        }
        if job.resources.is_empty() {
            row_of(&mut rows, ELSEWHERE).jobs.push((instance, job));
        }
    }
    for (instance, wait) in long_waits(run) {
        for resource in &wait.resources {
            row_of(&mut rows, resource).waits.push((instance, wait.from_s, wait.to_s));
        }
    }
    let mut rows: Vec<Row<'_>> = rows.into_values().collect();
    let rank = |row: &Row<'_>| row.jobs.iter().map(|(_, job)| job.activity).min();
    rows.sort_by_cached_key(|row| (row.name == ELSEWHERE, rank(row), row.name.clone()));
    rows
}

/// Rows in the order in which the states were first visited.
fn by_node(run: &Timeline) -> Vec<Row<'_>> {
    let mut states: Vec<(Lanes, Vec<Row<'_>>)> = Vec::new();
    let mut places: BTreeMap<String, usize> = BTreeMap::new();
    for instance in run.instances().filter(|one| !one.jobs.is_empty()) {
        let state = without_visits(&instance.path);
        let at = *places.entry(state.clone()).or_insert(states.len());
        if at == states.len() {
            states.push(Default::default());
        }
        let (lanes, rows) = &mut states[at];
        let ends_s = instance.jobs.iter().map(|job| job.to_s).fold(0.0, f64::max);
        let (lane, is_new) = lanes.take(instance.jobs[0].from_s, ends_s);
        if is_new {
            let name = if lane == 0 { state } else { format!("{state} ({})", lane + 1) };
            rows.push(Row { name, jobs: vec![], waits: vec![] });
        }
        rows[lane].jobs.extend(instance.jobs.iter().map(|job| (instance, job)));
        let waits = instance.waits.iter().filter(|wait| wait.to_s - wait.from_s >= SHORTEST_WAIT_S);
        rows[lane].waits.extend(waits.map(|wait| (instance, wait.from_s, wait.to_s)));
    }
    states.into_iter().flat_map(|(_, rows)| rows).collect()
}

fn row_of<'r, 'a, 'n>(rows: &'r mut BTreeMap<&'n str, Row<'a>>, name: &'n str) -> &'r mut Row<'a> {
    rows.entry(name).or_insert_with(|| Row { name: name.to_owned(), jobs: vec![], waits: vec![] })
}

fn long_waits(run: &Timeline) -> impl Iterator<Item = (&Instance, &Wait)> {
    let waits = run.instances().flat_map(|one| one.waits.iter().map(move |wait| (one, wait)));
    waits.filter(|(_, wait)| wait.to_s - wait.from_s >= SHORTEST_WAIT_S)
}

impl Row<'_> {
    fn draw(&self, out: &mut String, axis: &Axis, y: f64, shaded: bool) {
        if shaded {
            let _ = writeln!(
                out,
                "<rect x=\"0\" y=\"{y:.1}\" width=\"{WIDTH}\" height=\"{ROW}\" fill=\"#5b6b86\" fill-opacity=\"0.06\"/>"
            );
        }
        let _ = writeln!(
            out,
            "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
            LEFT - 10.0,
            y + 19.0,
            escaped(&shortened(&self.name, 26))
        );
        self.draw_waits(out, axis, y + 3.0 + BAR + 1.0);
        for (instance, job) in &self.jobs {
            draw_job(out, axis, y + 3.0, instance, job);
        }
    }

    fn draw_waits(&self, out: &mut String, axis: &Axis, y: f64) {
        let mut lanes = [f64::NEG_INFINITY; WAIT_LANES];
        for (instance, from_s, to_s) in &self.waits {
            let Some(lane) = lanes.iter().position(|free_at| free_at <= from_s) else { continue };
            lanes[lane] = *to_s;
            let _ = writeln!(
                out,
                "<rect x=\"{:.1}\" y=\"{:.1}\" width=\"{:.1}\" height=\"{:.1}\" fill=\"url(#wait)\"><title>{} waits for {} \
                 from {from_s:.1} to {to_s:.1} s</title></rect>",
                axis.x(*from_s),
                y + WAIT_LANE * lane as f64,
                axis.x(*to_s) - axis.x(*from_s),
                WAIT_LANE - 0.5,
                escaped(&instance.path),
                escaped(&self.name)
            );
        }
    }
}

fn draw_job(out: &mut String, axis: &Axis, y: f64, instance: &Instance, job: &Job) {
    let (x, width) = (axis.x(job.from_s), (axis.x(job.to_s) - axis.x(job.from_s)).max(1.0));
    let unused = instance.squashed || job.invalidated.is_some();
    let discarded = (unused && !job.used_elsewhere) || job.ending == Ending::Cancelled;
    let fill = if discarded { "#c4c9d2" } else { colour(job.activity, visit(&instance.path)) };
    let (how, failed) = match &job.ending {
        Ending::Outcome(outcome, reason) if outcome == "aborted" => (format!("aborted: {reason}"), true),
        Ending::Outcome(outcome, _) => (outcome.clone(), false),
        Ending::Crashed(reason) => (format!("crashed: {reason}"), true),
        Ending::Cancelled => ("cancelled".into(), false),
        Ending::Open => ("not ended".into(), false),
    };
    let stroke = if failed { "#c3362b\" stroke-width=\"2" } else { "#ffffff\" stroke-width=\"0.8" };
    let attempt = if job.attempt > 1 { format!(", attempt {}", job.attempt) } else { String::new() };
    let discarded = match &job.invalidated {
        _ if job.used_elsewhere => ", its result was used by an equal visit".into(),
        Some(reason) => format!(", done again: {}", escaped(reason)),
        None if discarded => ", discarded".into(),
        None => String::new(),
    };
    let _ = write!(
        out,
        "<g><title>{}: {}/{}\n{:.1} to {:.1} s ({:.1} s), {}{attempt}{discarded}</title><rect x=\"{x:.1}\" y=\"{y:.1}\" \
         width=\"{width:.1}\" height=\"{BAR}\" rx=\"2.5\" fill=\"{fill}\" stroke=\"{stroke}\"/>",
        escaped(&instance.path),
        escaped(&job.provider),
        escaped(&job.action),
        job.from_s,
        job.to_s,
        job.to_s - job.from_s,
        escaped(&how),
    );
    let room = ((width - 8.0) / CHARACTER).floor();
    if room >= 3.0 {
        let _ = write!(
            out,
            "<text x=\"{:.1}\" y=\"{:.1}\" font-size=\"11\">{}</text>",
            x + 4.0,
            y + 16.0,
            escaped(&shortened(&label(&instance.path), room as usize))
        );
    }
    out.push_str("</g>\n");
}

/// Pale colours, so that dark text is readable on them.
fn colour(activity: Activity, shade: usize) -> &'static str {
    let shades = match activity {
        Activity::Motion => ["#8fb8e8", "#b3d0f2", "#74a3da"],
        Activity::Detection => ["#8fcf9b", "#b4e0bb", "#72ba80"],
        Activity::Other => ["#c9b6e4", "#ddd0ef", "#b39ad6"],
        Activity::Planning => ["#f5c06b", "#fad79c", "#e8aa45"],
    };
    shades[shade % shades.len()]
}

/// The number of the innermost visit in a path; 0 without one.
fn visit(path: &str) -> usize {
    path.rsplit_once('[').and_then(|(_, rest)| rest.split_once(']')?.0.parse().ok()).unwrap_or(0)
}

/// `place_all[2]/plan_transfer` → `plan_transfer [2]`
fn label(path: &str) -> String {
    let last = path.rsplit('/').next().unwrap_or(path);
    match path.rsplit_once('[') {
        Some((_, rest)) if !last.contains('[') => {
            format!("{last} [{}]", rest.split_once(']').map_or("", |(visit, _)| visit))
        }
        _ => last.to_owned(),
    }
}

fn shortened(text: &str, characters: usize) -> String {
    if text.chars().count() <= characters {
        return text.to_owned();
    }
    text.chars().take(characters.saturating_sub(1)).chain(['…']).collect()
}

/// Escapes a text for XML, which allows neither control characters nor U+FFFE and U+FFFF.
fn escaped(text: &str) -> String {
    let text = readable(text).replace(['\u{fffe}', '\u{ffff}'], "\u{fffd}");
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}
