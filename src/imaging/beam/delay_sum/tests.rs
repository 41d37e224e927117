//! Compares delay-and-sum beams with closed forms and exact element sums.

use std::f64::consts::{PI, TAU};

use glam::DVec3;
use num_complex::Complex64;

use super::steering::turn;
use super::*;
use crate::beam::conventional::line_array_response;
use crate::beam::matched::MatchedFilter;
use crate::beam::test_rig::{
    C, array, elements_of_plane_wave, fan, frame, half_power, limits, on_threads, plan_moving,
    pulse, tone, transmitter,
};
use crate::beam::weights;
use echotank_config::spec::BeamSpacing;
use echotank_core::pulse::PulseKind;

const CARRIER_HZ: f64 = 400e3;
const LAMBDA_M: f64 = C / CARRIER_HZ;
const RATE_HZ: f64 = 40e3;
/// Samples that hold one echo while it crosses any of these lines.
const AROUND: usize = 240;

fn single(sine: f64, former: Former) -> FanSpec {
    let mut fan = fan(1, 1.0, Shading::Uniform, former);
    fan.form.center_rad = sine.asin();
    fan
}

/// Tapered, so that no sample falls on a discontinuity.
fn sweep(duration_s: f64) -> Pulse {
    pulse(PulseKind::LfmUp, 30e3, duration_s, 0.2)
}

struct Rig {
    array: ArrayGeometry,
    transmit_m: DVec3,
    velocity_m_per_s: DVec3,
    pulse: Pulse,
    samples: usize,
}

impl Rig {
    /// Fore and aft, pointing down, at rest.
    fn new(elements: usize, spacing_m: f64, samples: usize) -> Self {
        Self {
            array: array(elements, spacing_m, 0.0),
            transmit_m: DVec3::ZERO,
            velocity_m_per_s: DVec3::ZERO,
            pulse: sweep(1e-3),
            samples,
        }
    }

    fn former(&self, fan: &FanSpec) -> DelaySumFormer {
        let limits = limits(RATE_HZ, self.samples, self.pulse.duration_s);
        let transmit = transmitter(self.transmit_m);
        DelaySumFormer::new(
            &self.array,
            &transmit,
            fan,
            limits,
            &self.pulse,
            Shading::Uniform,
            C,
        )
    }

    fn plan(&self, velocity_m_per_s: DVec3) -> PingPlan {
        plan_moving(&self.pulse, self.samples, DVec3::ZERO, velocity_m_per_s)
    }

    fn beams(&self, fan: &FanSpec, frame: &ElementFrame) -> BeamFrame {
        let mut out = BeamFrame::default();
        self.former(fan)
            .form(&self.plan(self.velocity_m_per_s), frame, &mut out);
        out
    }

    /// Exact two-way delay of a point at a place of the moving array: bisection in f64, independent of the former's closed form.
    fn delay_s(&self, point_m: DVec3, place_m: DVec3) -> f64 {
        let out_m = point_m.distance(self.transmit_m);
        let late = |u: f64| {
            let at = place_m + self.velocity_m_per_s * u;
            C * u - out_m - point_m.distance(at)
        };
        let (mut low, mut high) = (0.0, 4.0 * (out_m + 10.0) / C);
        for _ in 0..200 {
            let middle = 0.5 * (low + high);
            if late(middle) > 0.0 {
                high = middle;
            } else {
                low = middle;
            }
        }
        0.5 * (low + high)
    }

    fn point(sine: f64, range_m: f64) -> DVec3 {
        DVec3::new(range_m * sine, 0.0, range_m * (1.0 - sine * sine).sqrt())
    }

    /// The point near `range_m` whose echo arrives at the array's centre on a sample, and that sample.
    fn on_a_sample(&self, sine: f64, range_m: f64) -> (DVec3, usize) {
        let sample = (self.delay_s(Self::point(sine, range_m), DVec3::ZERO) * RATE_HZ).round();
        let (mut low, mut high) = (0.5 * range_m, 2.0 * range_m + 1.0);
        for _ in 0..200 {
            let middle = 0.5 * (low + high);
            if self.delay_s(Self::point(sine, middle), DVec3::ZERO) * RATE_HZ > sample {
                high = middle;
            } else {
                low = middle;
            }
        }
        (Self::point(sine, 0.5 * (low + high)), sample as usize)
    }

    /// The echo of a point in a window about its arrival sample at the array's centre, the matching plan, and the index of `sample` in the
    /// window.
    fn around(
        &self,
        point_m: DVec3,
        sample: usize,
        velocity_m_per_s: DVec3,
    ) -> (ElementFrame, PingPlan, usize) {
        let first = sample.saturating_sub(AROUND / 3);
        let first_s = first as f64 / RATE_HZ;
        let frame = elements_of_plane_wave(&self.array, RATE_HZ, self.samples, |e| {
            let delay_s = self.delay_s(point_m, self.array.element_m(e));
            (self.pulse, delay_s - first_s)
        });
        let mut plan = self.plan(velocity_m_per_s);
        plan.first_sample_s = first_s;
        (frame, plan, sample - first)
    }

