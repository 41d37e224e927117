//! Which fineness a tolerance asks for, and what is refused.
//!
//! The parts of the error, each relative to the echoes of a window: the two kernels (computed, not estimated: [`Kernel::error`]), the
//! series (each task takes as many terms as its own echoes need, and reports what it left out), the delay's fourth order along a stretch,
//! steps of the attitude between a polyline's segments, rounding.

use std::f64::consts::{PI, TAU};

use crate::array::filter::Decimator;
use crate::array::gridded::CostEstimate;
use crate::array::gridded::kernel::Kernel;
use crate::array::gridded::simd_level::SimdLevel;
use echotank_core::flow::{
    ArrayGeometry, DopplerModel, ErrorModel, ModelChoice, PathModel, Pattern, Pulse,
};

use num_complex::Complex64;

use super::alone::{Alone, noise_db};
use super::engine::{Fineness, PulseMotion};
use super::lanes::BLOCK;
use super::series::terms_needed;
use super::task::MAX_DILATION;

/// Stretches tried, from long to short: long ones are cheap.
const STRETCHES: [usize; 6] = [128, 64, 32, 16, 8, 1];
/// By how much more than a kernel's mean over the band the worst of many windows errs, where echoes cancel: 4.4 in 17,000 windows of a multibeam over
/// a swath of seabed (measured). A window that holds no more than the onset of a few echoes is one number, which is so many times less than they
/// are with a chance of one over its square: 2 %.
const KERNEL_FACTOR: f64 = 7.0;
/// The same of a pulse with few degrees of freedom, times its [`Pulse::weakest_window`] (measured).
const FACTOR_OF_WEAKEST: f64 = 2.25;
/// Of the tolerance, what the kernel over time may leave of an echo by itself in any window beside it; and what lies beyond the band, of which
/// no choice makes less (it is that of the worst echo alone: where it was up to 1.25 of a tolerance, answers were off by 0.63 of theirs at most).
const ALONE_SHARE: f64 = 0.6;
const BAND_SHARE: f64 = 1.25;
/// Of f32 tables, grids and transforms: of the strongest echo of a slab, in any window of it (measured: 1e-7 to 2.5e-7).
const F32_ERROR: f64 = 2.5e-7;
/// They will do where that, against the noise, is so many times less than the tolerance.
const F32_ROOM: f64 = 2.5;
/// Per m/s along the array, and Hz over metre of range (1.8e-6 of 400 kHz at 36 m): third orders in slope and motion that are taken at a
/// column's own slope (measured).
const UNDERWAY_ERROR_S_PER_M: f64 = 1.8e-6 * 36.0 / 400e3;
/// Of the tolerance (half of it where the rest is not small), what each series may leave out in the worst corner of its spans; what a window sees is several times less (measured).
const SERIES_SHARE: f64 = 0.2;
/// Terms of the dilation's series that leave room for those of bend, twist and fade in the grid's channels.
const MAX_TERMS: usize = 16;
/// Levels farther below a slab's strongest are not reached by f32 transforms either, dB.
const FARTHEST_DB: f64 = 60.0;
/// Of the tolerance, what the delay's and the strength's changes along a stretch may leave, of which a shorter one makes less.
const STRETCH_SHARE: f64 = 0.3;
/// Rows per bin that is heard, and columns per cycle of the aperture over the least, that are tried. (Fewer columns take more powers along the
/// stretch: 13 in place of 9 with 1.25, and longer altogether.)
const ROWS: [f64; 4] = [1.25, 1.5, 1.75, 2.0];
const COLUMNS: [f64; 3] = [1.5, 1.75, 2.0];
/// Widest kernels.
const MAX_WIDTH: usize = 14;
/// Nanoseconds of one core, rough (measured on a 2.7 GHz core): per echo and stretch, and for each of its values on the grid's columns and
/// rows; per element and slab, and for its share of the columns of a grid twice as dense as sampling asks for, of which so much is there
/// however many rows the columns have.
const ECHO_NS: f64 = 60.0;
const VALUE_NS: f64 = 5.0;
const RETURN_NS: f64 = 2e4;
const COLUMNS_NS: f64 = 2.2e5;
const COLUMN_SHARE: f64 = 0.7;
/// Below this nothing is promised: the receiver filter's stop band is 82 dB down and its image is left out, and motion across the array
/// leaves what the columns beside an echo do not know.
pub(crate) const MIN_TOLERANCE: f64 = 2e-5;

