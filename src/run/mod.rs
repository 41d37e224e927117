//! Who knows the order: pipeline, pacing, settings.
pub mod pipeline;
pub mod settings;
