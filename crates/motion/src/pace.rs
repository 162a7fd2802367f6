//! How the caller controls the planner: it calls a callback often, which gets the progress and answers whether to continue.

use crate::plan::Plan;

/// What the planner reports when it calls the callback.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Progress<'p> {
    /// Nothing new.
    Working,
    /// The first path was found; reported once.
    FirstPath {
        /// Its length in joint space.
        length_rad: f64,
    },
    /// The path became quicker; for the first one, when its improvement begins.
    Quicker {
        /// Estimated duration of the motion after the departure, in seconds.
        about_s: f64,
    },
    /// A complete, usable motion, after [`Control::Settle`]: the best so far, then those that are at least [`BETTER`] quicker. They all end in the
    /// same posture.
    Usable(&'p Plan),
}

/// A quicker motion is reported when it saves at least this share of the duration.
pub const BETTER: f64 = 0.01;

/// The caller's answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Control {
    /// Go on.
    Continue,
    /// The best motion so far is sufficient: report it as [`Progress::Usable`] and continue, with the same end. This answer remains in force.
    Settle,
    /// Finish with the best path so far.
    TimeUp,
    /// Give up.
    Cancelled,
}

impl Control {
    /// Whether the planner goes on.
    pub(crate) fn goes_on(self) -> bool {
        matches!(self, Control::Continue | Control::Settle)
    }
}

/// Why the planner stopped before it was done.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Stop {
    TimeUp,
    Cancelled,
}

impl From<Control> for Stop {
    fn from(control: Control) -> Stop {
        match control {
            Control::Cancelled => Stop::Cancelled,
            Control::Continue | Control::Settle | Control::TimeUp => Stop::TimeUp,
        }
    }
}

pub(crate) struct Pace<'c> {
    control: &'c mut dyn FnMut(Progress<'_>) -> Control,
    /// Iterations of search and improvement so far.
    pub(crate) iterations: usize,
    /// The caller has answered [`Control::Settle`].
    is_settled: bool,
}

impl<'c> Pace<'c> {
    pub(crate) fn new(control: &'c mut dyn FnMut(Progress<'_>) -> Control) -> Pace<'c> {
        Pace { control, iterations: 0, is_settled: false }
    }

    pub(crate) fn report(&mut self, progress: Progress<'_>) -> Result<(), Stop> {
        match self.asked(progress) {
            Control::Continue | Control::Settle => Ok(()),
            Control::TimeUp => Err(Stop::TimeUp),
            Control::Cancelled => Err(Stop::Cancelled),
        }
    }

    /// Calls the callback directly, for searches that count their own iterations.
    pub(crate) fn answer(&mut self) -> Control {
        match self.asked(Progress::Working) {
            Control::Settle => Control::Continue,
            answer => answer,
        }
    }

    fn asked(&mut self, progress: Progress<'_>) -> Control {
        let answer = (self.control)(progress);
        self.is_settled |= answer == Control::Settle;
        answer
    }

    /// Whether the caller has answered [`Control::Settle`].
    pub(crate) fn is_settled(&self) -> bool {
        self.is_settled
    }

    pub(crate) fn poll(&mut self) -> Result<(), Stop> {
        self.report(Progress::Working)
    }

    pub(crate) fn iteration(&mut self) -> Result<(), Stop> {
        self.iterations += 1;
        self.poll()
    }
}
