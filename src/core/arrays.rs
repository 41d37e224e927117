//! Transmit and receive arrays, their patterns, and the receiver.

use glam::DQuat;
use glam::DVec3;

/// Position and orientation of an array in the body.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mounting {
    /// Centre of the array, body axes, metres.
    pub position_m: DVec3,
    /// Rotation from array to body axes.
    pub body_from_array: DQuat,
}

/// Directional response of a transmitter or of one receive element, in array axes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Pattern {
    /// 1 in every direction.
    Omnidirectional,
    /// A rectangular piston: sinc(L u_x/lambda) sinc(W u_y/lambda), with u the unit vector to the point in array axes. A side of
    /// 0 is omnidirectional.
    Rectangle {
        /// Length L along x, metres.
        length_m: f64,
        /// Width W along y, metres.
        width_m: f64,
        /// No response behind the face (u_z < 0).
        baffled: bool,
    },
    /// Several equal elements along x, represented by one element at their centre. The response is the mean of the responses of the
    /// elements. The walk applies the array factor of the elements, which depends on the direction of the echo. Levels and culling
    /// use the pattern of one element.
    Part {
        /// Number of elements.
        elements: usize,
        /// Spacing of the elements along x, metres.
        spacing_m: f64,
        /// Length of an element along x, metres.
        length_m: f64,
        /// Width of an element along y, metres.
        width_m: f64,
        /// No response behind the face (u_z < 0).
        baffled: bool,
    },
}

/// One transmit array: a single coherent radiator.
#[derive(Clone, Debug, PartialEq)]
pub struct TransmitArray {
    /// Position and orientation in the body.
    pub mounting: Mounting,
    /// Directional response.
    pub pattern: Pattern,
    /// Offset to the source level of the settings, dB.
    pub level_offset_db: f64,
}

/// One receive array: a uniform line of equal elements along the array's x axis, centred on the mounting.
#[derive(Clone, Debug, PartialEq)]
pub struct ArrayGeometry {
    /// Position and orientation in the body.
    pub mounting: Mounting,
    /// Number of elements.
    pub elements: usize,
    /// Element spacing along x, metres.
    pub spacing_m: f64,
    /// Directional response of one element.
    pub element_pattern: Pattern,
    /// Receive sensitivity, dB re 1 V/uPa.
    pub sensitivity_db: f64,
    /// Index of the transmit array whose pulse this array receives.
    pub transmit: usize,
}

impl Pattern {
    /// Length and width, metres; 0 without a side.
    pub fn sides_m(&self) -> [f64; 2] {
        match *self {
            Self::Omnidirectional => [0.0; 2],
            Self::Rectangle {
                length_m, width_m, ..
            }
            | Self::Part {
                length_m, width_m, ..
            } => [length_m, width_m],
        }
    }
}

/// -3 dB width of a line of length L, in wavelengths over L (Meng et al. 2023, Eq. 1).
const BEAM_WIDTH: f64 = 0.886;
/// Arrays with a larger cosine between their axes narrow the same beam.
const ALONG: f64 = 0.5;

impl ArrayGeometry {
    /// Widths of the beam of the whole array with a transmitter, radians, at most 1. First that of the longer of the two where they are parallel, and that
    /// of the transmitter otherwise; then that of the array across it, 1 where they are parallel.
    pub fn beam_widths_rad(&self, transmit: &TransmitArray, wavelength_m: f64) -> [f64; 2] {
        let [transmit_m, _] = transmit.pattern.sides_m();
        let axis = |mounting: &Mounting| mounting.body_from_array * DVec3::X;
        let common = axis(&transmit.mounting).dot(axis(&self.mounting)).abs();
        let receive_m = self.elements as f64 * self.spacing_m;
        let sides_m = match common > ALONG || transmit_m == 0.0 {
            true => [transmit_m.max(receive_m), 0.0],
            false => [transmit_m, receive_m],
        };
        sides_m.map(|side_m| (BEAM_WIDTH * wavelength_m / side_m).min(1.0))
    }

    /// Position of element `e` along the array's x axis, metres.
    pub fn element_x_m(&self, e: usize) -> f64 {
        (e as f64 - (self.elements as f64 - 1.0) / 2.0) * self.spacing_m
    }
    /// Position of element `e` in body axes, metres.
    pub fn element_body_m(&self, e: usize) -> DVec3 {
        self.mounting.position_m
            + self.mounting.body_from_array * DVec3::new(self.element_x_m(e), 0.0, 0.0)
    }
}

/// Low-pass filter of the receiver before sampling.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ReceiverFilter {
    /// No filter: the sum is sampled directly.
    None,
    /// Linear-phase low-pass filter before sampling, with its delay removed.
    Fir,
}

/// Time-varying gain over slant range r, metres.
#[derive(Clone, Debug, PartialEq)]
pub enum TimeVaryingGain {
    /// No gain.
    None,
    /// Gain of spreading log10(r) + 2 absorption r, in dB, limited to 0..=max.
    Law {
        /// Spreading coefficient: 20, 30 or 40.
        spreading: f64,
        /// One-way absorption, dB per metre.
        absorption_db_per_m: f64,
        /// Maximum gain, dB.
        max_db: f64,
    },
    /// Points of range (metres) and gain (dB). The gain is linear between the points and constant outside them.
    Table(Vec<(f64, f64)>),
}

/// Receiver chain after the elements.
#[derive(Clone, Debug, PartialEq)]
pub struct Receiver {
    /// Sample rate, hertz.
    pub sample_rate_hz: f64,
    /// Anti-aliasing filter.
    pub filter: ReceiverFilter,
    /// Time-varying gain.
    pub tvg: TimeVaryingGain,
    /// Noise at the element, dB re 1 uPa^2/Hz; `None` is noiseless.
    pub noise_db: Option<f64>,
    /// Resolution of the converter, bits; `None` does not quantise.
    pub adc_bits: Option<u32>,
    /// Full scale of the converter and of integer records, volts (rms of the complex envelope).
    pub full_scale_v: f64,
    /// Seed of the noise.
    pub seed: u64,
}
