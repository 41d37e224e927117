//! Compares the fast fan with the exact one over many cases.

use glam::DVec3;

use super::*;
use crate::beam::RowLimits;
use crate::beam::conventional::FanFormer;
use crate::beam::test_rig::{self, C, array};
use echotank_config::spec::{BeamSpacing, FanSpec, Former, Shading};
use echotank_core::arrays::ArrayGeometry;
use echotank_core::pulse::{Pulse, PulseKind};
use echotank_core::testing::plan_at_rest;

const RATE_HZ: f64 = 160e3;
const SAMPLES: usize = 700;

fn pulse() -> Pulse {
    Pulse {
        center_frequency_hz: 200e3,
        ..test_rig::pulse(PulseKind::LfmUp, 100e3, 1e-3, 0.1)
    }
}

fn limits() -> RowLimits {
    test_rig::limits(RATE_HZ, SAMPLES, 1e-3)
}

/// Independent random samples for every element: energy from all directions, no cancellation.
fn noise(elements: usize, samples: usize) -> ElementFrame {
    let mut state = 7u64;
    let mut draw = || {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) as f64 / (1u64 << 31) as f64 - 0.5
    };
    let iq = (0..elements * samples).map(|_| Complex64::new(draw(), draw()));
    test_rig::frame(elements, samples, iq.collect())
}

fn fan(beams: usize, sector_rad: f64, spacing: BeamSpacing) -> FanSpec {
    let mut fan = test_rig::fan(beams, sector_rad, Shading::Hann, Former::Fft);
    fan.form.spacing = spacing;
    fan
}

fn steered(array: &ArrayGeometry, spec: &FanSpec) -> SteeredArray {
    SteeredArray::far_field(array, spec, limits(), &pulse(), Shading::Uniform, C)
}

/// rms of the differences relative to the rms, and largest difference relative to the largest value.
fn error(got: &BeamFrame, want: &BeamFrame) -> (f64, f64) {
    let (mut off, mut all, mut worst, mut most) = (0.0, 0.0, 0.0_f64, 0.0_f64);
    let wide = |z: &Complex32| Complex64::new(z.re.into(), z.im.into());
    for (g, w) in got.iq.iter().map(wide).zip(want.iq.iter().map(wide)) {
        let d = (g - w).norm_sqr();
        off += d;
        all += w.norm_sqr();
        worst = worst.max(d);
        most = most.max(w.norm_sqr());
    }
    ((off / all).sqrt(), (worst / most).sqrt())
}

/// Dense and sparse lines, odd and even numbers of elements, few and many beams, every spacing, and frequencies half the bandwidth off the
/// centre.
#[test]
fn equals_the_exact_fan_to_2e_minus_6_for_any_line_and_any_directions() {
    for (elements, spacing_m, beams, sector_rad, spacing) in [
        (128, 0.003, 101, 2.4, BeamSpacing::EquiAngle),
        (33, 0.003, 64, 2.0, BeamSpacing::EquiSine),
        (48, 0.011, 40, 2.9, BeamSpacing::EquiDistant),
        (5, 0.2, 25, 0.02, BeamSpacing::EquiSine),
        (2, 0.004, 3, 3.1, BeamSpacing::EquiAngle),
        (6, 0.1, 1, 0.0, BeamSpacing::EquiAngle),
    ] {
        let array = array(elements, spacing_m, 90.0);
        let mut spec = fan(beams, sector_rad, spacing);
        spec.form.center_rad = 0.01;
        let frame = noise(elements, SAMPLES);
        let plan = plan_at_rest(&pulse(), SAMPLES, C);
        let (mut got, mut want) = (BeamFrame::default(), BeamFrame::default());
        let weighting = Shading::Hamming;
        let steered = || SteeredArray::far_field(&array, &spec, limits(), &pulse(), weighting, C);
        FastFan::new(steered()).form(&plan, &frame, &mut got);
        FanFormer::new(steered()).form(&plan, &frame, &mut want);
        assert_eq!(got.angle_rad, want.angle_rad);
        assert_eq!(got.width_rad, want.width_rad);
        let (rms, worst) = error(&got, &want);
        println!(
            "{elements} x {spacing_m} m, {beams} beams {spacing:?}: rms {rms:.1e}, worst {worst:.1e}"
        );
        assert!(
            rms < 2e-6 && worst < 2e-6,
            "{elements}: {rms:.1e} {worst:.1e}"
        );
    }
}

