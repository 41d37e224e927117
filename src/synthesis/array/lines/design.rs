//! Sizes of the engine from a tolerance, with the predicted error and cost.
//!
//! The error of an echo has three parts: images of the spreading kernel, the weights on columns of Doppler, and the interpolation along the line.
//! `windows` tells what the first two are in the worst window of a ping with that many echoes; the third is a bound.

use std::f64::consts::{PI, TAU};
use std::sync::{Arc, Mutex, PoisonError};

use crate::array::echo_profile::EchoProfile;
use crate::array::filter::Decimator;
use crate::array::gridded::pulse_spectrum::PulseSpectrum;
use crate::array::gridded::transform::grid_size;
use crate::array::gridded::{CostEstimate, LEVELS};
use crate::error_model::ErrorModel;
use echotank_core::arrays::{ArrayGeometry, Pattern};
use echotank_core::model::DopplerModel;
use echotank_core::pulse::Pulse;
use echotank_core::simd::{Kind, SimdLevel};

use super::dopplers::{Band, Columns, CurvatureFit, MAX_TAPS};
use super::kernel::{Content, Kernel};
use super::nodes::{
    COARSE, NODES, NodeCounts, coarse, gain_error, interpolation_errors_m, places, spreading_error,
};
use super::spread::{LANES, NARROW, QUARTER, cell_lanes, lanes_for};
use super::windows::{
    ErrorsByLevel, KernelErrors, MORE, SingleEcho, noise_factor, rounding_over_noise, worst,
    worst_of_even,
};

/// Share of the tolerance, as energy, that the interpolation along the line may use: so much, and up to the second where the nearest scatterers ask for it.
const PATH_SHARES: [f64; 2] = [0.1, 0.4];
/// Share of the tolerance, as energy, that the change of the Doppler during the pulse may use, with three taps and more.
const CURVATURE_SHARE: f64 = 0.1;
/// Shares of the tolerance, as energy, that the change of the Doppler along a block may use: its second order where weights do not follow it, and its third,
/// which they never do. Both are largest at the ends of the pulse and of the block, and not part of the predicted error.
const STRAIGHT_SHARE: f64 = 0.04;
const SWING_SHARE: f64 = 0.25;
/// Share of the tolerance, as energy, that echoes with a Doppler beyond all columns may use.
pub(super) const BEYOND_SHARE: f64 = 0.05;
/// Range from which on scatterers change their Doppler as those at this range, metres: a platform comes nearer before its engine is made anew.
const CURVED_M: f64 = 5.0;
/// Shares of the tolerance, as energy, to try for the columns.
const COLUMN_SHARES: [f64; 4] = [0.1, 0.3, 0.5, 0.7];
/// Frequencies of a cosine flank, in inverses of its length: beyond it they are a thirtieth of those of an edge.
const FLANK: f64 = 3.0;
/// Flatness of the spectrum for which kernels are fitted: exponents of the energy. A flatter one favours windows with the onset of a single echo.
const FLATNESS: [f64; 2] = [1.0, 0.5];
/// Smallest supported tolerance. The kernels tried do not reach it with short pulses of sharp ends. Designs for 2e-4 to
/// 5e-4 have all left 2.0e-4 before the first echo, with the strongest one close behind.
pub const MIN_TOLERANCE: f64 = 3e-4;
/// Kernels and grids to try: rows, and rows per sample as a fraction.
const WIDTHS: [usize; 7] = [2, 3, 4, 5, 6, 7, 8];
const DENSITIES: [(usize, usize); 4] = [(1, 1), (5, 4), (3, 2), (2, 1)];
/// Frequencies at which the pulse's spectrum weighs the images.
const CONTENTS: usize = 48;
/// Samples of a slab's transform.
const MIN_SLAB: usize = 192;
const MAX_SLAB: usize = 8192;
/// Samples of a slab of which a few columns fit the second-level cache.
const CACHED_SLAB: f64 = 768.0;
/// Costs, nanoseconds of one core. Those of an echo and of inner loops depend on the vectors ([`LoopCosts`]).
const NODE_NS: f64 = 8.0;
/// Per sample and element of the output.
const SAMPLE_NS: f64 = 3.0;
/// Grids of more bytes leave the second-level cache, and then the third: each tap of a row costs so many nanoseconds more for every doubling.
const CACHED: [(f64, f64); 2] = [(512.0 * 1024.0, 0.25), (8.0 * 1024.0 * 1024.0, 3.5)];
/// What a narrow block saves of a wide one, whose vectors are twice as wide, and a quarter block.
const NARROW_SAVES: f64 = 0.45;
const QUARTER_SAVES: f64 = 0.6;
/// Ranges at which the interpolation along the line is examined: the farthest, in half lengths, and the steps towards the line.
const FARTHEST: f64 = 1e4;
const NEARER: f64 = 0.9;
const RANGES: i32 = 120;
/// ... and those of the scatterers of a ping.
const PING_RANGES: i32 = 24;
/// Halvings of the last step towards the line: selection looks at one range, and must find what the engine finds.
const HALVINGS: u32 = 16;
/// Of the error of interpolated delays, the share that is left where squares of receive legs are interpolated: so much, and so many times the speed of the
/// platform over that of sound.
const COARSE_SHARE: f64 = 0.02;
const COARSE_PER_MACH: f64 = 4.0;
/// Parts of the ranges at which it is looked whether [`coarse`] nodes are enough, for the cost.
const COARSE_PARTS: u32 = 8;
/// Speed that echoes typically differ by with their side lobes, m/s, and nodes along a line, for the cost.
const TYPICAL_M_PER_S: f64 = 6.0;
const TYPICAL_NODES: f64 = 5.0;

