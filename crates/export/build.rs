//! Generates the messages of `proto/` in pure Rust, and keeps the descriptors of Foxglove's, which an MCAP file carries with it.

use std::error::Error;
use std::path::PathBuf;

fn main() -> Result<(), Box<dyn Error>> {
    let root = PathBuf::from(std::env::var("CARGO_MANIFEST_DIR")?).join("proto");
    println!("cargo::rerun-if-changed={}", root.display());
    let out = PathBuf::from(std::env::var("OUT_DIR")?);
    let mut foxglove = protox::Compiler::new([&root])?;
    foxglove.include_imports(true).open_file(root.join("foxglove.proto"))?;
    std::fs::write(out.join("foxglove_descriptors.bin"), foxglove.encode_file_descriptor_set())?;
    let both = protox::compile(["foxglove.proto", "perfetto.proto"], [&root])?;
    tonic_prost_build::configure().emit_rerun_if_changed(false).compile_fds(both)?;
    Ok(())
}
