//! Direct sum of the echoes, `direct`. The emission time of each echo is expanded about its leading edge u; the sum is otherwise
//! exact:
//!
//! x(t) = sum A exp(-j 2pi f_c u) a(t') exp(j 2pi f_c (t' - s)),  t' = eta s + q s^2,  s = t - u,  0 <= t' <= T.
//!
//! q is zero for all Doppler models except `stretch-quadratic`. Over a run of samples, the phase of one echo is a quadratic in the
//! sample number. (With q, a cubic part below 1e-6 rad remains.) Two complex products therefore give each phasor from the previous
//! one. Eight lanes of eight samples are computed together. They restart from sines and cosines before rounding errors grow.

use num_complex::Complex64;

use crate::arrivals::{ArrivalChunk, ArrivalSink};
use crate::edges::{END_POINTS, EndWeights, FIRST_POINT};
use echotank_core::ping::PingPlan;
use echotank_core::pulse::Pulse;

use super::phasor::{LANES, cis, cis_lanes};

/// Number of samples between restarts of the recurrence. Its error grows as steps^1.5; 64 steps of eight lanes stay below 1e-13.
const RESTART: usize = 64 * LANES;

/// Maximum phase error of a run from the neglected cubic part, in turns. It limits the length of runs with a changing stretch.
pub(crate) const CUBIC_TURNS: f64 = 1e-7;

/// Sink that adds echoes to the samples of one element.
pub struct Direct<'a> {
    pulse: Pulse,
    rate_hz: f64,
    first_sample_s: f64,
    ends: Option<&'a EndWeights>,
    out: &'a mut [Complex64],
}

/// Extent of an echo, in samples from the first sample of the record. It may extend beyond the record.
struct Span {
    /// First sample within the pulse.
    first: f64,
    /// Last sample within the pulse.
    last: f64,
    /// Distances from the leading edge to the first sample, and from the last sample to the trailing edge, samples.
    inside: (f64, f64),
}

impl<'a> Direct<'a> {
    /// Sink for samples at `first_sample_s + k / rate_hz` seconds after the start of the pulse. Echoes are added to the values of
    /// `out`.
    pub fn new(
        plan: &PingPlan,
        rate_hz: f64,
        first_sample_s: f64,
        out: &'a mut [Complex64],
    ) -> Self {
        Self {
            pulse: plan.pulse,
            rate_hz,
            first_sample_s,
            ends: None,
            out,
        }
    }

    /// Weights the points next to the breaks of each echo, for a sum that a filter follows
    /// ([`Decimator::ends`](super::Decimator::ends)). `None` leaves the values at the samples, as from a receiver without a filter.
    pub fn with_ends(mut self, ends: Option<&'a EndWeights>) -> Self {
        self.ends = ends;
        self
    }

    /// Range of the samples with 0 <= t' <= T.
    #[inline(always)]
    fn span(&self, echo: &Echo) -> Span {
        let delay_s = echo.delay_s;
        let since_s = |k: f64| (self.first_sample_s + k / self.rate_hz) - delay_s;
        let emitted_s = |k: f64| echo.emitted_s(since_s(k));
        let edge = |at_s: f64| (at_s - self.first_sample_s) * self.rate_hz;
        let duration_s = self.pulse.duration_s;
        let trailing_s = echo.received_s(duration_s);
        // The estimates are wrong by at most two samples. The condition on t' gives the exact range.
        let mut first = edge(delay_s).floor();
        let mut last = edge(delay_s + trailing_s).ceil();
        for _ in 0..2 {
            first += f64::from(u8::from(emitted_s(first) < 0.0));
            last -= f64::from(u8::from(emitted_s(last) > duration_s));
        }
        Span {
            first,
            last,
            inside: (
                since_s(first) * self.rate_hz,
                (trailing_s - since_s(last)) * self.rate_hz,
            ),
        }
    }

