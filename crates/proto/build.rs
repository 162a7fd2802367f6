//! Generates the wire types and services from `proto/` in pure Rust: no `protoc` is needed. And, as the generated code forgets the
//! options of methods, the table of what each method does.

use protox::prost_reflect::{DescriptorPool, MethodDescriptor};
use std::error::Error;
use std::fmt::Write;
use std::path::PathBuf;

const FILES: [&str; 8] = ["access", "value", "resources", "world", "processes", "action", "cell", "safety"];
const PACKAGE: &str = "ratn.v1";
/// The option of a method that says what it does, and what its values begin with.
const OPTION: (&str, &str) = ("ratn.v1.access", "ACCESS_");

fn main() -> Result<(), Box<dyn Error>> {
    let root = PathBuf::from(std::env::var("CARGO_MANIFEST_DIR")?).join("../../proto");
    println!("cargo::rerun-if-changed={}", root.display());
    let files: Vec<PathBuf> = FILES.iter().map(|name| root.join(format!("ratn/v1/{name}.proto"))).collect();
    let mut compiler = protox::Compiler::new([&root])?;
    // Comments are for the generated code; a server's reflection does without. It is encoded with the options of methods.
    compiler.include_imports(true).open_files(&files)?;
    let out = PathBuf::from(std::env::var("OUT_DIR")?);
    std::fs::write(out.join("ratn_v1_descriptors.bin"), compiler.encode_file_descriptor_set())?;
    std::fs::write(out.join("ratn_v1_methods.rs"), methods(&compiler.descriptor_pool())?)?;

    let mut descriptors = compiler.include_source_info(true).file_descriptor_set();
    descriptors.file.retain(|file| file.package() == PACKAGE);
    tonic_prost_build::configure().btree_map(".").emit_rerun_if_changed(false).compile_fds(descriptors)?;
    Ok(())
}

/// Rust: a `&[Method]` of every method of every service.
fn methods(pool: &DescriptorPool) -> Result<String, Box<dyn Error>> {
    let mut table = "&[\n".to_owned();
    for service in pool.services().filter(|service| service.package_name() == PACKAGE) {
        for method in service.methods() {
            let operation = match operation(pool, &method)? {
                Some(operation) => format!("Some(Operation::{operation})"),
                None => "None".to_owned(),
            };
            let (service, name) = (service.full_name(), method.name());
            writeln!(table, "Method {{ service: {service:?}, name: {name:?}, operation: {operation} }},")?;
        }
    }
    Ok(table + "]\n")
}

/// `Look` of a method with the option `ACCESS_LOOK`.
fn operation(pool: &DescriptorPool, method: &MethodDescriptor) -> Result<Option<String>, Box<dyn Error>> {
    let option = pool.get_extension_by_name(OPTION.0).ok_or("the option of methods is gone")?;
    let options = method.options();
    let number = options.get_extension(&option).as_enum_number().filter(|number| *number != 0);
    let Some(number) = number.filter(|_| options.has_extension(&option)) else { return Ok(None) };
    let values = option.kind().as_enum().ok_or("the option of methods is no enum")?.clone();
    let value = values.get_value(number).ok_or_else(|| format!("{}: {number} is no access", method.full_name()))?;
    let word = value.name().strip_prefix(OPTION.1).unwrap_or(value.name());
    let (first, rest) = word.split_at(1);
    Ok(Some(format!("{first}{}", rest.to_lowercase())))
}
