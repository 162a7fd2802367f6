//! How the caller controls the planner: a callback is called often, reports progress, and answers whether to go on.

/// What the planner reports when it asks whether to go on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Progress {
    /// Nothing new.
    Working,
    /// The first path was found; reported once.
    FirstPath {
        /// Its length in joint space.
        length_rad: f64,
    },
    /// The path became quicker.
    Quicker {
        /// About how long what follows the departure takes now, in seconds.
        about_s: f64,
    },
}

/// The caller's answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Control {
    /// Go on.
    Continue,
    /// Finish with the best path so far.
    TimeUp,
    /// Give up.
    Cancelled,
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
            Control::Continue | Control::TimeUp => Stop::TimeUp,
        }
    }
}

pub(crate) struct Pace<'c> {
    control: &'c mut dyn FnMut(Progress) -> Control,
    /// Iterations of search and improvement so far.
    pub(crate) iterations: usize,
}

impl<'c> Pace<'c> {
    pub(crate) fn new(control: &'c mut dyn FnMut(Progress) -> Control) -> Pace<'c> {
        Pace { control, iterations: 0 }
    }

    pub(crate) fn report(&mut self, progress: Progress) -> Result<(), Stop> {
        match (self.control)(progress) {
            Control::Continue => Ok(()),
            Control::TimeUp => Err(Stop::TimeUp),
            Control::Cancelled => Err(Stop::Cancelled),
        }
    }

    /// Calls the callback directly, for searches that count their own iterations.
    pub(crate) fn answer(&mut self) -> Control {
        (self.control)(Progress::Working)
    }

    pub(crate) fn poll(&mut self) -> Result<(), Stop> {
        self.report(Progress::Working)
    }

    pub(crate) fn iteration(&mut self) -> Result<(), Stop> {
        self.iterations += 1;
        self.poll()
    }
}
