//! The desired size of a pool.
//!
//! ```text
//!   wanted = max(asked (at least `min`), held) + spares, or demanded or queued where that is more; at most `max`
//! ```
//! Idle workers above this size end after a while, those that have been idle for longest first; held workers never do. Demand (`demanded`)
//! is for workers that do not exist, and counts while it lasts. The queue (`queued`) waits for workers that exist and are held: a worker
//! that is being started for it is started to the end even where that wait is over by then, for the next request. If it were ended, waits
//! slightly shorter than a start would start workers again and again and never have one.

use super::demand::Demanded;
use ratn_model::time::Timestamp;
use ratn_proto::types::Scale;
use std::time::Duration;

/// See the module.
#[derive(Debug, Clone)]
pub(super) struct Size {
    min: u32,
    max: u32,
    spares: u32,
    /// The maximum of the config, which `max` never exceeds.
    most: u32,
    /// Number of workers that are kept without any demand.
    asked: u32,
    /// Workers wanted for requests that need more than exists; 0 without such requests.
    demanded: u32,
    /// Workers wanted for requests that wait for held ones; 0 without such requests.
    queued: u32,
    /// The highest `queued` since the last time that no worker was starting.
    begun: u32,
    /// The demand exceeds the maximum.
    short: bool,
}

impl Size {
    pub(super) fn new(min: u32, max: u32, spares: u32) -> Size {
        Size { min, max, spares, most: max, asked: min, demanded: 0, queued: 0, begun: 0, short: false }
    }

    /// Minimum and maximum number of workers, and the number kept ready beside held ones.
    pub(super) fn bounds(&self) -> (u32, u32, u32) {
        (self.min, self.max, self.spares)
    }

    /// Changes the bounds; a new minimum also replaces the number that was asked for.
    ///
    /// # Errors
    /// A message where the config does not allow it; nothing is changed then.
    pub(super) fn scale(&mut self, scale: Scale) -> Result<(), String> {
        let (min, max) = (scale.min.unwrap_or(self.min), scale.max.unwrap_or(self.max));
        let spares = scale.spares.unwrap_or(self.spares);
        if max > self.most {
            return Err(format!("max = {max} is more than its config's {}", self.most));
        }
        if min > max {
            return Err(format!("min = {min} is above max = {max}"));
        }
        if spares > 0 && min.saturating_add(spares) > max {
            return Err(format!("min + spares = {} is above max = {max}", min.saturating_add(spares)));
        }
        self.asked = if scale.min.is_some() { min } else { self.asked.min(max) };
        self.demanded = self.demanded.min(max);
        (self.queued, self.begun) = (self.queued.min(max), self.begun.min(max));
        (self.min, self.max, self.spares) = (min, max, spares);
        Ok(())
    }

    /// The wanted number of workers while `held` of them are held.
    pub(super) fn wanted(&self, held: u32) -> u32 {
        let others = self.demanded.max(self.queued).max(self.begun);
        self.asked.max(held).saturating_add(self.spares).max(others).min(self.max)
    }

    /// Whether the demand exceeds the maximum.
    pub(super) fn is_short(&self) -> bool {
        self.short
    }

    /// A client asks for more workers beyond `counted` (the number asked for so far, or in a failed pool the existing ones). False, with
    /// nothing changed, where that would exceed the maximum.
    pub(super) fn ask(&mut self, counted: u32, more: u32) -> bool {
        if more > self.max.saturating_sub(counted) {
            return false;
        }
        self.asked = (counted + more).max(self.min);
        true
    }

    /// The number that clients have asked for so far.
    pub(super) fn asked(&self) -> u32 {
        self.asked
    }

    /// A worker was ended on request.
    pub(super) fn one_less(&mut self) {
        self.asked = self.asked.saturating_sub(1).max(self.min);
    }

    /// Sets the demand. True where there was none before.
    pub(super) fn demand(&mut self, demanded: Demanded) -> bool {
        let begins = self.demanded == 0 && demanded.missing > 0;
        self.short = demanded.missing > self.max;
        self.demanded = demanded.missing.min(self.max);
        self.queued = demanded.queued.min(self.max);
        self.begun = self.begun.max(self.queued);
        begins
    }

    /// No worker is being started.
    pub(super) fn all_started(&mut self) {
        self.begun = self.queued;
    }
}

