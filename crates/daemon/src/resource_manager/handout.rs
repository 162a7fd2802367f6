//! Which provider meets which demand: each unit that is missing is asked of one, so that two hosts do not both start a worker for it.
//!
//! ```text
//!   asked of the first that has room ──▶ there in time ──▶ met
//!        ▲                                    │ no progress for too long, says that it cannot, or is gone
//!        └───────────── the next one ◀────────┘
//! ```
//! What is beyond all room is told to everybody, so that who waits hears why there is no more. A pure state machine: what is
//! asked of whom depends on nothing but what was said so far, and is the same as long as that is.

use ratn_model::time::Timestamp;
use ratn_resources::SessionId;
use std::collections::BTreeMap;
use std::time::Duration;

/// Who can provide.
#[derive(Debug, Clone)]
pub(super) struct Provider {
    pub(super) session: SessionId,
    /// Kinds, and how many of each at the most.
    pub(super) kinds: BTreeMap<String, u32>,
}

/// What is missing.
#[derive(Debug, Clone)]
pub(super) struct Missing {
    /// The same for the same selector.
    pub(super) selector: String,
    /// The kinds that would do.
    pub(super) kinds: Vec<String>,
    /// How much.
    pub(super) count: u32,
    /// Of each provider: how much of it it provides already, and whether it has said that it cannot provide more.
    pub(super) of: Vec<(u32, bool)>,
}

/// See the module.
#[derive(Debug)]
pub(super) struct HandOut {
    patience: Duration,
    turns: BTreeMap<(String, SessionId), Turn>,
}

/// What was asked of a provider.
#[derive(Debug, Clone, Copy)]
struct Turn {
    /// How much; 0 where it is the turn of others.
    asked: u32,
    /// What it provided when there was progress last.
    provided: u32,
    since: Timestamp,
    /// How often it was passed on to others.
    passed: u32,
}

impl HandOut {
    /// A provider has so long to come closer to what is asked of it.
    pub(super) fn new(patience: Duration) -> HandOut {
        HandOut { patience, turns: BTreeMap::new() }
    }

    /// How much of each demand (the second index) is asked of each provider now.
    pub(super) fn hand_out(&mut self, now: Timestamp, providers: &[Provider], missing: &[Missing]) -> Vec<Vec<u32>> {
        let mut turns = BTreeMap::new();
        let mut asked = vec![vec![0; missing.len()]; providers.len()];
        for (at, demand) in missing.iter().enumerate() {
            let turn = |index: usize| self.turn(now, &demand.selector, &providers[index].session, demand.of[index].0);
            let most =
                |index: usize| demand.kinds.iter().filter_map(|kind| providers[index].kinds.get(kind)).sum::<u32>();
            let mut able: Vec<(usize, Turn)> =
                (0..providers.len()).filter(|index| most(*index) > 0).map(|index| (index, turn(index))).collect();
            able.sort_by_key(|(index, turn)| (demand.of[*index].1, turn.passed, *index));
            let mut left = demand.count;
            for (index, turn) in &mut able {
                let (provided, _) = demand.of[*index];
                let share = most(*index).saturating_sub(provided).min(left);
                left -= share;
                if turn.asked == 0 {
                    (turn.since, turn.provided) = (now, provided);
                }
                turn.asked = share;
                asked[*index][at] = share;
            }
            for (index, turn) in able {
                asked[index][at] += left;
                turns.insert((demand.selector.clone(), providers[index].session.clone()), turn);
            }
        }
        self.turns = turns;
        asked
    }

    /// As it is after what has passed since.
    fn turn(&self, now: Timestamp, selector: &str, session: &SessionId, provided: u32) -> Turn {
        let key = (selector.to_owned(), session.clone());
        let Some(turn) = self.turns.get(&key).copied() else {
            return Turn { asked: 0, provided, since: now, passed: 0 };
        };
        if provided > turn.provided {
            Turn { provided, since: now, ..turn }
        } else if turn.asked > 0 && turn.since + self.patience <= now {
            Turn { asked: 0, passed: turn.passed + 1, ..turn }
        } else {
            turn
        }
    }

