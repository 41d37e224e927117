//! Records and client sessions of real protocols, without sockets.

mod buffers;
mod records;
mod session;

use echotank_testing::allocations::Counting;

#[global_allocator]
static COUNTING: Counting = Counting;