    /// Adds the echoes of a chunk. `add_flat` is [`Lanes::add_flat`] or its AVX2 build.
    #[inline(always)]
    fn add(&mut self, chunk: &ArrivalChunk, add_flat: impl Fn(&mut Lanes, &mut [Block]) + Copy) {
        let pulse = self.pulse;
        for i in 0..chunk.len {
            let (delay_s, doppler) = (chunk.delay_s[i], chunk.doppler[i]);
            let curvature_per_s = chunk.curvature_per_s[i];
            let amplitude = chunk.amplitude[i];
            let echo = Echo {
                pulse: &pulse,
                step_s: 1.0 / self.rate_hz,
                delay_s,
                doppler,
                curvature_per_s,
            };
            let span = self.span(&echo);
            // The conversion to integer saturates: a negative start gives 0, a negative end an empty range.
            let end = ((span.last + 1.0).max(0.0) as usize).min(self.out.len());
            let mut first = (span.first.max(0.0) as usize).min(end);
            if let Some(ends) = self.ends {
                self.correct_ends(ends, &echo, &span, amplitude);
            }
            let longest = echo.longest_run();
            while first < end {
                let stop = end.min(first + longest);
                let since_s = (self.first_sample_s + first as f64 / self.rate_hz) - delay_s;
                let run = echo.run(since_s, (stop - first) as f64);
                add_stretch(&run, amplitude, &mut self.out[first..stop], add_flat);
                first = stop;
            }
        }
    }

    /// Adds the difference between the weights of [`EndWeights`] and 1 at the points next to all breaks of an echo.
    #[inline(always)]
    fn correct_ends(&mut self, ends: &EndWeights, echo: &Echo, span: &Span, amplitude: Complex64) {
        // Also false for delays that are no numbers.
        let near = span.first < self.out.len() as f64 - FIRST_POINT && span.last > FIRST_POINT;
        if !near {
            return;
        }
        let duration_s = self.pulse.duration_s;
        let flank_s = 0.5 * self.pulse.taper * duration_s;
        if flank_s <= 0.0 {
            let leading = (span.first, span.inside.0, 1.0);
            let trailing = (span.last, span.inside.1, -1.0);
            for end in [leading, trailing] {
                self.correct_end(ends, echo, end, None, amplitude);
            }
            return;
        }
        // Beside the ends of a flank, the taper is sin^2 on one side and 0 on the other, or 1 - sin^2 = cos^2 is added to it. Both are the same
        // function of the time from the break.
        let turns_per_s = 0.5 / flank_s;
        for (break_s, inward) in [
            (0.0, 1.0),
            (flank_s, 1.0),
            (duration_s - flank_s, -1.0),
            (duration_s, -1.0),
        ] {
            let at =
                (echo.received_s(break_s) + (echo.delay_s - self.first_sample_s)) * self.rate_hz;
            let first = if inward > 0.0 { at.ceil() } else { at.floor() };
            let end = (first, (first - at).abs(), inward);
            self.correct_end(ends, echo, end, Some((break_s, turns_per_s)), amplitude);
        }
    }

    /// Corrects one end of a piece of an echo that continues in direction `inward` (1 or -1) from point `first`, which is `inside` points from the
    /// end. `flank`: the emission time from which the level rises as a flank, and half the inverse of the flank's length; none for a level of 1.
    #[inline(always)]
    fn correct_end(
        &mut self,
        ends: &EndWeights,
        echo: &Echo,
        (first, inside, inward): (f64, f64, f64),
        flank: Option<(f64, f64)>,
        amplitude: Complex64,
    ) {
        let mut weights = ends.at(inside);
        let (mut since_s, mut turns) = ([0.0; END_POINTS], [0.0; END_POINTS]);
        for j in 0..END_POINTS {
            let at = first + inward * (FIRST_POINT + j as f64);
            since_s[j] = (self.first_sample_s + at / self.rate_hz) - echo.delay_s;
            turns[j] = echo.turns(since_s[j]);
        }
        if let Some((break_s, turns_per_s)) = flank {
            let rise = since_s.map(|since_s| (echo.emitted_s(since_s) - break_s) * turns_per_s);
            let (cos, _) = cis_lanes(rise);
            for (weight, cos) in weights.iter_mut().zip(cos) {
                *weight *= 0.5 - 0.5 * cos;
            }
        }
        let (cos, sin) = cis_lanes(turns);
        for j in 0..END_POINTS {
            let at = first + inward * (FIRST_POINT + j as f64);
            if at >= 0.0 && at < self.out.len() as f64 {
                self.out[at as usize] += amplitude * Complex64::new(cos[j], sin[j]) * weights[j];
            }
        }
    }