    /// Every element receives the point with unit amplitude.
    fn echo(&self, point_m: DVec3) -> ElementFrame {
        elements_of_plane_wave(&self.array, RATE_HZ, self.samples, |e| {
            (self.pulse, self.delay_s(point_m, self.array.element_m(e)))
        })
    }
}

fn db(x: f64) -> f64 {
    20.0 * x.log10()
}

/// Level of an endless tone from `sine` in a beam, in the middle of the row.
fn tone_level(former: &mut DelaySumFormer, rig: &Rig, hz: f64, sine: f64) -> f64 {
    let mut out = BeamFrame::default();
    let frame = tone(&rig.array, rig.samples, hz, sine);
    former.form(&rig.plan(DVec3::ZERO), &frame, &mut out);
    out.sample(0, rig.samples / 2).norm()
}

/// A long CW: narrow-band, so that the envelope has no effect.
fn narrow(elements: usize, spacing_wavelengths: f64) -> Rig {
    Rig {
        pulse: pulse(PulseKind::Cw, 0.0, 5e-3, 0.0),
        ..Rig::new(elements, spacing_wavelengths * LAMBDA_M, 600)
    }
}

fn array_response(weights: &[f64], spacing_wavelengths: f64, sine: f64) -> f64 {
    let middle = (weights.len() as f64 - 1.0) / 2.0;
    let sum: Complex64 = weights
        .iter()
        .enumerate()
        .map(|(e, w)| {
            Complex64::from_polar(*w, TAU * (e as f64 - middle) * spacing_wavelengths * sine)
        })
        .sum();
    sum.norm() / weights.iter().sum::<f64>()
}

#[test]
fn side_lobes_are_within_0p2_db_of_the_exact_pattern_for_every_shading() {
    for shading in [
        Shading::Uniform,
        Shading::Hann,
        Shading::Taylor { side_lobe_db: 35.0 },
        Shading::Chebyshev { side_lobe_db: 30.0 },
    ] {
        for former in [Former::Phase, Former::TimeDelay] {
            let rig = narrow(48, 0.5);
            let mut weights = vec![0.0; 48];
            weights::fill(shading, &mut weights);
            let beam_sine = 0.3;
            let mut spec = single(beam_sine, former);
            spec.shading = shading;
            let mut beams = rig.former(&spec);
            let mut worst: f64 = 0.0;
            for step in -60..=60 {
                let sine = beam_sine + f64::from(step) * 0.0101;
                let want = array_response(&weights, 0.5, sine - beam_sine);
                // Levels more than 50 dB down are not compared.
                if want < 10f64.powf(-50.0 / 20.0) {
                    continue;
                }
                let got = tone_level(&mut beams, &rig, CARRIER_HZ, sine);
                worst = worst.max((db(got) - db(want)).abs());
            }
            println!("{shading:?} {former:?}: within {worst:.4} dB");
            assert!(worst < 0.2, "{shading:?} {former:?}: {worst:.3} dB");
        }
    }
}

#[test]
fn beam_widths_are_those_of_the_exact_pattern_within_1_percent() {
    for (elements, spacing, sine) in [(16, 0.5, 0.0), (64, 0.5, 0.5), (5, 2.0, 0.0)] {
        let rig = narrow(elements, spacing);
        let spec = single(sine, Former::TimeDelay);
        let mut beams = rig.former(&spec);
        let mut half = |toward: f64| {
            let (mut inside, mut outside) = (0.0, 0.7 / (elements as f64 * spacing));
            for _ in 0..40 {
                let middle = 0.5 * (inside + outside);
                let level = tone_level(&mut beams, &rig, CARRIER_HZ, sine + toward * middle);
                if level > 0.5_f64.sqrt() {
                    inside = middle;
                } else {
                    outside = middle;
                }
            }
            inside
        };
        let (above, below) = (half(1.0), half(-1.0));
        let got = (sine + above).asin() - (sine - below).asin();
        let reported = rig
            .beams(&spec, &tone(&rig.array, 600, CARRIER_HZ, sine))
            .width_rad[0];
        assert!(
            (got / reported - 1.0).abs() < 0.01,
            "{elements}: measured {got:.5}, reported {reported:.5}"
        );
        if elements >= 16 && sine == 0.0 {
            let closed = 0.886 / (elements as f64 * spacing);
            assert!((got / closed - 1.0).abs() < 0.01, "{got} want {closed}");
        }
    }
}

#[test]
fn grating_lobes_are_where_the_spacing_predicts() {
    let rig = narrow(16, 1.6);
    let mut beams = rig.former(&single(0.1, Former::TimeDelay));
    for order in [-1.0, 0.0, 1.0] {
        let sine = 0.1 + order / 1.6;
        let level = tone_level(&mut beams, &rig, CARRIER_HZ, sine);
        assert!(db(level).abs() < 0.05, "order {order}: {:.3} dB", db(level));
        let beside = tone_level(&mut beams, &rig, CARRIER_HZ, sine + 0.5 / 16.0 / 1.6);
        let want = line_array_response(16, 1.6, 0.5 / 16.0 / 1.6);
        assert!((beside - want).abs() < 0.01, "{beside} want {want}");
    }
}

