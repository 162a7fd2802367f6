//! The paper's tables, replayed.

mod support;

use anyhow::{Context, ensure};
use support::{Place, texts};

/// Rows in the paper's order: HSM seconds of the notes, and the improvement that the paper reports for two planners.
const EXPECTED: [(&str, &str, f64, f64); 5] = [
    ("I", "1", 81.3, 11.1),
    ("I", "2", 124.4, 21.3),
    ("I", "3", 167.5, 29.0),
    ("II", "2B+2F", 170.4, 27.4),
    ("II", "3B+3F", 255.6, 18.9),
];

#[test]
fn every_row_is_at_least_as_good_as_the_papers() -> anyhow::Result<()> {
    let output = Place::new()?.ratn(&["tables", "--json"]).output()?;
    ensure!(output.status.success(), "{}", texts(&output).1);
    let rows: Vec<serde_json::Value> = serde_json::from_slice(&output.stdout)?;
    ensure!(rows.len() == EXPECTED.len());
    for (row, (table, objects, hsm_s, improvement)) in rows.iter().zip(EXPECTED) {
        let number = |key: &str| row[key].as_f64().with_context(|| format!("no {key} in {row}"));
        ensure!(row["table"] == table && row["objects"] == objects, "{row}");
        ensure!((number("hsm_s")? - hsm_s).abs() < 0.01, "{row}");
        let got = 100.0 * (1.0 - number("cdtn_2mp_s")? / number("hsm_s")?);
        ensure!(got > improvement - 0.1, "{row}: {got:.1} %");
        ensure!(number("cdtn_1mp_s")? >= number("cdtn_2mp_s")?, "{row}");
    }
    Ok(())
}
