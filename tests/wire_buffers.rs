//! Emitting a ping allocates nothing once every buffer has been met.

mod wire_rig;

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use echotank::emit::sevenk::{RecordSet, SevenKEmitter};
use wire_rig::*;

struct Counting;

thread_local! {
    static ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
}

// SAFETY: hands everything on to the system's allocator; the count is a thread-local integer without a destructor.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.with(|count| count.set(count.get() + 1));
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, place: *mut u8, layout: Layout) {
        unsafe { System.dealloc(place, layout) }
    }
    unsafe fn realloc(&self, place: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        ALLOCATIONS.with(|count| count.set(count.get() + 1));
        unsafe { System.realloc(place, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

#[test]
fn the_second_ping_allocates_nothing() {
    let mut emitter = SevenKEmitter::new(sheet(), 2);
    let (plan, output) = (plan(1, 500), output(500));
    let mut records = Vec::new();
    let before = ALLOCATIONS.with(Cell::get);
    emitter.emit_ping(&plan, &output, RecordSet::ALL, &mut records);
    let first = ALLOCATIONS.with(Cell::get) - before;
    assert!(first > 10, "the counter counts: {first} for the first ping");
    for round in 0..5 {
        records.clear();
        let before = ALLOCATIONS.with(Cell::get);
        emitter.emit_ping(&plan, &output, RecordSet::ALL, &mut records);
        let again = ALLOCATIONS.with(Cell::get) - before;
        assert_eq!(again, 0, "round {round}");
    }
    assert_eq!((records.len(), emitter.pool_misses()), (10, 0));
}
