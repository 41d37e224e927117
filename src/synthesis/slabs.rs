//! Engine `gridded-1d` applied to records in slabs.
//!
//! A long record of a few elements is divided into slabs along time. Each slab is synthesised from
//! the echoes that overlap it. All threads are then busy when there are fewer elements than
//! threads, and the grids stay in the inner caches. Arrays with many elements use one slab, because
//! the walk visits batches that overlap two slabs twice.
//!
//! The number of slabs depends only on the element count and on the lengths of record, pulse and
//! filter. The output bits therefore do not depend on the thread count.

use std::sync::{Mutex, PoisonError};

use num_complex::Complex64;

use crate::array::echo_profile::EchoProfile;
use crate::array::filter::{Decimator, grid_ahead};
use crate::array::gridded::{
    CostEstimate, DopplerSpan, Gridded1d, Gridded1dWork, GriddedError, LEVELS, one_dimensional,
};
use crate::echo::{Slab, TransmitLeg, Window, Workspace, arrivals_of_slab};
use crate::error_model::ErrorModel;
use echotank_core::arrays::ArrayGeometry;
use echotank_core::ping::{EchoCounts, PingPlan};

/// Minimum length of a slab in echo lengths. Echoes that overlap a slab boundary are synthesised
/// twice, so short slabs are inefficient.
const SLAB_ECHOES: f64 = 10.0;
/// Maximum number of slabs in a record.
const MAX_SLABS: usize = 4;
/// Maximum number of elements of an array with several slabs.
const FEW_ELEMENTS: usize = 8;

/// Design of the slab engine without its buffers, for the prediction of error and cost.
pub struct SlabDesign {
    engine: Gridded1d,
    /// Number of samples of the longest slab.
    samples: usize,
    /// Number of slabs in a record.
    slabs: usize,
    /// Length of an echo in samples, including both filter tails.
    echo_samples: f64,
    sample_rate_hz: f64,
    filter: Option<Decimator>,
}

impl SlabDesign {
    /// Designs slabs for arrays of `elements` elements and records of at most `spec.samples`
    /// samples.
    ///
    /// Returns an error under the same conditions as [`Gridded1d::new`].
    pub fn new(spec: &one_dimensional::Spec, elements: usize) -> Result<Self, GriddedError> {
        let filter_s = spec.filter.map_or(0.0, |filter| 2.0 * filter.half_s());
        let echo_samples = spec.sample_rate_hz * (spec.pulse.duration_s + filter_s);
        let slabs = spec.samples as f64 / (SLAB_ECHOES * echo_samples).max(1.0);
        let most = if elements <= FEW_ELEMENTS {
            MAX_SLABS
        } else {
            1
        };
        let slabs = (slabs as usize).clamp(1, most);
        let samples = spec.samples.div_ceil(slabs);
        let engine = Gridded1d::new(&one_dimensional::Spec {
            samples,
            arrivals: spec.arrivals / slabs,
            ..*spec
        })?;
        Ok(Self {
            engine,
            samples,
            slabs,
            echo_samples,
            sample_rate_hz: spec.sample_rate_hz,
            filter: spec.filter.cloned(),
        })
    }

    /// Predicted error, and cost in milliseconds of one core per element.
    pub fn error_model(&self) -> ErrorModel {
        let mut error_model = self.engine.error_model().clone();
        if self.slabs > 1 {
            error_model.cost_ms *= self.slabs as f64;
            error_model.why += &format!(", of each of {} slabs", self.slabs);
        }
        error_model
    }

    /// Predicted error of a single echo; see [`Gridded1d::single_echo_error`].
    pub fn single_echo_error(&self) -> f64 {
        self.engine.single_echo_error()
    }

    /// By the levels of windows; see [`Gridded1d::single_echo_errors`].
    pub fn single_echo_errors(&self) -> [f64; LEVELS] {
        self.engine.single_echo_errors()
    }

    /// Mean error over echoes; see [`Gridded1d::mean_error`].
    pub fn mean_error(&self) -> f64 {
        self.engine.mean_error()
    }

    /// Error of curved echoes; see [`Gridded1d::curvature_error`].
    pub fn curvature_error(&self) -> [f64; 2] {
        self.engine.curvature_error()
    }

