//! Number formats of binary files.

/// The storage format of a number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Scalar {
    /// A signed integer of 1, 2, 4 or 8 bytes.
    Signed(usize),
    /// An unsigned integer of 1, 2, 4 or 8 bytes.
    Unsigned(usize),
    /// IEEE 754 single precision, 4 bytes.
    Single,
    /// IEEE 754 double precision, 8 bytes.
    Double,
}

impl Scalar {
    /// The size in bytes.
    pub(crate) fn size(self) -> usize {
        match self {
            Scalar::Signed(size) | Scalar::Unsigned(size) => size,
            Scalar::Single => 4,
            Scalar::Double => 8,
        }
    }

    /// The number at the beginning of `bytes`; `None` if there are too few.
    pub(crate) fn read(self, bytes: &[u8], is_big_endian: bool) -> Option<f64> {
        let bytes = bytes.get(..self.size())?;
        let mut eight = [0; 8];
        eight[..bytes.len()].copy_from_slice(bytes);
        if is_big_endian {
            eight[..bytes.len()].reverse();
        }
        let word = u64::from_le_bytes(eight);
        let unused = 64 - 8 * self.size();
        Some(match self {
            Scalar::Signed(_) => ((word << unused) as i64 >> unused) as f64,
            Scalar::Unsigned(_) => word as f64,
            Scalar::Single => f64::from(f32::from_bits(word as u32)),
            Scalar::Double => f64::from_bits(word),
        })
    }
}
