//! Readers of seabeds and models.

pub mod ascii_grid;
mod shapes;
pub(in crate::scene) mod text;

pub use shapes::{Depth, HeightField, PointCloud, TriangleMesh};
