//! Amounts of a resource: exact decimal numbers, so that parts that are taken and given back add up exactly.
//!
//! For people, on the wire and in files an amount is a number with at most three decimals; internally and in the resource
//! manager's log it is an integer number of thousandths. Anything else (negative, not a number, finer, too large) is refused
//! on input.

use serde::de::{self, Visitor};
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::fmt;
use std::str::FromStr;

/// Thousandths in a unit.
const UNIT: u64 = 1_000;

/// An amount of a resource in fixed-point units of a thousandth: `2` of an indivisible resource, `0.5` of a divisible one.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Quantity(u64);

/// Error: the number is no quantity.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum QuantityError {
    /// Not a number, infinite, or a text that is no number.
    #[error("is `{0}`: an amount is a number such as 2 or 0.5")]
    NotANumber(String),
    /// Below zero.
    #[error("is {0}: an amount is not negative")]
    Negative(f64),
    /// More than three decimals.
    #[error("is {0}: an amount has at most three decimals")]
    TooPrecise(f64),
    /// Too large.
    #[error("is {0}: an amount is at most {max}", max = Quantity::MAX)]
    TooLarge(f64),
}

impl Quantity {
    /// Zero.
    pub const ZERO: Quantity = Quantity(0);
    /// One whole unit.
    pub const ONE: Quantity = Quantity(UNIT);
    /// The largest amount that is accepted; far below the limits of exact floats and of sums.
    pub const MAX: Quantity = Quantity::whole(u32::MAX);

    /// A number of whole units.
    pub const fn whole(units: u32) -> Quantity {
        Quantity(units as u64 * UNIT)
    }

    /// A number of thousandths of a unit.
    pub const fn from_thousandths(thousandths: u64) -> Quantity {
        Quantity(thousandths)
    }

    /// The amount in thousandths of a unit.
    pub const fn thousandths(self) -> u64 {
        self.0
    }

    /// The number of whole units in it.
    pub fn units(self) -> u32 {
        u32::try_from(self.0 / UNIT).unwrap_or(u32::MAX)
    }

    /// The amount in units, rounded up.
    pub fn units_up(self) -> u32 {
        u32::try_from(self.0.div_ceil(UNIT)).unwrap_or(u32::MAX)
    }

    /// Whether it is a number of whole units.
    pub const fn is_whole(self) -> bool {
        self.0.is_multiple_of(UNIT)
    }

    /// Whether it is zero.
    pub const fn is_zero(self) -> bool {
        self.0 == 0
    }

    /// Rounds down to a multiple of `grain`.
    #[must_use]
    pub fn floor_to(self, grain: Quantity) -> Quantity {
        Quantity(self.0 - self.0 % grain.0.max(1))
    }

    /// The difference, or zero if it would be negative.
    #[must_use]
    pub const fn saturating_sub(self, other: Quantity) -> Quantity {
        Quantity(self.0.saturating_sub(other.0))
    }
}

impl From<u32> for Quantity {
    fn from(units: u32) -> Quantity {
        Quantity::whole(units)
    }
}

impl TryFrom<f64> for Quantity {
    type Error = QuantityError;

    fn try_from(number: f64) -> Result<Quantity, QuantityError> {
        if !number.is_finite() {
            return Err(QuantityError::NotANumber(number.to_string()));
        }
        if number < 0.0 {
            return Err(QuantityError::Negative(number));
        }
        if number > f64::from(Quantity::MAX) {
            return Err(QuantityError::TooLarge(number));
        }
        // Exact: a decimal number is parsed as its nearest float, and this reproduces that float.
        let quantity = Quantity((number * UNIT as f64).round() as u64);
        if f64::from(quantity) == number { Ok(quantity) } else { Err(QuantityError::TooPrecise(number)) }
    }
}

impl From<Quantity> for f64 {
    fn from(quantity: Quantity) -> f64 {
        quantity.0 as f64 / UNIT as f64
    }
}

impl FromStr for Quantity {
    type Err = QuantityError;