/// Requirements on the engine.
#[derive(Clone, Copy)]
pub struct Spec<'a> {
    /// The line array.
    pub array: &'a ArrayGeometry,
    /// Transmitted pulse.
    pub pulse: &'a Pulse,
    /// Sound speed, m/s.
    pub sound_speed_m_per_s: f64,
    /// Sample rate of the output, Hz.
    pub sample_rate_hz: f64,
    /// Receiver filter. It is required, because the method needs a limited band.
    pub filter: Option<&'a Decimator>,
    /// Doppler model.
    pub doppler: DopplerModel,
    /// Smallest range of a scatterer, metres.
    pub nearest_m: f64,
    /// Fastest platform, m/s.
    pub fastest_m_per_s: f64,
    /// Largest relative error in any window of one pulse length.
    pub tolerance: f64,
    /// Approximate number of samples of one element, for the cost only.
    pub samples: usize,
    /// Approximate number of echoes, for the cost only.
    pub scatterers: usize,
    /// Smallest number of echoes in a ping: with more, errors in a window add like noise. The tolerance holds for this number and more.
    pub min_scatterers: usize,
    /// Instruction set of the inner loops.
    pub simd_level: SimdLevel,
}

/// Requirements that the engine does not meet.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum Refusal {
    /// The tolerance is below the smallest supported one.
    #[error("tolerance {tolerance:e} is below its minimum of {least:e}")]
    TooFine {
        /// Requested tolerance.
        tolerance: f64,
        /// Smallest tolerance with this pulse and sample rate.
        least: f64,
    },
    /// There is no receiver filter.
    #[error("the receiver filter is required: without it the band of the pulse is unlimited")]
    NoFilter,
    /// The Doppler model is not supported.
    #[error("doppler model `{}` is not supported: expected `none`, `stretch` or `stretch-quadratic`", .0.name())]
    Doppler(DopplerModel),
    /// The array is a single element.
    #[error("an array of one element is not a line: use gridded-1d")]
    OneElement,
    /// An element of the array stands for several.
    #[error("combined elements are not supported: use gridded-1d")]
    Part,
    /// The elements of an arc have a baffle, so that some of them hear what others do not.
    #[error("baffled elements on an arc are not supported: use gridded-1d")]
    BaffledArc,
    /// The pulse is too long for the longest slab.
    #[error(
        "a pulse of {duration_s} s is too long: a slab has {MAX_SLAB} samples of {rate_hz} Hz at most"
    )]
    PulseTooLong {
        /// Length of the pulse, seconds.
        duration_s: f64,
        /// Sample rate, Hz.
        rate_hz: f64,
    },
}

/// The chosen sizes.
#[derive(Clone, Debug)]
pub struct Design {
    pub(super) kernel: Kernel,
    pub(super) columns: Columns,
    /// Stretch between neighbouring columns; 0 with one column.
    pub(super) step: f64,
    /// Largest phase at the ends of the pulse from the change of the Doppler, radians; echoes beyond it are counted.
    pub(super) max_curvature_rad: f64,
    /// Phase at the ends of the pulse that the second order of the Doppler along a block may make unless weights follow it, radians.
    pub(super) straight_rad: f64,
    /// Largest change of the phase at the ends of the pulse from the middle of a block to its end, radians; echoes beyond it are counted.
    pub(super) max_swing_rad: f64,
    /// Columns to either side of zero Doppler.
    pub(super) reach: usize,
    /// Samples and grid rows of a slab's transform.
    pub(super) slab_samples: usize,
    pub(super) slab_rows: usize,
    /// Samples between slabs.
    pub(super) payload: usize,
    /// Samples from the middle of an echo at the line's centre to its end at any element, with the filter; and the margin of the kernel.
    pub(super) extent: usize,
    pub(super) guard: usize,
    /// Largest error of a path length along the line, metres.
    pub(super) path_m: f64,
    /// Of this error, the share that is left with [`coarse`] nodes.
    coarse_share: f64,
    wavelength_m: f64,
    error_model: ErrorModel,
    parts: ErrorParts,
    /// An echo at rest with the errors of the kernel; none with Doppler, and before the sizes are selected.
    echo: Option<Arc<EchoProfile>>,
    /// Of an echo alone.
    by_level: ErrorsByLevel,
    effort: Effort,
}

/// Errors in the worst window of a ping, apart from the interpolation along the line.
#[derive(Clone, Copy, Debug)]
struct ErrorParts {
    kernel: f64,
    /// Of a single echo, rms.
    kernel_of_echo: f64,
    columns: f64,
    /// Of echoes with a Doppler beyond all columns.
    beyond: f64,
    fading: f64,
    /// Largest curvature of the design, per second; 0 where the Doppler does not change.
    curvature_per_s: f64,
    /// Phase at the ends of the pulse for each of it, radians.
    curvature_rad_s: f64,
    /// Largest error by curvature where weights carry it.
    curvature_room: f64,
    /// Half the bandwidth of a sweep over the carrier, negative if it falls.
    wide: f64,
}

impl ErrorParts {
    fn of_curvature(&self, columns: &Columns, curvature_per_s: f64) -> f64 {
        let curvature_rad = self.curvature_rad_s * curvature_per_s;
        let (first, second) = self.curvature_terms(columns);
        let error = (first * curvature_rad).hypot(second * curvature_rad * curvature_rad);
        match columns.taps {
            ..3 => error,
            _ => error.min(self.curvature_room),
        }
    }

    /// Largest phase at the ends of the pulse that leaves room for other errors.
    fn max_curvature_rad(&self, columns: &Columns) -> f64 {
        if columns.taps < 3 {
            return f64::INFINITY;
        }
        // Of the sum of both squares.
        let (first, second) = self.curvature_terms(columns);
        let (first, second) = (first * first, 2.0 * second * self.curvature_room);
        let room = self.curvature_room;
        (2.0 * room * room / (first + first.hypot(second))).sqrt()
    }

