//! The exceptions of the package. Each carries the message of the part that refused, which says what to do next.

use pyo3::create_exception;
use pyo3::exceptions::{PyBaseException, PyException};
use pyo3::prelude::*;
use ratn_model::program::{PREEMPTED, STOPPED};
use ratn_worker::action::{ActionFailure, WorldFailure};
use ratn_worker::client::CallError;
use std::error::Error as StdError;
use std::iter::successors;

create_exception!(_ratn, Error, PyException, "A failure of a system; the base class of the other exceptions.");
create_exception!(_ratn, Unavailable, Error, "No answer: a process has ended, or a connection broke.");
create_exception!(_ratn, Malformed, Error, "An answer that is not valid.");
create_exception!(_ratn, Refused, Error, "The server refused; the base class of the gRPC codes below.");
create_exception!(_ratn, NotFound, Refused, "What was requested does not exist (NOT_FOUND).");
create_exception!(_ratn, AlreadyExists, Refused, "It is another's, or was requested differently (ALREADY_EXISTS).");
create_exception!(_ratn, InvalidArgument, Refused, "The request is not valid (INVALID_ARGUMENT).");
create_exception!(_ratn, FailedPrecondition, Refused, "The present state does not allow it (FAILED_PRECONDITION).");
create_exception!(_ratn, PermissionDenied, Refused, "The caller's roles do not allow it (PERMISSION_DENIED).");
create_exception!(_ratn, ResourceExhausted, Refused, "A limit is reached (RESOURCE_EXHAUSTED).");
create_exception!(_ratn, DeadlineExceeded, Refused, "The deadline passed (DEADLINE_EXCEEDED).");
create_exception!(_ratn, OutOfRange, Refused, "A number is outside of the available range (OUT_OF_RANGE).");
create_exception!(_ratn, Unauthenticated, Refused, "The caller is not identified (UNAUTHENTICATED).");
create_exception!(_ratn, Unimplemented, Refused, "The server does not have this method (UNIMPLEMENTED).");
create_exception!(_ratn, InvalidTask, Error, "A task file that is not valid; `findings` lists the problems.");
create_exception!(_ratn, Cancelled, Error, "The goal was cancelled: clean up, and let the exception through.");
create_exception!(
    _ratn,
    Aborted,
    Error,
    "Raised by an action: the goal's outcome is `aborted`, with this as the reason."
);
create_exception!(_ratn, Lost, Error, "The goal's world does not exist any more; another attempt may succeed.");

/// Adds the exceptions to the module.
pub(crate) fn add_to(py: Python<'_>, module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("Error", py.get_type::<Error>())?;
    module.add("Unavailable", py.get_type::<Unavailable>())?;
    module.add("Malformed", py.get_type::<Malformed>())?;
    module.add("Refused", py.get_type::<Refused>())?;
    module.add("NotFound", py.get_type::<NotFound>())?;
    module.add("AlreadyExists", py.get_type::<AlreadyExists>())?;
    module.add("InvalidArgument", py.get_type::<InvalidArgument>())?;
    module.add("FailedPrecondition", py.get_type::<FailedPrecondition>())?;
    module.add("PermissionDenied", py.get_type::<PermissionDenied>())?;
    module.add("ResourceExhausted", py.get_type::<ResourceExhausted>())?;
    module.add("DeadlineExceeded", py.get_type::<DeadlineExceeded>())?;
    module.add("OutOfRange", py.get_type::<OutOfRange>())?;
    module.add("Unauthenticated", py.get_type::<Unauthenticated>())?;
    module.add("Unimplemented", py.get_type::<Unimplemented>())?;
    module.add("InvalidTask", py.get_type::<InvalidTask>())?;
    module.add("Cancelled", py.get_type::<Cancelled>())?;
    module.add("Aborted", py.get_type::<Aborted>())?;
    module.add("Lost", py.get_type::<Lost>())
}

