//! Random rigs that test method selection: [`case`] generates them, [`measure`] compares predictions with measurements.

pub(crate) mod case;
pub(crate) mod measure;
pub(crate) mod reference;
