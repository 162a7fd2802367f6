//! The `.sm` format of PSPLIB, the public library of project scheduling problems (Kolisch, Sprecher: PSPLIB – a project scheduling
//! problem library, 1996): activities with one mode that need units of renewable resources.
//!
//! It reads the numbers of jobs and of resources, and the sections `PRECEDENCE RELATIONS`, `REQUESTS/DURATIONS` and
//! `RESOURCEAVAILABILITIES`. Other features of the format (several modes, nonrenewable resources) are refused, not ignored.

use crate::activities::{Activities, Activity};

/// Limit of jobs in a file, including source and sink.
pub const MAX_JOBS: usize = 10_000;
/// Limit of resource kinds in a file.
pub const MAX_RESOURCES: usize = 100;
/// Limit of the units of a kind, and of a duration.
pub const MAX_NUMBER: u32 = 1_000_000;

/// Error: the text is no project.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("line {line}: {problem}")]
pub struct InvalidProject {
    /// The line, counted from 1.
    pub line: usize,
    /// What is wrong, and what is expected.
    pub problem: String,
}

fn wrong(line: usize, problem: impl Into<String>) -> InvalidProject {
    InvalidProject { line, problem: problem.into() }
}

/// Parses a project; its activities are ordered, each after its predecessors.
///
/// # Errors
/// [`InvalidProject`] names the first line that does not fit.
pub fn parse(text: &str) -> Result<Activities, InvalidProject> {
    let lines = Lines { lines: text.lines().map(str::trim).collect() };
    let jobs = lines.counted("jobs", MAX_JOBS)?;
    let renewable = lines.counted("- renewable", MAX_RESOURCES)?;
    for kind in ["- nonrenewable", "- doubly constrained"] {
        let (line, count) = lines.count(kind)?;
        if count != 0 {
            let kind = kind.trim_start_matches("- ");
            return Err(wrong(line, format!("there are {count} {kind} resources, and only renewable ones can be had")));
        }
    }
    let behind = lines.precedences(jobs)?;
    let requests = lines.requests(jobs, renewable)?;
    let (line, available) = lines.availabilities(renewable)?;
    let kinds = available.iter().enumerate().map(|(at, units)| (format!("R{}", at + 1), *units)).collect();
    for (at, request) in requests.iter().enumerate() {
        let lacking = request.units.iter().zip(&available).position(|(needed, there_is)| needed > there_is);
        if let Some(kind) = lacking {
            let (needed, there_is, kind) = (request.units[kind], available[kind], kind + 1);
            let problem = format!("job {} needs {needed} of R{kind}, and line {line} has {there_is}", at + 1);
            return Err(wrong(request.line, problem));
        }
    }
    let order = in_order(&behind)?;
    Ok(Activities { kinds, activities: activities(&order, &behind, &requests) })
}

/// The successors of a job, and the line that gives them.
struct Precedence {
    line: usize,
    /// Job numbers, counted from 0.
    behind: Vec<usize>,
}

struct Request {
    line: usize,
    duration: u32,
    units: Vec<u32>,
}

struct Lines<'a> {
    lines: Vec<&'a str>,
}

