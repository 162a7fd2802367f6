//! Where what people read of a run goes.

use std::fmt::{self, Display};
use std::sync::Arc;

/// Takes lines for people, one or several at once: a terminal, a window, or nobody. Nothing depends on them.
#[derive(Clone)]
pub struct Messages(Arc<dyn Fn(&str) + Send + Sync>);

impl Messages {
    /// Gives what is said to `take`, from any thread: a line, or several with line breaks between them.
    pub fn to(take: impl Fn(&str) + Send + Sync + 'static) -> Messages {
        Messages(Arc::new(take))
    }

    /// Nobody reads them.
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
