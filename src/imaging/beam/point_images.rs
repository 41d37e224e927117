//! Images of single points by a side-scan line at 10 knots, at 5 to 200 m, compared with the patterns that produce them.
//!
//! The image along the track is the level of the broadside beam while the platform passes the point. In the far field it is the product of
//! the transmit and receive patterns. The transmit pattern is centred on the transmitter's position at the pulse. The receive pattern is
//! that of the elements in use about their focus, times one element's own pattern about the position at reception, 2 r v/c ahead. The
//! echoes come from the full model: every element has its own position, delay and pattern.

use std::f64::consts::PI;

use glam::DVec3;
use num_complex::Complex64;

use super::conventional::line_array_response;
use super::delay_sum::DelaySumFormer;
use super::test_rig::{
    self, C, array, elements_of_plane_wave, half_power, limits, plan_moving, transmitter,
};
use echotank_config::spec::{FanSpec, Former, Shading};
use echotank_core::arrays::ArrayGeometry;
use echotank_core::ping::{BeamFrame, ElementFrame, PingPlan};
use echotank_core::pulse::{Pulse, PulseKind};

const LAMBDA_M: f64 = C / 400e3;
const RATE_HZ: f64 = 40e3;
/// 10 knots.
const SPEED_M_PER_S: f64 = 5.144;
const SAMPLES: usize = 120;
/// Number of samples before the echo.
const LEAD: usize = 40;

struct Rig {
    array: ArrayGeometry,
    /// Along-track lengths of the transmitter and of one element.
    transmit_m: f64,
    element_m: f64,
    f_number: Option<f64>,
    /// Sine of the beam's direction.
    sine: f64,
}

fn pulse() -> Pulse {
    test_rig::pulse(PulseKind::LfmUp, 30e3, 1e-3, 0.2)
}

fn sinc(x: f64) -> f64 {
    match x == 0.0 {
        true => 1.0,
        false => (PI * x).sin() / (PI * x),
    }
}

impl Rig {
    fn fan(&self, former: Former, beams: usize, sector_rad: f64) -> FanSpec {
        let mut fan = test_rig::fan(beams, sector_rad, Shading::Uniform, former);
        fan.form.center_rad = self.sine.asin();
        fan.form.f_number = self.f_number;
        fan.form.focus_error_rad = 0.05;
        fan
    }

    fn former(&self, fan: &FanSpec) -> DelaySumFormer {
        let limits = limits(RATE_HZ, SAMPLES, pulse().duration_s);
        let transmit = transmitter(DVec3::ZERO);
        let weighting = Shading::Uniform;
        DelaySumFormer::new(&self.array, &transmit, fan, limits, &pulse(), weighting, C)
    }

    fn plan(&self, first: usize) -> PingPlan {
        PingPlan {
            first_sample_s: first as f64 / RATE_HZ,
            ..plan_moving(&pulse(), SAMPLES, DVec3::ZERO, DVec3::X * SPEED_M_PER_S)
        }
    }

    /// Echo of a point `along_m` ahead of the platform at the pulse, from sample `first` on.
    fn echo(&self, range_m: f64, along_m: f64, first: usize) -> ElementFrame {
        let out_m = along_m.hypot(range_m);
        let sent = sinc(self.transmit_m * along_m / out_m / LAMBDA_M);
        let delay_s = |x_m: f64| {
            let mut u = 2.0 * out_m / C;
            for _ in 0..40 {
                u = (out_m + (along_m - x_m - SPEED_M_PER_S * u).hypot(range_m)) / C;
            }
            u
        };
        let mut frame = elements_of_plane_wave(&self.array, RATE_HZ, SAMPLES, |e| {
            let late_s = delay_s(self.array.along_m(e)) - first as f64 / RATE_HZ;
            (pulse(), late_s)
        });
        for e in 0..self.array.elements {
            let x_m = self.array.along_m(e);
            let ahead_m = along_m - x_m - SPEED_M_PER_S * delay_s(x_m);
            let heard = sinc(self.element_m * ahead_m / ahead_m.hypot(range_m) / LAMBDA_M);
            for x in frame.element_mut(e) {
                *x *= sent * heard;
            }
        }
        frame
    }