    /// Error in the worst window for a phase of 1 rad at the ends of the pulse: what the weights leave out in proportion to it, and to its square.
    fn curvature_terms(&self, columns: &Columns) -> (f64, f64) {
        let [first, second] = self.curvature_of_echo(columns);
        let of = |(rms, end): (f64, f64)| worst_of_even(self.fading, rms, end);
        (of(first), of(second))
    }

    /// The same of one echo: rms, and how many times as large it is at the ends. With two columns u^2 + wide u^3 is left out; the rms of half the square of
    /// u^2 less its mean is 0.06.
    fn curvature_of_echo(&self, columns: &Columns) -> [(f64, f64); 2] {
        let most = 1.0 + self.wide.abs();
        match columns.taps {
            ..3 => {
                let rms = (1.0 / 5.0 + self.wide * self.wide / 7.0).sqrt();
                [(rms, most / rms), (0.0, 1.0)]
            }
            _ => {
                let CurvatureFit { rms, end, .. } = columns.curvature;
                [(rms, end), (0.06 * most * most, 4.0)]
            }
        }
    }
}

/// Motion of a ping's echoes, for the error in that ping.
#[derive(Clone, Copy, Debug)]
pub struct LineMotion {
    /// Ranges of the nearest and the farthest scatterer, metres.
    pub range_m: (f64, f64),
    /// Fastest closing speed, m/s.
    pub closing_m_per_s: f64,
    /// Largest second derivative of the range, mean of both legs, over the sound speed, per second.
    pub curvature_per_s: f64,
}

/// Costs of the inner loops, nanoseconds of one core: per echo, without Doppler and with that of both orders; per echo and block, per row of it, and per tap of a
/// row; of a transform per row and log2 of the rows, to columns and back.
struct LoopCosts {
    echo_ns: [f64; 3],
    block_ns: f64,
    row_ns: f64,
    tap_ns: f64,
    forward_ns: f64,
    back_ns: f64,
}

impl LoopCosts {
    /// AVX-512: set between two processors by `tools/bench rates` on lines of 8, 16, 20 and 256 elements; those of an echo with Doppler on an AMD EPYC by
    /// `tools/accuracy rigs`. Others: a fit to 328 random pings of 2 to 256
    /// elements on an AMD EPYC with AVX2.
    fn of(simd_level: SimdLevel) -> Self {
        match simd_level.kind() {
            Kind::Avx512 => Self {
                echo_ns: [60.0, 85.0, 100.0],
                block_ns: 16.0,
                row_ns: 1.6,
                tap_ns: 1.3,
                forward_ns: 1.8,
                back_ns: 1.6,
            },
            _ => Self {
                echo_ns: [60.0, 110.0, 110.0],
                block_ns: 14.0,
                row_ns: 3.4,
                tap_ns: 3.9,
                forward_ns: 3.0,
                back_ns: 1.8,
            },
        }
    }
}

/// Echoes of a ping, for its cost.
#[derive(Clone, Copy, Debug)]
pub struct Heard {
    /// How many echoes there are.
    pub echoes: f64,
    /// Closing speeds of those that sound together lie so far apart, m/s.
    pub differ_m_per_s: f64,
    /// Time from the first echo to the last one's start, seconds.
    pub duration_s: f64,
}

/// What a ping costs apart from its echoes and their Dopplers.
#[derive(Clone, Copy, Debug)]
struct Effort {
    /// Per echo, nanoseconds, and for its rows; its nodes cost [`NODE_NS`] each.
    echo_ns: f64,
    rows_ns: f64,
    /// Taps of an echo in all its rows.
    echo_taps: f64,
    tap_ns: f64,
    /// Of one column of one block's grid.
    column_bytes: f64,
    /// Transforms of one column of a slab, and of the slab's samples; all samples, nanoseconds.
    column_ns: f64,
    slab_ns: f64,
    samples_ns: f64,
    /// Slabs of a record, and of each second.
    slabs: f64,
    slabs_per_s: f64,
    /// Columns of an echo.
    taps: f64,
    /// Stretch between columns; 0 with one column.
    step: f64,
    sound_speed_m_per_s: f64,
}

impl Effort {
    fn cost(&self, heard: Heard) -> CostEstimate {
        let columns = match self.step > 0.0 {
            false => 1.0,
            true => self.taps + stretch(heard.differ_m_per_s, self.sound_speed_m_per_s) / self.step,
        };
        let grid = columns * self.column_bytes;
        let uncached_ns = CACHED.map(|(bytes, ns)| ns * (grid / bytes).log2().max(0.0));
        let tap_ns = self.tap_ns + uncached_ns.iter().sum::<f64>();
        // A time touches one slab more than it is long.
        let slabs = (1.0 + heard.duration_s * self.slabs_per_s)
            .min(self.slabs)
            .min(heard.echoes);
        CostEstimate {
            echoes_ns: heard.echoes * (self.echo_ns + self.rows_ns + self.echo_taps * tap_ns),
            grids_ns: slabs * (columns * self.column_ns + self.slab_ns) + self.samples_ns,
        }
    }

    /// Of a typical ping with so many echoes in all its record, with their nodes, milliseconds.
    fn typical_ms(&self, echoes: f64) -> f64 {
        let nodes_ns = echoes * TYPICAL_NODES * NODE_NS;
        let heard = Heard {
            echoes,
            differ_m_per_s: TYPICAL_M_PER_S,
            duration_s: f64::INFINITY,
        };
        self.cost(heard).ms() + 1e-6 * nodes_ns
    }
}

/// To two digits, for messages.
fn rounded_up(value: f64) -> f64 {
    let digits = 10f64.powf(1.0 - value.log10().floor());
    (value * digits).ceil() / digits
}

/// Least-squares errors of so many columns are like the Legendre polynomial of that degree: at the ends of an echo so many times their rms.
fn end_of_columns(taps: usize) -> f64 {
    (2.0 * taps as f64 + 1.0).sqrt()
}

