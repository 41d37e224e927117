//! An array steered to the directions of a fan: the part that all fan formers share.

use echotank_fft::Planned;

use super::RowLimits;
use super::delay_sum::ArcApertures;
use super::directions::{Directions, widths_rad};
use super::matched::Correlator;
use super::weights;
use echotank_config::spec::{FanSpec, Shading};
use echotank_core::arrays::ArrayGeometry;
use echotank_core::ping::{BeamFrame, ElementFrame, PingPlan};
use echotank_core::pulse::Pulse;

/// Zeros between row ends beyond twice the travel time along the array, samples: room for the tails of delays applied in the frequency
/// domain.
const GUARD_SAMPLES: usize = 32;

/// Pulse, sound speed and directions of the current ping; `T` is the number type of the matched filter.
pub(super) struct SteeredArray<T: Planned = f64> {
    array: usize,
    spacing_m: f64,
    /// Element weights; their sum is 1.
    pub(super) weights: Vec<f64>,
    /// Of an arc: the elements and weights of each beam, in place of `weights`.
    pub(super) arc: Option<ArcApertures>,
    pub(super) directions: Directions,
    width_rad: Vec<f64>,
    pub(super) sound_speed_m_per_s: f64,
    pub(super) correlator: Correlator<T>,
}

impl<T: Planned> SteeredArray<T> {
    /// `array` is the receive array that `fan` names. Each row is followed by `silence` zeros.
    ///
    /// Panics on a fan without beams, an array without elements or a pulse beyond `limits`; a checked configuration prevents these.
    pub(super) fn new(
        array: &ArrayGeometry,
        fan: &FanSpec,
        (limits, silence): (RowLimits, usize),
        pulse: &Pulse,
        weighting: Shading,
        sound_speed_m_per_s: f64,
    ) -> Self {
        assert!(
            fan.beams > 0 && array.elements > 0,
            "a fan needs beams and elements"
        );
        let mut weights = vec![0.0; array.elements];
        weights::fill(fan.shading, &mut weights);
        normalise(&mut weights);
        let mut steered = Self {
            array: fan.array,
            spacing_m: array.spacing_m,
            weights,
            arc: ArcApertures::new(array, fan),
            directions: Directions::new(array, fan),
            width_rad: vec![0.0; fan.beams],
            sound_speed_m_per_s,
            correlator: Correlator::new(pulse, limits, silence, weighting),
        };
        steered.measure_widths();
        steered
    }

    /// As [`SteeredArray::new`], with the zeros that delays in the frequency domain need: samples shifted past one end of a row do not wrap
    /// to the other.
    pub(super) fn far_field(
        array: &ArrayGeometry,
        fan: &FanSpec,
        limits: RowLimits,
        pulse: &Pulse,
        weighting: Shading,
        sound_speed_m_per_s: f64,
    ) -> Self {
        let c = sound_speed_m_per_s;
        let length_m = array.spacing_m * (array.elements - 1) as f64;
        let travel = (length_m / c * limits.sample_rate_hz).ceil() as usize;
        let silence = 2 * travel + GUARD_SAMPLES;
        Self::new(array, fan, (limits, silence), pulse, weighting, c)
    }

    pub(super) fn array(&self) -> usize {
        self.array
    }

    pub(super) fn elements(&self) -> usize {
        self.weights.len()
    }

    pub(super) fn beams(&self) -> usize {
        self.directions.sine.len()
    }

    pub(super) fn spacing_m(&self) -> f64 {
        self.spacing_m
    }

    pub(super) fn wavelength_m(&self) -> f64 {
        self.sound_speed_m_per_s / self.correlator.pulse().center_frequency_hz
    }

    /// Sets the ping's pulse, sound speed and roll.
    ///
    /// Panics on a frame of another array or on more samples than the limits allow.
    pub(super) fn begin(&mut self, plan: &PingPlan, frame: &ElementFrame) {
        assert!(
            frame.array == self.array && frame.elements == self.elements(),
            "the frame belongs to another array"
        );
        let max_samples = self.correlator.limits().samples;
        assert!(
            frame.samples <= max_samples,
            "row of {} samples, sized for {max_samples}",
            frame.samples
        );
        let tuned_hz = self.correlator.pulse().center_frequency_hz;
        self.correlator.set_pulse(&plan.pulse);
        let turned = self.directions.aim(plan);
        if turned
            || plan.sound_speed_m_per_s != self.sound_speed_m_per_s
            || plan.pulse.center_frequency_hz != tuned_hz
        {
            self.sound_speed_m_per_s = plan.sound_speed_m_per_s;
            self.measure_widths();
        }
    }

    /// Sizes `out` for the fan's beams; it grows once to its maximum size.
    pub(super) fn size(&self, samples: usize, out: &mut BeamFrame) {
        out.beams = self.beams();
        out.samples = samples;
        out.angle_rad.clone_from(&self.directions.angle_rad);
        out.width_rad.clone_from(&self.width_rad);
        self.size_samples(samples, &mut out.iq);
    }

    /// Sizes a row of `samples` for each beam; `rows` grows once to its maximum size.
    pub(super) fn size_samples<S: Clone + Default>(&self, samples: usize, rows: &mut Vec<S>) {
        let max = self.beams() * self.correlator.limits().samples;
        rows.reserve_exact(max.saturating_sub(rows.len()));
        rows.resize(self.beams() * samples, S::default());
    }

    fn measure_widths(&mut self) {
        let wavelength_m = self.wavelength_m();
        if let Some(arc) = &mut self.arc {
            arc.aim(&self.directions.sine);
            arc.widths_rad(wavelength_m, &mut self.width_rad);
            return;
        }
        let spacing = self.spacing_m / wavelength_m;
        let sines = &self.directions.sine;
        widths_rad(&self.weights, spacing, sines, &mut self.width_rad);
    }

    pub(super) fn band(&self) -> Band {
        let length = self.correlator.length();
        Band {
            length,
            center_hz: self.correlator.pulse().center_frequency_hz,
            step_hz: self.correlator.limits().sample_rate_hz / length as f64,
        }
    }
}

/// Frequencies of the rows' transform.
pub(super) struct Band {
    pub(super) length: usize,
    pub(super) center_hz: f64,
    pub(super) step_hz: f64,
}

impl Band {
    /// Acoustic frequency of bin `k`; the upper half of the bins lies below the centre frequency.
    pub(super) fn frequency_hz(&self, k: usize) -> f64 {
        let bin = match k < self.length / 2 {
            true => k as f64,
            false => k as f64 - self.length as f64,
        };
        self.center_hz + bin * self.step_hz
    }
}

fn normalise(weights: &mut [f64]) {
    let sum: f64 = weights.iter().sum();
    for w in weights {
        *w /= sum;
    }
}
