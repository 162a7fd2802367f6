//! Rate limit of new connections per user or host. A pure state machine: time is an argument.

use super::Origin;
use crate::token_bucket::TokenBucket;
use std::collections::BTreeMap;
use std::time::Instant;

/// Maximum number of origins with a rate of their own; all further ones share one rate.
const MOST_ORIGINS: usize = 4_096;

/// See the module.
#[derive(Debug)]
pub(super) struct Rates {
    per_s: u32,
    at_once: u32,
    of: BTreeMap<Origin, TokenBucket>,
}

impl Rates {
    pub(super) fn new(per_s: u32, at_once: usize) -> Rates {
        let at_once = u32::try_from(at_once).unwrap_or(u32::MAX).max(per_s);
        Rates { per_s, at_once, of: BTreeMap::new() }
    }

    /// Whether one more connection from this origin is accepted.
    pub(super) fn admit(&mut self, now: Instant, origin: Origin) -> bool {
        let Rates { per_s, at_once, ref mut of } = *self;
        if of.len() >= MOST_ORIGINS && !of.contains_key(&origin) {
            of.retain(|_, rate| !rate.is_full(per_s, at_once, now));
        }
        let origin = if of.len() < MOST_ORIGINS || of.contains_key(&origin) { origin } else { Origin::Unknown };
        of.entry(origin).or_insert_with(|| TokenBucket::full(at_once, now)).take(per_s, at_once, now)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    fn accepted(rates: &mut Rates, now: Instant, origin: Origin, tried: usize) -> usize {
        (0..tried).filter(|_| rates.admit(now, origin)).count()
    }

    #[test]
    fn one_user_connects_so_often_and_another_is_not_kept_from_it() {
        let (mut rates, start) = (Rates::new(200, 768), Instant::now());
        let (eve, adam) = (Origin::User(7), Origin::User(8));
        assert_eq!(accepted(&mut rates, start, eve, 5_000), 768, "all that may be there at once");
        assert_eq!(accepted(&mut rates, start, adam, 5), 5);
        assert_eq!(accepted(&mut rates, start + Duration::from_secs(1), eve, 5_000), 200);
        assert_eq!(accepted(&mut rates, start + Duration::from_secs(60), eve, 5_000), 768);
    }

    #[test]
    fn hosts_beyond_number_share_a_rate_until_others_have_been_quiet() {
        let (mut rates, start) = (Rates::new(1, 2), Instant::now());
        let host = |number: usize| Origin::Host(u32::try_from(number).map_or([0; 4], u32::to_be_bytes).into());
        let hosts = (0..2 * MOST_ORIGINS).filter(|number| rates.admit(start, host(*number))).count();
        assert_eq!(hosts, MOST_ORIGINS + 2);
        assert_eq!(rates.of.len(), MOST_ORIGINS + 1);
        let later = start + Duration::from_secs(5);
        assert_eq!(accepted(&mut rates, later, host(2 * MOST_ORIGINS), 5), 2);
        assert_eq!(rates.of.len(), 1, "who has been quiet is forgotten");
    }
}
