//! Mutual exclusion of the tool, measured at the provider and at those who held it.

use super::clients::client_of;
use super::history::{Done, History, NEVER, ToolHold};
use super::provider::Step;
use std::collections::BTreeMap;
use std::time::Duration;

/// What was measured of the tool in a round.
#[derive(Debug, Default, Clone, Copy)]
pub(crate) struct Measured {
    pub(crate) steps: usize,
    pub(crate) holders: usize,
    /// The longest that it moved under a lease after another client was told that it holds the tool.
    pub(crate) latest: Duration,
}

/// What is wrong with the steps, in words; and what was measured. It may not move for longer than `bound` under a lease after another client
/// was told that it holds the tool.
pub(crate) fn check(steps: &[Step], history: &History, bound: Duration) -> (Vec<String>, Measured) {
    let mut wrong = Vec::new();
    // Steps are in the order in which they were taken; two processes that move at the same time show in the times.
    for pair in steps.windows(2) {
        let [before, after] = pair else { continue };
        if after.at < before.at {
            wrong.push(format!("two of them move at the same time: {before:?}, then {after:?}"));
        }
        if after.token < before.token {
            wrong.push(format!("the token went back: {before:?}, then {after:?}"));
        }
    }
    let mut intervals: BTreeMap<u64, (u64, u64)> = BTreeMap::new();
    for step in steps {
        let interval = intervals.entry(step.token).or_insert((step.at, step.at));
        interval.1 = step.at;
        let Some(grant) = history.grants.get(&step.token) else {
            wrong.push(format!("it moved under a token that nobody saw granted: {step:?}"));
            continue;
        };
        let mover = step.goal.split('/').next();
        if grant.lease != step.lease || Some(grant.session.as_str()) != mover {
            wrong.push(format!("it moved for another than the holder: {step:?} under {grant:?}"));
        }
    }
    wrong.extend(two_holders(history));
    wrong.extend(granted_in_motion(&intervals, history));
    let latest = intervals.iter().flat_map(|(token, (_, last))| {
        let next = history.holds.iter().filter(move |hold| hold.token > *token).map(|hold| hold.granted).min();
        next.map(|granted| last.saturating_sub(granted))
    });
    let latest = Duration::from_nanos(latest.max().unwrap_or_default());
    if latest > bound {
        wrong.push(format!("it moved for {latest:?} after the next one was granted it; {bound:?} is allowed"));
    }
    (wrong, Measured { steps: steps.len(), holders: intervals.len(), latest })
}

/// Motions that went on when the next client had been granted the tool, of holders that had not given it back: the provider confirms that
/// they stand still, or offers the tool anew when they do.
fn granted_in_motion(intervals: &BTreeMap<u64, (u64, u64)>, history: &History) -> Vec<String> {
    let mut wrong = Vec::new();
    for hold in &history.holds {
        let Some((_, last)) = intervals.get(&hold.token) else { continue };
        let next = history.holds.iter().filter(|next| next.token > hold.token).min_by_key(|next| next.token);
        if let Some(next) = next
            && next.granted < hold.released
            && next.granted < *last
        {
            wrong.push(format!("it moved until {last} for {hold:?}, when {next:?} had been granted"));
        }
    }
    wrong
}

/// Leases of the tool whose holders were both told that they have it, while neither had given it back nor could have lost it.
fn two_holders(history: &History) -> Vec<String> {
    if history.tool_vanished {
        return Vec::new();
    }
    let mut holds = history.holds.clone();
    holds.sort_by_key(|hold| hold.token);
    let mut wrong = Vec::new();
    for pair in holds.windows(2) {
        let [before, after] = pair else { continue };
        let until = before.released.min(session_lives(before, history));
        if after.granted < until {
            wrong.push(format!("{before:?}, which nothing ended before {until}, and {after:?}"));
        }
    }
    wrong
}

/// Until when the session of a holder cannot have expired, by its pings.
fn session_lives(hold: &ToolHold, history: &History) -> u64 {
    let mut until = 0;
    for timed in &history.threads[2 * hold.session + 1] {
        let Done::Pinged { ttl, .. } = timed.call.done else { continue };
        if until != 0 && until < timed.end && timed.end > hold.granted {
            // It may have come too late.
            break;
        }
        if timed.begin > hold.granted && until == 0 {
            break;
        }
        until = timed.begin + ttl;
    }
    until
}

/// The tool's leases that nobody can have got: for the message.
pub(crate) fn told(history: &History) -> String {
    let of = |hold: &ToolHold| {
        let released = if hold.released == NEVER { "never".to_owned() } else { hold.released.to_string() };
        format!("client-{} {} from {} to {released}", hold.session, hold.token, hold.granted)
    };
    let holds: Vec<String> = history.holds.iter().map(of).collect();
    let unheard = history.grants.iter().filter(|(_, grant)| client_of(&grant.session).is_none());
    format!("{}\nof nobody here: {:?}", holds.join("\n"), unheard.collect::<Vec<_>>())
}
