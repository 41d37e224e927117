//! Transmit and receive arrays, their patterns, and the receiver.

use std::f64::consts::FRAC_PI_2;

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

/// One receive array: equal elements, evenly spaced on a straight line along the array's x axis or on an arc in the plane of its x and z axes, centred on
/// the mounting.
#[derive(Clone, Debug, PartialEq)]
pub struct ArrayGeometry {
    /// Position and orientation in the body.
    pub mounting: Mounting,
    /// Number of elements.
    pub elements: usize,
    /// Element spacing along the line or arc, metres.
    pub spacing_m: f64,
    /// Radius of the arc, metres; `None` for a straight line. The arc bulges towards the boresight, and each element looks along its own normal.
    pub radius_m: Option<f64>,
    /// Directional response of one element, in its own axes.
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
        let receive_m = self.length_m();
        let sides_m = match common > ALONG || transmit_m == 0.0 {
            true => [transmit_m.max(receive_m), 0.0],
            false => [transmit_m, receive_m],
        };
        sides_m.map(|side_m| (BEAM_WIDTH * wavelength_m / side_m).min(1.0))
    }

    /// Position of element `e` along the line or arc from its centre, metres.
    pub fn along_m(&self, e: usize) -> f64 {
        (e as f64 - (self.elements as f64 - 1.0) / 2.0) * self.spacing_m
    }

    /// Length of the array along its x axis with its outermost elements whole, metres; of an arc, that of its chord.
    pub fn length_m(&self) -> f64 {
        let along_m = self.elements as f64 * self.spacing_m;
        match self.radius_m {
            None => along_m,
            Some(radius_m) => 2.0 * radius_m * libm::sin((0.5 * along_m / radius_m).min(FRAC_PI_2)),
        }
    }

    /// Angle from the boresight to the normal of the outermost elements, radians; 0 for a line.
    pub fn half_arc_rad(&self) -> f64 {
        let along_m = self.along_m(self.elements.max(1) - 1);
        self.radius_m.map_or(0.0, |radius_m| along_m / radius_m)
    }

    /// The place `along_m` from the centre along the line or arc: position in array axes, metres, and rotation from its own axes to these.
    pub fn place(&self, along_m: f64) -> (DVec3, DQuat) {
        let Some(radius_m) = self.radius_m else {
            return (DVec3::new(along_m, 0.0, 0.0), DQuat::IDENTITY);
        };
        let (sin, cos) = libm::sincos(0.5 * along_m / radius_m);
        (
            // R sin(2x) and R (1 - cos(2x)), without cancellation.
            2.0 * radius_m * sin * DVec3::new(cos, 0.0, -sin),
            DQuat::from_xyzw(0.0, sin, 0.0, cos),
        )
    }

    /// Position and orientation in the body of the point `along_m` from the centre along the line or arc.
    pub fn mounting_at(&self, along_m: f64) -> Mounting {
        let Mounting {
            position_m,
            body_from_array,
        } = self.mounting;
        let (place_m, turn) = self.place(along_m);
        Mounting {
            position_m: position_m + body_from_array * place_m,
            body_from_array: match self.radius_m {
                None => body_from_array,
                Some(_) => body_from_array * turn,
            },
        }
    }

    /// Position and orientation of element `e` in the body.
    pub fn element_mounting(&self, e: usize) -> Mounting {
        self.mounting_at(self.along_m(e))
    }

    /// Position of element `e` in array axes, metres.
    pub fn element_m(&self, e: usize) -> DVec3 {
        self.place(self.along_m(e)).0
    }

    /// Position of element `e` in body axes, metres.
    pub fn element_body_m(&self, e: usize) -> DVec3 {
        self.element_mounting(e).position_m
    }

    /// Elements that bound the array: the first and the last, and between them the middle one of an arc. Those of a small array may be the same.
    pub fn outermost(&self) -> impl Iterator<Item = usize> + Clone + use<> {
        let middle = self.radius_m.map(|_| self.elements / 2);
        [Some(0), middle, Some(self.elements.max(1) - 1)]
            .into_iter()
            .flatten()
    }

    /// Response in array axes that no element exceeds: the elements of an arc look in many directions of its plane, and all have the same width across it.
    pub fn envelope_pattern(&self) -> Pattern {
        match (self.radius_m, self.element_pattern) {
            (None, pattern) => pattern,
            (Some(_), Pattern::Rectangle { width_m, .. }) => Pattern::Rectangle {
                length_m: 0.0,
                width_m,
                baffled: false,
            },
            (Some(_), _) => Pattern::Omnidirectional,
        }
    }
}