/// Stretch of an echo that closes at this speed on both ways.
fn stretch(m_per_s: f64, sound_speed_m_per_s: f64) -> f64 {
    2.0 * m_per_s / (sound_speed_m_per_s - m_per_s)
}

/// Slab sizes for an echo that reaches `extent` samples from its middle.
fn slabs(
    extent: usize,
    guard: usize,
    samples: usize,
    density: (usize, usize),
) -> Option<(usize, usize)> {
    let spent = 2 * (extent + guard);
    let sizes = (MIN_SLAB..=MAX_SLAB).filter(|&size| {
        let rows = size * density.0 / density.1;
        size % (8 * density.1) == 0
            && grid_size(size) == size
            && grid_size(rows) == rows
            && size > spent + spent / 4
    });
    let cost = |&size: &usize| {
        let payload = size - spent;
        let count = (samples + 2 * extent).div_ceil(payload);
        // Columns of more rows leave the second-level cache between transform and template.
        let cached = 1.0 + 0.1 * (size as f64 / CACHED_SLAB).log2().max(0.0);
        // A fixed part for every slab, as many samples.
        (count * (size + 64)) as f64 * (size as f64).log2() * cached
    };
    sizes
        .min_by(|a, b| cost(a).total_cmp(&cost(b)))
        .map(|size| (size, size - spent))
}

/// Kernels and their errors, which depend on pulse and filter alone. They are kept for all designs of the program: fitting them is most of the
/// effort of a design, and results do not depend on who fits them.
static FITS: Mutex<Vec<(FitKey, PulseFits)>> = Mutex::new(Vec::new());
/// Maximum number of pulses that are kept; the oldest gives way.
const MAX_FITS: usize = 32;

/// Everything that kernels and their errors depend on.
#[derive(PartialEq)]
struct FitKey {
    pulse: Pulse,
    filter: Decimator,
    sample_rate_hz: f64,
    noise_factor: f64,
    shift_hz: f64,
}

/// One per [`FLATNESS`].
type Fitted = [(Kernel, KernelErrors); 2];

/// Fits for one pulse.
struct PulseFits {
    single_echo: SingleEcho,
    /// One per [`FLATNESS`].
    contents: [Vec<Content>; 2],
    /// By density and width.
    kernels: [[Option<Fitted>; WIDTHS.len()]; DENSITIES.len()],
}

/// Makes a design with the fits for its pulse.
fn with_fits<T>(spec: &Spec, filter: &Decimator, design: impl FnOnce(&mut PulseFits) -> T) -> T {
    let key = FitKey {
        pulse: *spec.pulse,
        filter: filter.clone(),
        sample_rate_hz: spec.sample_rate_hz,
        noise_factor: noise_factor(spec),
        shift_hz: shift_hz(spec),
    };
    // A panic under the lock leaves complete fits.
    let mut all = FITS.lock().unwrap_or_else(PoisonError::into_inner);
    let at = match all.iter().position(|(of, _)| *of == key) {
        Some(at) => at,
        None => {
            let fits = PulseFits {
                single_echo: SingleEcho::new(spec, filter),
                contents: FLATNESS.map(|flatness| content(spec, filter, flatness)),
                kernels: Default::default(),
            };
            if all.len() == MAX_FITS {
                all.remove(0);
            }
            all.push((key, fits));
            all.len() - 1
        }
    };
    design(&mut all[at].1)
}

impl Design {
    /// Selects the cheapest sizes that keep the tolerance.
    ///
    /// Returns a [`Refusal`] if there are none.
    pub fn new(spec: &Spec) -> Result<Self, Refusal> {
        Self::among(spec, &DENSITIES, &WIDTHS)
    }

    /// Whether [`Self::new`] finds sizes: those of the largest kernel on the densest grid do, at less effort.
    pub fn exists(spec: &Spec) -> Result<(), Refusal> {
        Self::among(
            spec,
            &DENSITIES[DENSITIES.len() - 1..],
            &WIDTHS[WIDTHS.len() - 1..],
        )
        .map(drop)
    }

    /// The cheapest of these kernels and grids.
    fn among(spec: &Spec, densities: &[(usize, usize)], widths: &[usize]) -> Result<Self, Refusal> {
        let Spec {
            array, tolerance, ..
        } = *spec;
        let Some(filter) = spec.filter else {
            return Err(Refusal::NoFilter);
        };
        if spec.doppler == DopplerModel::PaperEq21 {
            return Err(Refusal::Doppler(spec.doppler));
        }
        if array.elements < 2 {
            return Err(Refusal::OneElement);
        }
        if matches!(array.element_pattern, Pattern::Part { .. }) {
            return Err(Refusal::Part);
        }
        if let (Some(_), Pattern::Rectangle { baffled: true, .. }) =
            (array.radius_m, array.element_pattern)
        {
            return Err(Refusal::BaffledArc);
        }
        if !(MIN_TOLERANCE..).contains(&tolerance) {
            return Err(Refusal::TooFine {
                tolerance,
                least: MIN_TOLERANCE,
            });
        }
        with_fits(spec, filter, |fits| {
            Self::with(spec, filter, fits, densities, widths)
        })
    }