/// The idle workers (since when, and number) that end now where `surplus` are too many, and when the next one does.
pub(super) fn retiring(
    idle: impl Iterator<Item = (Timestamp, u64)>,
    surplus: u32,
    patience: Duration,
    now: Timestamp,
) -> (Vec<u64>, Option<Timestamp>) {
    if surplus == 0 {
        return (Vec::new(), None);
    }
    let mut idle: Vec<(Timestamp, u64)> = idle.collect();
    idle.sort_unstable();
    idle.truncate(surplus as usize);
    let due = idle.iter().take_while(|(since, _)| *since + patience <= now).count();
    let next = idle.get(due).map(|(since, _)| *since + patience);
    (idle[..due].iter().map(|(_, number)| *number).collect(), next)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    #[test]
    fn what_is_asked_for_stays_between_minimum_and_maximum() {
        let mut size = Size::new(1, 3, 0);
        assert!(size.ask(size.asked(), 2));
        assert_eq!(size.wanted(0), 3);
        assert!(!size.ask(size.asked(), 1));
        for _ in 0..5 {
            size.one_less();
        }
        assert_eq!(size.wanted(0), 1);
    }

    #[test]
    fn demand_raises_it_for_as_long_as_it_is_there_and_to_the_maximum_only() {
        let mut size = Size::new(0, 3, 0);
        let missing = |missing| Demanded { missing, queued: 0 };
        assert!(size.demand(missing(2)));
        assert_eq!((size.wanted(0), size.is_short()), (2, false));
        assert!(!size.demand(missing(9)), "it goes on");
        assert_eq!((size.wanted(0), size.is_short()), (3, true));
        size.demand(missing(0));
        assert_eq!((size.wanted(0), size.is_short()), (0, false));
    }

    #[test]
    fn what_is_begun_for_those_who_wait_for_what_is_held_is_wanted_until_it_is_there() {
        let mut size = Size::new(1, 3, 0);
        let queued = |queued| Demanded { missing: 0, queued };
        assert!(!size.demand(queued(2)), "nothing is missing: a failed pool is not tried again for it");
        assert_eq!(size.wanted(1), 2);
        size.demand(queued(0));
        assert_eq!(size.wanted(1), 2, "one is being started");
        size.all_started();
        assert_eq!(size.wanted(1), 1);
        size.demand(queued(9));
        assert_eq!((size.wanted(1), size.is_short()), (3, false), "nothing is missing");
    }

    #[test]
    fn spares_are_kept_beside_those_that_are_held() {
        let size = Size::new(2, 5, 1);
        let wanted = (0..=5).map(|held| size.wanted(held));
        assert_eq!(wanted.collect::<Vec<_>>(), [3, 3, 3, 4, 5, 5]);
        let growing = Size::new(0, 3, 1);
        let wanted = (0..=3).map(|held| growing.wanted(held));
        assert_eq!(wanted.collect::<Vec<_>>(), [1, 2, 3, 3], "one more while all are held");
    }

    #[test]
    fn it_is_scaled_within_what_the_config_allows() {
        let mut size = Size::new(1, 4, 0);
        size.ask(1, 3);
        let scaled = |min, max, spares| Scale { min, max, spares };
        assert_eq!(size.scale(scaled(None, Some(5), None)).unwrap_err(), "max = 5 is more than its config's 4");
        assert_eq!(size.scale(scaled(Some(3), Some(2), None)).unwrap_err(), "min = 3 is above max = 2");
        assert_eq!(size.scale(scaled(Some(2), None, Some(3))).unwrap_err(), "min + spares = 5 is above max = 4");
        assert_eq!((size.bounds(), size.wanted(0)), ((1, 4, 0), 4), "nothing has changed");
        size.scale(scaled(None, Some(3), None)).unwrap();
        assert_eq!(size.wanted(0), 3);
        size.scale(scaled(Some(0), None, Some(1))).unwrap();
        assert_eq!((size.bounds(), size.wanted(0), size.wanted(9)), ((0, 3, 1), 1, 3));
    }

    #[test]
    fn of_those_too_many_the_longest_idle_end_first_each_when_it_is_due() {
        let (at, patience) = (Timestamp::from_seconds, Duration::from_secs(10));
        let idle = || [(at(3.0), 1), (at(1.0), 2), (at(2.0), 3)].into_iter();
        assert_eq!(retiring(idle(), 2, patience, at(10.0)), (vec![], Some(at(11.0))));
        assert_eq!(retiring(idle(), 2, patience, at(11.5)), (vec![2], Some(at(12.0))));
        assert_eq!(retiring(idle(), 2, patience, at(99.0)), (vec![2, 3], None));
        assert_eq!(retiring(idle(), 0, patience, at(99.0)), (vec![], None));
    }
}
