//! Arrays, plans and plane waves for the tests of beamforming.

use std::f64::consts::TAU;

use glam::DVec3;
use num_complex::Complex64;

use super::RowLimits;
use echotank_config::spec::{FanForm, FanSpec, Former, Shading};
use echotank_core::arrays::{ArrayGeometry, Mounting, Pattern, TransmitArray};
use echotank_core::frames::rotation_from_angles;
use echotank_core::ping::{ElementFrame, PingPlan, Segment};
use echotank_core::pulse::{Pulse, PulseKind};
use echotank_core::testing::plan_at_rest;

/// Sound speed of these tests.
pub(crate) const C: f64 = 1500.0;

/// A pulse about 400 kHz.
pub(crate) fn pulse(kind: PulseKind, bandwidth_hz: f64, duration_s: f64, taper: f64) -> Pulse {
    Pulse {
        kind,
        center_frequency_hz: 400e3,
        bandwidth_hz,
        duration_s,
        taper,
    }
}

pub(crate) fn limits(sample_rate_hz: f64, samples: usize, pulse_s: f64) -> RowLimits {
    RowLimits {
        sample_rate_hz,
        samples,
        pulse_s,
    }
}

/// A fan about the boresight with equal steps of angle.
pub(crate) fn fan(beams: usize, sector_rad: f64, shading: Shading, former: Former) -> FanSpec {
    FanSpec {
        array: 0,
        beams,
        sector_rad,
        shading,
        form: FanForm {
            former,
            ..FanForm::default()
        },
    }
}

/// An omnidirectional transmitter.
pub(crate) fn transmitter(position_m: DVec3) -> TransmitArray {
    TransmitArray {
        mounting: Mounting {
            position_m,
            body_from_array: glam::DQuat::IDENTITY,
        },
        pattern: Pattern::Omnidirectional,
        level_offset_db: 0.0,
    }
}

/// Plan of a level platform that is at `position_m` at the pulse.
pub(crate) fn plan_moving(
    pulse: &Pulse,
    samples: usize,
    position_m: DVec3,
    velocity_m_per_s: DVec3,
) -> PingPlan {
    let mut plan = plan_at_rest(pulse, samples, C);
    plan.segments.push(Segment {
        start_s: 0.0,
        position_m,
        velocity_m_per_s,
        world_from_body: glam::DQuat::IDENTITY,
    });
    plan
}

/// The frame of array 0 with these samples, element-major.
pub(crate) fn frame(elements: usize, samples: usize, iq: Vec<Complex64>) -> ElementFrame {
    ElementFrame {
        array: 0,
        elements,
        samples,
        iq,
        saturated: 0,
    }
}

/// Distance from the peak to half its power towards `step`, in samples, interpolated linearly.
pub(crate) fn half_power(level: &[f64], peak: usize, step: isize) -> f64 {
    let half = level[peak] * 0.5_f64.sqrt();
    let mut k = peak;
    while level[k] > half {
        k = k.strict_add_signed(step);
    }
    let inner = k.strict_add_signed(-step);
    inner.abs_diff(peak) as f64 + (level[inner] - half) / (level[inner] - level[k])
}

/// The result of `work` in a pool of its own.
pub(crate) fn on_threads<T: Send>(threads: usize, work: impl FnOnce() -> T + Send) -> T {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
    pool.expect("a pool").install(work)
}

/// A line array at the body's origin, pointing down, rotated by `yaw_deg` (0: fore and aft, 90: x to starboard).
pub(crate) fn array(elements: usize, spacing_m: f64, yaw_deg: f64) -> ArrayGeometry {
    ArrayGeometry {
        mounting: Mounting {
            position_m: DVec3::ZERO,
            body_from_array: rotation_from_angles(0.0, 0.0, yaw_deg.to_radians()),
        },
        elements,
        spacing_m,
        radius_m: None,
        element_pattern: Pattern::Omnidirectional,
        sensitivity_db: 0.0,
        transmit: 0,
    }
}

/// Every element receives the pulse of `echo` with its leading edge's delay: exp(-j 2pi f_c u) a(t - u).
pub(crate) fn elements_of_plane_wave(
    array: &ArrayGeometry,
    rate_hz: f64,
    samples: usize,
    echo: impl Fn(usize) -> (Pulse, f64),
) -> ElementFrame {
    let mut iq = Vec::new();
    for e in 0..array.elements {
        let (pulse, delay_s) = echo(e);
        let carrier = Complex64::from_polar(1.0, -TAU * pulse.center_frequency_hz * delay_s);
        iq.extend((0..samples).map(|k| carrier * pulse.envelope(k as f64 / rate_hz - delay_s)));
    }
    frame(array.elements, samples, iq)
}

/// An endless tone from `sine` towards the array's +x.
pub(crate) fn tone(
    array: &ArrayGeometry,
    samples: usize,
    frequency_hz: f64,
    sine: f64,
) -> ElementFrame {
    let iq: Vec<_> = (0..array.elements)
        .flat_map(|e| {
            let early_s = array.along_m(e) * sine / C;
            std::iter::repeat_n(
                Complex64::from_polar(1.0, TAU * frequency_hz * early_s),
                samples,
            )
        })
        .collect();
    frame(array.elements, samples, iq)
}
