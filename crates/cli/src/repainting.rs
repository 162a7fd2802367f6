//! What is shown again whenever it changes: on a terminal in the same place, elsewhere one text after the other.

use crate::output;
use std::io::IsTerminal;
use std::time::Duration;

/// How often it is looked at.
pub(crate) const PERIOD: Duration = Duration::from_millis(500);

/// What is shown now.
#[derive(Debug, Default)]
pub(crate) struct Repainting {
    shown: Option<String>,
}

impl Repainting {
    /// Shows a text if it is another one than before; false once nobody reads it any more.
    pub(crate) fn show(&mut self, text: String, json: bool) -> anyhow::Result<bool> {
        if self.shown.as_ref() == Some(&text) {
            return Ok(true);
        }
        let in_place = !json && std::io::stdout().is_terminal();
        let reads = if in_place { output::line(format_args!("\x1b[H\x1b[J{text}")) } else { output::line(&text) };
        self.shown = Some(text);
        reads
    }

    /// Shows what `look` says, once or until nobody reads it any more.
    pub(crate) async fn repeat<E: From<anyhow::Error>>(
        watch: bool,
        json: bool,
        mut look: impl AsyncFnMut() -> Result<String, E>,
    ) -> Result<(), E> {
        let mut repainting = Repainting::default();
        loop {
            let text = look().await?;
            if !repainting.show(text, json)? || !watch {
                return Ok(());
            }
            tokio::time::sleep(PERIOD).await;
        }
    }
}

/// JSON as one document for people, or as one line of many.
pub(crate) fn json_text(value: &impl serde::Serialize, line: bool) -> anyhow::Result<String> {
    Ok(if line { serde_json::to_string(value)? } else { serde_json::to_string_pretty(value)? })
}