    /// The same for requirements that any design meets, with the fits for its pulse.
    fn with(
        spec: &Spec,
        filter: &Decimator,
        fits: &mut PulseFits,
        densities: &[(usize, usize)],
        widths: &[usize],
    ) -> Result<Self, Refusal> {
        let Spec {
            array,
            pulse,
            sound_speed_m_per_s: c,
            sample_rate_hz: rate_hz,
            tolerance,
            ..
        } = *spec;
        let path_share = path_share(spec);
        let path_error = tolerance * path_share.sqrt();
        let beyond_error = match spec.doppler {
            DopplerModel::None => 0.0,
            _ => tolerance * BEYOND_SHARE.sqrt(),
        };
        let PulseFits {
            single_echo,
            contents,
            kernels,
        } = fits;
        let single_echo = &*single_echo;
        let fading = single_echo.fading(spec);
        let carrier_hz = pulse.center_frequency_hz;
        let worst_of_columns =
            |taps: usize, rms: f64| worst_of_even(fading, rms, end_of_columns(taps));
        let of_columns = |columns: &Columns| worst_of_columns(columns.taps, columns.error);
        let half_m = 0.5 * (array.elements - 1) as f64 * array.spacing_m;
        let extent_s = 0.55 * pulse.duration_s + filter.half_s() + 1.1 * half_m / c;
        let extent = (extent_s * rate_hz).ceil() as usize + 1;
        let saves = match (array.elements % LANES, lanes_for(array.elements % LANES)) {
            (0, _) => 0.0,
            (_, QUARTER) => QUARTER_SAVES,
            (_, NARROW) => NARROW_SAVES,
            _ => 0.0,
        };
        let blocks = array.elements.div_ceil(LANES) as f64 - saves;
        let (echoes, samples) = (spec.scatterers as f64, spec.samples);

        let moving = spec.doppler != DopplerModel::None;
        // Flanks of the pulse have few frequencies beyond the band.
        let flank_s = 0.5 * pulse.taper * pulse.duration_s;
        let beside_hz = 0.5 * pulse.sweep_hz_per_s().abs() * pulse.duration_s + FLANK / flank_s;
        let band = Band {
            wide: 0.5 * pulse.sweep_hz_per_s() * pulse.duration_s / carrier_hz,
            highest: beside_hz.min(0.5 * rate_hz) / carrier_hz,
            models_curvature: spec.doppler == DopplerModel::StretchQuadratic,
        };
        let turn_per_stretch = PI * carrier_hz * pulse.duration_s;
        let candidates: Vec<Columns> = match moving {
            false => vec![Columns::one()],
            true => (2..=MAX_TAPS)
                .flat_map(|taps| COLUMN_SHARES.map(|share| (taps, share)))
                .map(|(taps, share)| {
                    let rms = tolerance * share.sqrt() / worst_of_columns(taps, 1.0);
                    Columns::fit(taps, rms, band)
                })
                .collect(),
        };
        // The change of the Doppler during the pulse: left out with two columns, to first order with more.
        let curvature_room = tolerance * CURVATURE_SHARE.sqrt();
        let no_kernel = ErrorParts {
            kernel: 0.0,
            kernel_of_echo: 0.0,
            columns: 0.0,
            beyond: beyond_error,
            fading,
            curvature_per_s: match spec.doppler {
                DopplerModel::StretchQuadratic => {
                    spec.fastest_m_per_s.powi(2) / (spec.nearest_m.min(CURVED_M) * c)
                }
                _ => 0.0,
            },
            curvature_rad_s: 0.5 * PI * carrier_hz * pulse.duration_s.powi(2),
            curvature_room,
            wide: band.wide,
        };
        let of_curvature =
            |columns: &Columns| no_kernel.of_curvature(columns, no_kernel.curvature_per_s);
        let mut finest = f64::INFINITY;
        let mut best: Option<Self> = None;
        let places = kernels.iter_mut().zip(DENSITIES);
        let places = places.filter(|(_, density)| densities.contains(density));
        let places = places.flat_map(|(row, density)| {
            let row = row.iter_mut().zip(WIDTHS);
            let row = row.filter(|(_, width)| widths.contains(width));
            row.map(move |(place, width)| (place, density, width))
        });
        for (place, density, width) in places {
            let per_sample = density.0 as f64 / density.1 as f64;
            let guard = (0.5 * width as f64 / per_sample).ceil() as usize + 2;
            let Some((slab_samples, payload)) = slabs(extent, guard, samples, density) else {
                return Err(Refusal::PulseTooLong {
                    duration_s: pulse.duration_s,
                    rate_hz,
                });
            };
            let slab_rows = slab_samples * density.0 / density.1;
            // Rows that the delays of a block spread over, for echoes from 20 degrees: between those of a side-scan's beam and of a wide fan.
            let of_block = array.elements as f64 / array.elements.div_ceil(LANES).max(1) as f64;
            let block_s = 0.35 * of_block * array.spacing_m / c;
            let rows = width as f64 + block_s * rate_hz * per_sample;
            let step = |columns: &Columns| match moving {
                false => 0.0,
                true => columns.turn_rad / turn_per_stretch,
            };
            let costs = LoopCosts::of(spec.simd_level);
            let order = match spec.doppler {
                DopplerModel::None => 0,
                DopplerModel::StretchQuadratic => 2,
                _ => 1,
            };
            let lanes = cell_lanes(lanes_for(array.elements)) as f64;
            let effort = |columns: &Columns| {
                let transform = |n: usize, ns: f64| blocks * ns * n as f64 * (n as f64).log2();
                Effort {
                    echo_ns: costs.echo_ns[order] + blocks * costs.block_ns,
                    rows_ns: blocks * rows * costs.row_ns,
                    echo_taps: blocks * rows * columns.taps as f64,
                    tap_ns: costs.tap_ns,
                    column_bytes: slab_rows as f64 * 2.0 * lanes * size_of::<f32>() as f64,
                    column_ns: transform(slab_rows, costs.forward_ns),
                    slab_ns: transform(slab_samples, costs.back_ns),
                    samples_ns: SAMPLE_NS * array.elements as f64 * samples as f64,
                    slabs: (samples + 2 * extent).div_ceil(payload) as f64,
                    slabs_per_s: rate_hz / payload as f64,
                    taps: columns.taps as f64,
                    step: step(columns),
                    sound_speed_m_per_s: c,
                }
            };
            let cost_ms = |columns: &Columns| effort(columns).typical_ms(echoes);
            let cheaper = |columns: &&Columns, best: &Option<Self>| {
                best.as_ref()
                    .is_none_or(|best| cost_ms(columns) < best.error_model.cost_ms)
            };
            if !candidates.iter().any(|columns| cheaper(&columns, &best)) {
                continue;
            }
            let fit = |content: &Vec<Content>| {
                let in_rows: Vec<Content> = content
                    .iter()
                    .map(|c| Content {
                        nu: c.nu / per_sample,
                        energy: c.energy,
                    })
                    .collect();
                let (kernel, _) = Kernel::fit(width, &in_rows);
                (kernel, single_echo.errors(&kernel, per_sample))
            };
            let fitted = *place.get_or_insert_with(|| contents.each_ref().map(fit));
            let [steep, flat] =
                fitted.map(|(kernel, errors)| (kernel, worst(fading, errors), errors));
            let (kernel, kernel_error, of_echo) = match steep.1 <= flat.1 {
                true => steep,
                false => flat,
            };
            let rest = 1.0 - path_share - COLUMN_SHARES[0] - CURVATURE_SHARE - BEYOND_SHARE;
            finest = finest.min(kernel_error / rest.sqrt());
            for columns in &candidates {
                let others = kernel_error
                    .hypot(of_columns(columns))
                    .hypot(path_error.hypot(beyond_error));
                let error = others.hypot(of_curvature(columns));
                if !(error <= tolerance && cheaper(&columns, &best)) {
                    continue;
                }
                let step = step(columns);
                let reach = match moving {
                    false => 0,
                    true => {
                        (stretch(spec.fastest_m_per_s, c) / step).ceil() as usize + columns.taps
                    }
                };
                // What the others leave of the tolerance.
                let parts = ErrorParts {
                    kernel: kernel_error,
                    kernel_of_echo: of_echo.rms,
                    columns: of_columns(columns),
                    curvature_room: (tolerance * tolerance - others * others).max(0.0).sqrt(),
                    ..no_kernel
                };
                let of_curvature = parts.of_curvature(columns, parts.curvature_per_s);
                let error = others.hypot(of_curvature);
                best = Some(Self {
                    kernel,
                    columns: *columns,
                    step,
                    straight_rad: STRAIGHT_SHARE.sqrt() * tolerance
                        / worst_of_even(fading, 1.0 / 5f64.sqrt(), 5f64.sqrt()),
                    max_swing_rad: (6.0 * SWING_SHARE.sqrt() * tolerance
                        / worst_of_even(fading, 1.0 / 7f64.sqrt(), 7f64.sqrt()))
                    .cbrt(),
                    max_curvature_rad: parts.max_curvature_rad(columns),
                    reach,
                    slab_samples,
                    slab_rows,
                    payload,
                    extent,
                    guard,
                    path_m: path_error * c / (TAU * carrier_hz),
                    coarse_share: COARSE_SHARE + COARSE_PER_MACH * spec.fastest_m_per_s / c,
                    wavelength_m: c / carrier_hz,
                    error_model: ErrorModel {
                        name: "gridded-lines",
                        error,
                        cost_ms: cost_ms(columns),
                        why: format!(
                            "slabs of {slab_samples} samples, {slab_rows} rows; kernel of {width} rows; {} Doppler taps every {:.2e}",
                            columns.taps, step
                        ),
                    },
                    parts,
                    echo: None,
                    by_level: ErrorsByLevel::default(),
                    effort: effort(columns),
                });
            }
        }
        let mut best = best.ok_or(Refusal::TooFine {
            tolerance,
            least: rounded_up(finest),
        })?;
        let per_sample = best.slab_rows as f64 / best.slab_samples as f64;
        best.by_level = single_echo.by_level(&best.kernel, per_sample, &best.columns);
        best.echo = (!moving).then(|| Arc::new(single_echo.profile(&best.kernel, per_sample)));
        Ok(best)
    }

