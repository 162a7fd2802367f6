//! Messages about a run for people.

use std::fmt::{self, Display};
use std::sync::Arc;

/// Receives lines for people, one or several at a time: a terminal, a window, or nothing. Nothing depends on them.
#[derive(Clone)]
pub struct Messages(Arc<dyn Fn(&str) + Send + Sync>);

impl Messages {
    /// Calls `take` with each message, from any thread: a line, or several separated by line breaks.
    pub fn to(take: impl Fn(&str) + Send + Sync + 'static) -> Messages {
        Messages(Arc::new(take))
    }

    /// Discards all messages.
    pub fn nowhere() -> Messages {
        Messages::to(|_| {})
    }

    pub(crate) fn say(&self, line: impl Display) {
        (self.0)(&line.to_string());
    }
}

impl fmt::Debug for Messages {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Messages")
    }
}
