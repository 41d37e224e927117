//! Tests of the records and client sessions of all protocols, without sockets.

mod buffers;
mod records;
mod session;

use echotank_testing::allocations::Counting;

#[global_allocator]
static COUNTING: Counting = Counting;
