//! Keyed random numbers: ChaCha8 with a key from the scene's seed and a label, one stream per target.

use num_complex::Complex64;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

pub(crate) struct KeyedRandom(ChaCha8Rng);

impl KeyedRandom {
    /// `label` separates this use of the seed from others. `stream` is the index of the target.
    pub(crate) fn new(seed: u64, label: &[u8; 24], stream: u64) -> Self {
        let mut key = [0; 32];
        key[..8].copy_from_slice(&seed.to_le_bytes());
        key[8..].copy_from_slice(label);
        let mut rng = ChaCha8Rng::from_seed(key);
        rng.set_stream(stream);
        Self(rng)
    }

    /// Uniform in [0, 1), from the upper 53 bits.
    pub(crate) fn uniform(&mut self) -> f64 {
        const STEP: f64 = 1.0 / (1_u64 << 53) as f64;
        (self.0.next_u64() >> 11) as f64 * STEP
    }

    /// Circular Gaussian with E|z|^2 = 1 (Box and Muller 1958).
    pub(crate) fn circular_gaussian(&mut self) -> Complex64 {
        let radius = (-libm::log(1.0 - self.uniform())).sqrt();
        let (sin, cos) = libm::sincos(std::f64::consts::TAU * self.uniform());
        Complex64::new(radius * cos, radius * sin)
    }
}
