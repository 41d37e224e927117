//! A counting global allocator, for tests of code that must not allocate.
#![allow(dead_code, reason = "each test uses one of the two counters")]

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::sync::atomic::{AtomicU64, Ordering};

static ALL_THREADS: AtomicU64 = AtomicU64::new(0);
thread_local! {
    static THIS_THREAD: Cell<u64> = const { Cell::new(0) };
}

struct Counting;

fn count() {
    ALL_THREADS.fetch_add(1, Ordering::Relaxed);
    // A thread that is ending has no counter any more.
    let _ = THIS_THREAD.try_with(|n| n.set(n.get() + 1));
}

// SAFETY: every call is passed unchanged to the system allocator; the counters allocate nothing and have no destructors.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count();
        // SAFETY: the caller's guarantee about `layout` is passed on.
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: `pointer` came from `alloc` above with this layout.
        unsafe { System.dealloc(pointer, layout) }
    }
    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count();
        // SAFETY: as for `dealloc`; the caller guarantees that `size` is not zero.
        unsafe { System.realloc(pointer, layout, size) }
    }
}

#[global_allocator]
static COUNTING: Counting = Counting;

/// Allocations of the calling thread so far.
pub(crate) fn on_this_thread() -> u64 {
    THIS_THREAD.get()
}

/// Allocations of the whole process so far.
pub(crate) fn in_all_threads() -> u64 {
    ALL_THREADS.load(Ordering::Relaxed)
}
