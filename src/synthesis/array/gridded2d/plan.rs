//! Selection of the resolution for a tolerance, and the conditions that are refused.
//!
//! The parts of the error, each relative to the echoes of a window, are: the two kernels (computed,
//! see [`Kernel::error`]); the series (each task takes as many terms as its echoes need, and
//! reports the truncation error); the fourth order of the delay along a section; attitude steps
//! between segments of a polyline; and rounding.

use std::f64::consts::{PI, TAU};

use crate::array::filter::Decimator;
use crate::array::gridded::CostEstimate;
use crate::array::gridded::kernel::Kernel;
use crate::error_model::ErrorModel;
use echotank_core::arrays::{ArrayGeometry, Pattern};
use echotank_core::model::{DopplerModel, ModelChoice, PathModel};
use echotank_core::pulse::Pulse;
use echotank_core::simd::SimdLevel;

use num_complex::Complex64;

use super::engine::{PulseMotion, Resolution};
use super::lanes::BLOCK;
use super::series::terms_needed;
use super::single_echo::{SingleEcho, noise_db};
use super::task::MAX_DILATION;

/// Section lengths to try, from long to short; long ones are cheap.
const SECTION_ELEMENTS: [usize; 6] = [128, 64, 32, 16, 8, 1];
/// Ratio of the kernel error in the worst of many windows, where echoes cancel, to its mean over
/// the band. Measured: 4.4 in 17,000 windows of a multibeam over a swath of seabed. In a window
/// that holds only the onset of a few echoes, a cancellation by this factor has a probability of
/// one over its square, 2 %.
const KERNEL_FACTOR: f64 = 7.0;
/// The same for a pulse with few degrees of freedom, times its [`Pulse::weakest_window`]
/// (measured).
const FACTOR_OF_WEAKEST: f64 = 2.25;
/// Share of the tolerance for the single-echo error of the kernel over time in any window beside
/// the echo, and for energy outside the band, which no choice reduces. It refers to the worst
/// single echo. At up to 1.25 of a tolerance, measured errors reached 0.63 of theirs.
const ALONE_SHARE: f64 = 0.6;
const BAND_SHARE: f64 = 1.25;
/// Error of f32 tables, grids and transforms relative to the strongest echo of a slab, in any
/// window (measured: 1e-7 to 2.5e-7).
const F32_ERROR: f64 = 2.5e-7;
/// f32 is used if this error, relative to the noise, is smaller than the tolerance by this factor.
const F32_ROOM: f64 = 2.5;
/// Error per m/s along the array and per Hz over metre of range (1.8e-6 at 400 kHz and 36 m). It
/// stems from third orders in slope and motion, which are taken at a column's slope (measured).
const UNDERWAY_ERROR_S_PER_M: f64 = 1.8e-6 * 36.0 / 400e3;
/// Share of the tolerance (half of it if the rest is not small) for the truncation of each series
/// in the worst corner of its spans. The error in a window is several times smaller (measured).
const SERIES_SHARE: f64 = 0.2;
/// Maximum number of terms in the series of the dilation. It leaves channels for curvature, rate
/// gradient and gain slope.
const MAX_TERMS: usize = 16;
/// f32 transforms do not reach levels further below the strongest echo of a slab than this, dB.
const FARTHEST_DB: f64 = 60.0;
/// Share of the tolerance for changes of delay and strength along a section; a shorter section
/// reduces them.
const SECTION_SHARE: f64 = 0.3;
/// Oversamplings to try: rows per used bin, and columns per cycle of the aperture relative to the
/// sampling limit. (Fewer columns need more powers along the section: 13 instead of 9 at 1.25,
/// which takes longer in total.)
const ROWS: [f64; 4] = [1.25, 1.5, 1.75, 2.0];
const COLUMNS: [f64; 3] = [1.5, 1.75, 2.0];
/// Maximum width of the kernels.
const MAX_WIDTH: usize = 14;
/// Approximate costs in nanoseconds of one core (measured at 2.7 GHz): per echo and section; per
/// grid value of an echo; per element and slab; and per element and slab for the columns of a grid
/// at twice the sampling limit. The last share is independent of the rows of the columns.
const ECHO_NS: f64 = 60.0;
const VALUE_NS: f64 = 5.0;
const RETURN_NS: f64 = 2e4;
const COLUMNS_NS: f64 = 2.2e5;
const COLUMN_SHARE: f64 = 0.7;
/// Smallest supported tolerance. The stop band of the receiver filter is 82 dB down and its alias
/// is neglected. Motion across the array leaves an error that neighbouring columns do not
/// represent.
pub(crate) const MIN_TOLERANCE: f64 = 2e-5;

