//! Side-scan lines to pictures: [`Line`](crate::flow::Line)s in, rows of coloured pixels out. Files belong to `io::record`.
//!
//! - [`mod@line`]: the slant-range axis of a line and its gathering into cells.
//! - [`waterfall`]: lines stacked into a picture.
//!
//! Not modelled: ground range, mosaics, water column, bottom detection.
pub mod line;
pub mod waterfall;