    fn from_str(text: &str) -> Result<Quantity, QuantityError> {
        text.parse::<f64>().map_err(|_| QuantityError::NotANumber(text.to_owned()))?.try_into()
    }
}

impl PartialEq<u32> for Quantity {
    fn eq(&self, units: &u32) -> bool {
        *self == Quantity::whole(*units)
    }
}

impl std::ops::Add for Quantity {
    type Output = Quantity;

    fn add(self, other: Quantity) -> Quantity {
        Quantity(self.0.saturating_add(other.0))
    }
}

impl std::ops::AddAssign for Quantity {
    fn add_assign(&mut self, other: Quantity) {
        *self = *self + other;
    }
}

impl std::iter::Sum for Quantity {
    fn sum<I: Iterator<Item = Quantity>>(amounts: I) -> Quantity {
        amounts.fold(Quantity::ZERO, |sum, amount| sum + amount)
    }
}

impl fmt::Display for Quantity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.0 / UNIT)?;
        match self.0 % UNIT {
            0 => Ok(()),
            rest => f.write_str(format!(".{rest:03}").trim_end_matches('0')),
        }
    }
}

impl Serialize for Quantity {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match serializer.is_human_readable() {
            true if self.is_whole() => serializer.serialize_u64(self.0 / UNIT),
            true => serializer.serialize_f64((*self).into()),
            false => serializer.serialize_u64(self.0),
        }
    }
}

impl<'de> Deserialize<'de> for Quantity {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Quantity, D::Error> {
        match deserializer.is_human_readable() {
            true => deserializer.deserialize_any(Number),
            false => u64::deserialize(deserializer).map(Quantity),
        }
    }
}

/// Deserializes a quantity as people write it.
struct Number;

impl Visitor<'_> for Number {
    type Value = Quantity;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an amount: a number that is not negative, with at most three decimals")
    }

    fn visit_u64<E: de::Error>(self, units: u64) -> Result<Quantity, E> {
        let whole = u32::try_from(units).map(Quantity::whole);
        whole.map_err(|_| E::custom(QuantityError::TooLarge(units as f64)))
    }

    fn visit_i64<E: de::Error>(self, units: i64) -> Result<Quantity, E> {
        match u64::try_from(units) {
            Ok(units) => self.visit_u64(units),
            Err(_) => Err(E::custom(QuantityError::Negative(units as f64))),
        }
    }

    fn visit_f64<E: de::Error>(self, number: f64) -> Result<Quantity, E> {
        number.try_into().map_err(E::custom)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn what_is_no_amount_is_refused_with_the_rule() {
        let why = |number: f64| Quantity::try_from(number).unwrap_err().to_string();
        assert_eq!(why(f64::NAN), "is `NaN`: an amount is a number such as 2 or 0.5");
        assert_eq!(why(f64::INFINITY), "is `inf`: an amount is a number such as 2 or 0.5");
        assert_eq!(why(-0.5), "is -0.5: an amount is not negative");
        assert_eq!(why(0.0005), "is 0.0005: an amount has at most three decimals");
        assert_eq!(why(4_294_967_295.5), "is 4294967295.5: an amount is at most 4294967295");
        assert_eq!("two".parse::<Quantity>().unwrap_err(), QuantityError::NotANumber("two".to_owned()));
        assert_eq!("2.5".parse::<Quantity>(), Ok(Quantity::from_thousandths(2_500)));
    }

    proptest! {
        #[test]
        fn every_amount_is_read_as_it_was_written(thousandths in 0..=Quantity::MAX.thousandths()) {
            let quantity = Quantity::from_thousandths(thousandths);
            prop_assert_eq!(Quantity::try_from(f64::from(quantity)).unwrap(), quantity);
            prop_assert_eq!(quantity.to_string().parse::<Quantity>().unwrap(), quantity);
            let json = serde_json::to_string(&quantity).unwrap();
            prop_assert_eq!(serde_json::from_str::<Quantity>(&json).unwrap(), quantity);
        }
    }
}
