//! The messages of `proto/`, generated.
#![allow(missing_docs, unreachable_pub, clippy::all, reason = "generated code")]

pub(crate) mod perfetto {
    include!(concat!(env!("OUT_DIR"), "/perfetto.protos.rs"));
}

pub(crate) mod foxglove {
    include!(concat!(env!("OUT_DIR"), "/foxglove.rs"));
    /// With what they import, as an encoded `FileDescriptorSet`.
    pub(crate) const DESCRIPTORS: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/foxglove_descriptors.bin"));
}
