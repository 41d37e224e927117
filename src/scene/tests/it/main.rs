//! Seabeds from files, and their simplification.

mod readers;
mod simplify;
mod survey;

use echotank_testing::allocations::Counting;

#[global_allocator]
static COUNTING: Counting = Counting;
