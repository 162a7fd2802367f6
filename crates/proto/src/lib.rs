//! The wire: code generated from `proto/` and conversions to the cores' types.
//!
//! [`access`] says what each method does. [`v1`] is what prost and tonic make of `proto/ratn/v1`; [`convert`] turns it into types that cannot be wrong and back;
//! [`types`] holds those of them that no core owns. Wire types stop here: cores never see one. The conversion out of the
//! wire checks what the schema cannot say (a missing choice, a number that is none, nesting without end) and answers with
//! the field's path; the conversion onto the wire cannot fail.

pub mod access;
pub mod convert;
pub mod types;

/// Generated from `proto/ratn/v1` by `scripts/generate-wire`; its documentation is that of the `.proto` files.
#[allow(missing_docs, unreachable_pub, clippy::all, clippy::allow_attributes_without_reason, reason = "generated code")]
pub mod v1 {
    include!("generated/ratn.v1.rs");
}

/// The encoded file descriptors of [`v1`], for gRPC reflection.
pub const FILE_DESCRIPTOR_SET: &[u8] = include_bytes!("generated/ratn_v1_descriptors.bin");

/// No message on the wire is larger than this, in bytes, both ways: a camera image with room to spare.
pub const MAX_MESSAGE_BYTES: usize = 16 * 1024 * 1024;
/// What an answer or a part of one has at the most: the rest of [`MAX_MESSAGE_BYTES`] is for one thing more of any size that is accepted.
pub const MAX_PAGE_BYTES: usize = 8 * 1024 * 1024;
/// The page that a client asks for.
pub const PAGE_BYTES: u32 = 4 * 1024 * 1024;
/// All inputs of a goal together, all its outputs, and all attributes that somebody asks for or offers.
pub const MAX_PORTS_BYTES: usize = 8 * 1024 * 1024;
