//! How many workers a pool shall have: what was asked for, and what those who wait demand, between its minimum and maximum.

/// See the module.
#[derive(Debug, Clone)]
pub(super) struct Size {
    min: u32,
    max: u32,
    /// What is kept without any demand.
    asked: u32,
    /// How many there should be for those who wait; 0 when nobody does.
    demanded: u32,
    /// More is demanded than there may be.
    short: bool,
}

impl Size {
    pub(super) fn new(min: u32, max: u32) -> Size {
        Size { min, max, asked: min, demanded: 0, short: false }
    }

    /// How many there shall be now.
    pub(super) fn wanted(&self) -> u32 {
        self.asked.max(self.demanded)
    }

    /// More than were asked for so far are demanded, and more than there may be.
    pub(super) fn is_short(&self) -> bool {
        self.short
    }

    /// Somebody asks for so many more beyond `counted` (what was asked for so far, or of a failed pool what there is).
    /// False, and nothing is changed, where that were more than the maximum.
    pub(super) fn ask(&mut self, counted: u32, more: u32) -> bool {
        if more > self.max.saturating_sub(counted) {
            return false;
        }
        self.asked = (counted + more).max(self.min);
        true
    }

    /// What was asked for so far.
    pub(super) fn asked(&self) -> u32 {
        self.asked
    }

    /// One was ended on request.
    pub(super) fn one_less(&mut self) {
        self.asked = self.asked.saturating_sub(1).max(self.min);
    }

    /// So many are demanded now. True where nothing was before.
    pub(super) fn demand(&mut self, count: u32) -> bool {
        let begins = self.demanded == 0 && count > 0;
        self.short = count > self.max;
        self.demanded = count.min(self.max);
        begins
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_asked_for_stays_between_minimum_and_maximum() {
        let mut size = Size::new(1, 3);
        assert!(size.ask(size.asked(), 2));
        assert_eq!(size.wanted(), 3);
        assert!(!size.ask(size.asked(), 1));
        for _ in 0..5 {
            size.one_less();
        }
        assert_eq!(size.wanted(), 1);
    }

    #[test]
    fn demand_raises_it_for_as_long_as_it_is_there_and_to_the_maximum_only() {
        let mut size = Size::new(0, 3);
        assert!(size.demand(2));
        assert_eq!((size.wanted(), size.is_short()), (2, false));
        assert!(!size.demand(9), "it goes on");
        assert_eq!((size.wanted(), size.is_short()), (3, true));
        size.demand(0);
        assert_eq!((size.wanted(), size.is_short()), (0, false));
    }
}
