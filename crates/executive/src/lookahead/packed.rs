//! Amounts of several kinds in a few machine words: one subtraction takes all amounts, and one test tells whether there is enough of each.
//!
//! Each kind has a lane of bits for its largest amount, counted in the largest unit that divides all its amounts, and above it a guard bit.
//! The guard bits of a free amount are set: a subtraction that clears one shows that there was too little of that kind
//! (Lamport, Multiple byte processing with full-word instructions, 1975).

use super::network::Demand;

#[derive(Debug, Clone, Default)]
pub(super) struct Lanes {
    /// By kind.
    lanes: Vec<Lane>,
    /// Per word.
    guards: Vec<u64>,
}

#[derive(Debug, Clone, Copy)]
struct Lane {
    word: usize,
    shift: u32,
    unit: u64,
}

impl Lanes {
    /// Lanes for amounts up to `capacity`, and for these demands.
    pub(super) fn of<'a>(capacity: &[u64], demands: impl Iterator<Item = &'a Demand>) -> Lanes {
        let mut units = capacity.to_vec();
        for demand in demands {
            let unit = &mut units[demand.kind as usize];
            *unit = greatest_divisor(*unit, demand.units);
        }
        let mut guards: Vec<u64> = Vec::new();
        let mut used = u64::BITS;
        let lanes = capacity.iter().zip(units).map(|(most, unit)| {
            let unit = unit.max(1);
            let bits = (u64::BITS - (most / unit).leading_zeros()).min(u64::BITS - 1);
            if used + bits + 1 > u64::BITS {
                guards.push(0);
                used = 0;
            }
            let (word, shift) = (guards.len() - 1, used);
            guards[word] |= 1 << (shift + bits);
            used += bits + 1;
            Lane { word, shift, unit }
        });
        Lanes { lanes: lanes.collect(), guards }
    }

    /// Number of words for the amounts of all kinds.
    pub(super) fn words(&self) -> usize {
        self.guards.len()
    }

    /// Demands as words.
    pub(super) fn wanted(&self, demands: &[Demand]) -> Vec<u64> {
        let mut words = vec![0; self.words()];
        for demand in demands {
            let lane = self.lanes[demand.kind as usize];
            words[lane.word] += (demand.units / lane.unit) << lane.shift;
        }
        words
    }

    pub(super) fn free(&self, amounts: &[u64]) -> Vec<u64> {
        let mut words = self.guards.clone();
        for (lane, amount) in self.lanes.iter().zip(amounts) {
            words[lane.word] += (amount / lane.unit) << lane.shift;
        }
        words
    }

    /// Whether there is enough free of each kind for what is wanted.
    pub(super) fn has(&self, free: &[u64], wanted: &[u64]) -> bool {
        let words = free.iter().zip(wanted).zip(&self.guards);
        words.into_iter().all(|((free, wanted), guards)| (free.wrapping_sub(*wanted)) & guards == *guards)
    }
}

fn greatest_divisor(one: u64, other: u64) -> u64 {
    let (mut one, mut other) = (one, other);
    while other > 0 {
        (one, other) = (other, one % other);
    }
    one
}

#[cfg(test)]
mod tests {
    use super::super::dice::Dice;
    use super::*;

    #[test]
    fn there_is_enough_exactly_where_there_is_enough_of_each_kind() {
        let mut dice = Dice(1);
        for _ in 0..2_000 {
            let sizes = [1, 2, 3, 1_000, 7_000, 123_456_789, u64::from(u32::MAX) * 1_000];
            let kinds = 1 + dice.below(9);
            let capacity: Vec<u64> = (0..kinds).map(|_| sizes[dice.below(sizes.len())]).collect();
            let draw = |dice: &mut Dice| -> Vec<u64> {
                capacity
                    .iter()
                    .map(|most| if dice.below(4) == 0 { *most } else { dice.below(*most as usize + 1) as u64 })
                    .collect()
            };
            let (free, wanted) = (draw(&mut dice), draw(&mut dice));
            let demands: Vec<Demand> =
                wanted.iter().enumerate().map(|(kind, units)| Demand { kind: kind as u32, units: *units }).collect();
            let held: Vec<Demand> =
                (0..kinds).map(|kind| Demand { kind: kind as u32, units: capacity[kind] - free[kind] }).collect();
            let lanes = Lanes::of(&capacity, demands.iter().chain(&held));
            let is_enough = free.iter().zip(&wanted).all(|(free, wanted)| free >= wanted);
            assert_eq!(lanes.has(&lanes.free(&free), &lanes.wanted(&demands)), is_enough, "{free:?} {wanted:?}");
        }
    }
}