#[test]
fn roll_shorter_rows_and_other_pulses_are_handled() {
    let array = array(16, 0.004, 90.0);
    let mut spec = fan(9, 1.0, BeamSpacing::EquiAngle);
    spec.form.roll_stabilised = true;
    let mut fast = FastFan::new(steered(&array, &spec));
    let mut exact = FanFormer::new(steered(&array, &spec));
    let other = Pulse {
        kind: PulseKind::LfmDown,
        duration_s: 0.7e-3,
        ..pulse()
    };
    let (mut got, mut want) = (BeamFrame::default(), BeamFrame::default());
    for (pulse, samples, roll_rad, c) in [
        (pulse(), SAMPLES, 0.0, C),
        (other, 300, 0.1, C),
        (pulse(), 0, 0.1, C),
        (pulse(), 500, -0.2, 1460.0),
    ] {
        let frame = noise(16, samples);
        let mut plan = plan_at_rest(&pulse, samples, c);
        plan.nav.roll_rad = roll_rad;
        fast.form(&plan, &frame, &mut got);
        exact.form(&plan, &frame, &mut want);
        assert_eq!((got.beams, got.samples), (9, samples));
        assert_eq!(got.angle_rad, want.angle_rad);
        if samples > 0 {
            let (rms, worst) = error(&got, &want);
            assert!(
                rms < 2e-6 && worst < 2e-6,
                "{samples}: {rms:.1e} {worst:.1e}"
            );
        }
    }
}

#[test]
fn beams_are_bit_identical_on_one_thread_and_on_five() {
    let array = array(40, 0.004, 90.0);
    let spec = fan(23, 2.0, BeamSpacing::EquiAngle);
    let frame = noise(40, SAMPLES);
    let on = |threads: usize| {
        test_rig::on_threads(threads, || {
            let mut out = BeamFrame::default();
            let plan = plan_at_rest(&pulse(), SAMPLES, C);
            FastFan::new(steered(&array, &spec)).form(&plan, &frame, &mut out);
            out
        })
    };
    assert_eq!(on(1), on(5));
}

#[test]
fn scalar_and_simd_beams_agree_to_f32() {
    let array = array(32, 0.004, 90.0);
    let spec = fan(33, 2.0, BeamSpacing::EquiAngle);
    let frame = noise(32, SAMPLES);
    let with = |simd_level| {
        let mut former = FastFan::new(steered(&array, &spec));
        former.simd_level = simd_level;
        let mut out = BeamFrame::default();
        former.form(&plan_at_rest(&pulse(), SAMPLES, C), &frame, &mut out);
        out
    };
    let (rms, worst) = error(&with(SimdLevel::best()), &with(SimdLevel::PORTABLE));
    assert!(rms < 1e-6 && worst < 1e-6, "{rms:.1e} {worst:.1e}");
}

/// Selected by the name in the configuration.
#[test]
fn the_configuration_selects_this_fan() {
    let array = array(8, 0.004, 90.0);
    let transmit = test_rig::transmitter(DVec3::ZERO);
    let spec = fan(3, 1.0, BeamSpacing::EquiAngle);
    let fan = super::super::fan::Fan::new(
        &array,
        &transmit,
        &spec,
        limits(),
        &pulse(),
        Shading::Uniform,
        C,
    );
    assert!(fan.is_fast());
}