    /// AVX2 build of [`Self::add`], with the same arithmetic in the same order, so the same bits.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn add_avx2(&mut self, chunk: &ArrivalChunk) {
        self.add(chunk, |lanes, blocks| lanes.add_flat_avx2(blocks));
    }
}

impl ArrivalSink for Direct<'_> {
    fn accept(&mut self, chunk: &ArrivalChunk) {
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") {
            // SAFETY: the line above tests that the processor has AVX2; the function has no other requirement.
            return unsafe { self.add_avx2(chunk) };
        }
        self.add(chunk, Lanes::add_flat);
    }
}

/// Consecutive samples of the output.
type Block = [Complex64; LANES];

/// Echo of unit amplitude.
struct Echo<'p> {
    pulse: &'p Pulse,
    /// Interval between samples, seconds.
    step_s: f64,
    delay_s: f64,
    doppler: f64,
    curvature_per_s: f64,
}

impl Echo<'_> {
    /// Phase at `since_s` after the leading edge, in turns, without whole turns of the carrier.
    #[inline(always)]
    fn turns(&self, since_s: f64) -> f64 {
        let carrier_hz = self.pulse.center_frequency_hz;
        let from_middle_s = self.emitted_s(since_s) - 0.5 * self.pulse.duration_s;
        let carrier = carrier_hz * self.delay_s;
        // Whole turns are removed first, which preserves the digits of the rest.
        0.5 * self.pulse.sweep_hz_per_s() * from_middle_s * from_middle_s
            + carrier_hz * (self.doppler + self.curvature_per_s * since_s) * since_s
            - (carrier - carrier.round_ties_even())
    }

    /// Emission time of the sound that arrives `since_s` after the leading edge, seconds.
    #[inline(always)]
    fn emitted_s(&self, since_s: f64) -> f64 {
        ((1.0 + self.doppler) + self.curvature_per_s * since_s) * since_s
    }

    /// Time after the leading edge at which the sound of an emission time arrives, seconds.
    #[inline(always)]
    fn received_s(&self, emitted_s: f64) -> f64 {
        let eta = 1.0 + self.doppler;
        let root = (eta * eta + 4.0 * self.curvature_per_s * emitted_s).sqrt();
        2.0 * emitted_s / (eta + root)
    }

    /// Maximum number of samples between restarts of the recurrence.
    #[inline(always)]
    fn longest_run(&self) -> usize {
        if self.curvature_per_s == 0.0 {
            return RESTART;
        }
        // The error is count^3/32 times the cubic coefficient; see `run`.
        let cubic = self.pulse.sweep_hz_per_s() * self.curvature_per_s * self.step_s.powi(3);
        let count = (32.0 * CUBIC_TURNS / cubic.abs()).cbrt();
        ((count as usize) / LANES * LANES).clamp(LANES, RESTART)
    }

    /// Phase coefficients of `count` samples that begin `since_s` after the leading edge.
    #[inline(always)]
    fn run(&self, since_s: f64, count: f64) -> SampleRun {
        let pulse = self.pulse;
        let carrier_hz = pulse.center_frequency_hz;
        let half_sweep = 0.5 * pulse.sweep_hz_per_s();
        let curvature = self.curvature_per_s;
        // Emission time of sample n: emitted + step n + curvature n^2.
        let emitted_s = ((1.0 + self.doppler) + curvature * since_s) * since_s;
        let step_s = ((1.0 + self.doppler) + 2.0 * curvature * since_s) * self.step_s;
        let curvature_s = curvature * self.step_s * self.step_s;
        let from_middle_s = emitted_s - 0.5 * pulse.duration_s;
        let shift_hz = carrier_hz * (self.doppler + 2.0 * curvature * since_s);
        // The square has a cubic part, and a much smaller quartic part. On 0..count, the best parabola for n^3 is (3/2) count n^2 -
        // (9/16) count^2 n + count^3/32. Its error is at most count^3/32.
        let cubic = 2.0 * half_sweep * step_s * curvature_s;
        SampleRun {
            p0: self.turns(since_s) + cubic * count * count * count / 32.0,
            p1: 2.0 * half_sweep * from_middle_s * step_s + shift_hz * self.step_s
                - cubic * count * count * (9.0 / 16.0),
            p2: half_sweep * (step_s * step_s + 2.0 * from_middle_s * curvature_s)
                + carrier_hz * curvature_s
                + cubic * count * 1.5,
            emitted_s,
            step_s,
            curvature_s,
            duration_s: pulse.duration_s,
            flank_s: 0.5 * pulse.taper * pulse.duration_s,
        }
    }
}

