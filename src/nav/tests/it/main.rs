//! Navigation from bytes to motion: sentences, formats, recorded logs, history.

mod decode;
mod formats;
mod history;
mod logs;
mod mounting;

use echotank_testing::allocations::Counting;

#[global_allocator]
static COUNTING: Counting = Counting;