/// Also off the middle of the band: true time delays do not squint, phases do.
#[test]
fn time_delays_do_not_squint_at_the_band_edges_and_phases_do() {
    let rig = Rig::new(128, 2.0 * LAMBDA_M, 900);
    let sine = 0.5;
    let frame = elements_of_plane_wave(&rig.array, RATE_HZ, 900, |e| {
        let late_s = -rig.array.along_m(e) * sine / C;
        (rig.pulse, 400.0 / RATE_HZ + late_s)
    });
    let level = |former| {
        rig.beams(&single(sine, former), &frame)
            .sample(0, 400)
            .norm()
    };
    let (delayed, phased) = (level(Former::TimeDelay), level(Former::Phase));
    println!(
        "0.96 m at 30 degrees, 30 kHz: time delay {:.3} dB, phase {:.2} dB",
        db(delayed),
        db(phased)
    );
    assert!(db(delayed).abs() < 0.1, "{:.3} dB", db(delayed));
    // The echo spans 8 samples along the line, the compressed pulse 1.2.
    assert!(db(phased) < -8.0, "{:.2} dB", db(phased));
}

#[test]
fn focusing_gain_is_within_0p1_db_of_the_exact_element_sum_from_2_m_to_the_far_field() {
    for (elements, spacing_m) in [(128, 0.5 * LAMBDA_M), (64, 0.01), (5, 0.1)] {
        let rig = Rig::new(elements, spacing_m, AROUND);
        let mut worst: f64 = 0.0;
        for sine in [0.0, 0.1, -0.4, 0.7] {
            let mut former = rig.former(&single(sine, Former::DynamicFocus));
            let mut out = BeamFrame::default();
            for range_m in [2.0, 2.31, 3.7, 5.0, 11.0, 27.0, 75.0, 200.0] {
                let (point, sample) = rig.on_a_sample(sine, range_m);
                let (frame, plan, at) = rig.around(point, sample, DVec3::ZERO);
                former.form(&plan, &frame, &mut out);
                let gain_db = db(out.sample(0, at).norm());
                worst = worst.max(gain_db.abs());
                assert!(
                    gain_db.abs() < 0.1,
                    "{elements} x {spacing_m} m, sine {sine}, {range_m} m: {gain_db:.3} dB"
                );
            }
        }
        println!(
            "{elements} x {:.2} mm: within {worst:.3} dB",
            spacing_m * 1e3
        );
    }
}

#[test]
fn unfocused_beams_have_the_near_field_loss_of_the_exact_element_sum() {
    let rig = Rig {
        pulse: narrow(2, 0.5).pulse,
        ..Rig::new(64, 0.01, 2000)
    };
    for range_m in [8.0, 15.0, 30.0] {
        let (point, sample) = rig.on_a_sample(0.0, range_m);
        let out = rig.beams(&single(0.0, Former::Phase), &rig.echo(point));
        let exact: Complex64 = (0..64)
            .map(|e| {
                let late_m = point.distance(DVec3::X * rig.array.along_m(e)) - point.length();
                Complex64::from_polar(1.0 / 64.0, -TAU * late_m / LAMBDA_M)
            })
            .sum();
        // A rectangular pulse may lose one of its 201 samples.
        let got = out.sample(0, sample).norm();
        assert!(
            (db(got) - db(exact.norm())).abs() < 0.15,
            "{range_m} m: {:.2} dB want {:.2}",
            db(got),
            db(exact.norm())
        );
        assert!(db(exact.norm()) < -1.0);
    }
}

#[test]
fn steering_follows_the_moving_receiver_and_both_legs() {
    for (velocity, transmit_m) in [
        (DVec3::new(5.144, 0.0, 0.0), DVec3::ZERO),
        (DVec3::new(-9.0, 0.0, 0.6), DVec3::new(0.8, 0.0, 0.1)),
    ] {
        let mut rig = Rig::new(96, 0.01, AROUND);
        rig.velocity_m_per_s = velocity;
        rig.transmit_m = transmit_m;
        for sine in [0.0, 0.03, -0.3] {
            let spec = single(sine, Former::DynamicFocus);
            let mut former = rig.former(&spec);
            for range_m in [3.0, 10.0, 40.0, 180.0] {
                let (point, sample) = rig.on_a_sample(sine, range_m);
                let (frame, mut plan, at) = rig.around(point, sample, velocity);
                let mut out = BeamFrame::default();
                former.form(&plan, &frame, &mut out);
                let got_db = db(out.sample(0, at).norm());
                assert!(
                    got_db.abs() < 0.1,
                    "sine {sine}, {range_m} m, {velocity}: {got_db:.3} dB"
                );
                if range_m > 30.0 {
                    plan.segments[0].velocity_m_per_s = DVec3::ZERO;
                    former.form(&plan, &frame, &mut out);
                    let still = out.beam(0)[at - 4..at + 5]
                        .iter()
                        .fold(0.0_f64, |m, y| m.max(y.norm().into()));
                    assert!(db(still) < -3.0, "without motion: {:.2} dB", db(still));
                }
            }
        }
    }
}