    /// Predicted windowed error, and cost in milliseconds of one core per ping.
    pub fn error_model(&self) -> &ErrorModel {
        &self.error_model
    }

    /// Predicted windowed error of a ping with this motion: as [`Self::error_model`], which allows for the nearest scatterer and the fastest platform of
    /// the design.
    pub fn error_of(&self, array: &ArrayGeometry, motion: LineMotion) -> f64 {
        let [path, beyond, curvature_per_s] = self.of_motion(array, motion);
        let curvature = self.parts.of_curvature(&self.columns, curvature_per_s);
        let ErrorParts {
            kernel, columns, ..
        } = self.parts;
        [kernel, columns, path, beyond, curvature]
            .into_iter()
            .fold(0.0, f64::hypot)
    }

    /// Predicted errors of a single echo of such a ping: rms over the echo and its places on the grid, and in windows whose levels below the strongest
    /// are those of [`level_of`](crate::array::gridded::level_of).
    pub fn echo_errors(&self, array: &ArrayGeometry, motion: LineMotion) -> (f64, [f64; LEVELS]) {
        let [path, beyond, curvature_per_s] = self.of_motion(array, motion);
        let curvature_rad = self.parts.curvature_rad_s * curvature_per_s;
        let [first, second] = self.parts.curvature_of_echo(&self.columns);
        // Its second order along a block, where weights do not follow it.
        let straight = match self.step > 0.0 {
            true => self.straight_rad,
            false => 0.0,
        };
        let of = &self.by_level;
        let evens = [
            ((first.0 * curvature_rad, first.1), &of.legendre),
            (
                (second.0 * curvature_rad * curvature_rad, second.1),
                &of.fourth,
            ),
            ((straight / 5f64.sqrt(), 5f64.sqrt()), &of.square),
        ];
        let others = path.hypot(beyond);
        let rms = evens
            .iter()
            .fold(self.parts.kernel_of_echo, |sum, ((rms, _), _)| {
                sum.hypot(*rms)
            });
        let rms = rms.hypot(self.columns.error);
        let by_level = std::array::from_fn(|level| {
            // At an end of the pulse these may have the same phase.
            let all = evens
                .iter()
                .map(|((rms, end), grown)| rms * (end * grown[level]).max(1.0));
            let grown = of.columns[level] + all.sum::<f64>();
            grown.hypot(of.kernel[level]).hypot(others)
        });
        (MORE * rms.hypot(others), by_level)
    }

