//! A part of a line taken as one: what its elements' places make of an echo that is put together in its middle.
//!
//! An element x beside the middle hears an echo later by delta(x) than the middle does, and the part's mean is then the middle's echo times
//!
//! ```text
//! G = 1/n sum_x exp(-j 2 pi f_c delta(x))
//! c delta = (Q - D) / (1 + w / (Q c)),    q = d - x,   Q = |q|,   D = |d|,   w = v . q
//! ```
//!
//! d the scatterer from the middle in array axes, in the middle of the echo, and v the middle's velocity there; Q - D is formed as x (x - 2 d_x)/(Q + D).
//! This is exact in the near field, at the carrier. What it leaves out: the delay of the envelope (bandwidth times delta), how the part's
//! answer changes during the echo, and that each element has a level, a pattern and a Doppler of its own. `run::method_selection::parts` says what comes
//! of it.

use glam::{DMat3, DVec3};
use num_complex::Complex64;

use echotank_core::flow::{ArrayGeometry, CHUNK, Pattern, PingPlan};

use super::super::elementary::cis;
#[cfg(target_arch = "x86_64")]
use super::super::paths::has_avx512;
use super::super::paths::{ElementTrack, Rays};

/// The elements of every part of a line.
pub(super) struct Elements {
    count: usize,
    spacing_m: f64,
    c: f64,
    cycles_per_m: f64,
    half_pulse_s: f64,
}

/// What a batch of echoes is to be multiplied with.
pub(super) struct Answer {
    len: usize,
    /// Scatterers from the part's middle in array axes, halfway through their echoes: along the line, and the rest squared.
    x_m: [f64; CHUNK],
    beside_m2: [f64; CHUNK],
    range_m: [f64; CHUNK],
    /// v . d without the part along the line.
    beside_m2_per_s: [f64; CHUNK],
    re: [f64; CHUNK],
    im: [f64; CHUNK],
}

impl Default for Answer {
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

impl Answer {
    pub(super) fn of_each(&self) -> impl Iterator<Item = Complex64> {
        let parts = self.re[..self.len].iter().zip(&self.im);
        parts.map(|(&re, &im)| Complex64::new(re, im))
    }
}

impl Elements {
    /// None where elements are elements.
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

    /// Of the first `n` of a batch that has been solved on `track`.
    pub(super) fn answer(
        &self,
        plan: &PingPlan,
        track: &ElementTrack,
        rays: &Rays,
        n: usize,
        out: &mut Answer,
    ) {
        out.len = n;
        // One velocity does for a batch: it moves the scatterer by half a pulse's worth, and is the smaller part of a delay.
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
        #[cfg(target_arch = "x86_64")]
        {
            if has_avx512() {
                // SAFETY: asked on the line above; the function needs nothing else.
                return unsafe { sum_avx512(self, v.x, out) };
            }
            if is_x86_feature_detected!("avx2") {
                // SAFETY: asked on the line above; the function needs nothing else.
                return unsafe { sum_avx2(self, v.x, out) };
            }
        }
        sum_plain(self, v.x, out);
    }
}

/// The AVX2 and AVX-512 builds of [`sum_plain`]: the same arithmetic in the same order, so the same bits.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn sum_avx2(part: &Elements, along_m_per_s: f64, out: &mut Answer) {
    sum_plain(part, along_m_per_s, out);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512dq,avx512vl")]
fn sum_avx512(part: &Elements, along_m_per_s: f64, out: &mut Answer) {
    sum_plain(part, along_m_per_s, out);
}

#[inline(always)]
fn sum_plain(part: &Elements, along_m_per_s: f64, out: &mut Answer) {
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
            // (Q - D)/(1 + w/(Q c)) over one bar; never 0/0, not even where the scatterer sits on an element.
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
    use std::f64::consts::TAU;

    fn place(k: usize, step: f64) -> f64 {
        (k as f64 * step).fract() - 0.5
    }

    fn part(count: usize) -> Elements {
        Elements {
            count,
            spacing_m: 0.01,
            c: 1500.0,
            cycles_per_m: 300.0,
            half_pulse_s: 0.0,
        }
    }

    /// `v`: the middle's velocity in array axes.
    fn batch(v: DVec3) -> (Vec<DVec3>, Answer) {
        let mut out = Answer {
            len: CHUNK,
            ..Answer::default()
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

    /// Each element's delay by fixed-point iteration on c t = |d - x - v t|, in place of the closed form.
    #[test]
    fn a_part_answers_as_its_elements_hear_the_carrier() {
        let v = DVec3::new(5.0, 0.3, -1.0);
        for count in [2, 5, 8] {
            let part = part(count);
            let (places, mut out) = batch(v);
            sum_plain(&part, v.x, &mut out);
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
            // Of the second order in v/c: (v x/c)^2/(2 Q) of path.
            assert!(worst < 1e-5, "{count}: {worst:e}");
        }
    }

    #[test]
    fn an_element_alone_answers_with_one() {
        let (_, mut out) = batch(DVec3::ZERO);
        sum_plain(&part(1), 0.0, &mut out);
        assert!(out.of_each().all(|g| g == Complex64::ONE));
    }

    #[cfg(target_arch = "x86_64")]
    #[test]
    fn every_build_gives_the_same_bits() {
        let v = DVec3::new(5.0, 0.3, -1.0);
        let run = |sum: &dyn Fn(&Elements, &mut Answer)| {
            let (_, mut out) = batch(v);
            sum(&part(7), &mut out);
            [out.re, out.im].map(|x| x.map(f64::to_bits))
        };
        let want = run(&|part, out| sum_plain(part, v.x, out));
        assert!(want[1].iter().filter(|&&x| x != 0).count() > CHUNK / 2);
        if is_x86_feature_detected!("avx2") {
            // SAFETY: asked above.
            assert!(run(&|part, out| unsafe { sum_avx2(part, v.x, out) }) == want);
        }
        if has_avx512() {
            // SAFETY: asked above.
            assert!(run(&|part, out| unsafe { sum_avx512(part, v.x, out) }) == want);
        }
    }
}