    fn first(&self, range_m: f64) -> usize {
        ((2.0 * range_m / C * RATE_HZ) as usize).saturating_sub(LEAD)
    }

    /// Number of elements in use at a range.
    fn used(&self, range_m: f64) -> usize {
        let whole_m = 0.5 * self.array.spacing_m * self.array.elements as f64;
        let half_m = self
            .f_number
            .map_or(whole_m, |f| whole_m.min(0.5 * range_m / f))
            .max(0.5 * self.array.spacing_m);
        (0..self.array.elements)
            .filter(|&e| self.array.along_m(e).abs() <= half_m)
            .count()
    }

    /// Image of the point along the track, at each `along_m`.
    fn image(&self, range_m: f64, along_m: &[f64]) -> Vec<f64> {
        let mut former = self.former(&self.fan(Former::DynamicFocus, 1, 0.0));
        let (first, mut out) = (self.first(range_m), BeamFrame::default());
        along_m
            .iter()
            .map(|y| {
                former.form(&self.plan(first), &self.echo(range_m, *y, first), &mut out);
                f64::from(out.iq.iter().fold(0.0, |m, x| x.norm().max(m)))
            })
            .collect()
    }

    /// The same as the product of the far-field patterns.
    fn product(&self, range_m: f64, along_m: f64) -> f64 {
        let ahead_m = along_m - SPEED_M_PER_S * 2.0 * range_m / C;
        let sine = |y: f64| y / y.hypot(range_m);
        let spacing = self.array.spacing_m / LAMBDA_M;
        sinc(self.transmit_m * sine(along_m) / LAMBDA_M).abs()
            * sinc(self.element_m * sine(ahead_m) / LAMBDA_M).abs()
            * line_array_response(self.used(range_m), spacing, sine(along_m) - self.sine)
    }

    /// The same with every element's own pattern at its own position, in phase at the focus.
    fn element_sum(&self, range_m: f64, along_m: f64) -> f64 {
        let travelled_m = SPEED_M_PER_S * 2.0 * range_m / C;
        let used = self.used(range_m);
        let skipped = (self.array.elements - used) / 2;
        let focus_m = self.sine * range_m;
        let sum: Complex64 = (skipped..skipped + used)
            .map(|e| {
                let place_m = travelled_m + self.array.along_m(e);
                let late = |y: f64| (y - place_m).hypot(range_m) - (y - travelled_m).hypot(range_m);
                let ahead_m = along_m - place_m;
                let heard = sinc(self.element_m * ahead_m / ahead_m.hypot(range_m) / LAMBDA_M);
                let cycles = (late(along_m) - late(focus_m)) / LAMBDA_M;
                Complex64::from_polar(heard, -2.0 * PI * cycles)
            })
            .sum();
        sum.norm() * sinc(self.transmit_m * along_m / along_m.hypot(range_m) / LAMBDA_M).abs()
    }
}

/// Full -3 dB width of a curve sampled at `at`, in equal steps.
fn width(at: &[f64], level: &[f64]) -> f64 {
    let peak = (0..level.len()).fold(0, |b, k| if level[k] > level[b] { k } else { b });
    let steps = half_power(level, peak, 1) + half_power(level, peak, -1);
    steps * (at[1] - at[0])
}

/// Positions along the track about the beam, in steps of a fortieth of the smallest possible width.
fn positions(rig: &Rig, range_m: f64) -> Vec<f64> {
    let used_m = rig.used(range_m) as f64 * rig.array.spacing_m;
    let scale_m = LAMBDA_M * range_m / used_m.max(rig.transmit_m);
    let about_m = rig.sine * range_m;
    (-60..=60)
        .map(|i| about_m + f64::from(i) * scale_m / 40.0 * 1.4)
        .collect()
}

/// At 10 m two more elements join, and a zone of the former begins before that.
const RANGES_M: [f64; 9] = [5.0, 10.4, 20.0, 35.0, 50.0, 75.0, 100.0, 150.0, 200.0];

