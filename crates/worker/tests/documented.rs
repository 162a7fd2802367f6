//! `docs/workers.md` shows the example as it is.

#[test]
fn the_worker_in_the_document_is_the_example() {
    let document = include_str!("../../../docs/workers.md");
    let shown = document
        .split_once("```rust example=crates/worker/examples/nearest.rs\n")
        .and_then(|(_, rest)| rest.split_once("```\n"));
    assert_eq!(shown.map(|(code, _)| code), Some(include_str!("../examples/nearest.rs")));
}
