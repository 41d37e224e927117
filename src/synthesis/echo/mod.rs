//! Scatterers to arrivals: path models, Doppler, levels.
//!
//! In: a [`PingPlan`](echotank_core::flow::PingPlan), one transmit array, one element of a receive array, [`Scatterers`](echotank_core::flow::Scatterers).
//! Out: [`ArrivalChunk`](echotank_core::flow::ArrivalChunk)s of delay, Doppler stretch and complex amplitude, handed to an
//! [`ArrivalSink`](echotank_core::flow::ArrivalSink). Read [`walk`] first.
//!
//! Beside it stands [`reference()`](reference::reference): the slow truth, which makes samples itself and shares only the sonar equation.
//!
//! Not modelled: refraction, multipath, volume reverberation, occlusion (the scene hands over what is seen).

pub mod absorption;
pub mod culling;
mod elementary;
pub mod error_models;
pub mod levels;
pub mod paths;
pub mod probe;
pub mod reference;
pub mod span;
pub mod stretch;
pub mod walk;

pub use absorption::absorption_db_per_m;
pub use reference::reference;
pub use span::doppler_span;
pub use walk::{
    LineEchoes, LineWorkspace, Slab, TransmitLeg, Window, Workspace, arrivals, arrivals_of_slab,
    insonify, line_arrivals,
};
