//! Single-beam side-scan: the whole aperture of one side forms one broadside beam, one line per ping.

use num_complex::Complex64;

use super::RowLimits;
use super::delay_sum::DelaySumFormer;
use super::matched::MatchedFilter;
use super::work::broadside;
use echotank_config::spec::{LineSpec, Shading, SonarSpec};
use echotank_core::ping::{BeamFrame, ElementFrame, Line, PingPlan, Side};
use echotank_core::pulse::Pulse;

/// Forms the line of one side: mean of the elements, matched filter, envelope.
///
/// A unit plane wave from broadside peaks at 1 where its leading edge meets the array's centre.
pub struct LineFormer {
    side: Side,
    array: usize,
    limits: RowLimits,
    filter: MatchedFilter,
    sum: Vec<Complex64>,
    focus: Option<Focused>,
}

/// One broadside beam with dynamic focus along range.
struct Focused {
    former: DelaySumFormer,
    beam: BeamFrame,
}

impl LineFormer {
    /// Panics if the pulse exceeds `limits`; a checked configuration prevents this.
    pub fn new(line: &LineSpec, limits: RowLimits, pulse: &Pulse) -> Self {
        Self::weighted(line, limits, pulse, Shading::Uniform)
    }

    /// The line as `spec` configures it, with its weighting: with dynamic focus, which includes the motion of the receiver, or without.
    ///
    /// # Panics
    /// As [`LineFormer::new`].
    pub fn of_sonar(
        spec: &SonarSpec,
        line: &LineSpec,
        limits: RowLimits,
        sound_speed_m_per_s: f64,
    ) -> Self {
        let (pulse, beams) = (&spec.pulse, &spec.beams);
        if !beams.focused_lines {
            return Self::weighted(line, limits, pulse, beams.weighting);
        }
        let array = &spec.receive[line.array];
        let transmit = &spec.transmit[array.transmit];
        let broadside = broadside(spec, line);
        let (c, weighting) = (sound_speed_m_per_s, beams.weighting);
        let former = DelaySumFormer::new(array, transmit, &broadside, limits, pulse, weighting, c);
        Self {
            focus: Some(Focused {
                former,
                beam: BeamFrame::default(),
            }),
            ..Self::weighted(line, limits, pulse, weighting)
        }
    }

    /// `weighting` is applied along the pulse.
    fn weighted(line: &LineSpec, limits: RowLimits, pulse: &Pulse, weighting: Shading) -> Self {
        Self {
            side: line.side,
            array: line.array,
            limits,
            filter: MatchedFilter::new(pulse, limits, weighting),
            sum: vec![Complex64::ZERO; limits.samples],
            focus: None,
        }
    }

    /// Side of the line.
    pub fn side(&self) -> Side {
        self.side
    }

    /// Index of the line's receive array.
    pub fn array(&self) -> usize {
        self.array
    }

