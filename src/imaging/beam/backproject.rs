//! Synthetic aperture: back-projection of many pings onto points in world coordinates.
//!
//! ```text
//! I(S) = 1/N sum over pings and elements of y_e(u) exp(+j 2pi f_c u),    u the two-way time of S by the polyline's first segment
//! ```
//!
//! y is the matched-filtered row, interpolated with a windowed sinc. u follows from the pose and velocity in the ping's plan, which are the
//! measured navigation; its errors defocus the image. A point that scatters with unit amplitude at every element has I = 1.
//!
//! The platform moves during the pulse. An echo with Doppler shift nu = f_c (eta - 1) changes phase by pi nu T over the pulse, and its
//! compressed peak is delayed by -nu T/(+-B). Both effects are removed to first order in eta - 1; otherwise the image would be displaced by
//! v T/2 along the track.
//!
//! Work is split by points; no sum crosses threads.
//!
//! Not modelled: curvature of the track during one echo, rotation, autofocus.

use std::f64::consts::{PI, TAU};

use glam::DVec3;
use num_complex::Complex64;
use rayon::prelude::*;

use super::RowLimits;
use super::matched::MatchedFilter;
use super::weights::Taper;
use echotank_config::spec::Shading;
use echotank_core::arrays::{ArrayGeometry, TransmitArray};
use echotank_core::ping::{ElementFrame, PingPlan};
use echotank_core::pulse::{Pulse, PulseKind};

/// Length of the interpolation filter and its number of sub-sample positions (the nearest is used: 0.5 % error at the band's edge).
const TAPS: usize = 16;
const FRACTIONS: usize = 256;
/// Number of points per unit of parallel work.
const POINTS_PER_TASK: usize = 256;

/// An image that accumulates pings.
pub struct BackProjection {
    points_m: Vec<DVec3>,
    image: Vec<Complex64>,
    filter: MatchedFilter,
    limits: RowLimits,
    row: Vec<Complex64>,
    interpolation: Vec<[f64; TAPS]>,
    added: usize,
}

impl BackProjection {
    /// `points_m` are world coordinates, metres. `weighting` is applied along the pulse.
    pub fn new(points_m: Vec<DVec3>, limits: RowLimits, pulse: &Pulse, weighting: Shading) -> Self {
        let taper = Taper::new(Shading::Kaiser { beta: 4.6 });
        let interpolation = (0..FRACTIONS)
            .map(|f| {
                let fraction = f as f64 / FRACTIONS as f64;
                std::array::from_fn(|i| {
                    let x = i as f64 - (TAPS / 2 - 1) as f64 - fraction;
                    let sinc = if x == 0.0 {
                        1.0
                    } else {
                        (PI * x).sin() / (PI * x)
                    };
                    sinc * taper.at(x / TAPS as f64)
                })
            })
            .collect();
        Self {
            image: vec![Complex64::ZERO; points_m.len()],
            points_m,
            filter: MatchedFilter::new(pulse, limits, weighting),
            limits,
            row: vec![Complex64::ZERO; limits.samples],
            interpolation,
            added: 0,
        }
    }

    /// Adds one ping of one array. `plan` contains the ping's measured navigation.
    pub fn add(
        &mut self,
        plan: &PingPlan,
        transmit: &TransmitArray,
        array: &ArrayGeometry,
        frame: &ElementFrame,
    ) {
        let Some(segment) = plan.segments.first() else {
            return;
        };
        self.filter.set_pulse(&plan.pulse);
        let world = |body_m: DVec3| segment.position_m + segment.world_from_body * body_m;
        let transmit_m = world(transmit.mounting.position_m);
        for e in 0..frame.elements {
            let row = &mut self.row[..frame.samples];
            row.copy_from_slice(frame.element(e));
            self.filter.apply(row);
            let received = ReceivedRow {
                transmit_m,
                receive_m: world(array.element_body_m(e)),
                velocity_m_per_s: segment.velocity_m_per_s,
                c: plan.sound_speed_m_per_s,
                pulse: plan.pulse,
                first_sample_s: plan.first_sample_s,
                rate_hz: self.limits.sample_rate_hz,
            };
            let (row, interpolation) = (&*row, &self.interpolation[..]);
            self.image
                .par_chunks_mut(POINTS_PER_TASK)
                .zip(self.points_m.par_chunks(POINTS_PER_TASK))
                .for_each(|(image, points)| {
                    for (pixel, point) in image.iter_mut().zip(points) {
                        *pixel += received.sample(*point, row, interpolation);
                    }
                });
            self.added += 1;
        }
    }