    /// Errors of a ping with this motion, by the interpolation along the line and by Dopplers beyond all columns, and its curvature, per second.
    fn of_motion(&self, array: &ArrayGeometry, motion: LineMotion) -> [f64; 3] {
        let path_m = match self.path_errors_m(array, motion.range_m) {
            Some(errors) => errors.into_iter().map(|(_, m)| m).fold(0.0, f64::max),
            None => self.path_m,
        };
        let path = TAU / self.wavelength_m * path_m.min(self.path_m);
        let reach_columns = (self.reach + 1).saturating_sub(self.columns.taps) as f64;
        let closing = stretch(motion.closing_m_per_s, self.effort.sound_speed_m_per_s);
        let beyond = match closing <= reach_columns * self.step {
            true => 0.0,
            false => self.parts.beyond,
        };
        // Accelerations add to what the design allows for.
        let of_design = self.parts.curvature_per_s;
        let curvature_per_s = match of_design > 0.0 && motion.curvature_per_s.is_finite() {
            true => motion.curvature_per_s,
            false => of_design,
        };
        [path, beyond, curvature_per_s]
    }

    /// Rounding errors, which spread over the record, relative to the noise floor. The others leave them out.
    pub fn spread_error(&self) -> f64 {
        rounding_over_noise()
    }

    /// An echo with its error, apart from that of the interpolation along the line ([`Self::phase_errors`]), of a design without Doppler; none of
    /// others.
    pub fn echo_at_rest(&self) -> Option<&EchoProfile> {
        self.echo.as_deref()
    }

    /// Largest phase errors by the interpolation along `array`, radians, of scatterers from each of some ranges to the next, metres, the nearest first.
    pub fn phase_errors(&self, array: &ArrayGeometry, range_m: (f64, f64)) -> Vec<(f64, f64)> {
        let per_m = TAU / self.wavelength_m;
        let errors = self.path_errors_m(array, range_m).unwrap_or_default();
        let next = errors.iter().skip(1).chain(errors.last());
        let pairs = errors.iter().zip(next);
        pairs
            .map(|(here, next)| (here.0, per_m * here.1.max(next.1)))
            .collect()
    }

    /// Largest errors of the interpolated delays and gains, as a path, of scatterers at ranges between these; none if no number of nodes is enough.
    fn path_errors_m(
        &self,
        array: &ArrayGeometry,
        (nearest_m, farthest_m): (f64, f64),
    ) -> Option<Vec<(f64, f64)>> {
        let counts = self.node_counts(array, nearest_m)?;
        let ratio = (farthest_m / nearest_m).max(1.0);
        let ranges_m = (0..=PING_RANGES)
            .map(|k| nearest_m * ratio.powf(f64::from(k) / f64::from(PING_RANGES)));
        let errors = ranges_m.map(|range_m| {
            let by_few = self.coarse_error_m(counts, array, range_m);
            let error = match by_few <= self.path_m {
                true => by_few,
                false => self.path_error_m(counts, array, range_m),
            };
            (range_m, error)
        });
        Some(errors.collect())
    }

    /// Predicted cost of a ping with these echoes, without the solution of delays and gains at the nodes ([`Self::solved_points`] of them for every
    /// scatterer).
    pub fn cost_estimate(&self, heard: Heard) -> CostEstimate {
        self.effort.cost(heard)
    }

    /// Nodes along `array` for scatterers at `nearest_m` and beyond; none if no number is enough.
    pub fn nodes(&self, array: &ArrayGeometry, nearest_m: f64) -> Option<usize> {
        self.node_counts(array, nearest_m)
            .map(|counts| counts.delays)
    }

    /// The fewest that are enough.
    fn node_counts(&self, array: &ArrayGeometry, nearest_m: f64) -> Option<NodeCounts> {
        let enough =
            |counts: &NodeCounts| self.path_error_m(*counts, array, nearest_m) <= self.path_m;
        NODES.into_iter().find(enough)
    }

    /// Mean number of points along `array` at which delays are solved, for scatterers evenly from the nearest to the farthest range; none if no number is
    /// enough.
    pub fn solved_points(
        &self,
        array: &ArrayGeometry,
        (nearest_m, farthest_m): (f64, f64),
    ) -> Option<f64> {
        let counts = self.node_counts(array, nearest_m)?;
        let is_coarse = |part: &u32| {
            let range_m = nearest_m
                + (farthest_m - nearest_m) * (f64::from(*part) + 0.5) / f64::from(COARSE_PARTS);
            self.coarse_error_m(counts, array, range_m) <= self.path_m
        };
        let distant = (0..COARSE_PARTS).filter(is_coarse).count() as f64;
        let (all, few) = (counts.delays as f64, COARSE as f64);
        Some(all + (few - all) * distant / f64::from(COARSE_PARTS))
    }

    /// Largest error of a path length that is interpolated from so many nodes along `array`, with that of the gains; metres.
    fn path_error_m(&self, counts: NodeCounts, array: &ArrayGeometry, range_m: f64) -> f64 {
        path_error_m(counts, array, range_m, self.wavelength_m)
    }

