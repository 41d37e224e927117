//! Inner loop of the second sums: each beam sums [`TAPS`] directions of every group with real coefficients, turns the result by the phase of
//! the group's centre, and adds up the groups of each section. The coefficients of a moving focus are linear in time.
//!
//! Up to [`CHUNK`] samples are summed together in registers. The directions that a beam and its neighbours read then stay in the first-level
//! cache.

use std::ops::Range;

use super::groups::{BEAMS, MAX_GROUPS, Mix, TAPS};
use super::{MAX_SECTIONS, STEP};
use echotank_core::simd::{Kind, SimdLevel};

/// Maximum number of samples per call.
pub(super) const CHUNK: usize = 32;

/// Numbers that a step reads from its first direction on.
const REACH: usize = (TAPS - 1) * 2 * CHUNK + CHUNK + STEP;

/// Sums of each section: real parts, imaginary parts.
pub(super) type Totals = [[[f32; CHUNK]; 2]; MAX_SECTIONS];

const NO_TOTALS: Totals = [[[0.0; CHUNK]; 2]; MAX_SECTIONS];

/// Sums the first `beams` of a batch from sample `origin` of a chunk on, and gives the sums of each to `write`. `rows` holds for each direction
/// [`CHUNK`] real parts, then as many imaginary parts. `sections` are the groups of each section. With `places` of the samples in their span, from -1 at
/// its first to 1 at its last, coefficients change within it. Samples beyond `samples` are undefined.
///
/// Panics if a row, rounded up to whole steps, lies outside `rows`.
pub(super) fn sum_directions(
    simd_level: SimdLevel,
    rows: &[f32],
    (mix, beams): (&Mix, usize),
    sections: &[Range<usize>],
    (origin, samples, places): (usize, usize, Option<&[f32; CHUNK]>),
    write: impl FnMut(usize, &Totals),
) {
    match places {
        Some(places) => sum::<true>(
            simd_level,
            rows,
            (mix, beams),
            sections,
            (origin, samples, places),
            write,
        ),
        None => sum::<false>(
            simd_level,
            rows,
            (mix, beams),
            sections,
            (origin, samples, &[0.0; CHUNK]),
            write,
        ),
    }
}

fn sum<const MOVES: bool>(
    simd_level: SimdLevel,
    rows: &[f32],
    (mix, beams): (&Mix, usize),
    sections: &[Range<usize>],
    (origin, samples, places): (usize, usize, &[f32; CHUNK]),
    mut write: impl FnMut(usize, &Totals),
) {
    let steps = samples.div_ceil(STEP);
    assert!(beams <= BEAMS && sections.len() <= MAX_SECTIONS && samples <= CHUNK);
    let groups = sections.last().map_or(0, |section| section.end);
    let firsts = mix.first[..groups].iter().flatten();
    let last = firsts.copied().max().unwrap_or(0) as usize;
    let end = (last + TAPS - 1) * 2 * CHUNK + origin;
    assert!(
        groups <= MAX_GROUPS && end + CHUNK + STEP * steps <= rows.len(),
        "row outside the directions"
    );
    match simd_level.kind() {
        Kind::Portable => {
            for beam in 0..beams {
                let to =
                    sum_plain::<false, MOVES>(rows, (mix, beam), sections, (origin, steps, places));
                write(beam, &to);
            }
        }
        #[cfg(target_arch = "x86_64")]
        // SAFETY: a `SimdLevel` proves that the processor has the features; the rows are checked above.
        Kind::Avx512 => unsafe {
            match steps {
                0 => {}
                1 => sum_avx512::<1, MOVES>(rows, (mix, beams), sections, (origin, places), write),
                _ => sum_avx512::<2, MOVES>(rows, (mix, beams), sections, (origin, places), write),
            }
        },
        _ => simd_level.run(
            #[inline(always)]
            || {
                for beam in 0..beams {
                    let to = sum_plain::<true, MOVES>(
                        rows,
                        (mix, beam),
                        sections,
                        (origin, steps, places),
                    );
                    write(beam, &to);
                }
            },
        ),
    }
}