    /// Error that spreads over the record; see [`Gridded1d::spread_error`].
    pub fn spread_error(&self) -> f64 {
        self.engine.spread_error()
    }

    /// An echo with its error; see [`Gridded1d::echo_at_rest`].
    pub fn echo_at_rest(&self) -> Option<&EchoProfile> {
        self.engine.echo_at_rest()
    }

    /// Cost of a whole record; see [`Gridded1d::cost_estimate`] for the arguments.
    pub fn cost_estimate(&self, arrivals: usize, share: f64, curvature_per_s: f64) -> CostEstimate {
        let (samples, count) = (self.samples as f64, self.slabs as f64);
        let overlapping = match self.slabs {
            1 => 1.0,
            _ => (samples + self.echo_samples) / samples,
        };
        let in_slab = (arrivals as f64 * overlapping / count).ceil() as usize;
        let of_slab = self.engine.cost_estimate(in_slab, share, curvature_per_s);
        CostEstimate {
            echoes_ns: count * of_slab.echoes_ns,
            grids_ns: count * of_slab.grids_ns,
        }
    }

    /// Allocates the buffers of `threads` threads.
    pub fn build(self, threads: usize) -> SlabEngine {
        SlabEngine {
            error_model: self.error_model(),
            work: (0..threads)
                .map(|_| Mutex::new(self.engine.work()))
                .collect(),
            samples: self.samples,
            sample_rate_hz: self.sample_rate_hz,
            filter: self.filter,
        }
    }
}

/// Slab engine with buffers for every thread of the pool.
pub struct SlabEngine {
    error_model: ErrorModel,
    samples: usize,
    sample_rate_hz: f64,
    filter: Option<Decimator>,
    work: Vec<Mutex<Gridded1dWork>>,
}

/// Element and ping of a slab.
#[derive(Clone, Copy)]
pub struct PingElement<'a> {
    /// Geometry, pulse and model of the ping.
    pub plan: &'a PingPlan,
    /// Receive array of the element.
    pub array: &'a ArrayGeometry,
    /// Index of the element in `array`.
    pub element: usize,
    /// Insonified scatterers of the ping.
    pub transmit_leg: &'a TransmitLeg,
    /// Range of the Doppler stretches of this ping's echoes.
    pub span: DopplerSpan,
}

impl SlabEngine {
    /// Predicted error and cost; see [`SlabDesign::error_model`].
    pub fn error_model(&self) -> &ErrorModel {
        &self.error_model
    }

    /// Samples of a slab. The last slab of a record may be shorter.
    pub fn slab_samples(&self) -> usize {
        self.samples
    }

    /// Overwrites `out` with slab number `slab` of the record.
    pub fn synthesise_slab(
        &self,
        target: PingElement,
        slab: usize,
        walk: &mut Workspace,
        out: &mut [Complex64],
    ) -> EchoCounts {
        let PingElement {
            plan,
            array,
            element,
            transmit_leg,
            span,
        } = target;
        let [first, end] = [slab * self.samples, slab * self.samples + out.len()];
        let at_s = |sample: usize| plan.first_sample_s + sample as f64 / self.sample_rate_hz;
        let first_s = at_s(first);
        let filter = self.filter.as_ref();
        let (ahead_s, dense_hz, count) =
            grid_ahead(filter, first_s, self.sample_rate_hz, out.len());
        let window = Window::of_samples(ahead_s, dense_hz, count);
        let begins_s = match first {
            0 => f64::NEG_INFINITY,
            _ => first_s,
        };
        let ends_s = match end < plan.sample_count {
            true => at_s(end),
            false => f64::INFINITY,
        };
        let slab = Slab {
            window,
            own_s: (begins_s, ends_s),
        };
        let thread = rayon::current_thread_index().unwrap_or(0);
        // The lock may be poisoned by a panic in another ping. The buffers remain valid, because
        // `start` resets them.
        let mut work = self.work[thread]
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        work.start(first_s, span);
        let mut counts =
            arrivals_of_slab(plan, array, element, transmit_leg, slab, walk, &mut *work);
        // Two slabs that share an echo both count it here.
        counts.beyond_engine = work.finish(out).outside_span;
        counts
    }
}