/// Limits of the scene and the platform.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bounds {
    /// Smallest range of a scatterer, metres.
    pub nearest_m: f64,
    /// Sine of the largest angle from broadside.
    pub greatest_slope: f64,
    /// Largest speed along the array, m/s.
    pub along_m_per_s: f64,
    /// Largest speed across the array, m/s.
    pub across_m_per_s: f64,
    /// Largest rate of turn of the platform, rad/s; matters where the attitude steps from segment
    /// to segment.
    pub turning_rad_per_s: f64,
}

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
    /// Receiver filter. It is required, since the method needs a limited band.
    pub filter: Option<&'a Decimator>,
    /// Path and Doppler models.
    pub model: &'a ModelChoice,
    /// Limits of the scene and the platform.
    pub bounds: Bounds,
    /// Largest relative error in any window of one pulse length.
    pub tolerance: f64,
    /// Level of the weakest window below the strongest, dB.
    pub level_range_db: f64,
    /// Approximate number of samples of one element, for the cost only.
    pub samples: usize,
    /// Approximate number of scatterers, for the cost only.
    pub scatterers: usize,
    /// Instruction set of the inner loops.
    pub simd_level: SimdLevel,
}

/// Precision of grids and transforms.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Precision {
    /// f32.
    Single,
    /// f64.
    Double,
}

/// The selected resolution with its predicted error and cost.
#[derive(Clone, Debug)]
pub struct Choice {
    /// Resolution of the computation.
    pub resolution: Resolution,
    /// Precision of grids and transforms.
    pub precision: Precision,
    /// Predicted windowed error, and cost per ping.
    pub error_model: ErrorModel,
    /// Parts of the cost in the error model.
    pub cost: CostEstimate,
}

/// Requirements that `gridded-2d` does not meet.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum Refusal {
    /// The tolerance is below the smallest supported one.
    #[error("tolerance {tolerance} is below its minimum of {MIN_TOLERANCE}")]
    TooFine {
        /// Requested tolerance.
        tolerance: f64,
    },
    /// Scatterers are too close for every section length.
    #[error(
        "tolerance {tolerance} cannot be met with scatterers as near as {nearest_m} m: no section of the line is short enough"
    )]
    TooNear {
        /// Requested tolerance.
        tolerance: f64,
        /// Smallest range of a scatterer, metres.
        nearest_m: f64,
    },
    /// The platform moves too fast across the line.
    #[error(
        "tolerance {tolerance} cannot be met at {across_m_per_s} m/s across the line: the Doppler phase differs by {turn_rad:.0} rad from one side to the other"
    )]
    TooFastAcross {
        /// Requested tolerance.
        tolerance: f64,
        /// Speed across the array, m/s.
        across_m_per_s: f64,
        /// Difference in Doppler phase over the pulse between echoes from the two sides, radians.
        turn_rad: f64,
    },
    /// The Doppler model is not supported.
    #[error("doppler model `{}` is not supported: expected `none`, `stretch` or `stretch-quadratic`", .0.name())]
    Doppler(DopplerModel),
    /// The elements lie on an arc.
    #[error("an arc of elements is not supported: use gridded-lines or gridded-1d")]
    Arc,
    /// There is no receiver filter.
    #[error("the receiver filter is required: without it the band of the pulse is unlimited")]
    NoFilter,
    /// A value in [`Bounds`] is invalid.
    #[error("{what} = {value}: must be {rule}")]
    Bounds {
        /// Name of the value.
        what: &'static str,
        /// The value.
        value: f64,
        /// The rule that it breaks.
        rule: &'static str,
    },
    /// Too much energy of the pulse lies outside the sampled band.
    #[error(
        "tolerance {tolerance} cannot be met: energy of the pulse's ends outside the sampled band causes an error of {share:.1e} in some window; use a longer taper or `direct`"
    )]
    OutOfBand {
        /// Requested tolerance.
        tolerance: f64,
        /// Relative error in the worst window.
        share: f64,
    },
    /// The longest slab is too short for the pulse.
    #[error("a slab of {samples} samples at {rate_hz} Hz is too short for the pulse")]
    SlabTooShort {
        /// Sample rate, Hz.
        rate_hz: f64,
        /// Length of the longest slab, samples.
        samples: usize,
    },
}

/// Range of slab lengths to try, samples.
const MIN_SLAB: usize = 256;
const MAX_SLAB: usize = 1 << 16;
/// Smallest slab length relative to the time that its last echo, with the filter, lasts beyond it.
const MAX_SPENT: f64 = 3.0;
/// Share of the tolerance for the piecewise linear approximation of templates, and its limit
/// relative to the noise. The approximation causes images of the echo one block's time and more to
/// either side, where the echo may have no energy.
const STRAIGHT_SHARE: f64 = 0.1;
const STRAIGHT_BESIDE: f64 = 5.6;
/// Fixed cost of a slab, in samples (templates, bases of channels; measured).
const TASK_SAMPLES: f64 = 64.0;
/// Largest cost of a slab length relative to the cheapest one. The margin gives enough tasks to
/// balance a few threads.
const SLAB_SLACK: f64 = 1.1;
const TASKS: f64 = 8.0;
/// Length of a receiver filter that is not known yet, seconds.
const FILTER_S: f64 = 2e-3;

