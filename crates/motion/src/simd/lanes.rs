//! Vectors of several `f32`, and the instruction sets of this processor for them.
//!
//! The only file of the crate with unsafe code, for two reasons: the vector intrinsics of `core::arch` may be called only where the processor has
//! them, which [`Isa::detect`] establishes once, and nothing else can make an [`Isa`]; and loads and stores take pointers, here always to a whole
//! [`Block`]. The kernels themselves are safe, generic over [`Lanes`] and inlined into one function per instruction set.

#![allow(unsafe_code, reason = "vector intrinsics behind a detected instruction set, see above")]

use super::cloud::{self, Cloud};
use super::kernel::{Compiled, Edge, Scratch};
use super::{nearest, sweep};

/// Sixteen numbers on one cache line; narrower lanes use the first of them.
#[derive(Debug, Clone, Copy, PartialEq)]
#[repr(C, align(64))]
pub(crate) struct Block(pub(crate) [f32; 16]);

/// A vector of numbers. Masks have one bit per lane.
pub(super) trait Lanes: Copy {
    const WIDTH: usize;
    /// The mask with a bit for every lane.
    const ALL: u32 = (1 << Self::WIDTH) - 1;
    fn splat(value: f32) -> Self;
    fn load(block: &Block) -> Self;
    /// The numbers of a block from `part` times the width on.
    fn load_part(block: &Block, part: usize) -> Self;
    fn store(self, block: &mut Block);
    fn add(self, other: Self) -> Self;
    fn sub(self, other: Self) -> Self;
    fn mul(self, other: Self) -> Self;
    /// `self * factor + term`, rounded once if the processor has the instruction.
    fn mul_add(self, factor: Self, term: Self) -> Self;
    fn max(self, other: Self) -> Self;
    fn min(self, other: Self) -> Self;
    fn sqrt(self) -> Self;
    fn below(self, other: Self) -> u32;
    /// The maximum of all lanes.
    fn peak(self) -> f32;
    /// The maxima of six vectors, in the first six of these numbers.
    #[inline(always)]
    fn peaks(six: [Self; 6]) -> [f32; 8] {
        let [a, b, c, d, e, f] = six;
        [a.peak(), b.peak(), c.peak(), d.peak(), e.peak(), f.peak(), 0.0, 0.0]
    }
    /// `yes` in the lanes that are below the other's, `no` in the others.
    fn choose_below(self, other: Self, yes: Self, no: Self) -> Self;
    #[inline(always)]
    fn abs(self) -> Self {
        self.max(Self::splat(0.0).sub(self))
    }
}

/// An instruction set that this processor was found to have.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Isa(Kind);

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    #[cfg(target_arch = "x86_64")]
    Avx512,
    #[cfg(target_arch = "x86_64")]
    Avx2,
    #[cfg(target_arch = "aarch64")]
    Neon,
    Plain,
}

impl Isa {
    /// The widest instruction set of this processor.
    pub fn detect() -> Isa {
        Isa::available()[0]
    }