/// An error and its sources in one line.
pub(crate) fn line(error: &(dyn StdError + 'static)) -> String {
    let mut line = String::new();
    for part in successors(Some(error), |&error| error.source()).map(ToString::to_string) {
        if !line.ends_with(&part) {
            line = if line.is_empty() { part } else { format!("{line}: {part}") };
        }
    }
    line
}

/// The Python exception for a failed call; its attributes `code` and `reason` are those of the refusal.
pub(crate) fn of_call(error: &CallError) -> PyErr {
    let raised = by_code(error);
    let code = error.code().map(|code| format!("{code:?}")).unwrap_or_default();
    // `NotFound` → `NOT_FOUND`, as in the protocol.
    let mut said = String::new();
    for (index, character) in code.char_indices() {
        said.extend((index > 0 && character.is_uppercase()).then_some('_'));
        said.extend(character.to_uppercase());
    }
    Python::attach(|py| {
        let value = raised.value(py);
        // An exception accepts any attribute.
        let _ = value.setattr("code", said);
        let _ = value.setattr("reason", error.reason());
    });
    raised
}

fn by_code(error: &CallError) -> PyErr {
    let message = line(error);
    // Compares the names of gRPC codes, because the crate that defines the codes is no dependency here.
    let code = error.code().map(|code| format!("{code:?}")).unwrap_or_default();
    match (error, code.as_str()) {
        (CallError::Broken { .. }, _) => Unavailable::new_err(message),
        (CallError::Malformed { .. }, _) => Malformed::new_err(message),
        (_, "NotFound") => NotFound::new_err(message),
        (_, "AlreadyExists") => AlreadyExists::new_err(message),
        (_, "InvalidArgument") => InvalidArgument::new_err(message),
        (_, "FailedPrecondition") => FailedPrecondition::new_err(message),
        (_, "PermissionDenied") => PermissionDenied::new_err(message),
        (_, "ResourceExhausted") => ResourceExhausted::new_err(message),
        (_, "DeadlineExceeded") => DeadlineExceeded::new_err(message),
        (_, "OutOfRange") => OutOfRange::new_err(message),
        (_, "Unauthenticated") => Unauthenticated::new_err(message),
        (_, "Unimplemented") => Unimplemented::new_err(message),
        (_, "Unavailable") => Unavailable::new_err(message),
        _ => Refused::new_err(message),
    }
}

/// The exception for an action that cannot read its world.
pub(crate) fn of_world(failure: WorldFailure) -> PyErr {
    match ActionFailure::from(failure) {
        ActionFailure::Lost(reason) => Lost::new_err(reason),
        failure => of_failure(failure),
    }
}

/// The exception for a goal that did not come to an outcome.
pub(crate) fn of_failure(failure: ActionFailure) -> PyErr {
    match failure {
        ActionFailure::Aborted(reason) => Aborted::new_err(reason),
        ActionFailure::Preempted(reason) => cancelled(PREEMPTED, reason),
        ActionFailure::Stopped(reason) => cancelled(STOPPED, reason),
        ActionFailure::Lost(reason) => Lost::new_err(reason),
    }
}

/// With the outcome that the goal gets if the exception is not caught.
fn cancelled(outcome: &str, reason: String) -> PyErr {
    let raised = Cancelled::new_err(reason);
    Python::attach(|py| {
        // An exception accepts any attribute.
        let _ = raised.value(py).setattr("outcome", outcome);
    });
    raised
}

/// The failure of a goal that was not told to stop itself, when it raises the `Cancelled` of another goal.
pub(crate) fn stopped_elsewhere(raised: &Bound<'_, PyBaseException>, reason: String) -> Option<ActionFailure> {
    let outcome: String = raised.getattr("outcome").ok()?.extract().ok()?;
    match outcome.as_str() {
        PREEMPTED => Some(ActionFailure::Preempted(reason)),
        STOPPED => Some(ActionFailure::Stopped(reason)),
        _ => None,
    }
}