/// What the scene and the platform may be.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bounds {
    pub nearest_m: f64,
    /// Sine of the greatest angle from broadside.
    pub greatest_slope: f64,
    /// Speed along and across the array, m/s.
    pub along_m_per_s: f64,
    pub across_m_per_s: f64,
    /// Of the platform; counts where attitude steps from segment to segment.
    pub turning_rad_per_s: f64,
}

/// What the engine is to be made for.
#[derive(Clone, Copy)]
pub struct Spec<'a> {
    pub array: &'a ArrayGeometry,
    pub pulse: &'a Pulse,
    pub sound_speed_m_per_s: f64,
    pub sample_rate_hz: f64,
    /// Without one the method is refused: it needs a band that ends.
    pub filter: Option<&'a Decimator>,
    pub model: &'a ModelChoice,
    pub bounds: Bounds,
    /// Relative error in any window of a pulse's length.
    pub tolerance: f64,
    /// How much weaker than the strongest window the weakest may be, dB.
    pub level_range_db: f64,
    /// Samples of one element and scatterers, roughly: for the cost only.
    pub samples: usize,
    pub scatterers: usize,
    pub simd_level: SimdLevel,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Precision {
    Single,
    Double,
}

/// What was chosen.
#[derive(Clone, Debug)]
pub struct Choice {
    pub fineness: Fineness,
    pub precision: Precision,
    pub error_model: ErrorModel,
    /// What the error model's cost is made of.
    pub cost: CostEstimate,
}

#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum Refusal {
    #[error("tolerance {tolerance}: gridded-2d promises none below {MIN_TOLERANCE}")]
    TooFine { tolerance: f64 },
    #[error(
        "tolerance {tolerance}: with scatterers as near as {nearest_m} m no stretch of the line is short enough for gridded-2d"
    )]
    TooNear { tolerance: f64, nearest_m: f64 },
    #[error(
        "tolerance {tolerance}: {across_m_per_s} m/s across the line is too fast for gridded-2d: the Doppler differs by {turn_rad:.0} rad from one side to the other"
    )]
    TooFastAcross {
        tolerance: f64,
        across_m_per_s: f64,
        turn_rad: f64,
    },
    #[error("doppler model `{}`: gridded-2d knows `none`, `stretch` and `stretch-quadratic`", .0.name())]
    Doppler(DopplerModel),
    #[error("gridded-2d needs the receiver filter: without it the pulse has no end in frequency")]
    NoFilter,
    #[error("{what} = {value}: must be {rule}")]
    Bounds {
        what: &'static str,
        value: f64,
        rule: &'static str,
    },
    #[error(
        "tolerance {tolerance}: gridded-2d makes what lies within the sampled band, and beyond it lies {share:.1e} of what ends of pulses leave in some window; use a longer taper or `direct`"
    )]
    OutOfBand { tolerance: f64, share: f64 },
    #[error("sample rate {rate_hz} Hz: a slab of {samples} samples is too short for the pulse")]
    SlabTooShort { rate_hz: f64, samples: usize },
}

/// Slabs that are tried, samples.
const MIN_SLAB: usize = 256;
const MAX_SLAB: usize = 1 << 16;
/// A slab is at least so many times as long as what its last echo leaves beyond it.
const MAX_SPENT: f64 = 3.0;
/// Of the tolerance, what straight pieces of the templates may leave of an echo; and over the noise. What they leave are images of the echo, a
/// block's worth of time and more to either side of it, where it may be silent.
const STRAIGHT_SHARE: f64 = 0.1;
const STRAIGHT_BESIDE: f64 = 5.6;
/// What a slab costs whatever its length, in samples (templates, bases of channels; measured).
const TASK_SAMPLES: f64 = 64.0;
/// By how much dearer than the least slabs may be, so that there be as many tasks as a few threads share evenly.
const SLAB_SLACK: f64 = 1.1;
const TASKS: f64 = 8.0;
/// Both halves of a receiver filter that is not known yet, seconds.
const FILTER_S: f64 = 2e-3;

/// A kernel that was tried: its width, its grid, the part of the band that it is made for, and its error in the worst of many windows.
#[derive(Clone, Copy)]
struct Fit {
    width: usize,
    oversampling: f64,
    core: f64,
    error: f64,
}

/// The first that is fine enough, and the next one: which leaves the other kernel more.
fn two_that(fits: impl Iterator<Item = Fit>, fine: impl Fn(&Fit) -> bool) -> [Option<Fit>; 2] {
    let mut fine = fits.skip_while(|fit| !fine(fit));
    [fine.next(), fine.next()]
}

