//! Seabed, points and targets: scatterers on demand.
