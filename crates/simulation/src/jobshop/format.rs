//! The text formats of job shops: the standard one (per job, pairs of machine and duration) and Taillard's (a matrix of
//! durations under `Times`, then one of machines from 1 under `Machines`).

use super::JobShop;

/// Limit of the operations of an instance.
pub const MAX_OPERATIONS: usize = 10_000;

/// Error: the text is no instance.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("line {line}: {problem}")]
pub struct InvalidJobShop {
    /// The line, counted from 1.
    pub line: usize,
    /// What is wrong, and what to write instead.
    pub problem: String,
}

fn wrong(line: usize, problem: String) -> InvalidJobShop {
    InvalidJobShop { line, problem }
}

/// A line of numbers.
type Row<'a> = (usize, &'a str);

impl JobShop {
    /// Parses a text: a line with the numbers of jobs and machines (the rest of the line is ignored), then a line per job with
    /// pairs of machine (from 0) and duration; or Taillard's matrices. Empty lines, and lines that do not begin with a number,
    /// are comments.
    ///
    /// # Errors
    /// [`InvalidJobShop`] names the first line that does not fit.
    pub fn parse(text: &str) -> Result<JobShop, InvalidJobShop> {
        let lines = || text.lines().enumerate().map(|(number, line)| (number + 1, line.trim()));
        let is_numbers = |line: &str| line.starts_with(|c: char| c.is_ascii_digit() || c == '-');
        let titled = |title: &str| lines().find(|(_, line)| line.eq_ignore_ascii_case(title)).map(|(number, _)| number);
        let mut rows = lines().filter(|(_, line)| is_numbers(line));
        let Some((line, first)) = rows.next() else {
            return Err(wrong(1, "there is no line with the numbers of jobs and machines".to_owned()));
        };
        let numbers: Vec<usize> = first.split_whitespace().map_while(|word| word.parse().ok()).collect();
        let [count, machines, ..] = numbers.as_slice() else {
            return Err(wrong(line, format!("expected the numbers of jobs and machines, found `{first}`")));
        };
        let (count, machines) = (*count, *machines);
        if count == 0 || machines == 0 || count.saturating_mul(machines) > MAX_OPERATIONS {
            let limits = format!("both must be at least 1, and there are at most {MAX_OPERATIONS} operations");
            return Err(wrong(line, format!("{count} jobs on {machines} machines: {limits}")));
        }
        let last = text.lines().count();
        let jobs = match (titled("times"), titled("machines")) {
            (Some(times), Some(order)) => {
                let below = |after: usize, before: usize| -> Vec<Row<'_>> {
                    lines().filter(|(n, line)| *n > after && *n < before && is_numbers(line)).collect()
                };
                let bound = |title: usize, other: usize| if other > title { other } else { usize::MAX };
                let durations = below(times, bound(times, order));
                let order = below(order, bound(order, times));
                counted(&durations, count, last)?;
                counted(&order, count, last)?;
                durations.iter().zip(&order).map(|(d, o)| matrix_row(d, o, machines)).collect::<Result<_, _>>()?
            }
            _ => {
                let rows: Vec<Row<'_>> = rows.collect();
                counted(&rows, count, last)?;
                rows.iter().map(|row| pairs(row, machines)).collect::<Result<_, _>>()?
            }
        };
        Ok(JobShop { machines, jobs })
    }
}