/// As which power of the frequency the inverse of a kernel's spectrum grows at the end of its band.
fn edge_power(kernel: &Kernel) -> f64 {
    const STEP: f64 = 1e-3;
    let edge = 0.5 / kernel.oversampling;
    let log = |share: f64| libm::log(kernel.window_gain(edge * share));
    (log(1.0 - STEP) - log(1.0 + STEP)) / (2.0 * STEP)
}

/// Whether echoes are stretched at all.
fn motion_matters(doppler: DopplerModel) -> bool {
    doppler != DopplerModel::None
}

/// How long slabs are, samples, and about how many have echoes: of what costs little more than the least, the most there are, so that no thread
/// waits long for the last.
///
/// `half_m`: of a stretch; `turned_rad`: phase of what templates follow.
fn slabs(
    spec: &Spec,
    stretches: usize,
    half_m: f64,
    turned_rad: f64,
) -> Result<(usize, f64), Refusal> {
    let rate_hz = spec.sample_rate_hz;
    // Echoes that begin near a slab's end last beyond it, the filter adds to both, and the ends of a stretch hear sooner or later.
    let filter_s = spec.filter.map_or(FILTER_S, |filter| 2.0 * filter.half_s());
    let beside_s = filter_s + 2.0 * half_m / spec.sound_speed_m_per_s;
    let spent = rate_hz * (spec.pulse.duration_s + beside_s) + 2.0;
    // Templates are lines over a block of frequencies: half of what they turn in half of one, squared, is left.
    let beside = STRAIGHT_BESIDE * 10f64.powf(-noise_db(spec.level_range_db) / 20.0);
    let straight_rad = (2.0 * beside.min(STRAIGHT_SHARE) * spec.tolerance).sqrt();
    let per_bin = 0.5 * BLOCK as f64 * rate_hz / spec.pulse.center_frequency_hz;
    let straight = per_bin * turned_rad / straight_rad;
    let silent = rate_hz * 2.0 * spec.bounds.nearest_m / spec.sound_speed_m_per_s;
    let heard = (spec.samples as f64 - silent).max(1.0) + spent;
    let sizes = (MIN_SLAB..=MAX_SLAB).step_by(BLOCK).filter(|size| {
        let odd = size >> size.trailing_zeros();
        [1, 3, 5].contains(&odd) && *size as f64 >= straight.max(MAX_SPENT * spent)
    });
    let sized = sizes.map(|size| {
        let slabs = (heard / (size as f64 - spent)).ceil();
        (size, slabs, slabs * (size as f64 + TASK_SAMPLES))
    });
    let least = sized
        .clone()
        .map(|(_, _, cost)| cost)
        .fold(f64::INFINITY, f64::min);
    let enough = |&(_, slabs, _): &(usize, f64, f64)| slabs * stretches as f64 >= TASKS;
    let cheap = sized
        .clone()
        .filter(|(_, _, cost)| *cost <= SLAB_SLACK * least);
    let best = cheap
        .clone()
        .filter(enough)
        .min_by(|a, b| a.2.total_cmp(&b.2));
    best.or_else(|| cheap.max_by(|a, b| a.1.total_cmp(&b.1)))
        .map(|(size, slabs, _)| (size, slabs))
        .ok_or(Refusal::SlabTooShort {
            rate_hz,
            samples: MAX_SLAB,
        })
}