/// Delays of every sample compared exactly with those of its zone's focus.
#[test]
fn zone_phase_errors_are_within_the_configured_limit() {
    for error_rad in [0.05, 0.2] {
        let rig = Rig::new(128, 0.01, 4000);
        let mut spec = single(0.0, Former::DynamicFocus);
        spec.form.focus_error_rad = error_rad;
        let mut former = rig.former(&spec);
        former.make_zones(4000, 0.0);
        assert_eq!(
            (former.zones[0].first, former.zones.last().map(|z| z.end)),
            (0, Some(4000))
        );
        let mut worst: f64 = 0.0;
        for pair in former.zones.windows(2) {
            assert_eq!(pair[0].end, pair[1].first);
        }
        // From the minimum range of the focus on.
        for zone in &former.zones[1..] {
            for sample in [zone.first, zone.end - 1] {
                let range_m = (0.5 * C * sample as f64 / RATE_HZ).max(MIN_DISTANCE_M);
                let at_m = 0.5 * C * zone.time_s;
                let x = former.half_aperture_m(range_m);
                let late = |r: f64| r.hypot(x) - r;
                worst = worst.max(TAU * (late(range_m) - late(at_m)).abs() / LAMBDA_M);
            }
        }
        let zones = former.zones.len();
        println!("{zones} zones, {worst:.4} rad of {error_rad}");
        let (array, samples) = (&rig.array, (RATE_HZ, rig.samples));
        let (_, predicted) = DelaySumFormer::work(array, &spec, &rig.pulse, samples, C);
        let ratio = predicted / (array.elements * zones) as f64;
        assert!(
            (0.8..1.25).contains(&ratio),
            "predicted over counted products: {ratio}"
        );
        assert!(worst <= error_rad * 1.001, "{worst}");
        assert!(
            worst > 0.3 * error_rad,
            "zones shorter than necessary: {worst}"
        );
    }
}

/// Along-track width of a point: lambda r / L, and constant beyond the range from which the aperture grows with range.
#[test]
fn a_dynamic_aperture_keeps_the_width_until_the_whole_line_is_in_use() {
    let rig = Rig::new(128, 0.01, 8000);
    let f_number = 40.0;
    for range_m in [12.0, 24.0, 40.0, 100.0] {
        let (point, sample) = rig.on_a_sample(0.0, range_m);
        let frame = rig.echo(point);
        let mut spec = fan(161, 0.0, Shading::Uniform, Former::DynamicFocus);
        spec.form.f_number = Some(f_number);
        spec.form.spacing = BeamSpacing::EquiSine;
        let used_m = 1.28_f64.min(range_m / f_number);
        spec.sector_rad = 4.0 * LAMBDA_M / used_m;
        let out = rig.beams(&spec, &frame);
        let level: Vec<f64> = (0..161).map(|b| out.sample(b, sample).norm()).collect();
        let steps = half_power(&level, 80, 1) + half_power(&level, 80, -1);
        let width_m = range_m * steps * spec.sector_rad / 160.0;
        let want_m = 0.886 * LAMBDA_M * range_m / used_m;
        println!(
            "{range_m} m: {:.1} mm, closed form {:.1} mm",
            width_m * 1e3,
            want_m * 1e3
        );
        // Whole elements: the aperture changes in steps of a centimetre, and zones let it lag by 5 %.
        assert!(
            (width_m / want_m - 1.0).abs() < 0.08,
            "{range_m} m: {width_m} want {want_m}"
        );
    }
}

#[test]
fn beams_are_bit_identical_on_one_thread_and_on_five_and_ping_after_ping() {
    let rig = Rig::new(40, 0.01, 3000);
    let spec = fan(23, 0.6, Shading::Hann, Former::DynamicFocus);
    let frame = rig.echo(Rig::point(0.1, 20.0));
    let on = |threads: usize| {
        on_threads(threads, || {
            let mut former = rig.former(&spec);
            let mut out = BeamFrame::default();
            former.form(&rig.plan(DVec3::X), &frame, &mut out);
            let first = out.clone();
            former.form(&rig.plan(DVec3::X), &frame, &mut out);
            assert_eq!(first, out);
            out
        })
    };
    assert_eq!(on(1), on(5));
}

#[test]
fn scalar_and_simd_beams_agree_to_f32() {
    let rig = Rig::new(40, 0.01, 1500);
    let spec = fan(9, 0.6, Shading::Hann, Former::DynamicFocus);
    let frame = rig.echo(Rig::point(0.1, 15.0));
    let with = |simd_level| {
        let mut former = rig.former(&spec);
        former.simd_level = simd_level;
        let mut out = BeamFrame::default();
        former.form(&rig.plan(DVec3::X), &frame, &mut out);
        out
    };
    let (plain, best) = (with(SimdLevel::PORTABLE), with(SimdLevel::best()));
    let worst = plain
        .iq
        .iter()
        .zip(&best.iq)
        .fold(0.0_f32, |w, (a, b)| w.max((a - b).norm()));
    assert!(
        worst < 2e-4,
        "{worst:.1e}: the nearest fraction of a row may differ by rounding"
    );
}