    /// Forms the line of one ping. `frame` holds the samples of the line's array; `out` grows once and is reused.
    ///
    /// Sample 0 of a line is the start of the pulse, to the nearest sample. If the element samples begin later, the line begins with zeros;
    /// element samples before the pulse are dropped.
    pub fn form(&mut self, plan: &PingPlan, frame: &ElementFrame, out: &mut Line) {
        assert_eq!(
            frame.array, self.array,
            "the frame belongs to another array"
        );
        assert!(
            frame.samples <= self.limits.samples,
            "row of {} samples, sized for {}",
            frame.samples,
            self.limits.samples
        );
        let sum = &mut self.sum[..frame.samples];
        if let Some(focus) = &mut self.focus {
            focus.former.form(plan, frame, &mut focus.beam);
            for (s, y) in sum.iter_mut().zip(focus.beam.beam(0)) {
                *s = Complex64::new(y.re.into(), y.im.into());
            }
        } else {
            sum.fill(Complex64::ZERO);
            let weight = 1.0 / frame.elements as f64;
            for e in 0..frame.elements {
                for (s, x) in sum.iter_mut().zip(frame.element(e)) {
                    *s += x * weight;
                }
            }
            self.filter.set_pulse(&plan.pulse);
            self.filter.apply(sum);
        }

        let lead = (plan.first_sample_s * self.limits.sample_rate_hz).round();
        let silent = lead.max(0.0) as usize;
        let before = ((-lead).max(0.0) as usize).min(frame.samples);
        out.side = self.side;
        out.amplitude.clear();
        out.amplitude.reserve_exact(silent + self.limits.samples);
        out.amplitude.resize(silent, 0.0);
        out.amplitude
            .extend(sum[before..].iter().map(|y| y.norm() as f32));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::beam::test_rig::{self, C, array, elements_of_plane_wave, limits};
    use echotank_core::pulse::PulseKind;
    use echotank_core::testing::plan_at_rest as plan;

    fn pulse() -> Pulse {
        test_rig::pulse(PulseKind::LfmUp, 30e3, 5e-3, 0.0)
    }

    fn former(side: Side, samples: usize) -> LineFormer {
        LineFormer::new(
            &LineSpec { side, array: 0 },
            limits(40e3, samples, 5e-3),
            &pulse(),
        )
    }

    fn empty() -> Line {
        Line {
            side: Side::Port,
            amplitude: Vec::new(),
        }
    }

    #[test]
    fn a_unit_echo_from_broadside_peaks_at_one_on_its_leading_edge() {
        let array = array(20, 0.01, 0.0);
        let frame = elements_of_plane_wave(&array, 40e3, 1000, |_| (pulse(), 500.0 / 40e3));
        let mut line = empty();
        former(Side::Starboard, 1200).form(&plan(&pulse(), 1000, C), &frame, &mut line);
        assert_eq!((line.side, line.amplitude.len()), (Side::Starboard, 1000));
        // Rounding may exclude the last of the pulse's 201 samples.
        assert!((line.amplitude[500] - 1.0).abs() < 0.006);
        assert!(
            line.amplitude
                .iter()
                .enumerate()
                .all(|(k, &a)| k == 500 || a < 0.95)
        );
    }

    #[test]
    fn an_echo_off_broadside_has_the_level_of_the_dirichlet_kernel() {
        // 0.2 m: null and flank of the first side lobe, narrow-band at a relative bandwidth of 0.1 %.
        let array = array(20, 0.01, 0.0);
        let cw = test_rig::pulse(PulseKind::Cw, 0.0, 5e-3, 0.0);
        for sine in [0.0, 0.004, 0.01, 0.028] {
            let frame = elements_of_plane_wave(&array, 40e3, 1000, |e| {
                (cw, 500.0 / 40e3 - array.along_m(e) * sine / C)
            });
            let mut line = empty();
            former(Side::Port, 1000).form(&plan(&cw, 1000, C), &frame, &mut line);
            let want = crate::beam::conventional::line_array_response(20, 0.01 / (C / 400e3), sine);
            let got = f64::from(line.amplitude[500]);
            // An echo slightly off its sample loses one of the pulse's 201 samples.
            assert!((got - want).abs() < 0.006, "sine {sine}: {got} want {want}");
        }
    }

    #[test]
    fn sample_zero_is_the_start_of_the_pulse_even_when_reception_begins_later() {
        let array = array(4, 0.01, 0.0);
        let frame = elements_of_plane_wave(&array, 40e3, 600, |_| (pulse(), 100.0 / 40e3));
        let mut later = plan(&pulse(), 600, C);
        later.first_sample_s = 300.0 / 40e3;
        let mut line = empty();
        former(Side::Port, 600).form(&later, &frame, &mut line);
        assert_eq!(line.amplitude.len(), 900);
        assert!(line.amplitude[..300].iter().all(|&a| a == 0.0));
        assert!((line.amplitude[400] - 1.0).abs() < 0.006);
    }

    #[test]
    fn an_empty_row_gives_an_empty_line() {
        let frame = ElementFrame {
            elements: 3,
            ..ElementFrame::default()
        };
        let mut line = empty();
        former(Side::Port, 10).form(&plan(&pulse(), 0, C), &frame, &mut line);
        assert!(line.amplitude.is_empty());
    }
}