    /// When somebody's time is over: what was handed out is to be handed out again then.
    pub(super) fn deadline(&self) -> Option<Timestamp> {
        self.turns.values().filter(|turn| turn.asked > 0).map(|turn| turn.since + self.patience).min()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PATIENCE: Duration = Duration::from_secs(15);

    fn provider(session: &str, most: u32) -> Provider {
        Provider { session: SessionId::from(session), kinds: [("PathPlanner".to_owned(), most)].into() }
    }

    fn missing(count: u32, of: &[(u32, bool)]) -> [Missing; 1] {
        let kinds = vec!["Planner".to_owned(), "PathPlanner".to_owned()];
        [Missing { selector: "block Planner".to_owned(), kinds, count, of: of.to_vec() }]
    }

    fn at(seconds: f64) -> Timestamp {
        Timestamp::from_seconds(seconds)
    }

    /// What is asked of each of two providers of at most 3 workers.
    fn asked(hand_out: &mut HandOut, seconds: f64, count: u32, of: [(u32, bool); 2]) -> [u32; 2] {
        let providers = [provider("a", 3), provider("b", 3)];
        let asked = hand_out.hand_out(at(seconds), &providers, &missing(count, &of));
        [asked[0][0], asked[1][0]]
    }

    #[test]
    fn what_one_provider_has_room_for_is_asked_of_one() {
        let mut hand_out = HandOut::new(PATIENCE);
        assert_eq!(asked(&mut hand_out, 0.0, 2, [(0, false), (0, false)]), [2, 0]);
        assert_eq!(asked(&mut hand_out, 1.0, 1, [(1, false), (0, false)]), [1, 0], "one is there");
    }

    #[test]
    fn what_is_beyond_its_room_is_asked_of_the_next_and_stays_there() {
        let mut hand_out = HandOut::new(PATIENCE);
        assert_eq!(asked(&mut hand_out, 0.0, 5, [(0, false), (0, false)]), [3, 2]);
        assert_eq!(asked(&mut hand_out, 1.0, 4, [(1, false), (0, false)]), [2, 2]);
        assert_eq!(asked(&mut hand_out, 2.0, 3, [(1, false), (1, false)]), [2, 1]);
    }

    #[test]
    fn what_nobody_has_room_for_is_told_to_all_beside_their_share() {
        let mut hand_out = HandOut::new(PATIENCE);
        assert_eq!(asked(&mut hand_out, 0.0, 8, [(0, false), (0, false)]), [5, 5]);
        assert_eq!(asked(&mut hand_out, 1.0, 8, [(0, true), (0, true)]), [5, 5], "that they say so changes nothing");
    }

    #[test]
    fn one_that_says_that_it_cannot_is_asked_last() {
        let mut hand_out = HandOut::new(PATIENCE);
        assert_eq!(asked(&mut hand_out, 0.0, 2, [(0, true), (0, false)]), [0, 2]);
        let alone = hand_out.hand_out(at(1.0), &[provider("a", 3)], &missing(2, &[(0, true)]));
        assert_eq!(alone, [[2]], "and of whom else");
    }

    #[test]
    fn one_that_comes_no_closer_in_its_time_hands_it_on() {
        let mut hand_out = HandOut::new(PATIENCE);
        assert_eq!(asked(&mut hand_out, 0.0, 2, [(0, false), (0, false)]), [2, 0]);
        assert_eq!(hand_out.deadline(), Some(at(15.0)));
        assert_eq!(asked(&mut hand_out, 14.0, 1, [(1, false), (0, false)]), [1, 0]);
        assert_eq!(asked(&mut hand_out, 28.9, 1, [(1, false), (0, false)]), [1, 0], "one came at 14 s");
        assert_eq!(asked(&mut hand_out, 29.0, 1, [(1, false), (0, false)]), [0, 1]);
        assert_eq!(hand_out.deadline(), Some(at(44.0)));
        assert_eq!(asked(&mut hand_out, 44.0, 1, [(1, false), (0, false)]), [1, 0], "in turn");
    }

    #[test]
    fn of_one_that_is_gone_nothing_is_asked_and_a_demand_that_went_is_forgotten() {
        let mut hand_out = HandOut::new(PATIENCE);
        asked(&mut hand_out, 0.0, 2, [(0, false), (0, false)]);
        let left = hand_out.hand_out(at(1.0), &[provider("b", 3)], &missing(2, &[(0, false)]));
        assert_eq!(left, [[2]]);
        hand_out.hand_out(at(2.0), &[provider("b", 3)], &[]);
        assert_eq!(hand_out.deadline(), None);
    }

    #[test]
    fn of_other_kinds_nothing_is_asked() {
        let other = Provider { session: SessionId::from("c"), kinds: [("Detector".to_owned(), 9)].into() };
        let asked = HandOut::new(PATIENCE).hand_out(at(0.0), &[other], &missing(2, &[(0, false)]));
        assert_eq!(asked, [[0]]);
    }
}
