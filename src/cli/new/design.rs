//! The figures of a rig, from its kind, frequency and range.

use clap::ValueEnum;
use echotank_config::spec::{AbsorptionSpec, Water};
use echotank_synthesis::echo::absorption::absorption_db_per_m;

/// Sound speed of the rig, m/s.
pub(super) const SOUND_M_PER_S: f64 = 1500.0;
/// Temperature, degrees Celsius, and salinity of the rig.
pub(super) const WATER: (f64, f64) = (10.0, 35.0);
/// Source level, dB re 1 uPa at 1 m.
pub(super) const SOURCE_DB: f64 = 215.0;
/// Sensitivity of the elements, dB re 1 V/uPa.
pub(super) const SENSITIVITY_DB: f64 = -195.0;
/// Relative error of the element samples.
pub(super) const TOLERANCE: f64 = 1e-2;
/// Frequencies that the models of absorption and noise cover, kHz.
pub(super) const FREQUENCIES_KHZ: [f64; 2] = [5.0, 1500.0];
/// Least range in wavelengths: the arrays are up to a hundred of them long.
const MIN_RANGE_WAVELENGTHS: f64 = 300.0;
/// Greatest range that is tried, metres.
const MAX_RANGE_M: f64 = 5000.0;
/// Scattering strength of sand at a grazing angle of some ten degrees, and at 45 degrees, dB.
const GRAZING_DB: f64 = -35.0;
const SAND_DB: f64 = -27.0;
/// Least level of an echo from the longest range above the noise, dB.
const MIN_EXCESS_DB: f64 = -12.0;
/// Pings per second beyond which no sonar of these kinds goes.
const MAX_RATE_HZ: f64 = 50.0;

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Kind {
    /// Two lines of elements that look to port and to starboard
    Sidescan,
    /// A line of elements across the track that looks down: a fan of beams and soundings
    Multibeam,
    /// A line of elements across the track that looks ahead: a fan of beams
    ForwardLooking,
    /// A few hydrophones for an acquisition or DSP board
    Board,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Protocol {
    /// Teledyne RESON 7k
    #[value(name = "7k")]
    SevenK,
    /// EdgeTech JSF
    Jsf,
    /// Triton XTF files
    Xtf,
    /// NORBIT WBMS
    Wbms,
    /// Ping protocol of Blue Robotics and Cerulean
    Ping,
    /// Imagenex 872
    Imagenex872,
    /// ANSI/VITA 49.2
    Vita49,
    /// Element samples in Echotank's own stream
    Elements,
}

/// The word of a kind or protocol on the command line.
pub(super) fn word(value: &impl ValueEnum) -> String {
    let value = value.to_possible_value();
    value.map_or_else(String::new, |v| v.get_name().to_owned())
}

pub(super) fn words(values: &[impl ValueEnum]) -> String {
    values.iter().map(word).collect::<Vec<_>>().join(", ")
}

impl Kind {
    /// Protocols that suit the kind.
    pub(super) fn protocols(self) -> &'static [Protocol] {
        use Protocol::{Elements, Imagenex872, Jsf, Ping, SevenK, Vita49, Wbms, Xtf};
        match self {
            Self::Sidescan => &[SevenK, Jsf, Xtf, Ping, Imagenex872, Vita49, Elements],
            Self::Multibeam => &[SevenK, Wbms, Ping, Vita49, Elements],
            Self::ForwardLooking => &[SevenK, Wbms, Vita49, Elements],
            Self::Board => &[Vita49, Elements, SevenK],
        }
    }

    /// Fewest, usual and most elements of an array.
    pub(super) fn elements(self) -> [usize; 3] {
        match self {
            Self::Sidescan => [1, 4, 64],
            Self::Multibeam => [8, 96, 512],
            Self::ForwardLooking => [8, 64, 512],
            Self::Board => [1, 8, 64],
        }
    }

    /// Usual frequency, kHz, and range, metres.
    pub(super) fn usual(self) -> (f64, f64) {
        match self {
            Self::Sidescan => (455.0, 75.0),
            Self::Multibeam => (400.0, 45.0),
            Self::ForwardLooking => (300.0, 50.0),
            Self::Board => (100.0, 40.0),
        }
    }

    pub(super) fn noun(self) -> &'static str {
        match self {
            Self::Sidescan => "side-scan",
            Self::Multibeam => "multibeam",
            Self::ForwardLooking => "forward-looking sonar",
            Self::Board => "receiver board",
        }
    }

    /// Width of the transmit beam along the track, or up and down of a forward-looking sonar, degrees.
    pub(super) fn beam_deg(self) -> f64 {
        match self {
            Self::Sidescan => 0.5,
            Self::Multibeam => 1.0,
            Self::ForwardLooking => 25.0,
            Self::Board => 8.0,
        }
    }

    /// Width of what an element receives from a range, radians.
    fn element_rad(self) -> f64 {
        match self {
            Self::ForwardLooking => 2.0,
            other => other.beam_deg().to_radians(),
        }
    }

    /// Width of what a beam receives from a range, radians.
    fn beam_rad(self, elements: usize) -> f64 {
        match self {
            // Elements at half a wavelength.
            Self::ForwardLooking => 2.0 * 0.886 / elements as f64,
            other => other.element_rad(),
        }
    }

    /// Depth of a flat seabed below the waterline, as a share of the range.
    fn depth_share(self) -> f64 {
        match self {
            Self::Sidescan | Self::ForwardLooking => 0.16,
            // The outer beams, 65 degrees from the vertical, still end within the range.
            Self::Multibeam => 0.4,
            Self::Board => 0.33,
        }
    }

    /// Bandwidth as a share of the frequency.
    fn band_share(self) -> f64 {
        match self {
            Self::Sidescan => 0.066,
            Self::Multibeam => 0.05,
            Self::ForwardLooking => 0.03,
            Self::Board => 0.1,
        }
    }

    /// Full scale above the mean echo of sand at 45 degrees, dB. Kinds that look straight down receive the strong echo from there.
    fn headroom_db(self) -> f64 {
        match self {
            Self::Sidescan | Self::ForwardLooking => 26.0,
            Self::Multibeam | Self::Board => 44.0,
        }
    }
}