/// The same sums in the same order. `FUSED`: with fused multiply-add, where the processor has it.
#[inline(always)]
fn sum_plain<const FUSED: bool, const MOVES: bool>(
    rows: &[f32],
    (mix, beam): (&Mix, usize),
    sections: &[Range<usize>],
    (origin, steps, places): (usize, usize, &[f32; CHUNK]),
) -> Totals {
    let add = |a: f32, b: f32, sum: f32| {
        if FUSED {
            a.mul_add(b, sum)
        } else {
            a * b + sum
        }
    };
    let mut totals = NO_TOTALS;
    for (section, [to_re, to_im]) in sections.iter().zip(&mut totals) {
        for step in 0..steps {
            let (mut total_re, mut total_im) = ([0.0f32; STEP], [0.0f32; STEP]);
            let places: &[f32; STEP] = places[step * STEP..][..STEP].try_into().expect("as long");
            for g in section.clone() {
                let first = mix.first[g][beam] as usize * 2 * CHUNK + origin + step * STEP;
                let (mut re, mut im) = ([0.0f32; STEP], [0.0f32; STEP]);
                // Checked once.
                let rows: &[f32; REACH] = rows[first..][..REACH].try_into().expect("as long");
                for t in 0..TAPS {
                    let (w, change) = (mix.w[g][t][beam], mix.change[g][t][beam]);
                    let from = &rows[t * 2 * CHUNK..][..CHUNK + STEP];
                    for k in 0..STEP {
                        let w = if MOVES { add(change, places[k], w) } else { w };
                        re[k] = add(w, from[k], re[k]);
                        im[k] = add(w, from[CHUNK + k], im[k]);
                    }
                }
                let (cos, sin) = (mix.cos[g][beam], mix.sin[g][beam]);
                for k in 0..STEP {
                    total_re[k] = add(-sin, im[k], add(cos, re[k], total_re[k]));
                    total_im[k] = add(sin, re[k], add(cos, im[k], total_im[k]));
                }
            }
            to_re[step * STEP..][..STEP].copy_from_slice(&total_re);
            to_im[step * STEP..][..STEP].copy_from_slice(&total_im);
        }
    }
    totals
}

