//! A task whose base drives, on real processes: in both modes it ends in the same world.

mod support;

use anyhow::{Context, ensure};
use serde_json::Value;
use support::{Place, repository, texts};

#[test]
fn a_box_from_the_other_side_of_the_table_rides_home_in_both_modes() -> anyhow::Result<()> {
    let place = Place::new()?;
    let task = repository("examples/fetch_round_the_table.yaml");
    let task = task.to_str().context("a path")?;
    let mut ended = Vec::new();
    for mode in ["hsm", "cdtn"] {
        let output = place.ratn(&["run", task, "--mode", mode, "--speed", "20", "--seed", "3", "--json"]).output()?;
        let (document, said) = texts(&output);
        ensure!(output.status.success(), "{said}");
        let document: Value = serde_json::from_str(&document).with_context(|| said.clone())?;
        ensure!(document["outputs"]["seen_on_deck"] == 1, "{document}\n{said}");
        let at = &document["outputs"]["stands"]["pose"]["position"];
        let off = (0..2).filter_map(|i| at[i].as_f64()).fold(0.0, |off: f64, x| off.max(x.abs()));
        ensure!(off < 1e-3, "it stands at {at}");
        let statistics = &document["statistics"];
        ended.push((statistics["instances"]["retired"].clone(), document["outputs"]["delivered"].clone()));
        if mode == "cdtn" {
            // The arm's plans for the other side were made while the base was not there yet.
            ensure!(statistics["ahead_of_time"]["used"].as_u64() >= Some(6), "{}", statistics["ahead_of_time"]);
            ensure!(statistics["instances"]["invalidated"] == 0, "{}", statistics["instances"]);
        }
    }
    ensure!(ended[0] == ended[1], "{ended:?}");
    place.wait_until_empty()
}
