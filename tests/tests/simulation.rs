//! `ratn simulate` and what `ratn check` says of what keeps a task sequential: nothing is started for them.

mod support;

use anyhow::{Context, ensure};
use serde_json::Value;
use support::{Place, repository, texts};

fn json(place: &Place, arguments: &[&str]) -> anyhow::Result<Value> {
    let output = place.ratn(arguments).output()?;
    let (out, err) = texts(&output);
    ensure!(output.status.success(), "{arguments:?}: {:?}, {err}", output.status);
    serde_json::from_str(&out).with_context(|| out)
}

#[test]
fn a_job_shop_is_simulated_and_compared_with_the_best_known() -> anyhow::Result<()> {
    let place = Place::new()?;
    let file = repository("tests/jobshop/ft06.txt");
    let file = file.to_str().context("a path")?;
    let found = json(&place, &["simulate", "--jobshop", file, "--json"])?;
    let keys: Vec<&String> = found.as_object().context("an object")?.keys().collect();
    ensure!(keys == ["best_known", "instance", "makespan", "ratio"] && found["instance"] == "ft06", "{found}");
    let number = |found: &Value, key: &str| found[key].as_f64().with_context(|| format!("no {key} in {found}"));
    let ratio = number(&found, "ratio")?;
    ensure!((1.0..=1.06).contains(&ratio) && number(&found, "best_known")? == 55.0, "{found}");
    ensure!((number(&found, "makespan")? / 55.0 - ratio).abs() < 1e-3, "{found}");
    let plain = json(&place, &["simulate", "--jobshop", file, "--orders", "0", "--best", "50", "--json"])?;
    ensure!(number(&plain, "best_known")? == 50.0 && number(&plain, "ratio")? > 1.2, "{plain}");
    Ok(())
}

#[test]
fn of_an_unknown_job_shop_there_is_no_ratio() -> anyhow::Result<()> {
    let place = Place::new()?;
    let file = place.path().join("mine.txt");
    std::fs::write(&file, "# two jobs\n2 2\n0 3 1 2\n0 2 1 4\n")?;
    let found = json(&place, &["simulate", "--jobshop", file.to_str().context("a path")?, "--json"])?;
    ensure!(found["makespan"] == 8.0 && found["ratio"].is_null() && found["best_known"].is_null(), "{found}");
    Ok(())
}

#[test]
fn what_is_no_job_shop_is_refused_with_its_line() -> anyhow::Result<()> {
    let place = Place::new()?;
    let file = place.path().join("bad.txt");
    std::fs::write(&file, "2 2\n0 3 1 2\n0 2 7 4\n")?;
    let output = place.ratn(&["simulate", "--jobshop", file.to_str().context("a path")?]).output()?;
    let (out, err) = texts(&output);
    ensure!(output.status.code() == Some(2) && out.is_empty(), "{:?}, {out}", output.status);
    ensure!(err.contains("bad.txt: no job shop: line 3: `7` is no machine: they are 0 to 1"), "{err}");
    Ok(())
}

#[test]
fn check_says_what_an_annotation_is_worth() -> anyhow::Result<()> {
    let place = Place::new()?;
    let text = std::fs::read_to_string(repository("examples/fetch_boxes.yaml"))?;
    let task = place.path().join("task.yaml");
    std::fs::write(&task, &text)?;
    // A catalogue that does not say what a plan reads and changes.
    let said = "computes = true\nreads = [\"scene\"]\n";
    let known = std::fs::read_to_string(repository("deploy/catalogue.toml"))?;
    ensure!(known.contains(said));
    let unsaid = place.path().join("catalogue.toml");
    // What does not say that it computes cannot say that it does so at any time.
    std::fs::write(&unsaid, known.replace(said, "").replace("anytime = true\n", ""))?;
    let (task, unsaid) = (task.to_str().context("a path")?, unsaid.to_str().context("a path")?);
    let whole = json(&place, &["check", task, "--json"])?;
    let half = json(&place, &["check", task, "--json", "--catalogue", unsaid])?;
    let seconds =
        |found: &Value, key: &str| found["sequential"][key].as_f64().with_context(|| format!("{key}: {found}"));
    ensure!(whole["task"] == "fetch_boxes" && whole["sequential"]["gains"] == serde_json::json!([]), "{whole}");
    ensure!(seconds(&half, "cdtn_s")? > 1.2 * seconds(&whole, "cdtn_s")?, "{half}");
    ensure!(seconds(&half, "annotated_s")? == seconds(&whole, "cdtn_s")?, "{half}");
    ensure!(half["sequential"]["gains"].as_array().is_some_and(|gains| gains.len() == 4), "{half}");
    ensure!(whole["sequential"]["chain"][0]["because"] == "it is the first", "{whole}");
    Ok(())
}

