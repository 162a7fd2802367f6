//! Words of the command line that have to be of a form.

use ratn_cell::config::Setting;
use std::path::PathBuf;

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

/// A length that something is grown by.
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

pub(super) fn makespan(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(makespan) if makespan > 0.0 && makespan.is_finite() => Ok(makespan),
        _ => Err("expected a number greater than 0".to_owned()),
    }
}

pub(super) fn share(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(share) if (0.0..1.0).contains(&share) => Ok(share),
        _ => Err("expected a number from 0 to less than 1".to_owned()),
    }
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
