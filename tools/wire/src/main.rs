//! Generates the Rust code of every `.proto` file of ratn, in pure Rust: no `protoc` is needed.
//!
//! The code is checked in, beside the crate that uses it, so that a build of ratn compiles neither a parser of `.proto` files nor a
//! generator. The one argument is where to put it, the root of the project or a copy to compare with. Each folder of generated code has a file [`SOURCES`]: the digests of the files that it was made of. A test of the
//! workspace compares them, and the gate generates everything again and compares that.

use protox::prost_reflect::{DescriptorPool, MethodDescriptor};
use std::error::Error;
use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};

/// The file beside the generated code that says what it was made of: a line `DIGEST  PATH` (BLAKE3, from the root of the project) for
/// each file.
const SOURCES: &str = "SOURCES";
const PACKAGE: &str = "ratn.v1";
const FILES: [&str; 9] = ["access", "value", "resources", "world", "processes", "action", "cell", "safety", "run"];
/// The option of a method that says what it does, and what its values begin with.
const OPTION: (&str, &str) = ("ratn.v1.access", "ACCESS_");

type Fallible<T> = Result<T, Box<dyn Error>>;

fn main() -> Fallible<()> {
    let root = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../..").canonicalize()?;
    let out = std::env::args_os().nth(1).map_or_else(|| root.clone(), PathBuf::from);
    ratn(&root, &out)?;
    etcd(&root, &out)?;
    exports(&root, &out)
}

/// The wire of ratn itself, with the descriptors for reflection and, as the generated code forgets the options of methods, the table of
/// what each method does.
fn ratn(root: &Path, out: &Path) -> Fallible<()> {
    let out = folder(out, "crates/proto")?;
    let protos = root.join("proto");
    let files: Vec<PathBuf> = FILES.iter().map(|name| protos.join(format!("ratn/v1/{name}.proto"))).collect();
    let mut compiler = protox::Compiler::new([&protos])?;
    // Comments are for the generated code; a server's reflection does without. It is encoded with the options of methods.
    compiler.include_imports(true).open_files(&files)?;
    fs::write(out.join("ratn_v1_descriptors.bin"), compiler.encode_file_descriptor_set())?;
    fs::write(out.join("ratn_v1_methods.rs"), methods(&compiler.descriptor_pool())?)?;
    let mut descriptors = compiler.include_source_info(true).file_descriptor_set();
    descriptors.file.retain(|file| file.package() == PACKAGE);
    tonic_prost_build::configure().btree_map(".").out_dir(&out).compile_fds(descriptors)?;
    sources(root, &out, &files)
}

/// What is said to etcd.
fn etcd(root: &Path, out: &Path) -> Fallible<()> {
    let out = folder(out, "crates/storage")?;
    let file = root.join("crates/storage/proto/etcd.proto");
    let mut compiler = protox::Compiler::new([root.join("crates/storage/proto")])?;
    compiler.include_source_info(true).open_file(&file)?;
    tonic_prost_build::configure()
        .build_server(false)
        .bytes(".etcdserverpb")
        .out_dir(&out)
        .compile_fds(compiler.file_descriptor_set())?;
    sources(root, &out, &[file])
}

/// The messages of exports, and the descriptors of Foxglove's, which an MCAP file carries with it.
fn exports(root: &Path, out: &Path) -> Fallible<()> {
    let out = folder(out, "crates/export")?;
    let protos = root.join("crates/export/proto");
    let files = [protos.join("foxglove.proto"), protos.join("perfetto.proto")];
    let mut foxglove = protox::Compiler::new([&protos])?;
    foxglove.include_imports(true).open_file(&files[0])?;
    fs::write(out.join("foxglove_descriptors.bin"), foxglove.encode_file_descriptor_set())?;
    tonic_prost_build::configure().out_dir(&out).compile_fds(protox::compile(&files, [&protos])?)?;
    sources(root, &out, &files)
}

/// The folder of a crate's generated code, empty.
fn folder(root: &Path, name: &str) -> Fallible<PathBuf> {
    let folder = root.join(name).join("src/generated");
    if folder.exists() {
        fs::remove_dir_all(&folder)?;
    }
    fs::create_dir_all(&folder)?;
    Ok(folder)
}

fn sources(root: &Path, out: &Path, files: &[PathBuf]) -> Fallible<()> {
    let mut lines = String::new();
    for file in files {
        writeln!(lines, "{}  {}", blake3::hash(&fs::read(file)?), file.strip_prefix(root)?.display())?;
    }
    Ok(fs::write(out.join(SOURCES), lines)?)
}

/// Rust: a `&[Method]` of every method of every service.
fn methods(pool: &DescriptorPool) -> Fallible<String> {
    let mut table = "&[\n".to_owned();
    for service in pool.services().filter(|service| service.package_name() == PACKAGE) {
        for method in service.methods() {
            let operation = match operation(pool, &method)? {
                Some(operation) => format!("Some(Operation::{operation})"),
                None => "None".to_owned(),
            };
            let (service, name) = (service.full_name(), method.name());
            writeln!(table, "    Method {{ service: {service:?}, name: {name:?}, operation: {operation} }},")?;
        }
    }
    Ok(table + "]\n")
}

/// `Look` of a method with the option `ACCESS_LOOK`.
fn operation(pool: &DescriptorPool, method: &MethodDescriptor) -> Fallible<Option<String>> {
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
