//! Random rigs for the plan of methods: [`case`] makes them, [`measure`] holds a plan's promises against what its ping and those of other choices do.

pub(crate) mod case;
pub(crate) mod measure;
pub(crate) mod reference;
