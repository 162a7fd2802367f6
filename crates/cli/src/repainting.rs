//! Output that is shown again whenever it changes: on a terminal in the same place, as much as fits, elsewhere one text after the other.

use crate::colour::can_paint;
use crate::fitted::fitted;
use crate::output;
use std::io::IsTerminal;
use std::time::Duration;

/// Interval of updates.
const PERIOD: Duration = Duration::from_millis(500);

/// Shows the text of `look`: once, or again whenever it changes, until nobody reads it any more. On a terminal a text replaces the one before;
/// elsewhere texts are separated by a blank line, except lines of JSON.
pub(crate) async fn repeat<E: From<anyhow::Error>>(
    watch: bool,
    json: bool,
    mut look: impl AsyncFnMut() -> Result<String, E>,
) -> Result<(), E> {
    let mut shown: Option<String> = None;
    loop {
        let mut text = look().await?;
        let room = room().filter(|_| watch && !json);
        if let Some((width, height)) = room {
            text = fitted(&text, width, height);
        }
        if shown.as_ref() != Some(&text) {
            let reads = match watch && !json {
                true if room.is_some() => output::line(format_args!("\x1b[H\x1b[J{text}")),
                true if shown.is_some() => output::line(format_args!("\n{text}")),
                _ => output::line(&text),
            };
            if !reads? || !watch {
                return Ok(());
            }
            shown = Some(text);
        }
        tokio::time::sleep(PERIOD).await;
    }
}

/// The columns and rows of the terminal at standard output, where it can be painted on. They may change at any time.
pub(crate) fn room() -> Option<(usize, usize)> {
    if !std::io::stdout().is_terminal() || !can_paint() {
        return None;
    }
    let size = terminal_size::terminal_size_of(std::io::stdout());
    Some(size.map_or((80, 24), |(width, height)| (width.0.into(), height.0.into())))
}

/// JSON as one document for people, or as one line of many.
pub(crate) fn json_text(value: &impl serde::Serialize, line: bool) -> anyhow::Result<String> {
    Ok(if line { serde_json::to_string(value)? } else { serde_json::to_string_pretty(value)? })
}