/// Equi-distant beams meet a flat bottom in equal steps; stabilised beams keep their direction for any roll.
#[test]
fn spacings_and_roll_stabilisation_set_the_beam_directions() {
    let mut rig = Rig::new(16, 0.01, 10);
    rig.array = array(16, 0.01, 90.0);
    let frame = ElementFrame {
        elements: 16,
        samples: 10,
        iq: vec![Complex64::ZERO; 160],
        ..ElementFrame::default()
    };
    let mut spec = fan(11, 2.0, Shading::Uniform, Former::TimeDelay);
    spec.form.spacing = BeamSpacing::EquiDistant;
    let out = rig.beams(&spec, &frame);
    let steps: Vec<f64> = out
        .angle_rad
        .windows(2)
        .map(|a| a[1].tan() - a[0].tan())
        .collect();
    assert!(steps.iter().all(|s| (s / steps[0] - 1.0).abs() < 1e-12));
    assert!((out.angle_rad[0] + 1.0).abs() < 1e-12);
    spec.form.spacing = BeamSpacing::EquiSine;
    let out = rig.beams(&spec, &frame);
    let step = 2.0 * 1.0_f64.sin() / 10.0;
    assert!((out.angle_rad[6].sin() - step).abs() < 1e-12);
    spec.form.roll_stabilised = true;
    let mut plan = rig.plan(DVec3::ZERO);
    plan.nav.roll_rad = 0.1;
    let mut rolled = BeamFrame::default();
    rig.former(&spec).form(&plan, &frame, &mut rolled);
    for (level, array) in out.angle_rad.iter().zip(&rolled.angle_rad) {
        // The body's direction at this angle, rolled starboard down, from the vertical.
        let direction = echotank_core::frames::rotation_from_angles(0.1, 0.0, 0.0)
            * DVec3::new(0.0, array.sin(), array.cos());
        let seen = direction.y.atan2(direction.z);
        assert!((seen - level).abs() < 1e-12, "{seen} want {level}");
    }
}

#[test]
fn sines_and_cosines_of_many_turns_have_f32_accuracy() {
    for step in -20_000..20_000 {
        let cycles = step as f32 * 0.003_7;
        let (sin, cos) = turn(cycles);
        let want = (f64::from(cycles) * 2.0 * PI).sin_cos();
        let off = (f64::from(sin) - want.0).hypot(f64::from(cos) - want.1);
        assert!(off < 1e-6, "{cycles}: {off:e}");
    }
}

/// Matched-filtered white noise at the elements: echoes from everywhere.
struct Reverberation {
    rig: Rig,
    rate_hz: f64,
    frame: ElementFrame,
    /// Matched-filtered rows, f64.
    rows: Vec<Complex64>,
    /// Nearest range of the focus, metres.
    focus_from_m: f64,
}

