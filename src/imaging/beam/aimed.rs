//! A line array aimed at the directions of a fan: what every former of a fan has in common.

use num_complex::Complex64;

use super::RowLimits;
use super::directions::{Directions, widths_rad};
use super::matched::Correlator;
use super::weights;
use echotank_config::spec::{FanSpec, Shading};
use echotank_core::flow::{ArrayGeometry, BeamFrame, ElementFrame, PingPlan, Pulse};

/// Silence between row ends, over twice the travel time along the array, in samples: room for the tails of delays made in the frequency domain.
const GUARD_SAMPLES: usize = 32;

/// Pulse, water and directions of the ping at hand.
pub(super) struct Aimed {
    array: usize,
    spacing_m: f64,
    /// Over elements, sum 1.
    pub(super) weights: Vec<f64>,
    pub(super) directions: Directions,
    width_rad: Vec<f64>,
    pub(super) sound_speed_m_per_s: f64,
    pub(super) correlator: Correlator,
}

impl Aimed {
    /// `array` is the receive array that `fan` names; `silence` samples behind each row.
    ///
    /// Panics on an empty fan or array or a pulse beyond `limits`: they come from a checked configuration.
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
        let mut aimed = Self {
            array: fan.array,
            spacing_m: array.spacing_m,
            weights,
            directions: Directions::new(array, fan),
            width_rad: vec![0.0; fan.beams],
            sound_speed_m_per_s,
            correlator: Correlator::new(pulse, limits, silence, weighting),
        };
        aimed.measure_widths();
        aimed
    }

    /// Silence for delays that are made in the frequency domain: what leaves a row at one end does not come in at the other.
    pub(super) fn far_field_silence(
        array: &ArrayGeometry,
        limits: &RowLimits,
        sound_speed_m_per_s: f64,
    ) -> usize {
        let length_m = array.spacing_m * (array.elements - 1) as f64;
        let travel = (length_m / sound_speed_m_per_s * limits.sample_rate_hz).ceil() as usize;
        2 * travel + GUARD_SAMPLES
    }

    /// Only these elements, about the whole line's centre.
    pub(super) fn hear_with(&mut self, part: &std::ops::Range<usize>) {
        for (e, w) in self.weights.iter_mut().enumerate() {
            if !part.contains(&e) {
                *w = 0.0;
            }
        }
        normalise(&mut self.weights);
        self.measure_widths();
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

    /// Takes over the ping's pulse, sound speed and roll, and makes room for its beams; `out` grows once to the largest size.
    ///
    /// Panics on the elements of another array or more samples than the limits allow.
    pub(super) fn begin(&mut self, plan: &PingPlan, frame: &ElementFrame, out: &mut BeamFrame) {
        assert!(
            frame.array == self.array && frame.elements == self.elements(),
            "elements of another array"
        );
        let most = self.correlator.limits().samples;
        assert!(
            frame.samples <= most,
            "row of {} samples, sized for {most}",
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
        let beams = self.beams();
        out.beams = beams;
        out.samples = frame.samples;
        out.angle_rad.clone_from(&self.directions.angle_rad);
        out.width_rad.clone_from(&self.width_rad);
        out.iq
            .reserve_exact((beams * most).saturating_sub(out.iq.len()));
        out.iq.resize(beams * frame.samples, Complex64::ZERO);
    }

    fn measure_widths(&mut self) {
        let spacing = self.spacing_m / self.wavelength_m();
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

/// The frequencies of the rows' transform.
pub(super) struct Band {
    pub(super) length: usize,
    pub(super) center_hz: f64,
    pub(super) step_hz: f64,
}

impl Band {
    /// In the water, for bin `k`; the upper half of the bins lies below the centre.
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
