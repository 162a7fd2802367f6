//! The checked-in code of the wire was made of the `.proto` files that are here.

use crate::support::repository;
use anyhow::{Context, ensure};

/// The folders of generated code; each has a file `SOURCES` with lines `DIGEST  PATH`, which `tools/wire` writes.
const FOLDERS: [&str; 3] =
    ["crates/proto/src/generated", "crates/storage/src/generated", "crates/export/src/generated"];
/// Where the `.proto` files are.
const PROTOS: [&str; 3] = ["proto/ratn/v1", "crates/storage/proto", "crates/export/proto"];

#[test]
fn the_code_of_the_wire_is_that_of_the_proto_files() -> anyhow::Result<()> {
    let mut known = Vec::new();
    for folder in FOLDERS {
        let sources =
            std::fs::read_to_string(repository(folder).join("SOURCES")).with_context(|| format!("{folder}/SOURCES"))?;
        for line in sources.lines() {
            let (digest, path) = line.split_once("  ").with_context(|| format!("{folder}/SOURCES: `{line}`"))?;
            let file = std::fs::read(repository(path))
                .with_context(|| format!("{path} is gone: run scripts/generate-wire"))?;
            ensure!(blake3::hash(&file).to_string() == digest, "{path} was changed: run scripts/generate-wire");
            known.push(repository(path));
        }
    }
    for folder in PROTOS {
        for entry in std::fs::read_dir(repository(folder))? {
            let path = entry?.path();
            ensure!(known.contains(&path), "{} is not generated: name it in tools/wire/src/main.rs", path.display());
        }
    }
    Ok(())
}