impl Reverberation {
    fn new(rig: Rig, rate_hz: f64, focus_from_m: f64) -> Self {
        let mut state = 7u64;
        let mut draw = || {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1);
            (state >> 11) as f64 / (1u64 << 52) as f64 - 1.0
        };
        let count = rig.array.elements * rig.samples;
        let mut iq: Vec<_> = (0..count).map(|_| Complex64::new(draw(), draw())).collect();
        let limits = limits(rate_hz, rig.samples, rig.pulse.duration_s);
        let mut filter = MatchedFilter::new(&rig.pulse, limits, Shading::Uniform);
        // Echoes have the spectrum of the pulse.
        for row in iq.chunks_exact_mut(rig.samples) {
            filter.apply(row);
        }
        let mut rows = iq.clone();
        for row in rows.chunks_exact_mut(rig.samples) {
            filter.apply(row);
        }
        let frame = crate::beam::test_rig::frame(rig.array.elements, rig.samples, iq);
        Self {
            rig,
            rate_hz,
            frame,
            rows,
            focus_from_m,
        }
    }

    fn former(&self, fan: &FanSpec) -> DelaySumFormer {
        let limits = limits(self.rate_hz, self.rig.samples, self.rig.pulse.duration_s);
        let mut fan = fan.clone();
        fan.form.bottom_detection = true;
        fan.form.focus_from_m = self.focus_from_m;
        DelaySumFormer::new(
            &self.rig.array,
            &transmitter(self.rig.transmit_m),
            &fan,
            limits,
            &self.rig.pulse,
            Shading::Uniform,
            C,
        )
    }

    /// Beam and sample number `n` of those of a fan of 512 beams that are compared: in a record from range 0, from `min_m` on, where the reference has
    /// all its samples.
    fn probe(&self, n: usize, first_m: f64, min_m: f64) -> (usize, usize) {
        let near = match first_m == 0.0 {
            true => min_m * 2.0 / C * self.rate_hz,
            false => 60.0,
        };
        let near = near as usize + 20;
        (
            (n * 197) % 512,
            near + (n * 61) % (self.rig.samples - near - 60),
        )
    }

    /// One sample of a beam of some elements in f64: every element's exact delay, a sinc of 64 samples.
    fn exact(&self, weights: &[f64], sine: f64, sample: usize, first_s: f64) -> Complex64 {
        let time_s = (first_s + sample as f64 / self.rate_hz).max(2.0 * self.focus_from_m / C);
        // The point whose echo reaches the array's centre at this time.
        let (mut low, mut high) = (0.0, C * time_s);
        let delay_s = |range_m: f64, at_m: DVec3| self.rig.delay_s(Rig::point(sine, range_m), at_m);
        for _ in 0..60 {
            let middle = 0.5 * (low + high);
            if delay_s(middle, DVec3::ZERO) > time_s {
                high = middle;
            } else {
                low = middle;
            }
        }
        let taper = Taper::Kaiser(9.0);
        let sum = weights.iter().enumerate().filter(|(_, w)| **w != 0.0);
        sum.map(|(e, w)| {
            let late_s = delay_s(low, self.rig.array.element_m(e)) - time_s;
            let at = sample as f64 + late_s * self.rate_hz;
            let row = &self.rows[e * self.rig.samples..][..self.rig.samples];
            let near = at.floor() as i64;
            let value: Complex64 = (near - 31..=near + 32)
                .filter_map(|k| {
                    let (d, y) = (at - k as f64, row.get(usize::try_from(k).ok()?)?);
                    let sinc = if d == 0.0 {
                        1.0
                    } else {
                        (PI * d).sin() / (PI * d)
                    };
                    Some(y * (sinc * taper.at(d / 64.0)))
                })
                .sum();
            let cycles = self.rig.pulse.center_frequency_hz * late_s;
            value * Complex64::from_polar(*w, TAU * (cycles - cycles.round()))
        })
        .sum()
    }
}

/// Records: range of the first sample, metres, number of samples, and nearest range of the focus, metres.
const RECORDS: [(f64, usize, f64); 4] = [
    (0.0, 600, 0.0),
    (0.0, 600, 1.0),
    (8.0, 300, 0.0),
    (40.0, 300, 0.0),
];

/// The lines of two multibeam sonars at 400 kHz: a CW pulse, and a sweep of 80 kHz. Error of random samples of the fan and of the products of
/// its halves, relative to their rms, by groups and element by element.
#[test]
fn beams_by_groups_are_within_1_percent_of_the_exact_focus_at_every_range() {
    let cw = pulse(PulseKind::Cw, 0.0, 0.3e-3, 0.1);
    // Tapered so that almost no energy lies outside the sampled band, where interpolation is undefined.
    let lfm = pulse(PulseKind::LfmUp, 80e3, 0.5e-3, 0.5);
    let mut all_errors = Vec::new();
    for (name, pulse, rate_hz, spacing_m, sector_deg) in [
        ("CW", cw, 34e3, 0.0016, 140.0_f64),
        ("LFM", lfm, 115e3, 0.00172, 130.0),
    ] {
        for (first_m, samples, focus_from_m) in RECORDS {
            let mut rig = Rig::new(256, spacing_m, samples);
            rig.pulse = pulse;
            rig.velocity_m_per_s = DVec3::new(0.5, 0.0, 0.3);
            let rev = Reverberation::new(rig, rate_hz, focus_from_m);
            let shading = Shading::Taylor { side_lobe_db: 35.0 };
            let mut spec = fan(512, sector_deg.to_radians(), shading, Former::DynamicFocus);
            spec.form.focus_error_rad = f64::to_radians(2.0);
            let mut plan = rev.rig.plan(rev.rig.velocity_m_per_s);
            plan.first_sample_s = 2.0 * first_m / C;
            let mut weights = vec![0.0; 256];
            weights::fill(shading, &mut weights);
            let part = |range: Range<usize>| -> Vec<f64> {
                let sum: f64 = weights[range.clone()].iter().sum();
                let at = |e: usize| {
                    if range.contains(&e) {
                        weights[e] / sum
                    } else {
                        0.0
                    }
                };
                (0..256).map(at).collect()
            };
            let parts = [part(0..256), part(0..128), part(128..256)];
            let mut probes = Vec::new();
            for n in 0..120usize {
                let (beam, sample) = rev.probe(n, first_m, 0.34);
                let sine = (sector_deg.to_radians() * (beam as f64 / 511.0 - 0.5)).sin();
                let want = |w: &Vec<f64>| rev.exact(w, sine, sample, plan.first_sample_s);
                let [whole, a, b] = [&parts[0], &parts[1], &parts[2]].map(want);
                // Half of the weights belong to each half.
                probes.push((beam, sample, [whole, 0.25 * a * b.conj()]));
            }
            let mut errors = Vec::new();
            for by_groups in [true, false] {
                let mut former = rev.former(&spec);
                assert!(former.groups.is_some());
                if !by_groups {
                    former.groups = None;
                }
                let (mut whole, mut products) = (BeamFrame::default(), Vec::new());
                let start = std::time::Instant::now();
                let to = (Some(&mut whole), Some(&mut products));
                former.form_with_halves(&plan, &rev.frame, to.0, to.1);
                let took = start.elapsed();
                let (mut off, mut all) = ([0.0; 2], [0.0; 2]);
                for (beam, sample, want) in &probes {
                    let at = beam * samples + sample;
                    for (k, got) in [whole.iq[at], products[at]].into_iter().enumerate() {
                        let got = Complex64::new(got.re.into(), got.im.into());
                        off[k] += (got - want[k]).norm_sqr();
                        all[k] += want[k].norm_sqr();
                    }
                }
                errors.extend((0..2).map(|k| f64::sqrt(off[k] / all[k])));
                println!(
                    "{name} from {first_m} m, focus from {focus_from_m} m, groups {by_groups}: {:.1e} {:.1e}; {took:?}, {} tiles, {} zones, {:?}",
                    errors[errors.len() - 2],
                    errors[errors.len() - 1],
                    former.tiles.len(),
                    former.zones.len(),
                    former.directions.map(|directions| directions.count),
                );
            }
            all_errors.push((name, first_m, errors));
        }
    }
    for (name, first_m, errors) in all_errors {
        for error in errors {
            assert!(error < 1e-2, "{name} from {first_m} m: {error:.1e}");
        }
    }
}