/// # Safety
/// The processor has AVX-512F. Every row of 16 `V` samples lies in `rows`; `beams` and the groups of `sections` are in `mix`. `V` is 1 or 2.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512dq,avx512vl")]
unsafe fn sum_avx512<const V: usize, const MOVES: bool>(
    rows: &[f32],
    (mix, beams): (&Mix, usize),
    sections: &[Range<usize>],
    (origin, places): (usize, &[f32; CHUNK]),
    mut write: impl FnMut(usize, &Totals),
) {
    use std::arch::x86_64::*;
    let mut totals = NO_TOTALS;
    // SAFETY: `CHUNK` is at least 16 V.
    let places: [_; V] =
        std::array::from_fn(|v| unsafe { _mm512_loadu_ps(places.as_ptr().add(16 * v)) });
    for beam in 0..beams {
        for (section, [to_re, to_im]) in sections.iter().zip(&mut totals) {
            let mut total_re = [_mm512_setzero_ps(); V];
            let mut total_im = [_mm512_setzero_ps(); V];
            for g in section.clone() {
                let first = mix.first[g][beam] as usize * 2 * CHUNK + origin;
                let mut re = [_mm512_setzero_ps(); V];
                let mut im = [_mm512_setzero_ps(); V];
                for t in 0..TAPS {
                    let middle = _mm512_set1_ps(mix.w[g][t][beam]);
                    let change = _mm512_set1_ps(mix.change[g][t][beam]);
                    // SAFETY: the caller guarantees the rows.
                    unsafe {
                        let row = rows.as_ptr().add(first + t * 2 * CHUNK);
                        for v in 0..V {
                            let w = match MOVES {
                                true => _mm512_fmadd_ps(change, places[v], middle),
                                false => middle,
                            };
                            re[v] = _mm512_fmadd_ps(w, _mm512_loadu_ps(row.add(16 * v)), re[v]);
                            let x_im = _mm512_loadu_ps(row.add(CHUNK + 16 * v));
                            im[v] = _mm512_fmadd_ps(w, x_im, im[v]);
                        }
                    }
                }
                let cos = _mm512_set1_ps(mix.cos[g][beam]);
                let sin = _mm512_set1_ps(mix.sin[g][beam]);
                for v in 0..V {
                    total_re[v] = _mm512_fmadd_ps(cos, re[v], total_re[v]);
                    total_im[v] = _mm512_fmadd_ps(cos, im[v], total_im[v]);
                    total_re[v] = _mm512_fnmadd_ps(sin, im[v], total_re[v]);
                    total_im[v] = _mm512_fmadd_ps(sin, re[v], total_im[v]);
                }
            }
            for v in 0..V {
                // SAFETY: `CHUNK` is at least 16 V.
                unsafe {
                    _mm512_storeu_ps(to_re.as_mut_ptr().add(16 * v), total_re[v]);
                    _mm512_storeu_ps(to_im.as_mut_ptr().add(16 * v), total_im[v]);
                }
            }
        }
        write(beam, &totals);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_simd_level_equals_the_scalar_sum() {
        let mut state = 1u32;
        let mut draw = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            state as f32 / u32::MAX as f32 - 0.5
        };
        let directions = 40;
        let rows: Vec<f32> = (0..directions * 2 * CHUNK + STEP).map(|_| draw()).collect();
        let mut mix = Mix::NONE;
        for g in 0..MAX_GROUPS {
            for i in 0..BEAMS {
                mix.first[g][i] = ((g * 7 + i) % (directions - TAPS + 1)) as u32;
                (mix.cos[g][i], mix.sin[g][i]) = (draw(), draw());
                mix.w[g].iter_mut().for_each(|w| w[i] = draw());
                mix.change[g].iter_mut().for_each(|w| w[i] = draw());
            }
        }
        let places: [f32; CHUNK] = std::array::from_fn(|_| draw());
        let sections = [0..7, 7..9, 9..16];
        for simd_level in SimdLevel::available() {
            for n in 0..12 {
                let at = [(0, 0), (31, 1), (0, 16), (9, 17), (0, 32), (5, 20)];
                let ((origin, samples), places) = (at[n / 2], (n % 2 == 1).then_some(&places));
                sum_directions(
                    simd_level,
                    &rows,
                    (&mix, BEAMS),
                    &sections,
                    (origin, samples, places),
                    |beam, got| {
                        for (section, got) in sections.iter().zip(got) {
                            for k in 0..samples {
                                let (mut re, mut im) = (0.0, 0.0);
                                for g in section.clone() {
                                    let cos = f64::from(mix.cos[g][beam]);
                                    let sin = f64::from(mix.sin[g][beam]);
                                    for t in 0..TAPS {
                                        let first = mix.first[g][beam] as usize + t;
                                        let x = &rows[first * 2 * CHUNK + origin + k..];
                                        let change = f64::from(mix.change[g][t][beam]);
                                        let change =
                                            places.map_or(0.0, |p| change * f64::from(p[k]));
                                        let w = f64::from(mix.w[g][t][beam]) + change;
                                        let [a, b] = [x[0], x[CHUNK]].map(|x| w * f64::from(x));
                                        re += a * cos - b * sin;
                                        im += a * sin + b * cos;
                                    }
                                }
                                let off = (f64::from(got[0][k]) - re).abs()
                                    + (f64::from(got[1][k]) - im).abs();
                                assert!(
                                    off < 2e-6,
                                    "{simd_level:?}, sample {k}, beam {beam}: {off:e}"
                                );
                            }
                        }
                    },
                );
            }
        }
    }

    #[test]
    #[should_panic(expected = "outside the directions")]
    fn a_row_outside_the_directions_panics() {
        let mut mix = Mix::NONE;
        mix.first[0][3] = 5;
        let rows = vec![0.0; 10 * 2 * CHUNK];
        sum_directions(
            SimdLevel::best(),
            &rows,
            (&mix, 3),
            &[0..1, 1..2],
            (0, CHUNK, None),
            |_, _| {},
        );
    }
}