/// The cheapest fineness that keeps the tolerance.
pub fn choose(spec: &Spec) -> Result<Choice, Refusal> {
    let Spec {
        array,
        pulse,
        sound_speed_m_per_s,
        sample_rate_hz: rate_hz,
        bounds,
        tolerance,
        ..
    } = *spec;
    if tolerance.is_nan() || tolerance < MIN_TOLERANCE {
        return Err(Refusal::TooFine { tolerance });
    }
    for (what, value, rule, ok) in [
        (
            "nearest_m",
            bounds.nearest_m,
            "above 0",
            bounds.nearest_m > 0.0,
        ),
        (
            "greatest_slope",
            bounds.greatest_slope,
            "from 0 to 1",
            (0.0..=1.0).contains(&bounds.greatest_slope),
        ),
        (
            "elements",
            array.elements as f64,
            "at least 1",
            array.elements >= 1,
        ),
        (
            "spacing_m",
            array.spacing_m,
            "above 0",
            array.spacing_m > 0.0,
        ),
    ] {
        if !ok {
            return Err(Refusal::Bounds { what, value, rule });
        }
    }
    let motion = match spec.model.doppler {
        DopplerModel::None | DopplerModel::Stretch => PulseMotion::Stretch,
        DopplerModel::StretchQuadratic => PulseMotion::Quadratic,
        other @ DopplerModel::PaperEq21 => return Err(Refusal::Doppler(other)),
    };
    let per_m = TAU * (pulse.center_frequency_hz + 0.5 * rate_hz) / sound_speed_m_per_s;
    let half_s = 0.5 * pulse.duration_s;
    let across = bounds.across_m_per_s;
    // How fast the strength of an echo can change as the line looks at it from another angle.
    let sides = match array.element_pattern {
        Pattern::Omnidirectional => 0.0,
        Pattern::Rectangle {
            length_m, width_m, ..
        }
        | Pattern::Part {
            length_m, width_m, ..
        } => length_m.max(width_m) * pulse.center_frequency_hz / sound_speed_m_per_s,
    };
    let underway = UNDERWAY_ERROR_S_PER_M * pulse.center_frequency_hz / bounds.nearest_m
        * bounds.along_m_per_s;
    let along_stretch = |stretch: usize| {
        let half_m = 0.5 * (stretch.min(array.elements) - 1) as f64 * array.spacing_m;
        let quartic = per_m * half_m.powi(4) / (8.0 * bounds.nearest_m.powi(3));
        let turned = (1.0 + PI * sides) * half_m / bounds.nearest_m;
        quartic + turned.powi(3) / 6.0
    };
    let beyond_series = |stretch: usize| along_stretch(stretch) + underway;
    // A polyline's attitude steps at its vertices: while the wave passes the stretch, part of it is on either side.
    let steps = |stretch: usize| match spec.model.path {
        PathModel::Polyline => {
            let half_m = 0.5 * (stretch.min(array.elements) - 1) as f64 * array.spacing_m;
            let step_rad = per_m * half_m * bounds.turning_rad_per_s * spec.model.segment_s;
            let passes_s = 2.0 * half_m * bounds.greatest_slope / sound_speed_m_per_s;
            let share = passes_s / spec.model.segment_s.min(pulse.duration_s);
            step_rad * share.min(1.0).sqrt()
        }
        _ => 0.0,
    };
    // All parts but this one add up to four fifths of the tolerance at most, squared.
    let share = if tolerance < 1e-4 { 0.9 } else { 0.3 } * tolerance;
    let stretch = STRETCHES
        .into_iter()
        .find(|&stretch| {
            along_stretch(stretch) <= STRETCH_SHARE * tolerance
                && beyond_series(stretch) <= share
                && steps(stretch) <= share
        })
        .ok_or(Refusal::TooNear {
            tolerance,
            nearest_m: bounds.nearest_m,
        })?;
    let f32_error = F32_ERROR * 10f64.powf(noise_db(spec.level_range_db) / 20.0);
    let precision = if tolerance >= F32_ROOM * f32_error {
        Precision::Single
    } else {
        Precision::Double
    };
    let moments = match precision {
        Precision::Single => 8,
        Precision::Double => 12,
    };
    // Where the rest is not small either, the kernels leave it room.
    let kernel_share = if tolerance < 1e-4 { 0.42 } else { 0.78 };
    let stretches = array.elements.div_ceil(stretch);
    let half_m = 0.5 * (stretch.min(array.elements) - 1) as f64 * array.spacing_m;
    let bend_rad = 0.5 * per_m * half_m * half_m / bounds.nearest_m;
    let across_rad = match motion_matters(spec.model.doppler) {
        true => per_m * half_s * 2.0 * across,
        false => 0.0,
    };
    let echoes = (spec.scatterers * stretches) as f64;
    let factor = (FACTOR_OF_WEAKEST / pulse.weakest_window(rate_hz)).max(KERNEL_FACTOR);
    // Few values beside an echo on a dense grid, or more on a coarse one: the more echoes, the denser.
    let room = kernel_share * tolerance;
    let slopes = COLUMNS.map(|oversampling| {
        let fits = (2..=MAX_WIDTH).map(|width| {
            let kernel = Kernel::new(width, oversampling, moments);
            Fit {
                width,
                oversampling,
                core: 1.0,
                error: kernel.error * factor,
            }
        });
        two_that(fits, |fit| fit.error <= room)
    });
    // While the motion carries a stretch beyond its ends, a column's own spectrum is met at other places than at the end, where it is divided
    // out: a power of the frequency, as far as that is.
    let drift_m = match motion_matters(spec.model.doppler) {
        true => pulse.duration_s * (bounds.along_m_per_s + across),
        false => 0.0,
    };
    let reach_m = (half_m + drift_m).max(0.25 * sound_speed_m_per_s / pulse.center_frequency_hz);
    let power = |fit: Fit| edge_power(&Kernel::new(fit.width, fit.oversampling, moments));
    let power = slopes.into_iter().flatten().flatten().map(power);
    let power = power.fold(0.0, f64::max) * drift_m / reach_m;
    let turned_rad = (bend_rad + across_rad).hypot(power);
    let (slab_samples, slabs) = slabs(spec, stretches, half_m, turned_rad)?;
    let element_slabs = array.elements as f64 * slabs;
    // Over time, beside echoes too; exact where there is something of the pulse.
    let alone = spec.filter.map(|filter| {
        let doppler = match motion_matters(spec.model.doppler) {
            true => 2.0 * bounds.along_m_per_s.hypot(across) / sound_speed_m_per_s,
            false => 0.0,
        };
        Alone::new(pulse, rate_hz, filter, doppler, spec.level_range_db)
    });
    let core = alone.as_ref().map_or(1.0, Alone::core);
    let times = ROWS.map(|oversampling| {
        let fits = (2..=MAX_WIDTH).map(|width| {
            let kernel = Kernel::new(width, oversampling / core, moments);
            let error = |alone: &Alone| {
                let [whole, beside] = alone.kernel(&kernel, core);
                (whole.max(kernel.error) * factor).max(beside * room / (ALONE_SHARE * tolerance))
            };
            Fit {
                width,
                oversampling,
                core,
                // Not looked at closely where it is too much anyway.
                error: match kernel.error * factor <= room {
                    true => alone.as_ref().map_or(kernel.error * factor, error),
                    false => f64::INFINITY,
                },
            }
        });
        two_that(fits, |fit| fit.error <= room)
    });
    let share = alone.as_ref().map_or(0.0, Alone::beyond_band);
    if share > BAND_SHARE * tolerance {
        return Err(Refusal::OutOfBand { tolerance, share });
    }
    let cost = |time: Fit, slope: Fit| {
        let of_columns = COLUMN_SHARE + (1.0 - COLUMN_SHARE) * 0.5 * time.oversampling;
        CostEstimate {
            echoes_ns: echoes * (ECHO_NS + (time.width * slope.width) as f64 * VALUE_NS),
            grids_ns: element_slabs
                * (RETURN_NS + COLUMNS_NS * 0.5 * slope.oversampling * of_columns),
        }
    };
    let (cost, time, slope) = times
        .into_iter()
        .flatten()
        .flatten()
        .flat_map(|time| {
            let slopes = slopes.into_iter().flatten().flatten();
            slopes.map(move |slope| (cost(time, slope), time, slope))
        })
        .filter(|(_, time, slope)| time.error.hypot(slope.error) <= room)
        .min_by(|a, b| a.0.ms().total_cmp(&b.0.ms()))
        .ok_or(Refusal::TooFine { tolerance })?;
    let kernel_error = time.error.hypot(slope.error);
    let series = if tolerance < 1e-4 { 0.5 } else { 1.0 } * SERIES_SHARE * tolerance;
    if motion_matters(spec.model.doppler) {
        // Echoes from all sides: 2 v/c to either.
        let turn_rad = per_m * half_s * 2.0 * across;
        let wave = |x: f64| Complex64::from_polar(1.0, -turn_rad * x);
        let (terms, rest) = terms_needed(wave, MAX_DILATION, series);
        if terms > MAX_TERMS || rest > series {
            return Err(Refusal::TooFastAcross {
                tolerance,
                across_m_per_s: across,
                turn_rad,
            });
        }
    }
    let rounding = match precision {
        Precision::Single => f32_error,
        Precision::Double => 0.0,
    };
    let error = [
        kernel_error,
        series,
        beyond_series(stretch),
        steps(stretch),
        rounding,
    ]
    .iter()
    .map(|e| e * e)
    .sum::<f64>()
    .sqrt();
    if error > tolerance {
        return Err(Refusal::TooFine { tolerance });
    }
    Ok(Choice {
        fineness: Fineness {
            stretch,
            slab_samples,
            time_width: time.width,
            slope_width: slope.width,
            time_oversampling: time.oversampling,
            time_core: time.core,
            slope_oversampling: slope.oversampling,
            moments,
            series,
            far: series * 10f64.powf(-spec.level_range_db.clamp(0.0, FARTHEST_DB) / 20.0),
            motion,
        },
        precision,
        error_model: ErrorModel {
            name: "gridded-2d",
            error,
            cost_ms: cost.ms(),
            why: format!(
                "stretches of {stretch} elements, kernels {} x {} wide on grids {} x {} dense ({kernel_error:.1e}, core {core:.2}), series to {series:.1e}, beyond them {:.1e}",
                time.width,
                slope.width,
                time.oversampling,
                slope.oversampling,
                beyond_series(stretch)
            ),
        },
        cost,
    })
}
