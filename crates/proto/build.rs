//! Generates the wire types and services from `proto/` in pure Rust: no `protoc` is needed.

use prost::Message;
use std::error::Error;
use std::path::PathBuf;

const FILES: [&str; 7] = ["value", "resources", "world", "processes", "action", "cell", "safety"];

fn main() -> Result<(), Box<dyn Error>> {
    let root = PathBuf::from(std::env::var("CARGO_MANIFEST_DIR")?).join("../../proto");
    println!("cargo::rerun-if-changed={}", root.display());
    let files: Vec<PathBuf> = FILES.iter().map(|name| root.join(format!("ratn/v1/{name}.proto"))).collect();
    let descriptors = protox::compile(&files, [&root])?;

    let mut reflected = descriptors.clone();
    for file in &mut reflected.file {
        // Comments are for the generated code; a server's reflection does without.
        file.source_code_info = None;
    }
    let out = PathBuf::from(std::env::var("OUT_DIR")?);
    std::fs::write(out.join("ratn_v1_descriptors.bin"), reflected.encode_to_vec())?;

    tonic_prost_build::configure().btree_map(".").emit_rerun_if_changed(false).compile_fds(descriptors)?;
    Ok(())
}
