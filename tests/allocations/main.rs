//! Tests of code that must not allocate, or only a little. They are a separate binary, because most of them count the allocations
//! of the whole process.

mod gridded;
mod line_array;
mod methods;
mod pings;
mod readers;
mod scene;

use echotank_testing::allocations::Counting;

#[global_allocator]
static COUNTING: Counting = Counting;