/// The straight line between the ends of an array, as bound of its elements.
pub struct ArrayLine {
    first_m: DVec3,
    line_m: DVec3,
    per_m2: f64,
    /// An arc is this far off its chord, at most.
    bulge_m: f64,
}

impl ArrayLine {
    /// `at_m`: from body axes to the axes of the line.
    pub fn new(array: &ArrayGeometry, at_m: impl Fn(DVec3) -> DVec3) -> Self {
        let [first_m, last_m] = [0, array.elements - 1].map(|e| at_m(array.element_body_m(e)));
        let line_m = last_m - first_m;
        Self {
            first_m,
            line_m,
            per_m2: 1.0 / line_m.length_squared().max(f64::MIN_POSITIVE),
            bulge_m: -array.element_m(0).z,
        }
    }

    /// Distance from which no element is nearer.
    pub fn distance_m(&self, place_m: DVec3) -> f64 {
        let from_first_m = place_m - self.first_m;
        let along = (from_first_m.dot(self.line_m) * self.per_m2).clamp(0.0, 1.0);
        ((from_first_m - self.line_m * along).length() - self.bulge_m).max(0.0)
    }

    /// No element is farther from the origin of the axes.
    pub fn reach_m(&self) -> f64 {
        let last_m = self.first_m + self.line_m;
        self.first_m.length().max(last_m.length()) + self.bulge_m
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

#[cfg(test)]
mod tests {
    use super::*;

    fn array(elements: usize, spacing_m: f64, radius_m: Option<f64>) -> ArrayGeometry {
        ArrayGeometry {
            mounting: Mounting {
                position_m: DVec3::new(1.0, -2.0, 0.5),
                body_from_array: DQuat::from_rotation_z(0.3),
            },
            elements,
            spacing_m,
            radius_m,
            element_pattern: Pattern::Omnidirectional,
            sensitivity_db: -190.0,
            transmit: 0,
        }
    }

    #[test]
    fn elements_of_an_arc_lie_on_a_circle_and_look_away_from_its_centre() {
        let (elements, spacing_m, radius_m) = (31, 0.01, 0.12);
        let arc = array(elements, spacing_m, Some(radius_m));
        let Mounting {
            position_m,
            body_from_array,
        } = arc.mounting;
        let centre_m = position_m - body_from_array * DVec3::Z * radius_m;
        for e in 0..elements {
            let own = arc.element_mounting(e);
            let out_m = own.position_m - centre_m;
            assert!((out_m.length() - radius_m).abs() < 1e-15);
            let normal = own.body_from_array * DVec3::Z;
            assert!((normal * radius_m).distance(out_m) < 1e-15);
            // Its axis lies along the arc, towards the next element.
            if e > 0 {
                let step_m = own.position_m - arc.element_body_m(e - 1);
                let chord_m = 2.0 * radius_m * (0.5 * spacing_m / radius_m).sin();
                assert!((step_m.length() - chord_m).abs() < 1e-15);
                assert!(step_m.dot(own.body_from_array * DVec3::X) > 0.99 * chord_m);
            }
            assert!(arc.element_m(e).y == 0.0);
        }
        assert_eq!(arc.element_body_m(15), position_m);
        let ends = [0, elements - 1].map(|e| arc.element_body_m(e));
        assert!(ends[0].distance(ends[1]) < arc.length_m() && arc.length_m() < 0.31);
        assert!((arc.half_arc_rad() - 0.15 / 0.12).abs() < 1e-12);
    }

    #[test]
    fn a_wide_arc_is_a_line() {
        let (line, arc) = (array(24, 0.01, None), array(24, 0.01, Some(1e7)));
        for e in 0..24 {
            let [a, b] = [&line, &arc].map(|array| array.element_mounting(e));
            assert!(a.position_m.distance(b.position_m) < 1e-8);
            assert!(a.body_from_array.angle_between(b.body_from_array) < 1e-7);
        }
        assert_eq!(line.half_arc_rad(), 0.0);
        assert!((line.length_m() - arc.length_m()).abs() < 1e-9);
        assert_eq!(line.outermost().collect::<Vec<_>>(), [0, 23]);
        assert_eq!(arc.outermost().collect::<Vec<_>>(), [0, 12, 23]);
    }
}