/// The arc of a multibeam sonar with a sweep of 80 kHz, as [`beams_by_groups_are_within_1_percent_of_the_exact_focus_at_every_range`]: by groups, whose
/// shading has steps, and element by element.
#[test]
fn beams_of_an_arc_are_within_1_percent_of_the_exact_focus_at_every_range() {
    let lfm = pulse(PulseKind::LfmUp, 80e3, 0.5e-3, 0.5);
    let rate_hz = 115e3;
    let mut all_errors = Vec::new();
    for (first_m, samples, focus_from_m) in RECORDS {
        let mut rig = Rig::new(256, 0.00172, samples);
        rig.array.radius_m = Some(0.21);
        rig.pulse = lfm;
        rig.velocity_m_per_s = DVec3::new(0.5, 0.0, 0.3);
        let rev = Reverberation::new(rig, rate_hz, focus_from_m);
        let shading = Shading::Taylor { side_lobe_db: 30.0 };
        let sector_rad = 130f64.to_radians();
        let mut spec = fan(512, sector_rad, shading, Former::DynamicFocus);
        spec.form.focus_error_rad = f64::to_radians(1.0);
        let mut plan = rev.rig.plan(rev.rig.velocity_m_per_s);
        plan.first_sample_s = 2.0 * first_m / C;
        for by_groups in [true, false] {
            let mut former = rev.former(&spec);
            let mut groups = former.arc_groups.take().expect("fewer products");
            let parts = groups.parts.clone();
            if by_groups {
                groups.aim(former.steered.arc.as_ref().expect("an arc"));
                former.arc_groups = Some(groups);
            }
            let mut whole = BeamFrame::default();
            let start = std::time::Instant::now();
            former.form(&plan, &rev.frame, &mut whole);
            let took = start.elapsed();
            let arc = former.steered.arc.as_ref().expect("an arc");
            let (mut off, mut off_smooth, mut all) = (0.0, 0.0, 0.0);
            for n in 0..120usize {
                let (beam, sample) = rev.probe(n, first_m, 0.5);
                let own = &arc.beams[beam];
                let mut weights = vec![0.0; 256];
                for (w, own) in weights[own.elements.clone()]
                    .iter_mut()
                    .zip(arc.weights(own, own.elements.clone()))
                {
                    *w = f64::from(*own);
                }
                let smooth = weights.clone();
                for part in parts.iter().filter(|_| by_groups) {
                    let mean = weights[part.clone()].iter().sum::<f64>() / part.len() as f64;
                    weights[part.clone()].fill(mean);
                }
                let sine = (sector_rad * (beam as f64 / 511.0 - 0.5)).sin();
                let got = whole.iq[beam * samples + sample];
                let got = Complex64::new(got.re.into(), got.im.into());
                let want = rev.exact(&weights, sine, sample, plan.first_sample_s);
                let smooth = rev.exact(&smooth, sine, sample, plan.first_sample_s);
                off += (got - want).norm_sqr();
                off_smooth += (got - smooth).norm_sqr();
                all += want.norm_sqr();
            }
            let [error, of_smooth] = [off, off_smooth].map(|off: f64| (off / all).sqrt());
            println!(
                "from {first_m} m, focus from {focus_from_m} m, groups {by_groups}: {error:.1e}, of the smooth shading {of_smooth:.1e}; {took:?}, {} tiles, {} zones, {:?}",
                former.tiles.len(),
                former.zones.len(),
                former.directions.map(|directions| directions.count),
            );
            all_errors.push((first_m, by_groups, error));
        }
    }
    for (first_m, by_groups, error) in all_errors {
        assert!(
            error < 1e-2,
            "from {first_m} m, groups {by_groups}: {error:.1e}"
        );
    }
}

