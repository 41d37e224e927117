//! Pictures from side-scan lines and beams: [`Line`](echotank_core::ping::Line)s in, rows of coloured pixels out. The runtime crate writes
//! the files.
//!
//! - [`mod@line`]: the slant-range axis of a line and its division into cells.
//! - [`waterfall`]: lines stacked into a picture. [`colour`]: colour maps.
//! - [`masks`]: ground truth for each pixel of a picture. [`water_column`]: pictures of a fan.
//! - [`mosaic`]: lines projected onto a map in metres of a UTM zone, as GeoTIFF and PNG.
//! - [`bottom`]: soundings from a fan's beams.
pub mod bottom;
pub mod colour;
mod labels;
pub mod line;
pub mod masks;
pub mod mosaic;
pub mod water_column;
pub mod waterfall;
