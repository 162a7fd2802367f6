//! Parsers of arguments that need a certain form.

use ratn_cell::config::Setting;
use ratn_worker::session::Standing;
use std::path::PathBuf;
use std::time::{Duration, SystemTime};
use time::OffsetDateTime;
use time::format_description::well_known::Rfc3339;

const SLOWEST: f64 = 0.01;
const FASTEST: f64 = 1000.0;

/// X,Y,Z in metres.
pub(super) fn place(text: &str) -> Result<[f64; 3], String> {
    let number = |part: &str| part.trim().parse().ok().filter(|x: &f64| x.is_finite());
    let numbers: Option<Vec<f64>> = text.split(',').map(number).collect();
    numbers.and_then(|numbers| numbers.try_into().ok()).ok_or_else(|| "expected X,Y,Z in metres".to_owned())
}

pub(super) fn scene(text: &str) -> Result<Setting, String> {
    Setting::named(text).ok_or_else(|| format!("expected {}", Setting::ALL.map(Setting::name).join(" or ")))
}

pub(super) fn speed(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(x) if (SLOWEST..=FASTEST).contains(&x) => Ok(x),
        _ => Err(format!("expected a number from {SLOWEST} to {FASTEST}")),
    }
}

/// Padding of shapes, in millimetres.
pub(super) fn padding(text: &str) -> Result<f64, String> {
    let value: f64 = text.parse().map_err(|_| "not a number".to_owned())?;
    if (0.0..1e3).contains(&value) { Ok(value) } else { Err("expected 0 to 1000 mm".to_owned()) }
}

pub(super) fn at_least_one(text: &str) -> Result<usize, String> {
    match text.parse::<usize>() {
        Ok(count) if count > 0 => Ok(count),
        _ => Err("expected a whole number from 1".to_owned()),
    }
}

pub(super) fn positive(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value > 0.0 && value.is_finite() => Ok(value),
        _ => Err("expected a number greater than 0".to_owned()),
    }
}

pub(super) fn share(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(share) if (0.0..1.0).contains(&share) => Ok(share),
        _ => Err("expected a number from 0 to less than 1".to_owned()),
    }
}

/// A run's share of resources that several runs need.
pub(super) fn run_share(text: &str) -> Result<f64, String> {
    let (least, most) = (*Standing::SHARES.start(), *Standing::SHARES.end());
    match text.parse::<f64>() {
        Ok(share) if Standing::SHARES.contains(&share) => Ok(share),
        _ => Err(format!("expected a number from {least} to {most}; 1 is the usual share")),
    }
}

/// A due time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Due {
    /// This long after the begin.
    After(Duration),
    At(SystemTime),
}

impl Due {
    /// The due time of something that begins now.
    ///
    /// # Errors
    /// The instant has passed.
    pub(crate) fn from(self, now: SystemTime) -> Result<SystemTime, String> {
        match self {
            Due::After(time) => Ok(now + time),
            Due::At(at) if at > now => Ok(at),
            Due::At(_) => Err("--due: has passed; say a later time, or leave it out".to_owned()),
        }
    }
}

/// Maximum time until a run is due, in seconds: a year.
const LATEST_DUE_S: f64 = 31_536_000.0;

pub(super) fn due(text: &str) -> Result<Due, String> {
    let expected =
        "expected a time from the start as 90s, 15m or 2h, of a year at most, or an instant as 2026-11-28T17:15:00Z";
    let units = [("s", 1.0), ("m", 60.0), ("h", 3_600.0)];
    let time = units.iter().find_map(|(unit, seconds)| Some(text.strip_suffix(unit)?.parse::<f64>().ok()? * seconds));
    let time = time.filter(|seconds| *seconds > 0.0 && *seconds <= LATEST_DUE_S).map(Duration::from_secs_f64);
    time.map(Due::After).or_else(|| instant(text).map(Due::At)).ok_or_else(|| expected.to_owned())
}

/// Parses an instant in the form of RFC 3339.
fn instant(text: &str) -> Option<SystemTime> {
    OffsetDateTime::parse(text, &Rfc3339).ok().map(SystemTime::from)
}

pub(super) fn chart(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    let known = path.extension().is_some_and(|end| ["svg", "html"].iter().any(|known| end.eq_ignore_ascii_case(known)));
    if known { Ok(path) } else { Err("expected a file name that ends with .svg or .html".to_owned()) }
}

pub(super) fn setting(text: &str) -> Result<(String, String), String> {
    let pair = text.split_once('=').map(|(name, value)| (name.to_owned(), value.to_owned()));
    pair.ok_or_else(|| "expected NAME=VALUE".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_due_time_is_a_time_from_the_start_or_an_instant() {
        let after = |seconds: f64| Ok(Due::After(Duration::from_secs_f64(seconds)));
        assert_eq!([due("90s"), due("1.5m"), due("2h")], [after(90.0), after(90.0), after(7_200.0)]);
        let at = |seconds: f64| Ok(Due::At(SystemTime::UNIX_EPOCH + Duration::from_secs_f64(seconds)));
        assert_eq!(due("2026-11-28T17:15:00Z"), at(1_795_886_100.0));
        assert_eq!(due("2026-11-28T18:45:00.5+01:30"), at(1_795_886_100.5));
        assert_eq!(due("2026-11-28t12:15:00-05:00"), at(1_795_886_100.0));
        for text in [
            "",
            "90",
            "0s",
            "-5s",
            "infs",
            "9000h",
            "2026-11-28",
            "2026-02-30T00:00:00Z",
            "2026-11-28T17:15:00",
            "2026-11-28T25:00:00Z",
            "2026-11-28T17:15:00.xZ",
            "+026-11-28T17:15:00Z",
            "2026-11-28T17:15:00+1:00",
            "ä",
        ] {
            assert!(due(text).is_err_and(|why| why.starts_with("expected a time")), "{text}");
        }
        let now = SystemTime::UNIX_EPOCH + Duration::from_secs(100);
        assert_eq!(Due::After(Duration::from_secs(5)).from(now), Ok(now + Duration::from_secs(5)));
        assert!(Due::At(now).from(now).is_err_and(|why| why.contains("--due: has passed")));
    }

    #[test]
    fn a_share_is_a_number_within_its_bounds() {
        assert_eq!((run_share("0.01"), run_share("100")), (Ok(0.01), Ok(100.0)));
        for text in ["0", "-1", "100.1", "inf", "NaN", "much"] {
            assert_eq!(run_share(text), Err("expected a number from 0.01 to 100; 1 is the usual share".to_owned()));
        }
    }
}
