//! Echo model: path models, Doppler and levels convert scatterers to arrivals.
//!
//! The inputs are a [`PingPlan`](echotank_core::ping::PingPlan), one transmit array, one element of
//! a receive array, and [`Scatterers`](echotank_core::scene::Scatterers). The results are
//! [`ArrivalChunk`](crate::arrivals::ArrivalChunk)s of delay, Doppler stretch and complex
//! amplitude, passed to an [`ArrivalSink`](crate::arrivals::ArrivalSink). The main module is
//! [`walk`].
//!
//! [`reference()`](reference::reference) is the slow reference solution. It computes samples itself
//! and shares only the sonar equation with the other methods.
//!
//! [`rays`] bends the sound: it replaces scatterers by the points where the array sees them. [`reflected_rays`] does so for echoes by surface and bottom. [`boundaries`] holds what surface and bottom reflect and scatter. Not modelled: volume reverberation. The scene resolves occlusion
//! before the echo model receives the scatterers.

pub mod absorption;
pub mod boundaries;
pub mod culling;
mod elementary;
pub mod error_models;
pub mod levels;
pub mod moving;
pub mod paths;
pub mod probe;
pub mod rays;
pub mod reference;
pub mod reflected_rays;
pub mod span;
pub mod stretch;
pub mod walk;
pub mod wind_sea;

pub use absorption::absorption_db_per_m;
pub use paths::{Chord, segment_motion};
pub use reference::reference;
pub use span::doppler_span;
pub use walk::{
    LineEchoes, LineWorkspace, Slab, TransmitLeg, Window, Workspace, arrivals, arrivals_of_slab,
    insonify, line_arrivals,
};