impl Lines<'_> {
    /// The number behind the colon in the line that begins with `title`.
    fn count(&self, title: &str) -> Result<(usize, u32), InvalidProject> {
        let found = self.lines.iter().position(|line| line.starts_with(title));
        let Some(at) = found else {
            return Err(wrong(self.lines.len().max(1), format!("there is no line `{title} …: NUMBER`")));
        };
        let number = self.lines[at].split_once(':').and_then(|(_, rest)| rest.split_whitespace().next());
        Ok((at + 1, self::number(at + 1, number.unwrap_or_default())?))
    }

    fn counted(&self, title: &str, most: usize) -> Result<usize, InvalidProject> {
        let (line, count) = self.count(title)?;
        let count = count as usize;
        if count == 0 || count > most {
            let title = title.trim_start_matches("- ");
            return Err(wrong(line, format!("{count} {title}: there must be at least one, and at most {most}")));
        }
        Ok(count)
    }

    /// The numbers in `count` lines of a section, after its title and `headings` further lines.
    fn rows(&self, title: &str, headings: usize, count: usize) -> Result<Vec<(usize, Vec<u32>)>, InvalidProject> {
        let Some(at) = self.lines.iter().position(|line| line.starts_with(title)) else {
            return Err(wrong(self.lines.len().max(1), format!("there is no section `{title}`")));
        };
        let first = at + 1 + headings;
        let mut rows = Vec::with_capacity(count);
        for row in first..first + count {
            let Some(line) = self.lines.get(row).filter(|line| !line.starts_with('*')) else {
                let (line, found) = ((row + 1).min(self.lines.len()), row - first);
                return Err(wrong(line, format!("section `{title}` has {found} lines, and {count} are expected")));
            };
            let numbers = line.split_whitespace().map(|word| number(row + 1, word));
            rows.push((row + 1, numbers.collect::<Result<_, _>>()?));
        }
        match self.lines.get(first + count) {
            Some(line) if !line.is_empty() && !line.starts_with('*') => {
                Err(wrong(first + count + 1, format!("section `{title}` has more than the {count} lines expected")))
            }
            _ => Ok(rows),
        }
    }

    fn precedences(&self, jobs: usize) -> Result<Vec<Precedence>, InvalidProject> {
        let rows = self.rows("PRECEDENCE RELATIONS", 1, jobs)?.into_iter().enumerate();
        let read = |(at, (line, numbers)): (usize, (usize, Vec<u32>))| {
            let [job, modes, count, behind @ ..] = numbers.as_slice() else {
                return Err(wrong(line, "expected job, modes, number of successors, successors"));
            };
            is_job(line, *job, at)?;
            if *modes != 1 {
                return Err(wrong(line, format!("job {job} has {modes} modes, and only one can be had")));
            }
            if *count as usize != behind.len() {
                let found = behind.len();
                return Err(wrong(line, format!("{count} successors are announced and {found} are there")));
            }
            let there = |job: &u32| match (*job as usize).checked_sub(1).filter(|job| *job < jobs) {
                Some(job) => Ok(job),
                None => Err(wrong(line, format!("`{job}` is no job: they are 1 to {jobs}"))),
            };
            let behind = behind.iter().map(there).collect::<Result<_, _>>()?;
            Ok(Precedence { line, behind })
        };
        rows.map(read).collect()
    }

    fn requests(&self, jobs: usize, resources: usize) -> Result<Vec<Request>, InvalidProject> {
        let rows = self.rows("REQUESTS/DURATIONS", 2, jobs)?.into_iter().enumerate();
        let read = |(at, (line, numbers)): (usize, (usize, Vec<u32>))| {
            let [job, mode, duration, units @ ..] = numbers.as_slice() else {
                return Err(wrong(line, "expected job, mode, duration, units of each resource"));
            };
            is_job(line, *job, at)?;
            if *mode != 1 {
                return Err(wrong(line, format!("mode {mode} of job {job}, and only one can be had")));
            }
            if units.len() != resources {
                let found = units.len();
                return Err(wrong(line, format!("units of {found} resources, and there are {resources}")));
            }
            Ok(Request { line, duration: *duration, units: units.to_vec() })
        };
        rows.map(read).collect()
    }

    fn availabilities(&self, resources: usize) -> Result<(usize, Vec<u32>), InvalidProject> {
        let mut rows = self.rows("RESOURCEAVAILABILITIES", 1, 1)?;
        match rows.pop() {
            Some((line, units)) if units.len() == resources => Ok((line, units)),
            other => {
                let (line, found) = other.map_or((1, 0), |(line, units)| (line, units.len()));
                Err(wrong(line, format!("units of {found} resources, and there are {resources}")))
            }
        }
    }
}

fn is_job(line: usize, job: u32, at: usize) -> Result<(), InvalidProject> {
    let expected = at + 1;
    if job as usize == expected {
        Ok(())
    } else {
        Err(wrong(line, format!("job {job} where job {expected} is expected")))
    }
}

fn number(line: usize, word: &str) -> Result<u32, InvalidProject> {
    let number = word.parse::<u32>().ok().filter(|number| *number <= MAX_NUMBER);
    number.ok_or_else(|| wrong(line, format!("`{word}` is no number from 0 to {MAX_NUMBER}")))
}

/// The jobs, each after its predecessors.
fn in_order(precedences: &[Precedence]) -> Result<Vec<usize>, InvalidProject> {
    let mut open = vec![0_usize; precedences.len()];
    for job in precedences.iter().flat_map(|precedence| &precedence.behind) {
        open[*job] += 1;
    }
    let mut order: Vec<usize> = (0..open.len()).filter(|job| open[*job] == 0).collect();
    let mut next = 0;
    while let Some(job) = order.get(next) {
        next += 1;
        for behind in &precedences[*job].behind {
            open[*behind] -= 1;
            if open[*behind] == 0 {
                order.push(*behind);
            }
        }
    }
    match open.iter().position(|open| *open > 0) {
        None => Ok(order),
        Some(job) => Err(wrong(precedences[job].line, format!("job {} waits, over others, for itself", job + 1))),
    }
}

fn activities(order: &[usize], precedences: &[Precedence], requests: &[Request]) -> Vec<Activity> {
    let mut numbers = vec![0; order.len()];
    for (number, job) in order.iter().enumerate() {
        numbers[*job] = number;
    }
    let mut activities: Vec<Activity> = Vec::with_capacity(order.len());
    for job in order {
        let request = &requests[*job];
        let demands = request.units.iter().enumerate().filter(|(_, units)| **units > 0);
        activities.push(Activity {
            name: format!("job{}", job + 1),
            duration_s: f64::from(request.duration),
            demands: demands.map(|(kind, units)| (kind, *units)).collect(),
            after: Vec::new(),
        });
    }
    for (job, precedence) in precedences.iter().enumerate() {
        for behind in &precedence.behind {
            activities[numbers[*behind]].after.push(numbers[job]);
        }
    }
    for activity in &mut activities {
        activity.after.sort_unstable();
        activity.after.dedup();
    }
    activities
}

#[cfg(test)]
mod tests;