/// The figures that a rig's text needs, in SI units.
#[derive(Clone, Copy, Debug)]
pub(super) struct Design {
    pub kind: Kind,
    pub frequency_hz: f64,
    pub range_m: f64,
    pub elements: usize,
    pub wavelength_m: f64,
    pub duration_s: f64,
    pub bandwidth_hz: f64,
    pub sample_rate_hz: f64,
    /// Depth of a flat seabed below the waterline.
    pub depth_m: f64,
    pub noise_db: f64,
    pub tvg_max_db: f64,
    pub full_scale_v: f64,
    /// Pings per second that the sound allows, 0.95 c / (2R), or the greatest usual.
    pub sound_rate_hz: f64,
}

/// The number with so many significant digits.
pub(super) fn digits(x: f64, count: i32) -> f64 {
    let places = count - 1 - x.abs().log10().floor() as i32;
    let scale = 10f64.powi(places.abs());
    match places >= 0 {
        true => (x * scale).round() / scale,
        false => (x / scale).round() * scale,
    }
}

fn up(x: f64, step: f64) -> f64 {
    (x / step).ceil() * step
}

impl Design {
    pub(super) fn new(kind: Kind, frequency_hz: f64, range_m: f64, elements: usize) -> Self {
        let window_s = 2.0 * range_m / SOUND_M_PER_S;
        // Two per cent of the listening time, and at least 20 periods.
        let duration_s = digits(
            (0.02 * window_s).clamp(5e-5, 5e-3).max(20.0 / frequency_hz),
            2,
        );
        let bandwidth_hz = digits((kind.band_share() * frequency_hz).max(8.0 / duration_s), 2);
        let frequency_khz = frequency_hz / 1e3;
        let law_db = 30.0 * range_m.log10() + 2.0 * absorption(frequency_hz) * range_m;
        let cell = kind.element_rad() * SOUND_M_PER_S * duration_s / 2.0;
        let mean_db = SOURCE_DB + SENSITIVITY_DB + SAND_DB + 10.0 * cell.log10();
        Self {
            kind,
            frequency_hz,
            range_m,
            elements,
            wavelength_m: SOUND_M_PER_S / frequency_hz,
            duration_s,
            bandwidth_hz,
            // The rule of receiver.sample_rate_khz, for the shortest pulse of the limits: half of this one.
            sample_rate_hz: up(
                1.25 * (bandwidth_hz.max(8.0 / duration_s)
                    + 2.0 * 20.0 / SOUND_M_PER_S * (frequency_hz + bandwidth_hz / 2.0)),
                100.0,
            ),
            depth_m: digits(kind.depth_share() * range_m, 2),
            // Wind of 7 m/s (Coates 1990) where it is above the noise of the receiver.
            noise_db: (70.0 - 20.0 * frequency_khz.log10()).max(30.0).round(),
            tvg_max_db: up(law_db, 5.0),
            full_scale_v: digits(10f64.powf((mean_db + kind.headroom_db()) / 20.0), 1),
            sound_rate_hz: (0.95 / window_s).min(MAX_RATE_HZ),
        }
    }

