//! `gridded-1d` for whole records: long ones of few elements in slabs, each from the echoes that overlap it.
//!
//! So few elements keep all threads at work, and what echoes are added up on stays in the nearer caches. Of many elements nothing is gained, and batches
//! of scatterers that overlap two slabs are walked twice (the quickstart's 48 elements took a fifth longer). How many slabs depends on elements and
//! on the lengths of record, pulse and filter alone, so that bits do not depend on threads.

use std::sync::{Mutex, PoisonError};

use num_complex::Complex64;

use crate::array::filter::{Decimator, grid_ahead};
use crate::array::gridded::{
    CostEstimate, DopplerSpan, Gridded1d, Gridded1dWork, GriddedError, one_dimensional,
};
use crate::echo::{Slab, TransmitLeg, Window, Workspace, arrivals_of_slab};
use echotank_core::flow::{ArrayGeometry, EchoCounts, ErrorModel, PingPlan};

/// A slab is so many echoes long at least, since what overlaps its ends is made twice; and a record has so many slabs at most.
const SLAB_ECHOES: f64 = 10.0;
const MAX_SLABS: usize = 4;
/// Arrays of more elements are made without.
const FEW_ELEMENTS: usize = 8;

/// An engine for the slabs of records, without its work: for its error model and cost.
pub struct Sketch {
    engine: Gridded1d,
    /// Of a slab, at most; and how many there are.
    samples: usize,
    slabs: usize,
    /// Of an echo, the filter's tails included.
    echo_samples: f64,
    sample_rate_hz: f64,
    filter: Option<Decimator>,
}

impl Sketch {
    /// For records of `spec.samples` at most, of arrays of so many `elements`.
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

    /// Predicted error, and milliseconds of one core per element.
    pub fn error_model(&self) -> ErrorModel {
        let mut error_model = self.engine.error_model().clone();
        if self.slabs > 1 {
            error_model.cost_ms *= self.slabs as f64;
            error_model.why += &format!(", of each of {} slabs", self.slabs);
        }
        error_model
    }

    /// As [`Gridded1d::cost_estimate`], of whole records.
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

    /// With work for so many threads.
    pub fn made(self, threads: usize) -> Made {
        Made {
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

/// An engine with its work for every thread of the pool.
pub struct Made {
    error_model: ErrorModel,
    samples: usize,
    sample_rate_hz: f64,
    filter: Option<Decimator>,
    work: Vec<Mutex<Gridded1dWork>>,
}

/// One element in one ping.
#[derive(Clone, Copy)]
pub struct Listener<'a> {
    pub plan: &'a PingPlan,
    pub array: &'a ArrayGeometry,
    pub element: usize,
    pub transmit_leg: &'a TransmitLeg,
    /// Of this ping's echoes.
    pub span: DopplerSpan,
}

impl Made {
    /// See [`Sketch::error_model`].
    pub fn error_model(&self) -> &ErrorModel {
        &self.error_model
    }

    /// Samples of a slab; the last of a record may have fewer.
    pub fn slab_samples(&self) -> usize {
        self.samples
    }

    /// Overwrites `out`, the slab of a record with this number.
    pub fn make_slab(
        &self,
        listener: Listener,
        slab: usize,
        walk: &mut Workspace,
        out: &mut [Complex64],
    ) -> EchoCounts {
        let Listener {
            plan,
            array,
            element,
            transmit_leg,
            span,
        } = listener;
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
        // A panic in another ping leaves the work as good as any: every use begins anew.
        let mut work = self.work[thread]
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        work.start(first_s, span);
        let mut counts =
            arrivals_of_slab(plan, array, element, transmit_leg, slab, walk, &mut *work);
        // Of two slabs that hear an echo both count it here.
        counts.beyond_engine = work.finish(out).outside_span;
        counts
    }
}