    /// The same where delays are solved at the [`coarse`] nodes only, and found at the others from squares of receive legs, which are no polynomials
    /// along an arc.
    fn coarse_error_m(&self, counts: NodeCounts, array: &ArrayGeometry, range_m: f64) -> f64 {
        if array.radius_m.is_some() {
            return f64::INFINITY;
        }
        let all: Vec<f64> = places(counts.delays).collect();
        let [of_few_m, _] = delay_errors_m(&coarse(&all), array, range_m);
        let [along_m, block_m] = delay_errors_m(&all, array, range_m);
        let path_m = self.coarse_share * of_few_m + along_m + block_m;
        path_m.hypot(gains_as_path_m(COARSE, array, range_m, self.wavelength_m))
    }

    /// Range from which on the error is small enough along `array`, metres; infinite if it never is.
    fn enough_from_m(&self, array: &ArrayGeometry, error_m: impl Fn(f64) -> f64) -> f64 {
        let (half_m, _) = extents_m(array);
        let fits = |range_m: &f64| error_m(*range_m) <= self.path_m;
        let ranges_m = (0..RANGES).map(|k| half_m * FARTHEST * NEARER.powi(k));
        let Some(mut enough_m) = ranges_m.take_while(fits).last() else {
            return f64::INFINITY;
        };
        let mut near_m = NEARER * enough_m;
        for _ in 0..HALVINGS {
            let middle_m = 0.5 * (near_m + enough_m);
            match fits(&middle_m) {
                true => enough_m = middle_m,
                false => near_m = middle_m,
            }
        }
        enough_m
    }

    /// Range from which on each of [`NODES`] is enough along `array`, metres; infinite if none is.
    pub(super) fn near_m(&self, array: &ArrayGeometry) -> [f64; NODES.len()] {
        NODES.map(|counts| {
            self.enough_from_m(array, |range_m| self.path_error_m(counts, array, range_m))
        })
    }

    /// The same of the [`coarse`] ones among them, between which the squares of receive legs are interpolated.
    pub(super) fn coarse_m(&self, array: &ArrayGeometry) -> [f64; NODES.len()] {
        NODES.map(|counts| {
            self.enough_from_m(array, |range_m| self.coarse_error_m(counts, array, range_m))
        })
    }
}

/// Largest error of a path length that is interpolated from so many nodes along `array`, with that of the gains; metres.
fn path_error_m(counts: NodeCounts, array: &ArrayGeometry, range_m: f64, wavelength_m: f64) -> f64 {
    let places: Vec<f64> = places(counts.delays).collect();
    let [along_m, block_m] = delay_errors_m(&places, array, range_m);
    let gains_m = gains_as_path_m(counts.gains, array, range_m, wavelength_m);
    (along_m + block_m).hypot(gains_m)
}

/// The error of gains, as a path whose phase errs as much.
fn gains_as_path_m(gains: usize, array: &ArrayGeometry, range_m: f64, wavelength_m: f64) -> f64 {
    let (half_m, block_m) = extents_m(array);
    let element_m = match array.element_pattern {
        Pattern::Rectangle { length_m, .. } => length_m,
        Pattern::Omnidirectional | Pattern::Part { .. } => 0.0,
    };
    let of = [element_m, wavelength_m];
    let gain_error = gain_error(gains, of, (half_m, array.radius_m), block_m, range_m)
        + spreading_error(gains, half_m, block_m, range_m);
    gain_error * wavelength_m / TAU
}

/// Share of the tolerance, as energy, with which scatterers at the smallest range are interpolated, within [`PATH_SHARES`].
fn path_share(spec: &Spec) -> f64 {
    let wavelength_m = spec.sound_speed_m_per_s / spec.pulse.center_frequency_hz;
    let errors = NODES.map(|counts| path_error_m(counts, spec.array, spec.nearest_m, wavelength_m));
    let least_rad = TAU / wavelength_m * errors.into_iter().fold(f64::INFINITY, f64::min);
    let [least, most] = PATH_SHARES;
    (least_rad / spec.tolerance).powi(2).clamp(least, most)
}

/// Of delays at `places`, as paths: along the line, and over a block.
fn delay_errors_m(places: &[f64], array: &ArrayGeometry, range_m: f64) -> [f64; 2] {
    let (half_m, block_m) = extents_m(array);
    interpolation_errors_m(places, (half_m, array.radius_m), block_m, range_m)
}

/// Half of the line, and a block of elements; metres.
fn extents_m(array: &ArrayGeometry) -> (f64, f64) {
    let half_m = 0.5 * (array.elements - 1) as f64 * array.spacing_m;
    (half_m, (LANES as f64 * array.spacing_m).min(2.0 * half_m))
}

/// Doppler shift of the fastest echoes, Hz.
fn shift_hz(spec: &Spec) -> f64 {
    match spec.doppler {
        DopplerModel::None => 0.0,
        _ => 2.0 * spec.fastest_m_per_s / spec.sound_speed_m_per_s * spec.pulse.center_frequency_hz,
    }
}

/// The spectrum of the received pulse: cycles per sample.
fn content(spec: &Spec, filter: &Decimator, flatness: f64) -> Vec<Content> {
    let rate_hz = spec.sample_rate_hz;
    let shift_hz = shift_hz(spec);
    let spectrum = PulseSpectrum::new(spec.pulse, 0.5 * rate_hz + shift_hz + 1.0);
    (0..CONTENTS)
        .map(|k| {
            let nu = (k as f64 + 0.5) / CONTENTS as f64 - 0.5;
            let at = |shift_hz: f64| spectrum.at(nu * rate_hz + shift_hz).norm_sqr();
            let energy = 0.5 * at(0.0) + 0.25 * (at(-shift_hz) + at(shift_hz));
            Content {
                nu,
                energy: (energy * filter.gain(nu * rate_hz).powi(2)).powf(flatness),
            }
        })
        .filter(|content| content.energy > 0.0)
        .collect()
}
