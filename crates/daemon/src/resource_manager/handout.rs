//! Distributes demand to providers: each missing unit is asked of one, so that two hosts do not both start a worker for it.
//!
//! ```text
//!   asked of the first that has room ──▶ there in time ──▶ met
//!        ▲                                    │ no progress for too long, reports no room, or is gone
//!        └───────────── the next one ◀────────┘
//! ```
//! Reliable providers come first: those that failed go behind those that did not, and a provider that has never provided anything counts as having
//! failed once. A provider stays responsible for what it was asked as long as it has room for it. Demand beyond all room is told to every provider
//! that could ever meet it, so that the waiters are told why there is no more. A pure state machine: the result depends only on the reports so far.

use ratn_model::time::Timestamp;
use ratn_resources::SessionId;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

/// A demand.
#[derive(Debug, Clone)]
pub(super) struct Missing {
    /// Equal for equal selectors.
    pub(super) selector: Arc<str>,
    /// The missing amount.
    pub(super) count: u32,
    /// What each provider can contribute.
    pub(super) of: Vec<Part>,
}

/// What one provider can contribute to a demand.
#[derive(Debug, Clone, Copy)]
pub(super) struct Part {
    /// How much of it the provider provides already.
    pub(super) provided: u32,
    /// How much more it can provide now; `None` if it never can.
    pub(super) room: Option<u32>,
}

/// See the module.
#[derive(Debug)]
pub(super) struct HandOut {
    patience: Duration,
    turns: BTreeMap<(Arc<str>, SessionId), Turn>,
    /// The turns after the present round.
    next: BTreeMap<(Arc<str>, SessionId), Turn>,
    track_records: BTreeMap<SessionId, TrackRecord>,
}

/// How well a provider has done, whatever it was asked for.
#[derive(Debug, Clone, Copy, Default)]
struct TrackRecord {
    /// Whether it has provided anything that was missing.
    proven: bool,
    /// How often it ran out of time without progress, since its last progress.
    failed: u32,
}

impl TrackRecord {
    fn rank(self) -> u32 {
        self.failed.saturating_add(u32::from(!self.proven))
    }
}

/// A request to a provider.
#[derive(Debug, Clone, Copy)]
struct Turn {
    /// The amount; 0 while it is the turn of other providers.
    asked: u32,
    /// The amount provided at the last progress.
    provided: u32,
    since: Timestamp,
    /// How often the request was passed on to other providers.
    passed: u32,
}

impl HandOut {
    /// A provider has `patience` to make progress with what it is asked.
    pub(super) fn new(patience: Duration) -> HandOut {
        HandOut { patience, turns: BTreeMap::new(), next: BTreeMap::new(), track_records: BTreeMap::new() }
    }

    /// Begins a round, in which all demands are handed out to these providers.
    pub(super) fn begin(&mut self, providers: &[SessionId]) {
        let providers: BTreeSet<&SessionId> = providers.iter().collect();
        self.track_records.retain(|session, _| providers.contains(session));
        self.next.clear();
    }

    /// The amount of a demand that each provider of the round is asked for now.
    pub(super) fn hand_out(&mut self, now: Timestamp, providers: &[SessionId], demand: &Missing) -> Vec<u32> {
        let mut asked = vec![0; providers.len()];
        let able = |(index, part): (usize, &Part)| {
            let room = part.room?;
            Some((index, room, self.turn(now, &demand.selector, &providers[index], part.provided)))
        };
        let mut able: Vec<(usize, u32, Turn)> = demand.of.iter().enumerate().filter_map(able).collect();
        able.sort_by_key(|(index, _, turn)| {
            let standing = self.track_records.get(&providers[*index]).copied().unwrap_or_default();
            (standing.rank(), turn.passed, !standing.proven, *index)
        });
        let mut left = demand.count;
        for (index, room, turn) in &able {
            let stays = turn.asked.min(*room).min(left);
            left -= stays;
            asked[*index] = stays;
        }
        for (index, room, mut turn) in able.iter().copied() {
            let share = &mut asked[index];
            let more = (room - *share).min(left);
            left -= more;
            *share += more;
            if turn.asked == 0 {
                (turn.since, turn.provided) = (now, demand.of[index].provided);
            }
            turn.asked = *share;
            self.next.insert((Arc::clone(&demand.selector), providers[index].clone()), turn);
        }
        for (index, ..) in able {
            asked[index] += left;
        }
        asked
    }

    /// Ends the round: demands that were not handed out in it are no longer missing.
    pub(super) fn end(&mut self) {
        self.turns = std::mem::take(&mut self.next);
    }

