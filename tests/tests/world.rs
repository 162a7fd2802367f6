//! `ratn world …`: the root world of a pool that runs is looked at, back in time too, written to a file and loaded again.

mod support;

use anyhow::{Context, ensure};
use serde_json::Value;
use support::{Place, Started, texts, wait_for};

struct World {
    place: Place,
    _pool: Started,
}

impl World {
    fn new() -> anyhow::Result<World> {
        let place = Place::new()?;
        let pool = place.start(&["world-pool"])?;
        let endpoint = place.path().join("run/world-pool.endpoint");
        wait_for("the pool", || Ok(endpoint.exists().then_some(()))).with_context(|| pool.said())?;
        Ok(World { place, _pool: pool })
    }

    fn file(&self, name: &str) -> String {
        self.place.path().join(name).display().to_string()
    }

    fn ratn(&self, arguments: &[&str]) -> anyhow::Result<(Option<i32>, String, String)> {
        let output = self.place.ratn(&[&["world"], arguments].concat()).output()?;
        let (out, err) = texts(&output);
        Ok((output.status.code(), out, err))
    }

    fn done(&self, arguments: &[&str]) -> anyhow::Result<String> {
        let (code, out, err) = self.ratn(arguments)?;
        ensure!(code == Some(0), "{arguments:?}: {code:?} {out} {err}");
        Ok(out)
    }

    fn load(&self, name: &str, text: &str, more: &[&str]) -> anyhow::Result<(Option<i32>, String, String)> {
        std::fs::write(self.file(name), text)?;
        self.ratn(&[&["load", &self.file(name)], more].concat())
    }
}

const FACTS: &str = r#"
    @prefix w: <urn:ratn:world#> .
    [] w:predicate "on" ; w:argument1 "box_1" ; w:argument2 "table" ; w:value true .
    [] w:predicate "weight" ; w:argument1 "box_1" ; w:value 1.5 .
    [] w:predicate "weight" ; w:argument1 "box_2" ; w:value 3 .
"#;

#[cfg(feature = "sparql")]
#[test]
fn sparql_is_answered_over_the_root() -> anyhow::Result<()> {
    let world = World::new()?;
    ensure!(world.load("first.ttl", FACTS, &[])?.0 == Some(0));
    let query = "SELECT ?kg { ?f world:predicate 'weight' ; world:argument1 'box_1' ; world:value ?kg }";
    let answers = world.done(&["query", "--sparql", query])?;
    ensure!(answers.lines().collect::<Vec<_>>() == ["?kg", "1.5"], "{answers}");
    let (code, _, err) = world.ratn(&["query", "--sparql", "SELECT"])?;
    ensure!(code == Some(2) && err.contains("not SPARQL"), "{code:?} {err}");
    Ok(())
}

#[cfg(not(feature = "sparql"))]
#[test]
fn a_ratn_without_sparql_says_which_feature_it_was_built_without() -> anyhow::Result<()> {
    let world = World::new()?;
    let (code, out, err) = world.ratn(&["query", "--sparql", "SELECT * { ?f ?p ?o }"])?;
    ensure!(code == Some(2) && out.is_empty(), "{code:?} {out} {err}");
    ensure!(err.contains("without the feature `sparql`") && err.contains("--features sparql"), "{err}");
    Ok(())
}

#[test]
fn facts_are_loaded_asked_for_compared_and_dumped() -> anyhow::Result<()> {
    let world = World::new()?;
    ensure!(world.load("first.ttl", FACTS, &[])?.0 == Some(0));
    let table = world.done(&["facts", "weight(?)"])?;
    ensure!(table.lines().count() == 3 && table.contains("ratn world load"), "{table}");
    let answers = world.done(&["query", "weight(?box) = ?w, ?w < 2"])?;
    ensure!(answers.lines().nth(1) == Some("box_1  1.5"), "{answers}");
    let second = r#"{"facts": [{"predicate": "weight", "arguments": ["box_2"], "value": {"float": 0.1}}]}"#;
    ensure!(world.load("second.json", second, &["--replace"])?.0 == Some(0));
    let difference = world.done(&["diff", "1"])?;
    ensure!(difference.lines().count() == 4 && difference.contains("weight(box_2)     3       0.1"), "{difference}");
    let then: Value = serde_json::from_str(&world.done(&["facts", "--at", "1", "--json"])?)?;
    ensure!(then["facts"].as_array().map(Vec::len) == Some(3), "{then}");
    let history = world.done(&["history", "weight(box_2)"])?;
    ensure!(history.lines().count() == 4, "{history}");

    // Back to what was, from a dump in either format.
    for format in ["json", "turtle"] {
        let name = if format == "json" { "dump.json" } else { "dump.ttl" };
        let dump = world.done(&["dump", "--format", format, "--at", "1"])?;
        ensure!(world.load(name, &dump, &["--replace"])?.0 == Some(0));
        let now: Value = serde_json::from_str(&world.done(&["facts", "--json"])?)?;
        let values = |facts: &Value| {
            facts["facts"].as_array().map(|facts| facts.iter().map(|fact| fact["value"].clone()).collect::<Vec<_>>())
        };
        ensure!(values(&now) == values(&then), "{format}: {now}");
        ensure!(world.load("second.json", second, &["--replace"])?.0 == Some(0));
    }
    Ok(())
}

#[test]
fn what_cannot_be_answered_is_refused_with_why_and_nothing_is_loaded_by_halves() -> anyhow::Result<()> {
    let world = World::new()?;
    let (code, _, err) = world.load("bad.ttl", &FACTS.replace("w:value 3", "w:value 3, 4"), &[])?;
    ensure!(code == Some(2) && err.contains("bad.ttl") && err.contains("`value` twice"), "{code:?} {err}");
    let far = r#"{"facts": [{"predicate": "a", "arguments": [], "value": {"int": 1}}, {"predicate": "", "arguments": [], "value": {"int": 1}}]}"#;
    let (code, _, err) = world.load("bad.json", far, &[])?;
    ensure!(code == Some(1) && err.contains("bad.json is not loaded") && err.contains("predicate"), "{code:?} {err}");
    let facts: Value = serde_json::from_str(&world.done(&["facts", "--json"])?)?;
    ensure!(facts["revision"] == 0 && facts["facts"].as_array().is_some_and(Vec::is_empty), "{facts}");
    let (code, _, err) = world.ratn(&["facts", "--at", "7"])?;
    ensure!(code == Some(1) && err.contains("there is no revision 7 yet"), "{code:?} {err}");
    let (code, _, err) = world.ratn(&["query", "at(?box"])?;
    ensure!(code == Some(2) && err.contains("at character"), "{code:?} {err}");
    let nowhere = world.place.ratn(&["world", "facts", "--runtime-dir", &world.file("nowhere")]).output()?;
    ensure!(nowhere.status.code() == Some(2));
    Ok(())
}
