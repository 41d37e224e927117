//! Side-scan lines to pictures: [`Line`](echotank_core::flow::Line)s in, rows of coloured pixels out. Files belong to `io::record`.
//!
//! - [`mod@line`]: the slant-range axis of a line and its gathering into cells.
//! - [`waterfall`]: lines stacked into a picture. [`colour`]: colour maps.
//! - [`masks`]: what each pixel shows, beside every picture. [`water_column`]: pictures of a fan.
//! - [`mosaic`]: lines laid on the ground, in metres of a UTM zone ([`utm`]), as GeoTIFF and PNG.
//! - [`bottom`]: soundings of a fan's beams.
pub mod bottom;
pub mod colour;
mod labels;
pub mod line;
pub mod masks;
pub mod mosaic;
pub mod water_column;
pub mod waterfall;