/// Run of samples of one echo. The phase of sample n is p0 + p1 n + p2 n^2 turns.
struct SampleRun {
    p0: f64,
    p1: f64,
    p2: f64,
    /// Emission time of sample n: emitted + step n + curvature n^2.
    emitted_s: f64,
    step_s: f64,
    curvature_s: f64,
    duration_s: f64,
    /// Length of one flank of the Tukey taper, seconds.
    flank_s: f64,
}

impl SampleRun {
    /// Range of the blocks, of `count` blocks of [`LANES`] samples, in which the taper is 1 throughout.
    #[inline(always)]
    fn flat_blocks(&self, count: usize) -> std::ops::Range<usize> {
        if self.flank_s <= 0.0 {
            return 0..count;
        }
        // The curvature, below 1e-8 s, shifts a block by less than a sample. The taper is smooth where a flank meets the flat part.
        let block_at = |t_s: f64| (t_s - self.emitted_s) / (self.step_s * LANES as f64);
        let first = block_at(self.flank_s).ceil().max(0.0) as usize;
        let end = block_at(self.duration_s - self.flank_s).floor().max(0.0) as usize;
        let end = end.min(count);
        first.min(end)..end
    }

    /// Tukey weights of the block that starts at sample `n`.
    #[inline(always)]
    fn taper(&self, n: usize) -> [f64; LANES] {
        if self.flank_s <= 0.0 {
            return [1.0; LANES];
        }
        let turns_per_s = 0.5 / self.flank_s;
        let mut turns = [0.0; LANES];
        for (j, turns) in turns.iter_mut().enumerate() {
            let n = (n + j) as f64;
            let t_s = self.emitted_s + n * (self.step_s + n * self.curvature_s);
            // `clamp` would check its bounds, which keeps the loop from being vectorised.
            let inside_s = t_s.min(self.duration_s - t_s).max(0.0).min(self.flank_s);
            *turns = inside_s * turns_per_s;
        }
        let (cos, _) = cis_lanes(turns);
        cos.map(|cos| 0.5 - 0.5 * cos)
    }
}

/// Eight consecutive samples of one echo.
struct Lanes {
    /// Values of the echo.
    re: [f64; LANES],
    im: [f64; LANES],
    /// Factor that advances each lane by one block.
    step_re: [f64; LANES],
    step_im: [f64; LANES],
    /// Factor that advances `step_re` and `step_im` by one block.
    turn: (f64, f64),
}

impl Lanes {
    #[inline(always)]
    fn new(echo: &SampleRun, amplitude: Complex64) -> Self {
        const STEP: f64 = LANES as f64;
        let (p1, p2) = (echo.p1, echo.p2);
        let (mut now, mut forward) = ([0.0; LANES], [0.0; LANES]);
        for j in 0..LANES {
            let n = j as f64;
            now[j] = echo.p0 + n * (p1 + n * p2);
            forward[j] = STEP * (p1 + p2 * (2.0 * n + STEP));
        }
        let (cos, sin) = cis_lanes(now);
        let (step_re, step_im) = cis_lanes(forward);
        let (mut re, mut im) = ([0.0; LANES], [0.0; LANES]);
        for j in 0..LANES {
            re[j] = amplitude.re * cos[j] - amplitude.im * sin[j];
            im[j] = amplitude.re * sin[j] + amplitude.im * cos[j];
        }
        Self {
            re,
            im,
            step_re,
            step_im,
            turn: cis(2.0 * STEP * STEP * p2),
        }
    }

