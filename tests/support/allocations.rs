//! Global allocator with counters, for tests of code that must not allocate, or only a little.
//!
//! A test binary installs it: `#[global_allocator] static COUNTING: Counting = Counting;`.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

static ALL_THREADS: AtomicU64 = AtomicU64::new(0);
static IN_USE: AtomicUsize = AtomicUsize::new(0);
static HIGHEST: AtomicUsize = AtomicUsize::new(0);
thread_local! {
    static THIS_THREAD: Cell<u64> = const { Cell::new(0) };
}

/// System allocator with counters.
pub struct Counting;

fn take(bytes: usize) {
    ALL_THREADS.fetch_add(1, Ordering::Relaxed);
    // The counter does not exist in a thread that is ending.
    let _ = THIS_THREAD.try_with(|n| n.set(n.get() + 1));
    let now = IN_USE.fetch_add(bytes, Ordering::Relaxed) + bytes;
    HIGHEST.fetch_max(now, Ordering::Relaxed);
}

// SAFETY: every call is passed unchanged to the system allocator; the counters allocate nothing and have no destructors.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        take(layout.size());
        // SAFETY: the caller's guarantee about `layout` is passed on.
        unsafe { System.alloc(layout) }
    }
    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        take(layout.size());
        // SAFETY: as for `alloc`.
        unsafe { System.alloc_zeroed(layout) }
    }
    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        IN_USE.fetch_sub(layout.size(), Ordering::Relaxed);
        // SAFETY: `pointer` came from `alloc` above with this layout.
        unsafe { System.dealloc(pointer, layout) }
    }
    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        take(size);
        IN_USE.fetch_sub(layout.size(), Ordering::Relaxed);
        // SAFETY: as for `dealloc`; the caller guarantees that `size` is not zero.
        unsafe { System.realloc(pointer, layout, size) }
    }
}

/// Prevents other tests of the binary that call this function from allocating at the same time.
pub fn alone() -> MutexGuard<'static, ()> {
    static ONE: Mutex<()> = Mutex::new(());
    ONE.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Number of allocations of the calling thread so far.
pub fn on_this_thread() -> u64 {
    THIS_THREAD.get()
}

/// Number of allocations of the whole process so far.
pub fn in_all_threads() -> u64 {
    ALL_THREADS.load(Ordering::Relaxed)
}

/// Number of bytes in use by the whole process.
pub fn in_use() -> usize {
    IN_USE.load(Ordering::Relaxed)
}

/// Peak number of bytes in use since [`reset`].
pub fn highest() -> usize {
    HIGHEST.load(Ordering::Relaxed)
}

/// Starts the measurement of a new peak.
pub fn reset() {
    HIGHEST.store(in_use(), Ordering::Relaxed);
}