#[test]
fn groups_of_an_arc_serve_apertures_of_many_elements() {
    for (elements, serve) in [(256, true), (160, true), (40, false)] {
        let mut rig = Rig::new(elements, 0.00172, 200);
        rig.array.radius_m = Some(0.21 * elements as f64 / 256.0);
        let shading = Shading::Taylor { side_lobe_db: 30.0 };
        let spec = fan(512, 130f64.to_radians(), shading, Former::DynamicFocus);
        let former = rig.former(&spec);
        assert_eq!(former.arc_groups.is_some(), serve, "{elements}");
        assert!(former.groups.is_none());
    }
}

/// 200 elements on 115 degrees of an arc of 0.185 m.
fn arc(samples: usize) -> Rig {
    let mut rig = Rig::new(200, 0.5 * C / CARRIER_HZ, samples);
    rig.array.radius_m = Some(0.185);
    rig
}

#[test]
fn beams_of_an_arc_focus_and_add_like_the_sum_over_their_elements() {
    for (former, range_m, moves) in [
        (Former::DynamicFocus, 0.7, true),
        (Former::DynamicFocus, 12.0, true),
        (Former::TimeDelay, 3000.0, false),
    ] {
        let mut rig = arc(AROUND);
        rig.transmit_m = DVec3::new(0.1, 0.0, 0.03);
        if moves {
            rig.velocity_m_per_s = DVec3::new(4.0, 0.0, -1.0);
        }
        // In the middle, where apertures are whole, and at the ends, where they are cut off.
        for degrees in [-62.0f64, -10.0, 0.0, 35.0, 57.0] {
            let sine = degrees.to_radians().sin();
            let mut spec = single(sine, former);
            spec.shading = Shading::Taylor { side_lobe_db: 30.0 };
            // Zones of one sample, so that the focus has no error.
            spec.form.focus_error_rad = 1e-4;
            let (point_m, sample) = rig.on_a_sample(sine, range_m);
            let (frame, plan, sample) = rig.around(point_m, sample, rig.velocity_m_per_s);
            let mut out = BeamFrame::default();
            rig.former(&spec).form(&plan, &frame, &mut out);
            let got = out.sample(0, sample);
            // The envelope is read from rows at a few fractions of a sample.
            let error = (got.norm() - 1.0).abs();
            assert!(error < 0.01, "{former:?} at {degrees}: {error:.1e}");
        }
    }
}

#[test]
fn beams_of_an_arc_have_the_same_width_and_the_widths_that_they_report() {
    let tones = narrow(1, 0.5);
    let rig = Rig {
        pulse: tones.pulse,
        ..arc(tones.samples)
    };
    let tone_from = |sine: f64| {
        let toward = Rig::point(sine, 1.0);
        let iq = (0..rig.array.elements).flat_map(|e| {
            let early_s = rig.array.element_m(e).dot(toward) / C;
            let value = Complex64::from_polar(1.0, TAU * CARRIER_HZ * early_s);
            std::iter::repeat_n(value, rig.samples)
        });
        frame(rig.array.elements, rig.samples, iq.collect())
    };
    let mut all = Vec::new();
    for degrees in [0.0f64, 15.0, -15.0, 50.0] {
        let sine = degrees.to_radians().sin();
        let mut spec = single(sine, Former::TimeDelay);
        spec.shading = Shading::Taylor { side_lobe_db: 30.0 };
        let mut beams = rig.former(&spec);
        let mut out = BeamFrame::default();
        let mut level = |rad: f64| {
            beams.form(&rig.plan(DVec3::ZERO), &tone_from(rad.sin()), &mut out);
            (out.sample(0, rig.samples / 2).norm(), out.width_rad[0])
        };
        let (on_axis, reported) = level(degrees.to_radians());
        assert!((on_axis - 1.0).abs() < 1e-3, "{degrees}: {on_axis}");
        let mut half = |toward: f64| {
            let (mut inside, mut outside) = (0.0, 0.05);
            for _ in 0..30 {
                let middle = 0.5 * (inside + outside);
                match level(degrees.to_radians() + toward * middle).0 > 0.5f64.sqrt() {
                    true => inside = middle,
                    false => outside = middle,
                }
            }
            inside
        };
        let got = half(1.0) + half(-1.0);
        // The reported width of a cut aperture supposes the shape of a whole one.
        let limit = if degrees.abs() < 20.0 { 0.02 } else { 0.15 };
        assert!(
            (got / reported - 1.0).abs() < limit,
            "{degrees}: measured {got:.5}, reported {reported:.5}"
        );
        all.push(got);
    }
    let [middle, right, left, end] = all[..] else {
        unreachable!("four widths");
    };
    for width in [right, left] {
        assert!((width / middle - 1.0).abs() < 0.02, "{width} and {middle}");
    }
    assert!(end > 1.1 * middle, "{end} and {middle}");
}