    /// The image: one value per point, divided by the number of rows added.
    pub fn image(&self) -> impl Iterator<Item = Complex64> + '_ {
        let scale = 1.0 / self.added.max(1) as f64;
        self.image.iter().map(move |x| x * scale)
    }
}

/// Geometry of one received row.
struct ReceivedRow {
    transmit_m: DVec3,
    /// Position at the start of the pulse.
    receive_m: DVec3,
    velocity_m_per_s: DVec3,
    c: f64,
    pulse: Pulse,
    first_sample_s: f64,
    rate_hz: f64,
}

impl ReceivedRow {
    /// The row at the point's two-way time, with the carrier phase removed.
    fn sample(
        &self,
        point_m: DVec3,
        row: &[Complex64],
        interpolation: &[[f64; TAPS]],
    ) -> Complex64 {
        let (c, v) = (self.c, self.velocity_m_per_s);
        let out = point_m - self.transmit_m;
        let out_m = out.length();
        // Travel time from the point to the receiver: |D - v tau| = c tau, solved in its well-conditioned form.
        let first_s = out_m / c;
        let d = point_m - self.receive_m - v * first_s;
        let (along, d2) = (d.dot(v), d.length_squared());
        let root = (along * along + (c * c - v.length_squared()) * d2).sqrt();
        let back_s = if root + along > 0.0 {
            d2 / (root + along)
        } else {
            0.0
        };
        let delay_s = first_s + back_s;
        let back = d - v * back_s;
        let closing = v.dot(out) / out_m.max(1e-9) + v.dot(back) / back.length().max(1e-9);
        let doppler_hz = self.pulse.center_frequency_hz * closing / c;
        let sweep_hz_per_s = self.pulse.sweep_hz_per_s();
        let early_s = match self.pulse.kind {
            PulseKind::Cw => 0.0,
            PulseKind::LfmUp | PulseKind::LfmDown => doppler_hz / sweep_hz_per_s,
        };
        let position_m = (delay_s - early_s - self.first_sample_s) * self.rate_hz;
        if !(position_m >= 0.0 && position_m < row.len() as f64) {
            return Complex64::ZERO;
        }
        let steps = (position_m * FRACTIONS as f64).round() as usize;
        let (whole, fraction) = (steps / FRACTIONS, steps % FRACTIONS);
        let mut sum = Complex64::ZERO;
        for (i, w) in interpolation[fraction].iter().enumerate() {
            let k = (whole + i).wrapping_sub(TAPS / 2 - 1);
            if let Some(y) = row.get(k) {
                sum += y * w;
            }
        }
        let cycles =
            self.pulse.center_frequency_hz * delay_s - 0.5 * doppler_hz * self.pulse.duration_s;
        sum * Complex64::from_polar(1.0, TAU * (cycles - cycles.round()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::beam::test_rig::{
        self, C, array, frame, half_power, limits, plan_moving, transmitter,
    };

    const LAMBDA_M: f64 = C / 400e3;
    const RATE_HZ: f64 = 40e3;
    const PINGS: usize = 100;
    /// A quarter of a 0.2 m transducer.
    const SPACING_M: f64 = 0.05;
    const RANGE_M: f64 = 40.0;
    const SPEED_M_PER_S: f64 = 2.5;
    const SAMPLES: usize = 500;
    const FIRST_S: f64 = 0.05;

    fn pulse() -> Pulse {
        test_rig::pulse(PulseKind::LfmUp, 30e3, 5e-3, 0.1)
    }

    fn plan(at_m: DVec3) -> PingPlan {
        PingPlan {
            first_sample_s: FIRST_S,
            ..plan_moving(&pulse(), SAMPLES, at_m, DVec3::X * SPEED_M_PER_S)
        }
    }

    /// Echo of a point by the retarded-time sum: pulse time t' from c (t - t') = |S - p_T(t')| + |S - r(t)|, with both ends moving.
    fn echo(point_m: DVec3, at_m: DVec3) -> ElementFrame {
        let v = DVec3::X * SPEED_M_PER_S;
        let pulse = pulse();
        let iq = (0..SAMPLES)
            .map(|k| {
                let t = FIRST_S + k as f64 / RATE_HZ;
                let back_m = point_m.distance(at_m + v * t);
                let mut sent = 0.0;
                for _ in 0..20 {
                    sent = t - (back_m + point_m.distance(at_m + v * sent)) / C;
                }
                let cycles = pulse.center_frequency_hz * (sent - t);
                pulse.envelope(sent) * Complex64::from_polar(1.0, TAU * (cycles - cycles.round()))
            })
            .collect();
        frame(1, SAMPLES, iq)
    }

    fn position_m(ping: usize) -> DVec3 {
        DVec3::X * ((ping as f64 - 0.5 * (PINGS as f64 - 1.0)) * SPACING_M)
    }

    /// The image along the track through a point at broadside, in steps of a millimetre; `error_m` displaces the navigation of each ping.
    fn image(error_m: impl Fn(usize) -> DVec3) -> Vec<f64> {
        let point = DVec3::new(0.0, 0.0, RANGE_M);
        let pixels: Vec<_> = (-150..=150)
            .map(|i| point + DVec3::X * f64::from(i) * 1e-3)
            .collect();
        let limits = limits(RATE_HZ, SAMPLES, 5e-3);
        let transmit = transmitter(DVec3::ZERO);
        let mut image = BackProjection::new(pixels, limits, &pulse(), Shading::Uniform);
        for ping in 0..PINGS {
            let frame = echo(point, position_m(ping));
            let believed = plan(position_m(ping) + error_m(ping));
            image.add(&believed, &transmit, &array(1, 0.2, 0.0), &frame);
        }
        image.image().map(|x| x.norm()).collect()
    }

    #[test]
    fn a_hundred_pings_resolve_0p886_lambda_r_over_twice_the_track() {
        let level = image(|_| DVec3::ZERO);
        let peak = (0..301).fold(0, |b, k| if level[k] > level[b] { k } else { b });
        assert!(peak.abs_diff(150) <= 1, "peak {} mm off", peak as i64 - 150);
        // Doppler at the ends of the track costs 3 % of the time-bandwidth product.
        assert!((level[peak] - 1.0).abs() < 0.05, "{}", level[peak]);
        let width_m = 1e-3 * (half_power(&level, peak, 1) + half_power(&level, peak, -1));
        let want_m = 0.886 * LAMBDA_M * RANGE_M / (2.0 * PINGS as f64 * SPACING_M);
        println!(
            "{:.2} mm, closed form {:.2} mm",
            width_m * 1e3,
            want_m * 1e3
        );
        assert!(
            (width_m / want_m - 1.0).abs() < 0.1,
            "{width_m} want {want_m}"
        );
    }

    /// A bowed track, wrong by a metres at its ends in the navigation: the phase error over the aperture is 4 pi a xi^2/lambda, and the
    /// peak falls to the mean of its phasor.
    #[test]
    fn a_navigation_error_defocuses_by_the_predicted_phase() {
        for share in [0.125, 0.25, 0.5] {
            let a_m = share * LAMBDA_M;
            let xi = |ping: usize| (ping as f64 + 0.5) / (0.5 * PINGS as f64) - 1.0;
            let level = image(|ping| DVec3::Z * (a_m * xi(ping).powi(2)));
            let predicted: Complex64 = (0..PINGS)
                .map(|p| Complex64::from_polar(1.0, 2.0 * TAU * share * xi(p).powi(2)))
                .sum::<Complex64>()
                / PINGS as f64;
            let off_db = 20.0 * (level[150] / predicted.norm()).log10();
            println!(
                "{share} lambda: {:.2} dB, predicted {:.2}",
                20.0 * level[150].log10(),
                20.0 * predicted.norm().log10()
            );
            assert!(off_db.abs() < 0.4, "{share}: off by {off_db:.2} dB");
        }
    }
}