/// A candidate kernel: its width, its grid, the part of the band that it is designed for, and its
/// error in the worst of many windows.
#[derive(Clone, Copy)]
struct Fit {
    width: usize,
    oversampling: f64,
    core: f64,
    error: f64,
}

/// The first candidate that is accurate enough, and the next one, which leaves more error to the
/// other kernel.
fn two_that(fits: impl Iterator<Item = Fit>, fine: impl Fn(&Fit) -> bool) -> [Option<Fit>; 2] {
    let mut fine = fits.skip_while(|fit| !fine(fit));
    [fine.next(), fine.next()]
}

/// Exponent of the frequency with which the inverse of the kernel's spectrum grows at the end of
/// its band.
fn edge_power(kernel: &Kernel) -> f64 {
    const STEP: f64 = 1e-3;
    let edge = 0.5 / kernel.oversampling;
    let log = |share: f64| libm::log(kernel.window_gain(edge * share));
    (log(1.0 - STEP) - log(1.0 + STEP)) / (2.0 * STEP)
}

/// Whether the Doppler model stretches echoes.
fn motion_matters(doppler: DopplerModel) -> bool {
    doppler != DopplerModel::None
}

/// Length of the slabs in samples, and their approximate number. Among lengths near the minimum
/// cost it takes the one with the most slabs, to balance the threads.
///
/// `half_m`: half the length of a section; `turned_rad`: phase that the templates follow.
fn slabs(
    spec: &Spec,
    sections: usize,
    half_m: f64,
    turned_rad: f64,
) -> Result<(usize, f64), Refusal> {
    let rate_hz = spec.sample_rate_hz;
    // Echoes that begin near the end of a slab last beyond it. The filter and the time difference
    // to the ends of a section add to both sides.
    let filter_s = spec.filter.map_or(FILTER_S, |filter| 2.0 * filter.half_s());
    let beside_s = filter_s + 2.0 * half_m / spec.sound_speed_m_per_s;
    let spent = rate_hz * (spec.pulse.duration_s + beside_s) + 2.0;
    // Templates are linear over a block of frequencies. The error is the square of half the phase
    // over half a block.
    let beside = STRAIGHT_BESIDE * 10f64.powf(-noise_db(spec.level_range_db) / 20.0);
    let straight_rad = (2.0 * beside.min(STRAIGHT_SHARE) * spec.tolerance).sqrt();
    let per_bin = 0.5 * BLOCK as f64 * rate_hz / spec.pulse.center_frequency_hz;
    let straight = per_bin * turned_rad / straight_rad;
    let silent = rate_hz * 2.0 * spec.bounds.nearest_m / spec.sound_speed_m_per_s;
    let active = (spec.samples as f64 - silent).max(1.0) + spent;
    let sizes = (MIN_SLAB..=MAX_SLAB).step_by(BLOCK).filter(|size| {
        let odd = size >> size.trailing_zeros();
        [1, 3, 5].contains(&odd) && *size as f64 >= straight.max(MAX_SPENT * spent)
    });
    let sized = sizes.map(|size| {
        let slabs = (active / (size as f64 - spent)).ceil();
        (size, slabs, slabs * (size as f64 + TASK_SAMPLES))
    });
    let least = sized
        .clone()
        .map(|(_, _, cost)| cost)
        .fold(f64::INFINITY, f64::min);
    let enough = |&(_, slabs, _): &(usize, f64, f64)| slabs * sections as f64 >= TASKS;
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

/// Selects the cheapest resolution that keeps the tolerance.
///
/// Returns a [`Refusal`] if there is none.
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
    if array.radius_m.is_some() {
        return Err(Refusal::Arc);
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
    // Largest rate of change of an echo's strength with the viewing angle along the line.
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
    let along_section = |section_elements: usize| {
        let half_m = 0.5 * (section_elements.min(array.elements) - 1) as f64 * array.spacing_m;
        let quartic = per_m * half_m.powi(4) / (8.0 * bounds.nearest_m.powi(3));
        let turned = (1.0 + PI * sides) * half_m / bounds.nearest_m;
        quartic + turned.powi(3) / 6.0
    };
    let beyond_series = |section_elements: usize| along_section(section_elements) + underway;
    // The attitude of a polyline steps at its vertices. While the wave passes the section, a part
    // of the section lies on either side of a step.
    let steps = |section_elements: usize| match spec.model.path {
        PathModel::Polyline => {
            let half_m = 0.5 * (section_elements.min(array.elements) - 1) as f64 * array.spacing_m;
            let step_rad = per_m * half_m * bounds.turning_rad_per_s * spec.model.segment_s;
            let passes_s = 2.0 * half_m * bounds.greatest_slope / sound_speed_m_per_s;
            let share = passes_s / spec.model.segment_s.min(pulse.duration_s);
            step_rad * share.min(1.0).sqrt()
        }
        _ => 0.0,
    };
    // All other parts add up to at most four fifths of the tolerance, squared.
    let share = if tolerance < 1e-4 { 0.9 } else { 0.3 } * tolerance;
    let section_elements = SECTION_ELEMENTS
        .into_iter()
        .find(|&section_elements| {
            along_section(section_elements) <= SECTION_SHARE * tolerance
                && beyond_series(section_elements) <= share
                && steps(section_elements) <= share
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
    // If the rest is not small either, the kernels leave it a share.
    let kernel_share = if tolerance < 1e-4 { 0.42 } else { 0.78 };
    let sections = array.elements.div_ceil(section_elements);
    let half_m = 0.5 * (section_elements.min(array.elements) - 1) as f64 * array.spacing_m;
    let curvature_rad = 0.5 * per_m * half_m * half_m / bounds.nearest_m;
    let across_rad = match motion_matters(spec.model.doppler) {
        true => per_m * half_s * 2.0 * across,
        false => 0.0,
    };
    let echoes = (spec.scatterers * sections) as f64;
    let factor = (FACTOR_OF_WEAKEST / pulse.weakest_window(rate_hz)).max(KERNEL_FACTOR);
    // Few values per echo on a dense grid, or more values on a coarse grid: many echoes favour the
    // dense grid.
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
    // Motion carries a section beyond its ends. There the column's spectrum differs from that at
    // the end, where it is divided out, by a power of the frequency.
    let drift_m = match motion_matters(spec.model.doppler) {
        true => pulse.duration_s * (bounds.along_m_per_s + across),
        false => 0.0,
    };
    let reach_m = (half_m + drift_m).max(0.25 * sound_speed_m_per_s / pulse.center_frequency_hz);
    let power = |fit: Fit| edge_power(&Kernel::new(fit.width, fit.oversampling, moments));
    let power = slopes.into_iter().flatten().flatten().map(power);
    let power = power.fold(0.0, f64::max) * drift_m / reach_m;
    let turned_rad = (curvature_rad + across_rad).hypot(power);
    let (slab_samples, slabs) = slabs(spec, sections, half_m, turned_rad)?;
    let element_slabs = array.elements as f64 * slabs;
    // Over time, also beside echoes; exact where the pulse has energy.
    let alone = spec.filter.map(|filter| {
        let doppler = match motion_matters(spec.model.doppler) {
            true => 2.0 * bounds.along_m_per_s.hypot(across) / sound_speed_m_per_s,
            false => 0.0,
        };
        SingleEcho::new(pulse, rate_hz, filter, doppler, spec.level_range_db)
    });
    let core = alone.as_ref().map_or(1.0, SingleEcho::core);
    let times = ROWS.map(|oversampling| {
        let fits = (2..=MAX_WIDTH).map(|width| {
            let kernel = Kernel::new(width, oversampling / core, moments);
            let error = |alone: &SingleEcho| {
                let [whole, beside] = alone.kernel(&kernel, core);
                (whole.max(kernel.error) * factor).max(beside * room / (ALONE_SHARE * tolerance))
            };
            Fit {
                width,
                oversampling,
                core,
                // Skips the single-echo error if the kernel error is already too large.
                error: match kernel.error * factor <= room {
                    true => alone.as_ref().map_or(kernel.error * factor, error),
                    false => f64::INFINITY,
                },
            }
        });
        two_that(fits, |fit| fit.error <= room)
    });
    let share = alone.as_ref().map_or(0.0, SingleEcho::beyond_band);
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
        beyond_series(section_elements),
        steps(section_elements),
        rounding,
    ]
    .iter()
    .map(|e| e * e)
    .sum::<f64>()
    .sqrt();
    if error > tolerance {
        return Err(Refusal::TooFine { tolerance });
    }
    if array.radius_m.is_some() {
        return Err(Refusal::Arc);
    }
    Ok(Choice {
        resolution: Resolution {
            section_elements,
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
                "sections of {section_elements} elements, kernels {} x {} wide on grids {} x {} dense ({kernel_error:.1e}, core {core:.2}), series to {series:.1e}, beyond them {:.1e}",
                time.width,
                slope.width,
                time.oversampling,
                slope.oversampling,
                beyond_series(section_elements)
            ),
        },
        cost,
    })
}
