//! Time limits given in Python: one meaning everywhere.

use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use std::time::Duration;

/// A longer time counts as for ever: about thirty years.
const MAX_S: f64 = 1e9;

/// A time to wait, in seconds; `None` and infinity mean for ever, and give `None`. NaN or a negative number is a `ValueError` that names
/// the argument.
pub(crate) fn patience(argument: &str, seconds: Option<f64>) -> PyResult<Option<Duration>> {
    let Some(seconds) = seconds.filter(|seconds| *seconds <= MAX_S || seconds.is_nan()) else { return Ok(None) };
    Duration::try_from_secs_f64(seconds).map(Some).map_err(|_| {
        PyValueError::new_err(format!("{argument} is {seconds}: say seconds, 0 or more, or None to wait for ever"))
    })
}

/// The same in seconds, for waits in Python code.
#[pyfunction]
pub(crate) fn patience_s(argument: &str, seconds: Option<f64>) -> PyResult<Option<f64>> {
    Ok(patience(argument, seconds)?.map(|patience| patience.as_secs_f64()))
}