#[test]
fn a_check_without_simulation_says_only_what_is_wrong() -> anyhow::Result<()> {
    let place = Place::new()?;
    let task = repository("examples/fetch_boxes.yaml");
    let task = task.to_str().context("a path")?;
    let (with, without) =
        (place.ratn(&["check", task]).output()?, place.ratn(&["check", task, "--no-simulation"]).output()?);
    ensure!(texts(&with).0.contains("the longest chain:") && texts(&without).0.is_empty(), "{with:?} {without:?}");
    let found = json(&place, &["check", task, "--no-simulation", "--json"])?;
    ensure!(found["sequential"].is_null() && found["findings"] == serde_json::json!([]), "{found}");
    Ok(())
}

/// Five activities that need up to two of the units of one resource, and one of another's; 9 s is the best that there is.
const PROJECT: &str = include_str!("../projects/small.sm");

#[test]
fn projects_are_simulated_and_compared_with_a_table() -> anyhow::Result<()> {
    let place = Place::new()?;
    let path = |name: &str, text: &str| -> anyhow::Result<String> {
        let path = place.path().join(name);
        std::fs::write(&path, text)?;
        Ok(path.to_str().context("a path")?.to_owned())
    };
    let (one, other) =
        (path("one.sm", PROJECT)?, path("other.sm", &PROJECT.replace("2      1     3 ", "2      1     5 "))?);
    let table = path("best.csv", "instance,lower_bound,best_known\none.sm,7,8\nother,9,11\n")?;
    let found = json(&place, &["simulate", "--project", &one, &other, "--best-known", &table, "--json"])?;
    let expected = serde_json::json!({
        "projects": [
            { "instance": "one", "makespan": 9.0, "best_known": 8.0, "ratio": 1.125, "lower_bound": 6.5 },
            { "instance": "other", "makespan": 11.0, "best_known": 11.0, "ratio": 1.0, "lower_bound": 7.5 },
        ],
        "mean_ratio": 1.0625,
        "worst_ratio": 1.125,
    });
    ensure!(found == expected, "{found}");
    let varied = json(&place, &["simulate", "--project", &one, "--vary", "0.3", "--json"])?;
    let varied = &varied["projects"][0];
    ensure!(varied["clairvoyant"] == varied["makespan"] && varied["makespan"] != 9.0, "{varied}");
    let output = place.ratn(&["simulate", "--project", &one, &other]).output()?;
    let (out, err) = texts(&output);
    let help = "give a table of best known ones with --best-known";
    ensure!(
        out == format!("one: makespan 9; {help}; at least 6.5\nother: makespan 11; {help}; at least 7.5\n"),
        "{out}{err}"
    );
    Ok(())
}

#[test]
fn what_is_no_project_is_refused_with_its_line() -> anyhow::Result<()> {
    let place = Place::new()?;
    let file = place.path().join("bad.sm");
    std::fs::write(&file, PROJECT.replace("R 2\n    2    1\n", "R 2\n    1    1\n"))?;
    let output = place.ratn(&["simulate", "--project", file.to_str().context("a path")?]).output()?;
    let (out, err) = texts(&output);
    ensure!(output.status.code() == Some(2) && out.is_empty(), "{:?}, {out}", output.status);
    ensure!(err.contains("bad.sm: no project: line 22: job 3 needs 2 of R1, and line 28 has 1"), "{err}");
    Ok(())
}
