//! Array factor of a subarray that is synthesised as one element at its middle.
//!
//! An element at x from the middle receives an echo later than the middle by delta(x). The mean
//! over the subarray is then the echo at the middle times the array factor G:
//!
//! ```text
//! G = 1/n sum_x exp(-j 2 pi f_c delta(x))
//! c delta = (Q - D) / (1 + w / (Q c)),    q = d - x,   Q = |q|,   D = |d|,   w = v . q
//! ```
//!
//! Here d is the scatterer relative to the middle in array axes, halfway through the echo, and v is
//! the velocity of the middle. Q - D is evaluated as x (x - 2 d_x)/(Q + D) to avoid cancellation.
//!
//! The result is exact in the near field at the carrier. It neglects the delay of the envelope
//! (bandwidth times delta), the change of G during the echo, and differences of level, pattern and
//! Doppler between the elements. `method_selection::parts` estimates the resulting error.

use glam::{DMat3, DVec3};
use num_complex::Complex64;

use crate::arrivals::CHUNK;
use echotank_core::arrays::{ArrayGeometry, Pattern};
use echotank_core::ping::PingPlan;
use echotank_core::simd::widest;

use super::super::elementary::cis;
use super::super::paths::{ElementTrack, Rays};

/// Elements of each subarray of a line array.
pub(super) struct SubarrayElements {
    count: usize,
    spacing_m: f64,
    c: f64,
    cycles_per_m: f64,
    half_pulse_s: f64,
}

/// Array factors of a batch of echoes, with the geometry of the echoes.
pub(super) struct ArrayFactor {
    len: usize,
    /// Coordinates of the scatterers along the line, relative to the middle, halfway through the echoes.
    x_m: [f64; CHUNK],
    /// Squared distances of the scatterers from the line.
    beside_m2: [f64; CHUNK],
    range_m: [f64; CHUNK],
    /// v . d without the component along the line.
    beside_m2_per_s: [f64; CHUNK],
    re: [f64; CHUNK],
    im: [f64; CHUNK],
}

impl Default for ArrayFactor {
    fn default() -> Self {
        let zero = [0.0; CHUNK];
        Self {
            len: 0,
            x_m: zero,
            beside_m2: zero,
            range_m: zero,
            beside_m2_per_s: zero,
            re: zero,
            im: zero,
        }
    }
}

impl ArrayFactor {
    pub(super) fn of_each(&self) -> impl Iterator<Item = Complex64> {
        let parts = self.re[..self.len].iter().zip(&self.im);
        parts.map(|(&re, &im)| Complex64::new(re, im))
    }
}

impl SubarrayElements {
    /// Array factor of a line array of subarrays; `None` for any other array.
    pub(super) fn of(plan: &PingPlan, array: &ArrayGeometry) -> Option<Self> {
        let Pattern::Part {
            elements,
            spacing_m,
            ..
        } = array.element_pattern
        else {
            return None;
        };
        let c = plan.sound_speed_m_per_s;
        Some(Self {
            count: elements,
            spacing_m,
            c,
            cycles_per_m: plan.pulse.center_frequency_hz / c,
            half_pulse_s: 0.5 * plan.pulse.duration_s,
        })
    }

    /// Computes the array factors of the first `n` echoes of a batch that is solved on `track`.
    pub(super) fn array_factor(
        &self,
        plan: &PingPlan,
        track: &ElementTrack,
        rays: &Rays,
        n: usize,
        out: &mut ArrayFactor,
    ) {
        out.len = n;
        // One velocity serves the whole batch. It moves a scatterer only by half a pulse, a minor
        // part of the delay.
        let delay_s = rays.delay_s[..n]
            .iter()
            .copied()
            .fold(f64::INFINITY, f64::min);
        let (velocity, body_from_array) = track.velocity_at(plan, delay_s);
        let v = DMat3::from_quat(body_from_array.inverse()) * velocity;
        for i in 0..n {
            let d = DVec3::new(rays.array_x_m[i], rays.array_y_m[i], rays.array_z_m[i])
                - v * self.half_pulse_s;
            out.x_m[i] = d.x;
            out.beside_m2[i] = d.y * d.y + d.z * d.z;
            out.range_m[i] = d.length();
            out.beside_m2_per_s[i] = v.y * d.y + v.z * d.z;
        }
        out.re[..n].fill(0.0);
        out.im[..n].fill(0.0);
        widest(
            #[inline(always)]
            || sum(self, v.x, out),
        );
    }
}

