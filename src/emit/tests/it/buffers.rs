//! Test that emitting a ping does not allocate after every buffer has been used.

use echotank_emit::sevenk::{RecordSet, SevenKEmitter};
use echotank_testing::allocations;
use echotank_testing::wire::*;

#[test]
fn the_second_ping_allocates_nothing() {
    let mut emitter = SevenKEmitter::new(sheet(), 2);
    let (plan, output) = (plan(1, 500), output(500));
    let mut records = Vec::new();
    let wanted = RecordSet::ALL;
    let before = allocations::on_this_thread();
    emitter.emit_ping(&plan, &output, wanted, &mut records);
    let first = allocations::on_this_thread() - before;
    assert!(first > 10, "the counter counts: {first} for the first ping");
    for round in 0..5 {
        records.clear();
        let before = allocations::on_this_thread();
        emitter.emit_ping(&plan, &output, wanted, &mut records);
        let again = allocations::on_this_thread() - before;
        assert_eq!(again, 0, "round {round}");
    }
    assert_eq!((records.len(), emitter.pool_misses()), (15, 0));
}