    #[inline(always)]
    fn advance(&mut self) {
        let (turn_re, turn_im) = self.turn;
        for j in 0..LANES {
            let re = self.re[j] * self.step_re[j] - self.im[j] * self.step_im[j];
            self.im[j] = self.re[j] * self.step_im[j] + self.im[j] * self.step_re[j];
            self.re[j] = re;
            let step_re = self.step_re[j] * turn_re - self.step_im[j] * turn_im;
            self.step_im[j] = self.step_re[j] * turn_im + self.step_im[j] * turn_re;
            self.step_re[j] = step_re;
        }
    }

    /// Inner loop of the flat part: only the sum and the recurrence.
    #[inline(always)]
    fn add_flat(&mut self, blocks: &mut [Block]) {
        for samples in blocks {
            for (j, sample) in samples.iter_mut().enumerate() {
                sample.re += self.re[j];
                sample.im += self.im[j];
            }
            self.advance();
        }
    }

    /// AVX2 build of [`Self::add_flat`], with the same arithmetic in the same order, so the same bits. It is one and a half times
    /// as fast as the compiler's code.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn add_flat_avx2(&mut self, blocks: &mut [Block]) {
        use std::arch::x86_64::*;
        const HALF: usize = LANES / 2;
        // SAFETY: every load and store stays within one of the `LANES` = 8 element arrays of f64, or within one block of 8 complex
        // numbers. These are pairs of f64 (num-complex: repr(C)). No access needs alignment.
        let load =
            |a: &[f64; LANES], h: usize| unsafe { _mm256_loadu_pd(a.as_ptr().add(HALF * h)) };
        let mut z = [0, 1].map(|h| (load(&self.re, h), load(&self.im, h)));
        let mut w = [0, 1].map(|h| (load(&self.step_re, h), load(&self.step_im, h)));
        let (q_re, q_im) = (_mm256_set1_pd(self.turn.0), _mm256_set1_pd(self.turn.1));
        for samples in blocks {
            for h in 0..2 {
                let ((z_re, z_im), (w_re, w_im)) = (z[h], w[h]);
                // Order (re0 im0 re2 im2) and (re1 im1 re3 im3), then the order of the samples.
                let even = _mm256_unpacklo_pd(z_re, z_im);
                let odd = _mm256_unpackhi_pd(z_re, z_im);
                let pairs = [
                    _mm256_permute2f128_pd::<0x20>(even, odd),
                    _mm256_permute2f128_pd::<0x31>(even, odd),
                ];
                for (k, pair) in pairs.into_iter().enumerate() {
                    // SAFETY: as above; the access is to two complex numbers from index 4 h + 2 k of eight.
                    unsafe {
                        let at = samples.as_mut_ptr().add(HALF * h + 2 * k).cast::<f64>();
                        _mm256_storeu_pd(at, _mm256_add_pd(_mm256_loadu_pd(at), pair));
                    }
                }
                z[h] = (
                    _mm256_sub_pd(_mm256_mul_pd(z_re, w_re), _mm256_mul_pd(z_im, w_im)),
                    _mm256_add_pd(_mm256_mul_pd(z_re, w_im), _mm256_mul_pd(z_im, w_re)),
                );
                w[h] = (
                    _mm256_sub_pd(_mm256_mul_pd(w_re, q_re), _mm256_mul_pd(w_im, q_im)),
                    _mm256_add_pd(_mm256_mul_pd(w_re, q_im), _mm256_mul_pd(w_im, q_re)),
                );
            }
        }
        // SAFETY: as above.
        let store = |a: &mut [f64; LANES], h: usize, v| unsafe {
            _mm256_storeu_pd(a.as_mut_ptr().add(HALF * h), v);
        };
        for h in 0..2 {
            store(&mut self.re, h, z[h].0);
            store(&mut self.im, h, z[h].1);
            store(&mut self.step_re, h, w[h].0);
            store(&mut self.step_im, h, w[h].1);
        }
    }

    #[inline(always)]
    fn add_weighted(&mut self, weight: [f64; LANES], samples: &mut [Complex64]) {
        for (j, sample) in samples.iter_mut().enumerate() {
            sample.re += weight[j] * self.re[j];
            sample.im += weight[j] * self.im[j];
        }
        self.advance();
    }
}