/// A line of 64 elements whose length in use grows with range to 1.28 m. At every range the image width follows from the patterns.
#[test]
fn focused_points_at_10_knots_have_the_width_of_the_pattern_product_within_5_percent() {
    let rig = Rig {
        array: array(64, 0.02, 0.0),
        transmit_m: 0.4,
        element_m: 0.02,
        f_number: Some(20.0),
        sine: 0.0,
    };
    for range_m in RANGES_M {
        let at = positions(&rig, range_m);
        let got = width(&at, &rig.image(range_m, &at));
        let product: Vec<f64> = at.iter().map(|y| rig.product(range_m, *y)).collect();
        let want = width(&at, &product);
        println!(
            "{range_m} m: {:.1} mm, product {:.1} mm ({:+.1} %)",
            got * 1e3,
            want * 1e3,
            100.0 * (got / want - 1.0)
        );
        assert!(
            (got / want - 1.0).abs() < 0.05,
            "{range_m} m: {got} want {want}"
        );
    }
}

/// Five subarrays of 0.2 m receive an off-axis point with unequal levels, increasingly so at short range: the outer ones, 2 r v/c ahead,
/// point past it. The image is then wider than the product of patterns, by the amount that the element sum predicts. From 75 m on, the
/// product is correct within 5 %.
#[test]
fn long_subarrays_widen_near_images_only_by_their_unequal_levels() {
    let rig = Rig {
        array: array(5, 0.2, 0.0),
        transmit_m: 0.2,
        element_m: 0.2,
        f_number: None,
        sine: SPEED_M_PER_S / C,
    };
    for range_m in [35.0, 50.0, 75.0, 100.0, 150.0, 200.0] {
        let at = positions(&rig, range_m);
        let got = width(&at, &rig.image(range_m, &at));
        let [sum, product] = [true, false].map(|elements| {
            let level: Vec<f64> = at
                .iter()
                .map(|y| match elements {
                    true => rig.element_sum(range_m, *y),
                    false => rig.product(range_m, *y),
                })
                .collect();
            width(&at, &level)
        });
        println!(
            "{range_m} m: {:.1} mm, element sum {:.1} mm ({:+.1} %), product {:.1} mm ({:+.1} %)",
            got * 1e3,
            sum * 1e3,
            100.0 * (got / sum - 1.0),
            product * 1e3,
            100.0 * (got / product - 1.0)
        );
        assert!((got / sum - 1.0).abs() < 0.02, "{range_m} m: {got} {sum}");
        assert!(
            range_m < 75.0 || (got / product - 1.0).abs() < 0.05,
            "{range_m} m: {got} {product}"
        );
    }
}

/// Largest level of a fan beside one point, at 1.5 widths of the focused beam or more, relative to the fan's peak: a false target.
#[test]
fn conventional_beams_show_false_alarms_at_short_range_and_focused_ones_do_not() {
    let rig = Rig {
        array: array(64, 0.02, 0.0),
        transmit_m: 0.0,
        element_m: 0.02,
        f_number: None,
        sine: SPEED_M_PER_S / C,
    };
    let width_sine = 0.886 * LAMBDA_M / 1.28;
    for (range_m, conventional_above_db) in [(10.0, -3.0), (20.0, -3.0), (40.0, -3.0)] {
        let first = rig.first(range_m);
        let frame = rig.echo(range_m, rig.sine * range_m, first);
        let level_db = |former| {
            let fan = rig.fan(former, 241, 16.0 * width_sine);
            let mut out = BeamFrame::default();
            rig.former(&fan).form(&rig.plan(first), &frame, &mut out);
            let level: Vec<f64> = (0..out.beams)
                .map(|b| out.beam(b).iter().fold(0.0_f32, |m, x| x.norm().max(m)))
                .map(f64::from)
                .collect();
            let peak = level.iter().copied().fold(0.0, f64::max);
            let off = |b: usize| (out.angle_rad[b].sin() - rig.sine).abs();
            let beside = (0..out.beams).filter(|&b| off(b) > 1.5 * width_sine);
            let most = beside.map(|b| level[b]).fold(0.0, f64::max);
            20.0 * (most / peak).log10()
        };
        let (far, focused) = (level_db(Former::TimeDelay), level_db(Former::DynamicFocus));
        println!("{range_m} m: false alarm {far:.1} dB conventional, {focused:.1} dB focused");
        assert!(far > conventional_above_db, "{range_m} m: {far:.1} dB");
        // First side lobe of an unshaded line.
        assert!(focused < -12.5, "{range_m} m: {focused:.1} dB");
    }
}
