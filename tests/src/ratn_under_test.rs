//! The same command as `ratn`, built with this package so that its tests find it by `CARGO_BIN_EXE_ratn-under-test`.
fn main() -> std::process::ExitCode {
    ratn::main()
}
