//! The interface between the echo model and the engines: batches of echoes at one element, or along a line of elements.

use num_complex::Complex64;

use echotank_core::ping::EchoCounts;

// ---------------------------------------------------------------- echoes

/// Maximum number of scatterers in one chunk.
pub const CHUNK: usize = 256;

/// Echoes of up to [`CHUNK`] scatterers at one element, structure of arrays, small enough for L1.
pub struct ArrivalChunk {
    /// Number of echoes.
    pub len: usize,
    /// Index of the element.
    pub element: usize,
    /// Leading edge after the start of the pulse, seconds.
    pub delay_s: [f64; CHUNK],
    /// eta = dt'/dt - 1: Doppler stretch minus one, which keeps the precision of small values.
    pub doppler: [f64; CHUNK],
    /// Half of d2t'/dt2, per second. The sound at s seconds after the leading edge left at (1 + doppler) s + curvature s^2. Zero
    /// except with [`DopplerModel::StretchQuadratic`](echotank_core::model::DopplerModel::StretchQuadratic).
    pub curvature_per_s: [f64; CHUNK],
    /// Complex amplitude A_{m,e} at the element without carrier phase: uPa (rms), and volts after the sensitivity.
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

/// Echoes of up to [`CHUNK`] scatterers at one point of a line array, and how each changes along the line and during the pulse.
///
/// With u(y, w) the delay, at y metres along the line from the point, of what left w seconds into the pulse (leading edge: 0, 0).
pub struct LineChunk {
    /// Number of echoes.
    pub len: usize,
    /// As in [`ArrivalChunk`].
    pub delay_s: [f64; CHUNK],
    /// As in [`ArrivalChunk`].
    pub doppler: [f64; CHUNK],
    /// As in [`ArrivalChunk`].
    pub amplitude: [Complex64; CHUNK],
    /// -c du/dy: sine of the angle from broadside, as the moving line receives it.
    pub slope: [f64; CHUNK],
    /// c d2u/dy2.
    pub bend_per_m: [f64; CHUNK],
    /// c d2u/dy dw.
    pub twist_per_s: [f64; CHUNK],
    /// c d2u/dw2: the part that the linear stretch omits.
    pub swing_m_per_s2: [f64; CHUNK],
    /// First-order variation of the amplitude along the stretch: `amplitude` times 1 + fade y + curl y^2 at y metres from the
    /// middle, exact at both ends. Zero if not requested.
    pub fade_per_m: [f64; CHUNK],
    /// Second-order variation of the amplitude along the stretch, as in `fade_per_m`.
    pub curl_per_m2: [f64; CHUNK],
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
            bend_per_m: zero,
            twist_per_s: zero,
            swing_m_per_s2: zero,
            fade_per_m: zero,
            curl_per_m2: zero,
        }
    }

    /// Copies slope, bend, twist, swing, fade and curl of echo `from` to echo `to`.
    pub fn move_derivatives(&mut self, from: usize, to: usize) {
        self.slope[to] = self.slope[from];
        self.bend_per_m[to] = self.bend_per_m[from];
        self.twist_per_s[to] = self.twist_per_s[from];
        self.swing_m_per_s2[to] = self.swing_m_per_s2[from];
        self.fade_per_m[to] = self.fade_per_m[from];
        self.curl_per_m2[to] = self.curl_per_m2[from];
    }
}

impl Default for LineChunk {
    fn default() -> Self {
        Self::new()
    }
}

/// Consumer of echoes at stretches of a line array.
pub trait LineSink {
    /// Adds the echoes of a chunk.
    fn accept(&mut self, chunk: &LineChunk);
}

/// A stretch of a line array around its middle, and the requested interval of leading edges.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LineStretch {
    /// Middle of the stretch relative to the centre of the array, metres.
    pub middle_m: f64,
    /// Distance from the middle to the outermost elements, metres.
    pub half_m: f64,
    /// Fade and curl are requested.
    pub fades: bool,
    /// Number of elements, for the counts.
    pub elements: u64,
    /// First requested leading edge, inclusive, seconds.
    pub earliest_s: f64,
    /// Last requested leading edge, exclusive, seconds.
    pub latest_s: f64,
}

/// Source of the echoes of one ping at one line array; threads use it concurrently.
pub trait LineSource: Sync {
    /// Number of candidate scatterers.
    fn scatterers(&self) -> u64;

    /// Lower bound of all leading edges anywhere on the line, seconds; infinite without echoes.
    fn earliest_s(&self) -> f64;

    /// Emits points of amplitude 0 that bound nearly all echoes of [`Self::walk`], and a sample of its echoes with fade and curl.
    fn survey(&self, stretch: LineStretch, sink: &mut impl LineSink);

    /// Emits the echoes at the middle of a stretch in a fixed order, in chunks of at most [`CHUNK`]. Counts are of
    /// scatterer-element pairs. An echo outside the requested delays is not counted, because another stretch requests it.
    fn walk(&self, stretch: LineStretch, sink: &mut impl LineSink) -> EchoCounts;
}
