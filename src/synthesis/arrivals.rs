//! Interface between the echo model and the engines: batches of echoes at one element, or along a line of elements.

use num_complex::Complex64;

use echotank_core::ping::EchoCounts;

// ---------------------------------------------------------------- echoes

/// Maximum number of scatterers in one chunk.
pub const CHUNK: usize = 256;

/// Echoes of up to [`CHUNK`] scatterers at one element, as a structure of arrays that fits the L1 cache.
pub struct ArrivalChunk {
    /// Number of echoes.
    pub len: usize,
    /// Index of the element.
    pub element: usize,
    /// Delay of the leading edge after the start of the pulse, seconds.
    pub delay_s: [f64; CHUNK],
    /// Doppler stretch minus one, eta - 1 with eta = dt'/dt. This form keeps the precision of small values.
    pub doppler: [f64; CHUNK],
    /// Half of d2t'/dt2, per second. Sound received s seconds after the leading edge was transmitted at (1 + doppler) s +
    /// curvature s^2. Zero except with [`DopplerModel::StretchQuadratic`](echotank_core::model::DopplerModel::StretchQuadratic).
    pub curvature_per_s: [f64; CHUNK],
    /// Complex amplitude A_{m,e} at the element without carrier phase: uPa (rms), or volts after the sensitivity.
    pub amplitude: [Complex64; CHUNK],
}

impl ArrivalChunk {
    /// Empty chunk.
    pub fn new() -> Self {
        Self {
            len: 0,
            element: 0,
            delay_s: [0.0; CHUNK],
            doppler: [0.0; CHUNK],
            curvature_per_s: [0.0; CHUNK],
            amplitude: [Complex64::ZERO; CHUNK],
        }
    }
}

impl Default for ArrivalChunk {
    fn default() -> Self {
        Self::new()
    }
}

/// Consumer of echoes at elements.
pub trait ArrivalSink {
    /// Adds the echoes of a chunk.
    fn accept(&mut self, chunk: &ArrivalChunk);
}

/// Echoes of up to [`CHUNK`] scatterers at one point of a line array, with derivatives along the line and during the pulse.
///
/// The delay u(y, w) applies y metres along the line from the point, for sound transmitted w seconds into the pulse. The leading
/// edge is at (0, 0).
pub struct LineChunk {
    /// Number of echoes.
    pub len: usize,
    /// As in [`ArrivalChunk`].
    pub delay_s: [f64; CHUNK],
    /// As in [`ArrivalChunk`].
    pub doppler: [f64; CHUNK],
    /// As in [`ArrivalChunk`].
    pub amplitude: [Complex64; CHUNK],
    /// Slope -c du/dy: sine of the angle from broadside, as received by the moving line.
    pub slope: [f64; CHUNK],
    /// Curvature of the delay along the line, c d2u/dy2, per metre.
    pub curvature_per_m: [f64; CHUNK],
    /// Gradient of the range rate along the line, c d2u/dy dw, per second.
    pub rate_gradient_per_s: [f64; CHUNK],
    /// Acceleration of the range during the pulse, c d2u/dw2, m/s^2: the part of the delay that the linear stretch omits.
    pub acceleration_m_per_s2: [f64; CHUNK],
    /// First-order variation of the amplitude along the line section. At y metres from the middle, the amplitude is `amplitude`
    /// times 1 + gain_slope y + gain_curvature y^2, exact at both ends. Zero if not requested.
    pub gain_slope_per_m: [f64; CHUNK],
    /// Second-order variation of the amplitude along the line section, as in `gain_slope_per_m`.
    pub gain_curvature_per_m2: [f64; CHUNK],
}

impl LineChunk {
    /// Empty chunk.
    pub fn new() -> Self {
        let zero = [0.0; CHUNK];
        Self {
            len: 0,
            delay_s: zero,
            doppler: zero,
            amplitude: [Complex64::ZERO; CHUNK],
            slope: zero,
            curvature_per_m: zero,
            rate_gradient_per_s: zero,
            acceleration_m_per_s2: zero,
            gain_slope_per_m: zero,
            gain_curvature_per_m2: zero,
        }
    }

    /// Copies slope, curvature, rate gradient, acceleration, gain slope and gain curvature of echo `from` to echo `to`.
    pub fn move_derivatives(&mut self, from: usize, to: usize) {
        self.slope[to] = self.slope[from];
        self.curvature_per_m[to] = self.curvature_per_m[from];
        self.rate_gradient_per_s[to] = self.rate_gradient_per_s[from];
        self.acceleration_m_per_s2[to] = self.acceleration_m_per_s2[from];
        self.gain_slope_per_m[to] = self.gain_slope_per_m[from];
        self.gain_curvature_per_m2[to] = self.gain_curvature_per_m2[from];
    }
}

impl Default for LineChunk {
    fn default() -> Self {
        Self::new()
    }
}

/// Consumer of echoes at sections of a line array.
pub trait LineSink {
    /// Adds the echoes of a chunk.
    fn accept(&mut self, chunk: &LineChunk);
}

/// Section of a line array, with the requested interval of leading edges.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LineSection {
    /// Middle of the section relative to the centre of the array, metres.
    pub middle_m: f64,
    /// Distance from the middle of the section to its outermost elements, metres.
    pub half_m: f64,
    /// True if gain slope and gain curvature are requested.
    pub gain_terms: bool,
    /// Number of elements, for the counts.
    pub elements: u64,
    /// First requested leading edge, inclusive, seconds.
    pub earliest_s: f64,
    /// Last requested leading edge, exclusive, seconds.
    pub latest_s: f64,
}

/// Source of the echoes of one ping at one line array. Threads use it concurrently.
pub trait LineSource: Sync {
    /// Number of candidate scatterers.
    fn scatterers(&self) -> u64;

    /// Lower bound of all leading edges on the line, seconds; infinite without echoes.
    fn earliest_s(&self) -> f64;

    /// Emits points of amplitude 0 that bound nearly all echoes of [`Self::walk`], and a sample of its echoes with gain slope and
    /// gain curvature.
    fn survey(&self, section: LineSection, sink: &mut impl LineSink);

    /// Emits the echoes at the middle of a section in a fixed order, in chunks of at most [`CHUNK`]. Counts are in
    /// scatterer-element pairs. An echo outside the requested delays is not counted, because another section requests it.
    fn walk(&self, section: LineSection, sink: &mut impl LineSink) -> EchoCounts;
}
