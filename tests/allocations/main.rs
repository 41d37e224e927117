//! Code that must not allocate, or only a little. A binary of its own, because most of these tests count the allocations of the whole
//! process.

mod gridded;
mod line_array;
mod methods;
mod pings;
mod readers;
mod scene;

use echotank_testing::allocations::Counting;

#[global_allocator]
static COUNTING: Counting = Counting;