/// Adds one echo to at most [`RESTART`] samples.
#[inline(always)]
fn add_stretch(
    echo: &SampleRun,
    amplitude: Complex64,
    out: &mut [Complex64],
    add_flat: impl Fn(&mut Lanes, &mut [Block]),
) {
    let mut lanes = Lanes::new(echo, amplitude);
    let (blocks, rest) = out.as_chunks_mut::<LANES>();
    let count = blocks.len();
    let flat = echo.flat_blocks(count);
    let (head, others) = blocks.split_at_mut(flat.start);
    let (middle, tail) = others.split_at_mut(flat.len());
    for (b, samples) in head.iter_mut().enumerate() {
        lanes.add_weighted(echo.taper(b * LANES), samples);
    }
    add_flat(&mut lanes, middle);
    for (b, samples) in tail.iter_mut().enumerate() {
        lanes.add_weighted(echo.taper((flat.end + b) * LANES), samples);
    }
    lanes.add_weighted(echo.taper(count * LANES), rest);
}

/// Adds `amplitude` exp(j 2pi (p0 + p1 n)) to element n of `out`; phases in turns.
pub(crate) fn add_tone(p0: f64, p1: f64, amplitude: Complex64, out: &mut [Complex64]) {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx2") {
        // SAFETY: the line above tests that the processor has AVX2; the function has no other requirement.
        return unsafe { add_tone_avx2(p0, p1, amplitude, out) };
    }
    add_tone_with(p0, p1, amplitude, out, Lanes::add_flat);
}

/// AVX2 build of [`add_tone_with`], with the same arithmetic in the same order, so the same bits.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn add_tone_avx2(p0: f64, p1: f64, amplitude: Complex64, out: &mut [Complex64]) {
    add_tone_with(p0, p1, amplitude, out, |lanes, blocks| {
        lanes.add_flat_avx2(blocks)
    });
}