    /// All instruction sets of this processor, the widest first; the last one is the scalar one.
    pub fn available() -> Vec<Isa> {
        let mut all = Vec::new();
        #[cfg(target_arch = "x86_64")]
        {
            if std::arch::is_x86_feature_detected!("avx512f") && std::arch::is_x86_feature_detected!("fma") {
                all.push(Isa(Kind::Avx512));
            }
            if std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma") {
                all.push(Isa(Kind::Avx2));
            }
        }
        #[cfg(target_arch = "aarch64")]
        if std::arch::is_aarch64_feature_detected!("neon") {
            all.push(Isa(Kind::Neon));
        }
        all.push(Isa(Kind::Plain));
        all
    }

    /// Its name in lower case: `avx512`, `avx2`, `neon`, or `plain` for the scalar one.
    pub fn name(self) -> &'static str {
        match self.0 {
            #[cfg(target_arch = "x86_64")]
            Kind::Avx512 => "avx512",
            #[cfg(target_arch = "x86_64")]
            Kind::Avx2 => "avx2",
            #[cfg(target_arch = "aarch64")]
            Kind::Neon => "neon",
            Kind::Plain => "plain",
        }
    }

    /// Number of configurations that are checked at once.
    pub fn width(self) -> usize {
        match self.0 {
            #[cfg(target_arch = "x86_64")]
            Kind::Avx512 => 16,
            #[cfg(target_arch = "x86_64")]
            Kind::Avx2 => 16,
            #[cfg(target_arch = "aarch64")]
            Kind::Neon => 8,
            Kind::Plain => 8,
        }
    }

    /// See [`sweep::is_free`].
    #[inline]
    pub(crate) fn is_free(self, edge: &Edge<'_>, scratch: &mut Scratch) -> bool {
        match self.0 {
            // SAFETY: an `Isa` of this kind exists only where `available` found the features.
            #[cfg(target_arch = "x86_64")]
            Kind::Avx512 => unsafe { is_free_avx512(edge, scratch) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Kind::Avx2 => unsafe { is_free_avx2(edge, scratch) },
            // SAFETY: as above.
            #[cfg(target_arch = "aarch64")]
            Kind::Neon => unsafe { is_free_neon(edge, scratch) },
            Kind::Plain => sweep::is_free::<[f32; 8]>(edge, scratch),
        }
    }

    /// See [`sweep::near`].
    #[inline]
    pub(crate) fn near(self, edge: &Edge<'_>, scratch: &mut Scratch) -> u32 {
        match self.0 {
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Kind::Avx512 => unsafe { near_avx512(edge, scratch) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Kind::Avx2 => unsafe { near_avx2(edge, scratch) },
            // SAFETY: as above.
            #[cfg(target_arch = "aarch64")]
            Kind::Neon => unsafe { near_neon(edge, scratch) },
            Kind::Plain => sweep::near::<[f32; 8]>(edge, scratch),
        }
    }

    /// See [`sweep::touching_again`].
    #[inline]
    pub(crate) fn touching_again(
        self,
        compiled: &Compiled,
        positions: &[Block],
        count: usize,
        scratch: &mut Scratch,
    ) -> u32 {
        match self.0 {
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Kind::Avx512 => unsafe { touching_again_avx512(compiled, positions, count, scratch) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Kind::Avx2 => unsafe { touching_again_avx2(compiled, positions, count, scratch) },
            // SAFETY: as above.
            #[cfg(target_arch = "aarch64")]
            Kind::Neon => unsafe { touching_again_neon(compiled, positions, count, scratch) },
            Kind::Plain => sweep::touching_again::<[f32; 8]>(compiled, positions, count, scratch),
        }
    }

    /// See [`cloud::fill`].
    pub(crate) fn fill_cloud(self, cloud: &mut Cloud, points: &[[Block; 3]], reach: f32) {
        match self.0 {
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Kind::Avx512 => unsafe { fill_cloud_avx512(cloud, points, reach) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Kind::Avx2 => unsafe { fill_cloud_avx2(cloud, points, reach) },
            // SAFETY: as above.
            #[cfg(target_arch = "aarch64")]
            Kind::Neon => unsafe { fill_cloud_neon(cloud, points, reach) },
            Kind::Plain => cloud::fill::<[f32; 8]>(cloud, points, reach),
        }
    }

    /// See [`nearest::nearest_each`].
    #[inline]
    pub(crate) fn nearest_each(self, blocks: &[Block], states: &[[f32; 16]], to: &[Block]) -> [u32; 16] {
        let mut found = [0; 16];
        match self.0 {
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Kind::Avx512 => unsafe { nearest_each_avx512(blocks, states, to, &mut found) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Kind::Avx2 => unsafe { nearest_each_avx2(blocks, states, to, &mut found) },
            // SAFETY: as above.
            #[cfg(target_arch = "aarch64")]
            Kind::Neon => unsafe { nearest_each_neon(blocks, states, to, &mut found) },
            Kind::Plain => nearest::nearest_each::<[f32; 8]>(blocks, states, to, &mut found),
        }
        found
    }

    /// See [`nearest::nearest`].
    #[inline]
    pub(crate) fn nearest(self, blocks: &[Block], dimensions: usize, to: &[f32; 16]) -> usize {
        match self.0 {
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Kind::Avx512 => unsafe { nearest_avx512(blocks, dimensions, to) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Kind::Avx2 => unsafe { nearest_avx2(blocks, dimensions, to) },
            // SAFETY: as above.
            #[cfg(target_arch = "aarch64")]
            Kind::Neon => unsafe { nearest_neon(blocks, dimensions, to) },
            Kind::Plain => nearest::nearest::<[f32; 8]>(blocks, dimensions, to),
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx2,fma")]
fn is_free_avx512(edge: &Edge<'_>, scratch: &mut Scratch) -> bool {
    sweep::is_free::<x86::Wide16>(edge, scratch)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn is_free_avx2(edge: &Edge<'_>, scratch: &mut Scratch) -> bool {
    sweep::is_free::<x86::Pair>(edge, scratch)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx2,fma")]
fn near_avx512(edge: &Edge<'_>, scratch: &mut Scratch) -> u32 {
    sweep::near::<x86::Wide16>(edge, scratch)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn near_avx2(edge: &Edge<'_>, scratch: &mut Scratch) -> u32 {
    sweep::near::<x86::Pair>(edge, scratch)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx2,fma")]
fn touching_again_avx512(compiled: &Compiled, positions: &[Block], count: usize, scratch: &mut Scratch) -> u32 {
    sweep::touching_again::<x86::Wide16>(compiled, positions, count, scratch)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn touching_again_avx2(compiled: &Compiled, positions: &[Block], count: usize, scratch: &mut Scratch) -> u32 {
    sweep::touching_again::<x86::Pair>(compiled, positions, count, scratch)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx2,fma")]
fn nearest_each_avx512(blocks: &[Block], states: &[[f32; 16]], to: &[Block], found: &mut [u32; 16]) {
    nearest::nearest_each::<x86::Wide16>(blocks, states, to, found);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn nearest_each_avx2(blocks: &[Block], states: &[[f32; 16]], to: &[Block], found: &mut [u32; 16]) {
    nearest::nearest_each::<x86::Pair>(blocks, states, to, found);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx2,fma")]
fn fill_cloud_avx512(cloud: &mut Cloud, points: &[[Block; 3]], reach: f32) {
    cloud::fill::<x86::Wide16>(cloud, points, reach);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn fill_cloud_avx2(cloud: &mut Cloud, points: &[[Block; 3]], reach: f32) {
    cloud::fill::<x86::Pair>(cloud, points, reach);
}

#[cfg(target_arch = "aarch64")]
#[target_feature(enable = "neon")]
fn fill_cloud_neon(cloud: &mut Cloud, points: &[[Block; 3]], reach: f32) {
    cloud::fill::<arm::Pair>(cloud, points, reach);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx2,fma")]
fn nearest_avx512(blocks: &[Block], dimensions: usize, to: &[f32; 16]) -> usize {
    nearest::nearest::<x86::Wide16>(blocks, dimensions, to)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn nearest_avx2(blocks: &[Block], dimensions: usize, to: &[f32; 16]) -> usize {
    nearest::nearest::<x86::Pair>(blocks, dimensions, to)
}

#[cfg(target_arch = "aarch64")]
#[target_feature(enable = "neon")]
fn nearest_neon(blocks: &[Block], dimensions: usize, to: &[f32; 16]) -> usize {
    nearest::nearest::<arm::Pair>(blocks, dimensions, to)
}

#[cfg(target_arch = "aarch64")]
#[target_feature(enable = "neon")]
fn is_free_neon(edge: &Edge<'_>, scratch: &mut Scratch) -> bool {
    sweep::is_free::<arm::Pair>(edge, scratch)
}

#[cfg(target_arch = "aarch64")]
#[target_feature(enable = "neon")]
fn near_neon(edge: &Edge<'_>, scratch: &mut Scratch) -> u32 {
    sweep::near::<arm::Pair>(edge, scratch)
}

#[cfg(target_arch = "aarch64")]
#[target_feature(enable = "neon")]
fn touching_again_neon(compiled: &Compiled, positions: &[Block], count: usize, scratch: &mut Scratch) -> u32 {
    sweep::touching_again::<arm::Pair>(compiled, positions, count, scratch)
}

#[cfg(target_arch = "aarch64")]
#[target_feature(enable = "neon")]
fn nearest_each_neon(blocks: &[Block], states: &[[f32; 16]], to: &[Block], found: &mut [u32; 16]) {
    nearest::nearest_each::<arm::Pair>(blocks, states, to, found);
}

impl Lanes for [f32; 8] {
    const WIDTH: usize = 8;
    #[inline(always)]
    fn splat(value: f32) -> Self {
        [value; 8]
    }
    #[inline(always)]
    fn load(block: &Block) -> Self {
        std::array::from_fn(|i| block.0[i])
    }
    #[inline(always)]
    fn load_part(block: &Block, part: usize) -> Self {
        std::array::from_fn(|i| block.0[8 * (part & 1) + i])
    }
    #[inline(always)]
    fn store(self, block: &mut Block) {
        block.0[..8].copy_from_slice(&self);
    }
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        std::array::from_fn(|i| self[i] + other[i])
    }
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        std::array::from_fn(|i| self[i] - other[i])
    }
    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        std::array::from_fn(|i| self[i] * other[i])
    }
    #[inline(always)]
    fn mul_add(self, factor: Self, term: Self) -> Self {
        // Not `f32::mul_add`: without the instruction it is a library call.
        std::array::from_fn(|i| self[i] * factor[i] + term[i])
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        std::array::from_fn(|i| if self[i] > other[i] { self[i] } else { other[i] })
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        std::array::from_fn(|i| if self[i] < other[i] { self[i] } else { other[i] })
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        self.map(f32::sqrt)
    }
    #[inline(always)]
    fn below(self, other: Self) -> u32 {
        (0..8).fold(0, |mask, i| mask | u32::from(self[i] < other[i]) << i)
    }
    #[inline(always)]
    fn peak(self) -> f32 {
        self.into_iter().fold(f32::NEG_INFINITY, f32::max)
    }
    #[inline(always)]
    fn choose_below(self, other: Self, yes: Self, no: Self) -> Self {
        std::array::from_fn(|i| if self[i] < other[i] { yes[i] } else { no[i] })
    }
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    //! SAFETY of every block here: the methods are inlined into functions that have the features, see above; pointers are to
    //! the sixteen numbers of a block.

    use super::{Block, Lanes};
    use core::arch::x86_64::*;

    #[derive(Clone, Copy)]
    pub(super) struct Wide16(__m512);

    impl Lanes for Wide16 {
        const WIDTH: usize = 16;
        #[inline(always)]
        fn splat(value: f32) -> Self {
            Wide16(unsafe { _mm512_set1_ps(value) })
        }
        #[inline(always)]
        fn load(block: &Block) -> Self {
            Wide16(unsafe { _mm512_load_ps(block.0.as_ptr()) })
        }
        #[inline(always)]
        fn load_part(block: &Block, _: usize) -> Self {
            Self::load(block)
        }
        #[inline(always)]
        fn store(self, block: &mut Block) {
            unsafe { _mm512_store_ps(block.0.as_mut_ptr(), self.0) }
        }
        #[inline(always)]
        fn add(self, other: Self) -> Self {
            Wide16(unsafe { _mm512_add_ps(self.0, other.0) })
        }
        #[inline(always)]
        fn sub(self, other: Self) -> Self {
            Wide16(unsafe { _mm512_sub_ps(self.0, other.0) })
        }
        #[inline(always)]
        fn mul(self, other: Self) -> Self {
            Wide16(unsafe { _mm512_mul_ps(self.0, other.0) })
        }
        #[inline(always)]
        fn mul_add(self, factor: Self, term: Self) -> Self {
            Wide16(unsafe { _mm512_fmadd_ps(self.0, factor.0, term.0) })
        }
        #[inline(always)]
        fn max(self, other: Self) -> Self {
            Wide16(unsafe { _mm512_max_ps(self.0, other.0) })
        }
        #[inline(always)]
        fn min(self, other: Self) -> Self {
            Wide16(unsafe { _mm512_min_ps(self.0, other.0) })
        }
        #[inline(always)]
        fn sqrt(self) -> Self {
            Wide16(unsafe { _mm512_sqrt_ps(self.0) })
        }
        #[inline(always)]
        fn below(self, other: Self) -> u32 {
            u32::from(unsafe { _mm512_cmp_ps_mask::<_CMP_LT_OQ>(self.0, other.0) })
        }
        #[inline(always)]
        fn peak(self) -> f32 {
            unsafe { _mm512_reduce_max_ps(self.0) }
        }
        #[inline(always)]
        fn peaks(six: [Self; 6]) -> [f32; 8] {
            let [a, b, c, d, e, f] = six;
            unsafe { peaks([halved(a.0), halved(b.0), halved(c.0), halved(d.0), halved(e.0), halved(f.0)]) }
        }
        #[inline(always)]
        fn choose_below(self, other: Self, yes: Self, no: Self) -> Self {
            Wide16(unsafe { _mm512_mask_blend_ps(_mm512_cmp_ps_mask::<_CMP_LT_OQ>(self.0, other.0), no.0, yes.0) })
        }
        #[inline(always)]
        fn abs(self) -> Self {
            Wide16(unsafe { _mm512_abs_ps(self.0) })
        }
    }

    /// The lane-wise maximum of both halves.
    #[inline(always)]
    unsafe fn halved(a: __m512) -> __m256 {
        unsafe {
            let upper = _mm256_castpd_ps(_mm512_extractf64x4_pd::<1>(_mm512_castps_pd(a)));
            _mm256_max_ps(_mm512_castps512_ps256(a), upper)
        }
    }

    /// The maxima of six vectors with half of the instructions of six separate ones: two, then four of them are halved at once.
    #[inline(always)]
    unsafe fn peaks([a, b, c, d, e, f]: [__m256; 6]) -> [f32; 8] {
        unsafe {
            let ab = _mm256_max_ps(_mm256_unpacklo_ps(a, b), _mm256_unpackhi_ps(a, b));
            let cd = _mm256_max_ps(_mm256_unpacklo_ps(c, d), _mm256_unpackhi_ps(c, d));
            let ef = _mm256_max_ps(_mm256_unpacklo_ps(e, f), _mm256_unpackhi_ps(e, f));
            let abcd = _mm256_max_ps(_mm256_shuffle_ps::<0x44>(ab, cd), _mm256_shuffle_ps::<0xee>(ab, cd));
            let ef = _mm256_max_ps(ef, _mm256_shuffle_ps::<0xee>(ef, ef));
            let lower = _mm256_permute2f128_ps::<0x20>(abcd, ef);
            let all = _mm256_max_ps(lower, _mm256_permute2f128_ps::<0x31>(abcd, ef));
            let mut peaks = [0.0; 8];
            _mm256_storeu_ps(peaks.as_mut_ptr(), all);
            peaks
        }
    }

    /// Sixteen numbers in two registers: as many as in one of AVX-512, so that what a batch costs besides its vectors is paid for sixteen postures.
    #[derive(Clone, Copy)]
    pub(super) struct Pair(__m256, __m256);

    impl Pair {
        /// The lane-wise maximum of both registers.
        #[inline(always)]
        fn halved(self) -> __m256 {
            unsafe { _mm256_max_ps(self.0, self.1) }
        }
    }

    impl Lanes for Pair {
        const WIDTH: usize = 16;
        #[inline(always)]
        fn splat(value: f32) -> Self {
            let eight = unsafe { _mm256_set1_ps(value) };
            Pair(eight, eight)
        }
        #[inline(always)]
        fn load(block: &Block) -> Self {
            let first = block.0.as_ptr();
            Pair(unsafe { _mm256_load_ps(first) }, unsafe { _mm256_load_ps(first.add(8)) })
        }
        #[inline(always)]
        fn load_part(block: &Block, _: usize) -> Self {
            Self::load(block)
        }
        #[inline(always)]
        fn store(self, block: &mut Block) {
            let first = block.0.as_mut_ptr();
            unsafe { _mm256_store_ps(first, self.0) };
            unsafe { _mm256_store_ps(first.add(8), self.1) }
        }
        #[inline(always)]
        fn add(self, other: Self) -> Self {
            Pair(unsafe { _mm256_add_ps(self.0, other.0) }, unsafe { _mm256_add_ps(self.1, other.1) })
        }
        #[inline(always)]
        fn sub(self, other: Self) -> Self {
            Pair(unsafe { _mm256_sub_ps(self.0, other.0) }, unsafe { _mm256_sub_ps(self.1, other.1) })
        }
        #[inline(always)]
        fn mul(self, other: Self) -> Self {
            Pair(unsafe { _mm256_mul_ps(self.0, other.0) }, unsafe { _mm256_mul_ps(self.1, other.1) })
        }
        #[inline(always)]
        fn mul_add(self, factor: Self, term: Self) -> Self {
            let low = unsafe { _mm256_fmadd_ps(self.0, factor.0, term.0) };
            Pair(low, unsafe { _mm256_fmadd_ps(self.1, factor.1, term.1) })
        }
        #[inline(always)]
        fn max(self, other: Self) -> Self {
            Pair(unsafe { _mm256_max_ps(self.0, other.0) }, unsafe { _mm256_max_ps(self.1, other.1) })
        }
        #[inline(always)]
        fn min(self, other: Self) -> Self {
            Pair(unsafe { _mm256_min_ps(self.0, other.0) }, unsafe { _mm256_min_ps(self.1, other.1) })
        }
        #[inline(always)]
        fn sqrt(self) -> Self {
            Pair(unsafe { _mm256_sqrt_ps(self.0) }, unsafe { _mm256_sqrt_ps(self.1) })
        }
        #[inline(always)]
        fn below(self, other: Self) -> u32 {
            let low = unsafe { _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_LT_OQ>(self.0, other.0)) };
            let high = unsafe { _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_LT_OQ>(self.1, other.1)) };
            (low | high << 8) as u32
        }
        #[inline(always)]
        fn peak(self) -> f32 {
            unsafe {
                let eight = self.halved();
                let four = _mm_max_ps(_mm256_castps256_ps128(eight), _mm256_extractf128_ps::<1>(eight));
                let two = _mm_max_ps(four, _mm_movehl_ps(four, four));
                _mm_cvtss_f32(_mm_max_ss(two, _mm_movehdup_ps(two)))
            }
        }
        #[inline(always)]
        fn peaks(six: [Self; 6]) -> [f32; 8] {
            let [a, b, c, d, e, f] = six;
            unsafe { peaks([a.halved(), b.halved(), c.halved(), d.halved(), e.halved(), f.halved()]) }
        }
        #[inline(always)]
        fn choose_below(self, other: Self, yes: Self, no: Self) -> Self {
            let low = unsafe { _mm256_blendv_ps(no.0, yes.0, _mm256_cmp_ps::<_CMP_LT_OQ>(self.0, other.0)) };
            Pair(low, unsafe { _mm256_blendv_ps(no.1, yes.1, _mm256_cmp_ps::<_CMP_LT_OQ>(self.1, other.1)) })
        }
        #[inline(always)]
        fn abs(self) -> Self {
            let sign = unsafe { _mm256_set1_ps(-0.0) };
            Pair(unsafe { _mm256_andnot_ps(sign, self.0) }, unsafe { _mm256_andnot_ps(sign, self.1) })
        }
    }
}

#[cfg(target_arch = "aarch64")]
mod arm {
    //! SAFETY of every block here: as for the other processors, see above; the second four numbers of a block follow the first.

    use super::{Block, Lanes};
    use core::arch::aarch64::*;

    /// Eight numbers in two registers.
    #[derive(Clone, Copy)]
    pub(super) struct Pair(float32x4_t, float32x4_t);

    impl Lanes for Pair {
        const WIDTH: usize = 8;
        #[inline(always)]
        fn splat(value: f32) -> Self {
            let four = unsafe { vdupq_n_f32(value) };
            Pair(four, four)
        }
        #[inline(always)]
        fn load(block: &Block) -> Self {
            let first = block.0.as_ptr();
            Pair(unsafe { vld1q_f32(first) }, unsafe { vld1q_f32(first.add(4)) })
        }
        #[inline(always)]
        fn load_part(block: &Block, part: usize) -> Self {
            let first = unsafe { block.0.as_ptr().add(8 * (part & 1)) };
            Pair(unsafe { vld1q_f32(first) }, unsafe { vld1q_f32(first.add(4)) })
        }
        #[inline(always)]
        fn store(self, block: &mut Block) {
            let first = block.0.as_mut_ptr();
            unsafe { vst1q_f32(first, self.0) };
            unsafe { vst1q_f32(first.add(4), self.1) };
        }
        #[inline(always)]
        fn add(self, other: Self) -> Self {
            Pair(unsafe { vaddq_f32(self.0, other.0) }, unsafe { vaddq_f32(self.1, other.1) })
        }
        #[inline(always)]
        fn sub(self, other: Self) -> Self {
            Pair(unsafe { vsubq_f32(self.0, other.0) }, unsafe { vsubq_f32(self.1, other.1) })
        }
        #[inline(always)]
        fn mul(self, other: Self) -> Self {
            Pair(unsafe { vmulq_f32(self.0, other.0) }, unsafe { vmulq_f32(self.1, other.1) })
        }
        #[inline(always)]
        fn mul_add(self, factor: Self, term: Self) -> Self {
            let low = unsafe { vfmaq_f32(term.0, self.0, factor.0) };
            Pair(low, unsafe { vfmaq_f32(term.1, self.1, factor.1) })
        }
        #[inline(always)]
        fn max(self, other: Self) -> Self {
            Pair(unsafe { vmaxq_f32(self.0, other.0) }, unsafe { vmaxq_f32(self.1, other.1) })
        }
        #[inline(always)]
        fn min(self, other: Self) -> Self {
            Pair(unsafe { vminnmq_f32(self.0, other.0) }, unsafe { vminnmq_f32(self.1, other.1) })
        }
        #[inline(always)]
        fn sqrt(self) -> Self {
            Pair(unsafe { vsqrtq_f32(self.0) }, unsafe { vsqrtq_f32(self.1) })
        }
        #[inline(always)]
        fn below(self, other: Self) -> u32 {
            let worth: [u32; 8] = [1, 2, 4, 8, 16, 32, 64, 128];
            let low = unsafe { vandq_u32(vcltq_f32(self.0, other.0), vld1q_u32(worth.as_ptr())) };
            let high = unsafe { vandq_u32(vcltq_f32(self.1, other.1), vld1q_u32(worth.as_ptr().add(4))) };
            unsafe { vaddvq_u32(vorrq_u32(low, high)) }
        }
        #[inline(always)]
        fn peak(self) -> f32 {
            unsafe { vmaxvq_f32(vmaxq_f32(self.0, self.1)) }
        }
        #[inline(always)]
        fn choose_below(self, other: Self, yes: Self, no: Self) -> Self {
            let low = unsafe { vbslq_f32(vcltq_f32(self.0, other.0), yes.0, no.0) };
            Pair(low, unsafe { vbslq_f32(vcltq_f32(self.1, other.1), yes.1, no.1) })
        }
        #[inline(always)]
        fn abs(self) -> Self {
            Pair(unsafe { vabsq_f32(self.0) }, unsafe { vabsq_f32(self.1) })
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn peaks<V: Lanes>() -> [f32; 8] {
        // The maximum of each vector is in another lane.
        let mut six = [V::splat(0.0); 6];
        for (i, vector) in six.iter_mut().enumerate() {
            let mut block = Block([-10.0; 16]);
            block.0[(i * 3 + 1) % V::WIDTH] = i as f32 - 2.0;
            *vector = V::load(&block);
        }
        V::peaks(six)
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f,avx2,fma")]
    fn peaks_avx512() -> [f32; 8] {
        peaks::<x86::Wide16>()
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2,fma")]
    fn peaks_avx2() -> [f32; 8] {
        peaks::<x86::Pair>()
    }

    #[test]
    fn the_greatest_lanes_of_six_vectors_are_those_of_each() {
        for isa in Isa::available() {
            let found = match isa.0 {
                // SAFETY: only an instruction set that was found is listed.
                #[cfg(target_arch = "x86_64")]
                Kind::Avx512 => unsafe { peaks_avx512() },
                // SAFETY: as above.
                #[cfg(target_arch = "x86_64")]
                Kind::Avx2 => unsafe { peaks_avx2() },
                #[cfg(target_arch = "aarch64")]
                Kind::Neon => peaks::<[f32; 8]>(),
                Kind::Plain => peaks::<[f32; 8]>(),
            };
            assert_eq!(found[..6], [-2.0, -1.0, 0.0, 1.0, 2.0, 3.0], "{isa:?}");
        }
    }
}