fn counted(rows: &[Row<'_>], count: usize, last: usize) -> Result<(), InvalidJobShop> {
    if let Some((line, _)) = rows.get(count) {
        return Err(wrong(*line, format!("this is the line of a job, and there are {count} already")));
    }
    if rows.len() < count {
        return Err(wrong(last, format!("{count} jobs are announced and {} are there", rows.len())));
    }
    Ok(())
}

fn pairs((line, text): &Row<'_>, machines: usize) -> Result<Vec<(usize, f64)>, InvalidJobShop> {
    let words: Vec<&str> = text.split_whitespace().collect();
    if words.len() % 2 == 1 {
        let found = words.len();
        return Err(wrong(*line, format!("expected pairs of machine and duration, found {found} numbers")));
    }
    words.chunks(2).map(|pair| Ok((machine(*line, pair[0], machines, 0)?, duration(*line, pair[1])?))).collect()
}

fn matrix_row(durations: &Row<'_>, order: &Row<'_>, machines: usize) -> Result<Vec<(usize, f64)>, InvalidJobShop> {
    let times: Vec<&str> = durations.1.split_whitespace().collect();
    let order_words: Vec<&str> = order.1.split_whitespace().collect();
    if times.len() != order_words.len() {
        let found = format!("{} machines for the {} durations of line {}", order_words.len(), times.len(), durations.0);
        return Err(wrong(order.0, format!("there are {found}")));
    }
    let operations = order_words.iter().zip(times);
    operations.map(|(m, d)| Ok((machine(order.0, m, machines, 1)?, duration(durations.0, d)?))).collect()
}

fn machine(line: usize, word: &str, machines: usize, first: usize) -> Result<usize, InvalidJobShop> {
    let number = word.parse::<usize>().ok().and_then(|number| number.checked_sub(first));
    number
        .filter(|machine| *machine < machines)
        .ok_or_else(|| wrong(line, format!("`{word}` is no machine: they are {first} to {}", machines - 1 + first)))
}

fn duration(line: usize, word: &str) -> Result<f64, InvalidJobShop> {
    /// Limit of a duration, in seconds.
    const LONGEST_S: f64 = 1e6;
    let number = word.parse::<f64>().ok().filter(|duration| (0.0..=LONGEST_S).contains(duration));
    number.ok_or_else(|| wrong(line, format!("`{word}` is no duration from 0 to {LONGEST_S}")))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]

    use super::*;

    #[test]
    fn what_is_no_instance_is_refused_with_its_line() {
        let refusal = |text: &str| JobShop::parse(text).unwrap_err().to_string();
        assert_eq!(refusal(""), "line 1: there is no line with the numbers of jobs and machines");
        assert_eq!(refusal("# a comment\n2 2\n0 1 1 2\n0 1 2 2\n"), "line 4: `2` is no machine: they are 0 to 1");
        assert_eq!(refusal("1 1\n0 1\n0 1\n"), "line 3: this is the line of a job, and there are 1 already");
        assert_eq!(refusal("2 1\n0 1\n"), "line 2: 2 jobs are announced and 1 are there");
        assert_eq!(refusal("1 1\n0 x\n"), "line 2: `x` is no duration from 0 to 1000000");
        assert_eq!(refusal("1 1\n0 1 0\n"), "line 2: expected pairs of machine and duration, found 3 numbers");
        assert_eq!(
            refusal("1000 1000\n"),
            "line 1: 1000 jobs on 1000 machines: both must be at least 1, and there are at most 10000 operations"
        );
    }

    #[test]
    fn both_formats_say_the_same() {
        let pairs = JobShop::parse("+++ an instance\n\n 2 2\n0 3 1 2\n 1 2 0 4 \n").unwrap();
        let matrices =
            JobShop::parse("jobs machines seed\n2 2 840612802\nTimes\n3 2\n2 4\nMachines\n1 2\n2 1\n").unwrap();
        assert_eq!(pairs, matrices);
        assert_eq!(pairs.jobs, vec![vec![(0, 3.0), (1, 2.0)], vec![(1, 2.0), (0, 4.0)]]);
    }

    #[test]
    fn a_matrix_that_does_not_fit_is_refused_with_its_line() {
        let refusal = |text: &str| JobShop::parse(text).unwrap_err().to_string();
        assert_eq!(refusal("1 2\nTimes\n3 2\nMachines\n1 3\n"), "line 5: `3` is no machine: they are 1 to 2");
        assert_eq!(
            refusal("1 2\nTimes\n3 2\nMachines\n1\n"),
            "line 5: there are 1 machines for the 2 durations of line 3"
        );
    }
}