#[inline(always)]
fn add_tone_with(
    p0: f64,
    p1: f64,
    amplitude: Complex64,
    out: &mut [Complex64],
    add_flat: impl Fn(&mut Lanes, &mut [Block]) + Copy,
) {
    for (r, run) in out.chunks_mut(RESTART).enumerate() {
        let start = p0 + p1 * (r * RESTART) as f64;
        let tone = SampleRun {
            p0: start - start.round_ties_even(),
            p1,
            p2: 0.0,
            emitted_s: 0.0,
            step_s: 0.0,
            curvature_s: 0.0,
            duration_s: 0.0,
            flank_s: 0.0,
        };
        add_stretch(&tone, amplitude, run, add_flat);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use echotank_core::pulse::PulseKind;

    fn chunk_of(arrivals: &[(f64, f64, Complex64)]) -> ArrivalChunk {
        let mut chunk = ArrivalChunk::new();
        for (i, &(delay_s, doppler, amplitude)) in arrivals.iter().enumerate() {
            chunk.delay_s[i] = delay_s;
            chunk.doppler[i] = doppler;
            chunk.amplitude[i] = amplitude;
            chunk.len = i + 1;
        }
        chunk
    }

    fn pulse(kind: PulseKind, taper: f64) -> Pulse {
        Pulse {
            kind,
            center_frequency_hz: 400e3,
            bandwidth_hz: if kind == PulseKind::Cw { 0.0 } else { 60e3 },
            duration_s: 8e-3,
            taper,
        }
    }

    /// Sine and cosine at every sample, without a recurrence.
    fn plain(pulse: &Pulse, t_s: f64, (u, d, amplitude): (f64, f64, Complex64)) -> Complex64 {
        let turns = pulse.center_frequency_hz * (d * (t_s - u));
        let carrier = pulse.center_frequency_hz * u;
        let phase = std::f64::consts::TAU * (turns - (carrier - carrier.round()));
        amplitude * pulse.envelope((1.0 + d) * (t_s - u)) * Complex64::from_polar(1.0, phase)
    }

    #[test]
    fn the_recurrence_meets_plain_sines_to_1e_12() {
        // Powers of two make sample times exact, so the test measures only the recurrence.
        let (rate_hz, first_s) = (f64::from(1 << 21), 1.0 / 32.0);
        let arrivals = [
            (0.0313, 0.0, Complex64::ONE),
            (0.030_001, 1e-4, Complex64::new(0.3, -2.0)),
            (0.033_3, -7e-3, Complex64::new(-1.0, 0.1)),
            (0.045, 7e-3, Complex64::I),
        ];
        for kind in [PulseKind::LfmUp, PulseKind::LfmDown, PulseKind::Cw] {
            for taper in [0.0, 0.1, 1.0] {
                let pulse = pulse(kind, taper);
                let mut worst: f64 = 0.0;
                for arrival in arrivals {
                    let mut out = vec![Complex64::ZERO; 40_000];
                    let mut sink = Direct {
                        pulse,
                        rate_hz,
                        first_sample_s: first_s,
                        ends: None,
                        out: &mut out,
                    };
                    sink.accept(&chunk_of(&[arrival]));
                    for (k, got) in out.iter().enumerate() {
                        let t_s = first_s + k as f64 / rate_hz;
                        let want = plain(&pulse, t_s, arrival);
                        worst = worst.max((got - want).norm() / arrival.2.norm());
                    }
                }
                assert!(worst < 1e-12, "{kind:?}, taper {taper}: {worst:e}");
                println!("{kind:?}, taper {taper}: {worst:.1e}");
            }
        }
    }

    #[test]
    fn echoes_off_the_record_touch_nothing_and_never_panic() {
        let ends = EndWeights::new(1.5);
        let mut out = vec![Complex64::ZERO; 100];
        let mut sink = Direct {
            pulse: pulse(PulseKind::LfmUp, 0.0),
            rate_hz: 40e3,
            first_sample_s: 0.1,
            ends: Some(&ends),
            out: &mut out,
        };
        let off: Vec<_> = [
            -1e300,
            -1.0,
            0.0,
            0.05,
            0.2,
            1e9,
            1e300,
            f64::INFINITY,
            f64::NAN,
        ]
        .map(|u| (u, 0.0, Complex64::ONE))
        .to_vec();
        sink.accept(&chunk_of(&off));
        sink.accept(&ArrivalChunk::new());
        assert!(out.iter().all(|x| *x == Complex64::ZERO));
        Direct {
            pulse: pulse(PulseKind::LfmUp, 0.0),
            rate_hz: 40e3,
            first_sample_s: 0.1,
            ends: Some(&ends),
            out: &mut [],
        }
        .accept(&chunk_of(&[(0.1, 0.0, Complex64::ONE)]));
    }

    #[cfg(target_arch = "x86_64")]
    #[test]
    fn the_avx2_build_gives_the_same_bits() {
        if !is_x86_feature_detected!("avx2") {
            return;
        }
        let arrivals: Vec<_> = (0..200)
            .map(|k| {
                let x = k as f64;
                (
                    0.03 + 1.7e-4 * x,
                    1e-5 * (x - 100.0),
                    Complex64::new(x, -1.0),
                )
            })
            .collect();
        let ends = EndWeights::new(1.5);
        let run = |wide: bool| {
            let mut out = vec![Complex64::ZERO; 2000];
            let mut sink = Direct {
                pulse: pulse(PulseKind::LfmDown, 0.2),
                rate_hz: 40e3,
                first_sample_s: 0.025,
                ends: Some(&ends),
                out: &mut out,
            };
            if wide {
                // SAFETY: the processor has AVX2, as tested above.
                unsafe { sink.add_avx2(&chunk_of(&arrivals)) };
            } else {
                sink.add(&chunk_of(&arrivals), Lanes::add_flat);
            }
            out
        };
        assert_eq!(run(true), run(false));
    }
}
