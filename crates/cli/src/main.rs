//! The `ratn` command: see `ratn::main`.
fn main() -> std::process::ExitCode {
    ratn::main()
}