#[inline(always)]
fn sum(part: &SubarrayElements, along_m_per_s: f64, out: &mut ArrayFactor) {
    let n = out.len.min(CHUNK);
    let c = part.c;
    for j in 0..part.count {
        let e = (j as f64 - 0.5 * (part.count as f64 - 1.0)) * part.spacing_m;
        let (x_m, beside_m2) = (&out.x_m[..n], &out.beside_m2[..n]);
        let (range_m, beside_m2_per_s) = (&out.range_m[..n], &out.beside_m2_per_s[..n]);
        let (re, im) = (&mut out.re[..n], &mut out.im[..n]);
        for i in 0..n {
            let along = x_m[i] - e;
            let q = (along * along + beside_m2[i]).sqrt();
            let closing = along_m_per_s * along + beside_m2_per_s[i];
            // (Q - D)/(1 + w/(Q c)) as one fraction. The fraction is never 0/0, even for a
            // scatterer on an element.
            let over = e * (e - 2.0 * x_m[i]) * q * c;
            let under = ((q + range_m[i]) * (q * c + closing)).max(f64::MIN_POSITIVE);
            let (cos, sin) = cis(over / under * part.cycles_per_m);
            re[i] += cos;
            im[i] -= sin;
        }
    }
    let share = 1.0 / part.count as f64;
    for (re, im) in out.re[..n].iter_mut().zip(&mut out.im[..n]) {
        *re *= share;
        *im *= share;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use echotank_core::simd::SimdLevel;
    use std::f64::consts::TAU;

    fn place(k: usize, step: f64) -> f64 {
        (k as f64 * step).fract() - 0.5
    }

    fn part(count: usize) -> SubarrayElements {
        SubarrayElements {
            count,
            spacing_m: 0.01,
            c: 1500.0,
            cycles_per_m: 300.0,
            half_pulse_s: 0.0,
        }
    }

    /// `v`: velocity of the middle in array axes.
    fn batch(v: DVec3) -> (Vec<DVec3>, ArrayFactor) {
        let mut out = ArrayFactor {
            len: CHUNK,
            ..ArrayFactor::default()
        };
        let place_m = |k: usize| {
            DVec3::new(
                20.0 * place(k, 0.618),
                5.0 * place(k, 0.755),
                3.0 + 60.0 * (0.5 + place(k, 0.57)),
            )
        };
        let places: Vec<DVec3> = (0..CHUNK).map(place_m).collect();
        for (i, d) in places.iter().enumerate() {
            out.x_m[i] = d.x;
            out.beside_m2[i] = d.y * d.y + d.z * d.z;
            out.range_m[i] = d.length();
            out.beside_m2_per_s[i] = v.y * d.y + v.z * d.z;
        }
        (places, out)
    }

    /// Expected value: the delay of each element by fixed-point iteration on c t = |d - x - v t|.
    #[test]
    fn the_array_factor_is_the_mean_of_the_elements_carrier_phases() {
        let v = DVec3::new(5.0, 0.3, -1.0);
        for count in [2, 5, 8] {
            let part = part(count);
            let (places, mut out) = batch(v);
            sum(&part, v.x, &mut out);
            let mut worst = 0.0f64;
            for (d, got) in places.iter().zip(out.of_each()) {
                let mut want = Complex64::ZERO;
                for j in 0..count {
                    let x = DVec3::X * (j as f64 - 0.5 * (count as f64 - 1.0)) * 0.01;
                    let mut late_s = 0.0;
                    for _ in 0..20 {
                        late_s = ((*d - x - v * late_s).length() - d.length()) / 1500.0;
                    }
                    want += Complex64::cis(-TAU * 300.0 * 1500.0 * late_s) / count as f64;
                }
                worst = worst.max((got - want).norm());
            }
            println!("{count} elements: {worst:.1e}");
            // The closed form neglects terms of second order in v/c: a path of (v x/c)^2/(2 Q).
            assert!(worst < 1e-5, "{count}: {worst:e}");
        }
    }

    #[test]
    fn a_single_element_has_array_factor_one() {
        let (_, mut out) = batch(DVec3::ZERO);
        sum(&part(1), 0.0, &mut out);
        assert!(out.of_each().all(|g| g == Complex64::ONE));
    }

    #[test]
    fn every_build_gives_the_same_bits() {
        let v = DVec3::new(5.0, 0.3, -1.0);
        let run = |level: SimdLevel| {
            let (part, (_, mut out)) = (part(7), batch(v));
            level.run(
                #[inline(always)]
                || sum(&part, v.x, &mut out),
            );
            [out.re, out.im].map(|x| x.map(f64::to_bits))
        };
        let want = run(SimdLevel::PORTABLE);
        assert!(want[1].iter().filter(|&&x| x != 0).count() > CHUNK / 2);
        assert!(SimdLevel::available().all(|level| run(level) == want));
    }
}
