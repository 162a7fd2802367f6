//! An allocator that counts, so that benches can say what is in use.

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicBool, AtomicIsize, AtomicUsize, Ordering};

/// Counts the bytes that are in use, while it is told to: counting costs a tenth of an event.
struct Counting;

static COUNTS: AtomicBool = AtomicBool::new(false);
static IN_USE: AtomicIsize = AtomicIsize::new(0);
static ALLOCATIONS: AtomicUsize = AtomicUsize::new(0);

#[expect(
    unsafe_code,
    reason = "a global allocator is unsafe by its nature; this one adds two counters to the system's"
)]
// SAFETY: every call is passed on unchanged to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        if COUNTS.load(Ordering::Relaxed) {
            IN_USE.fetch_add(layout.size().cast_signed(), Ordering::Relaxed);
            ALLOCATIONS.fetch_add(1, Ordering::Relaxed);
        }
        // SAFETY: the caller keeps the contract of `alloc`.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        if COUNTS.load(Ordering::Relaxed) {
            IN_USE.fetch_sub(layout.size().cast_signed(), Ordering::Relaxed);
        }
        // SAFETY: the caller keeps the contract of `dealloc`.
        unsafe { System.dealloc(at, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Counts from now on.
pub fn begin() {
    COUNTS.store(true, Ordering::Relaxed);
}

/// Counts no more.
pub fn end() {
    COUNTS.store(false, Ordering::Relaxed);
}

/// Bytes that were allocated and not freed since counting began; what was allocated before and freed since counts negative.
pub fn bytes_in_use() -> isize {
    IN_USE.load(Ordering::Relaxed)
}

/// Allocations since counting began.
pub fn allocations() -> usize {
    ALLOCATIONS.load(Ordering::Relaxed)
}
