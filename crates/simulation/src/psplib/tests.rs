#![allow(clippy::unwrap_used, reason = "a test may panic")]

use super::*;
use crate::activities::Execution;

/// Three jobs between source and sink, with two units of one resource and one unit of another.
const SMALL: &str = include_str!("../../../../tests/projects/small.sm");

#[test]
fn a_project_is_activities_with_units_of_resources() {
    let project = parse(SMALL).unwrap();
    assert_eq!(project.kinds, [("R1".to_owned(), 2), ("R2".to_owned(), 1)]);
    let of = |activity: &Activity| (activity.duration_s, activity.demands.clone(), activity.after.clone());
    let found: Vec<_> = project.activities.iter().map(of).collect();
    let expected = [
        (0.0, vec![], vec![]),
        (3.0, vec![(0, 1)], vec![0]),
        (4.0, vec![(0, 2), (1, 1)], vec![0]),
        (2.0, vec![(0, 1), (1, 1)], vec![1]),
        (0.0, vec![], vec![2, 3]),
    ];
    assert_eq!(found, expected);
    assert_eq!(project.lower_bound_s(), 6.5, "13 units of work on two");
    for orders in [0, 100] {
        let run = project.execute(Execution { orders, ..Execution::default() }).unwrap();
        assert_eq!((run.outcome.as_str(), run.end_s), ("success", 9.0), "no two of the three can overlap");
    }
}

#[test]
fn what_is_no_project_is_refused_with_its_line() {
    let refusal = |from: &str, to: &str| {
        assert!(SMALL.contains(from), "{from}");
        parse(&SMALL.replacen(from, to, 1)).unwrap_err().to_string()
    };
    assert_eq!(refusal("jobs (incl", "jebs (incl"), "line 29: there is no line `jobs …: NUMBER`");
    assert_eq!(refusal(":  5\n", ":  x\n"), "line 3: `x` is no number from 0 to 1000000");
    assert_eq!(refusal(":  5\n", ":  20000\n"), "line 3: 20000 jobs: there must be at least one, and at most 10000");
    let nonrenewable = "line 6: there are 2 nonrenewable resources, and only renewable ones can be had";
    assert_eq!(refusal("0   N", "2   N"), nonrenewable);
    assert_eq!(
        refusal("2        1          1           4", "2   3   1   4"),
        "line 12: job 2 has 3 modes, and only one can be had"
    );
    assert_eq!(
        refusal("2        1          1           4", "2   1   2   4"),
        "line 12: 2 successors are announced and 1 are there"
    );
    assert_eq!(
        refusal("2        1          1           4", "2   1   1   7"),
        "line 12: `7` is no job: they are 1 to 5"
    );
    assert_eq!(refusal("2        1          1           4", "3   1   1   4"), "line 12: job 3 where job 2 is expected");
    assert_eq!(
        refusal("4        1          1           5", "4   1   1   2"),
        "line 12: job 2 waits, over others, for itself"
    );
    assert_eq!(
        refusal("  5      1     0       0    0\n", ""),
        "line 24: section `REQUESTS/DURATIONS` has 4 lines, and 5 are expected"
    );
    assert_eq!(
        refusal("0    0\n****", "0    0\n  6  1  0  0  0\n****"),
        "line 25: section `REQUESTS/DURATIONS` has more than the 5 lines expected"
    );
    assert_eq!(refusal("4       2    1", "4       2"), "line 22: units of 1 resources, and there are 2");
    assert_eq!(refusal("4       2    1", "4       3    1"), "line 22: job 3 needs 3 of R1, and line 28 has 2");
    assert_eq!(refusal("    2    1\n*", "    2\n*"), "line 28: units of 1 resources, and there are 2");
    assert_eq!(refusal("RESOURCEAVAIL", "RESOURCESAVAIL"), "line 29: there is no section `RESOURCEAVAILABILITIES`");
}

#[test]
fn a_damaged_project_is_read_or_refused_and_never_more() {
    for cut in 0..SMALL.len() {
        let _ = parse(&SMALL[..cut]);
        let mut bytes = SMALL.as_bytes().to_vec();
        for byte in [b'9', b'-', b' ', b'\n', b'*', b':'] {
            bytes[cut] = byte;
            let _ = parse(std::str::from_utf8(&bytes).unwrap());
        }
    }
}
