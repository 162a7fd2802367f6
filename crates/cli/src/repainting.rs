//! What is shown again whenever it changes: on a terminal in the same place, elsewhere one text after the other.

use crate::output;
use std::io::IsTerminal;
use std::time::Duration;

/// How often it is looked at.
const PERIOD: Duration = Duration::from_millis(500);

/// Shows what `look` says: once, or again whenever it is another text, until nobody reads it any more. On a terminal a text takes the place of
/// the one before; elsewhere a blank line is between two, and none between lines of JSON.
pub(crate) async fn repeat<E: From<anyhow::Error>>(
    watch: bool,
    json: bool,
    mut look: impl AsyncFnMut() -> Result<String, E>,
) -> Result<(), E> {
    let mut shown: Option<String> = None;
    loop {
        let text = look().await?;
        if shown.as_ref() != Some(&text) {
            let reads = match watch && !json {
                true if std::io::stdout().is_terminal() => output::line(format_args!("\x1b[H\x1b[J{text}")),
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

/// JSON as one document for people, or as one line of many.
pub(crate) fn json_text(value: &impl serde::Serialize, line: bool) -> anyhow::Result<String> {
    Ok(if line { serde_json::to_string(value)? } else { serde_json::to_string_pretty(value)? })
}