    /// Side of the transmitter that forms its narrow beam, metres.
    pub(super) fn narrow_m(&self) -> f64 {
        0.886 * self.wavelength_m / self.kind.beam_deg().to_radians()
    }

    /// Width of the beam of a side so long, degrees.
    pub(super) fn beam_deg(&self, length_m: f64) -> f64 {
        digits((0.886 * self.wavelength_m / length_m).to_degrees(), 2)
    }

    /// Depth of the transducers below the waterline for a seabed at `depth_m`.
    pub(super) fn draft_m(depth_m: f64) -> f64 {
        digits((0.1 * depth_m).clamp(0.05, 1.0), 1)
    }

    /// Level of an echo of grazed sand at the longest range above the noise of an array, dB.
    fn excess_db(&self) -> f64 {
        let cell = self.kind.beam_rad(self.elements) * SOUND_M_PER_S * self.duration_s / 2.0;
        let loss_db =
            30.0 * self.range_m.log10() + 2.0 * absorption(self.frequency_hz) * self.range_m;
        let echo_db = SOURCE_DB - loss_db + GRAZING_DB + 10.0 * cell.log10();
        let noise_db = self.noise_db + 10.0 * self.bandwidth_hz.log10();
        echo_db - noise_db + 10.0 * (self.elements as f64).log10()
    }

    /// Shortest and longest range of a kind, metres: beyond the longest, echoes are far below the noise.
    pub(super) fn ranges_m(kind: Kind, frequency_hz: f64, elements: usize) -> [f64; 2] {
        let shortest_m = MIN_RANGE_WAVELENGTHS * SOUND_M_PER_S / frequency_hz;
        let hears =
            |range_m| Self::new(kind, frequency_hz, range_m, elements).excess_db() >= MIN_EXCESS_DB;
        let mut longest_m = shortest_m;
        while 1.05 * longest_m <= MAX_RANGE_M && hears(1.05 * longest_m) {
            longest_m *= 1.05;
        }
        [shortest_m, longest_m].map(|m| digits(m, 2))
    }
}

fn absorption(frequency_hz: f64) -> f64 {
    let water = Water {
        temperature_c: WATER.0,
        salinity: WATER.1,
        depth_m: 50.0,
        ph: 8.0,
    };
    absorption_db_per_m(&AbsorptionSpec::FrancoisGarrison(water), frequency_hz)
}
