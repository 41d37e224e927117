//! Path models, Doppler, levels: scatterers to arrivals.