    /// The turn after the time that has passed.
    fn turn(&mut self, now: Timestamp, selector: &Arc<str>, session: &SessionId, provided: u32) -> Turn {
        let key = (Arc::clone(selector), session.clone());
        let standing = self.track_records.entry(session.clone()).or_default();
        standing.proven |= provided > 0;
        let Some(turn) = self.turns.get(&key).copied() else {
            return Turn { asked: 0, provided, since: now, passed: 0 };
        };
        if provided > turn.provided {
            standing.failed = 0;
            Turn { provided, since: now, ..turn }
        } else if turn.asked > 0 && turn.since + self.patience <= now {
            standing.failed = standing.failed.saturating_add(1);
            Turn { asked: 0, passed: turn.passed + 1, ..turn }
        } else {
            turn
        }
    }

    /// When a provider's time is over: then the demands have to be handed out again.
    pub(super) fn deadline(&self) -> Option<Timestamp> {
        self.turns.values().filter(|turn| turn.asked > 0).map(|turn| turn.since + self.patience).min()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PATIENCE: Duration = Duration::from_secs(15);

    fn sessions(names: &[&str]) -> Vec<SessionId> {
        names.iter().map(|&name| SessionId::from(name)).collect()
    }

    fn missing(count: u32, of: &[(u32, Option<u32>)]) -> [Missing; 1] {
        let of = of.iter().map(|&(provided, room)| Part { provided, room }).collect();
        [Missing { selector: "block Planner".into(), count, of }]
    }

    fn at(seconds: f64) -> Timestamp {
        Timestamp::from_seconds(seconds)
    }

    /// The requests of a round, by provider and demand.
    fn round(hand_out: &mut HandOut, now: Timestamp, providers: &[SessionId], missing: &[Missing]) -> Vec<Vec<u32>> {
        hand_out.begin(providers);
        let asked: Vec<_> = missing.iter().map(|demand| hand_out.hand_out(now, providers, demand)).collect();
        hand_out.end();
        (0..providers.len()).map(|index| asked.iter().map(|of| of[index]).collect()).collect()
    }

    /// The requests to two providers with this room.
    fn asked_with_room(hand_out: &mut HandOut, seconds: f64, count: u32, of: [(u32, Option<u32>); 2]) -> [u32; 2] {
        let asked = round(hand_out, at(seconds), &sessions(&["a", "b"]), &missing(count, &of));
        [asked[0][0], asked[1][0]]
    }

    /// The requests to two providers of at most 3 workers each.
    fn asked(hand_out: &mut HandOut, seconds: f64, count: u32, provided: [u32; 2]) -> [u32; 2] {
        asked_with_room(hand_out, seconds, count, provided.map(|provided| (provided, Some(3 - provided))))
    }

    #[test]
    fn what_one_provider_has_room_for_is_asked_of_one() {
        let mut hand_out = HandOut::new(PATIENCE);
        assert_eq!(asked(&mut hand_out, 0.0, 2, [0, 0]), [2, 0]);
        assert_eq!(asked(&mut hand_out, 1.0, 1, [1, 0]), [1, 0], "one is there");
    }

    #[test]
    fn what_is_beyond_its_room_is_asked_of_the_next_and_stays_there() {
        let mut hand_out = HandOut::new(PATIENCE);
        assert_eq!(asked(&mut hand_out, 0.0, 5, [0, 0]), [3, 2]);
        assert_eq!(asked(&mut hand_out, 1.0, 4, [1, 0]), [2, 2]);
        assert_eq!(asked(&mut hand_out, 2.0, 3, [1, 1]), [2, 1]);
        let mut hand_out = HandOut::new(PATIENCE);
        let room = |of_a| [(0, Some(of_a)), (0, Some(3))];
        assert_eq!(asked_with_room(&mut hand_out, 0.0, 2, room(1)), [1, 1]);
        assert_eq!(asked_with_room(&mut hand_out, 1.0, 2, room(3)), [1, 1], "also when there is room before it");
        assert_eq!(asked_with_room(&mut hand_out, 1.0, 1, room(3)), [1, 0], "for as long as it is missing");
    }

    #[test]
    fn what_nobody_has_room_for_is_told_to_all_beside_their_share() {
        let mut hand_out = HandOut::new(PATIENCE);
        assert_eq!(asked(&mut hand_out, 0.0, 8, [0, 0]), [5, 5]);
        let none = [(0, Some(0)), (0, Some(0))];
        assert_eq!(asked_with_room(&mut hand_out, 1.0, 8, none), [8, 8], "so that they try when there is room");
        assert_eq!(hand_out.deadline(), None, "nobody's time runs who has no room");
    }

    #[test]
    fn of_one_that_has_no_room_nothing_is_asked_that_another_can_provide() {
        let mut hand_out = HandOut::new(PATIENCE);
        assert_eq!(asked_with_room(&mut hand_out, 0.0, 2, [(0, Some(0)), (0, Some(3))]), [0, 2]);
        let alone = round(&mut hand_out, at(1.0), &sessions(&["a"]), &missing(2, &[(0, Some(0))]));
        assert_eq!(alone, [[2]], "and of whom else");
    }

    #[test]
    fn of_one_that_never_can_nothing_is_asked_whatever_is_missing() {
        let mut hand_out = HandOut::new(PATIENCE);
        assert_eq!(asked_with_room(&mut hand_out, 0.0, 9, [(0, None), (0, Some(3))]), [0, 9]);
        assert_eq!(asked_with_room(&mut hand_out, 0.0, 9, [(0, None), (0, None)]), [0, 0]);
        assert_eq!(hand_out.deadline(), None);
    }

    #[test]
    fn one_that_comes_no_closer_in_its_time_hands_it_on() {
        let mut hand_out = HandOut::new(PATIENCE);
        assert_eq!(asked(&mut hand_out, 0.0, 2, [0, 0]), [2, 0]);
        assert_eq!(hand_out.deadline(), Some(at(15.0)));
        assert_eq!(asked(&mut hand_out, 14.0, 1, [1, 0]), [1, 0]);
        assert_eq!(asked(&mut hand_out, 28.9, 1, [1, 0]), [1, 0], "one came at 14 s");
        assert_eq!(asked(&mut hand_out, 29.0, 1, [1, 0]), [0, 1]);
        assert_eq!(hand_out.deadline(), Some(at(44.0)));
        assert_eq!(asked(&mut hand_out, 44.0, 1, [1, 0]), [1, 0], "in turn");
    }

    /// Three providers that never provide the kind they offer, and the real one after them.
    #[test]
    fn who_fails_goes_to_the_end_and_who_never_provided_anything_comes_last() {
        let mut hand_out = HandOut::new(PATIENCE);
        let names = ["liar-1", "liar-2", "liar-3", "real"];
        let mut first = |seconds: f64, names: &[&str], provided: u32| {
            let part = |name: &&str| if *name == "real" { (provided, Some(3)) } else { (0, Some(3)) };
            let of: Vec<_> = names.iter().map(part).collect();
            let asked = round(&mut hand_out, at(seconds), &sessions(names), &missing(1, &of));
            names[asked.iter().position(|asked| asked[0] == 1).unwrap_or_default()].to_owned()
        };
        for (seconds, asked) in [(0.0, "liar-1"), (15.0, "liar-2"), (30.0, "liar-3"), (45.0, "real")] {
            assert_eq!(first(seconds, &names, 0), asked);
        }
        // It has provided: from now on it is asked first, also when new ones claim to provide as much.
        assert_eq!(first(50.0, &names, 1), "real");
        let more = ["liar-4", "liar-1", "liar-2", "liar-3", "real"];
        assert_eq!(first(51.0, &more, 1), "real");
        // It fails once: those that have never provided anything are asked instead, once each.
        assert_eq!(first(66.0, &more, 1), "liar-4");
        assert_eq!(first(81.0, &more, 1), "real");
    }

    #[test]
    fn a_demand_that_comes_again_is_not_asked_first_of_who_failed_the_last_time() {
        let mut hand_out = HandOut::new(PATIENCE);
        assert_eq!(asked(&mut hand_out, 0.0, 1, [0, 0]), [1, 0]);
        assert_eq!(asked(&mut hand_out, 15.0, 1, [0, 0]), [0, 1]);
        round(&mut hand_out, at(16.0), &sessions(&["a", "b"]), &[]);
        assert_eq!(asked(&mut hand_out, 17.0, 1, [0, 0]), [0, 1]);
    }

    #[test]
    fn of_one_that_is_gone_nothing_is_asked_and_a_demand_that_went_is_forgotten() {
        let mut hand_out = HandOut::new(PATIENCE);
        asked(&mut hand_out, 0.0, 2, [0, 0]);
        let left = round(&mut hand_out, at(1.0), &sessions(&["b"]), &missing(2, &[(0, Some(3))]));
        assert_eq!(left, [[2]]);
        round(&mut hand_out, at(2.0), &sessions(&["b"]), &[]);
        assert_eq!(hand_out.deadline(), None);
    }
}
