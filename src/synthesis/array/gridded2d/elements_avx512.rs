//! AVX-512 kernel that sums the columns' powers into pairs of elements. The scalar version is
//! `Task::add_columns`.

use std::arch::x86_64::*;

use super::elements::Columns;
use super::lanes::BLOCK;

/// Pairs processed together.
const PAIRS: usize = 2;
/// Vectors of a block.
const PARTS: usize = BLOCK / 16;

/// Whether there is a kernel for this number of powers.
pub(super) const fn takes(powers: usize) -> bool {
    matches!(powers, 4..=14)
}

/// Adds some columns to the sums of all pairs.
#[target_feature(enable = "avx512f,avx512dq,avx512vl,avx2,fma")]
pub(super) fn add(columns: Columns<f32>) {
    let (count, powers) = (columns.count, columns.powers);
    assert!(
        columns.re.len() >= count * powers * BLOCK && columns.im.len() >= count * powers * BLOCK
    );
    let pairs = columns.sums.len();
    assert!(columns.x.len() >= pairs && columns.rotors.len() >= pairs * columns.room);
    assert!(columns.first + count <= columns.room);
    // SAFETY: the lengths that the kernels need are asserted above; the processor's features are
    // this function's own precondition.
    unsafe {
        match powers {
            4 => all::<2, 2>(columns),
            5 => all::<3, 2>(columns),
            6 => all::<3, 3>(columns),
            7 => all::<4, 3>(columns),
            8 => all::<4, 4>(columns),
            9 => all::<5, 4>(columns),
            10 => all::<5, 5>(columns),
            11 => all::<6, 5>(columns),
            12 => all::<6, 6>(columns),
            13 => all::<7, 6>(columns),
            14 => all::<7, 7>(columns),
            _ => unreachable!("{powers} powers"),
        }
    }
}

/// SAFETY: as `add` has asserted; `EVEN` + `ODD` powers.
#[target_feature(enable = "avx512f,avx512dq,avx512vl,avx2,fma")]
unsafe fn all<const EVEN: usize, const ODD: usize>(mut columns: Columns<f32>) {
    let pairs = columns.sums.len();
    let mut pair = 0;
    while pair + PAIRS <= pairs {
        // SAFETY: the caller has the same precondition.
        unsafe { some::<PAIRS, EVEN, ODD>(&mut columns, pair) };
        pair += PAIRS;
    }
    while pair < pairs {
        // SAFETY: the caller has the same precondition.
        unsafe { some::<1, EVEN, ODD>(&mut columns, pair) };
        pair += 1;
    }
}

/// SAFETY: as for `all`; `N` pairs from `pair` on.
#[inline]
#[target_feature(enable = "avx512f,avx512dq,avx512vl,avx2,fma")]
unsafe fn some<const N: usize, const EVEN: usize, const ODD: usize>(
    columns: &mut Columns<f32>,
    pair: usize,
) {
    let zero = _mm512_setzero_ps();
    let per_column = (EVEN + ODD) * BLOCK;
    let mut sums = [[[zero; 4]; PARTS]; N];
    // SAFETY: all accesses lie within what `add` has asserted: a column's powers are `per_column`
    // numbers, a pair's sums four blocks.
    unsafe {
        for (n, sums) in sums.iter_mut().enumerate() {
            let of_pair = columns.sums.as_ptr().add(pair + n).cast::<f32>();
            for (part, sums) in sums.iter_mut().enumerate() {
                for (k, sum) in sums.iter_mut().enumerate() {
                    *sum = _mm512_loadu_ps(of_pair.add(k * BLOCK + 16 * part));
                }
            }
        }
        let mut x = [0.0f32; N];
        let mut square = [zero; N];
        for n in 0..N {
            x[n] = *columns.x.get_unchecked(pair + n);
            square[n] = _mm512_set1_ps(x[n] * x[n]);
        }
        for column in 0..columns.count {
            let re = columns.re.as_ptr().add(column * per_column);
            let im = columns.im.as_ptr().add(column * per_column);
            let mut even = [[[zero; 2]; PARTS]; N];
            for q in (0..EVEN).rev() {
                for part in 0..PARTS {
                    let at = 2 * q * BLOCK + 16 * part;
                    let (re, im) = (_mm512_loadu_ps(re.add(at)), _mm512_loadu_ps(im.add(at)));
                    for (even, &square) in even.iter_mut().zip(&square) {
                        let [of_re, of_im] = &mut even[part];
                        *of_re = _mm512_fmadd_ps(*of_re, square, re);
                        *of_im = _mm512_fmadd_ps(*of_im, square, im);
                    }
                }
            }
            for n in 0..N {
                let at = (pair + n) * columns.room + columns.first + column;
                let [cos, sin] = *columns.rotors.get_unchecked(at);
                let (cos, sin) = (_mm512_set1_ps(cos), _mm512_set1_ps(sin));
                for part in 0..PARTS {
                    let ([re, im], sums) = (even[n][part], &mut sums[n][part]);
                    sums[0] = _mm512_fmadd_ps(re, cos, sums[0]);
                    sums[1] = _mm512_fmadd_ps(im, cos, sums[1]);
                    sums[2] = _mm512_fnmadd_ps(im, sin, sums[2]);
                    sums[3] = _mm512_fmadd_ps(re, sin, sums[3]);
                }
            }
            let mut odd = [[[zero; 2]; PARTS]; N];
            for q in (0..ODD).rev() {
                for part in 0..PARTS {
                    let at = (2 * q + 1) * BLOCK + 16 * part;
                    let (re, im) = (_mm512_loadu_ps(re.add(at)), _mm512_loadu_ps(im.add(at)));
                    for (odd, &square) in odd.iter_mut().zip(&square) {
                        let [of_re, of_im] = &mut odd[part];
                        *of_re = _mm512_fmadd_ps(*of_re, square, re);
                        *of_im = _mm512_fmadd_ps(*of_im, square, im);
                    }
                }
            }
            for n in 0..N {
                let at = (pair + n) * columns.room + columns.first + column;
                let [cos, sin] = *columns.rotors.get_unchecked(at);
                let (cos, sin) = (_mm512_set1_ps(cos * x[n]), _mm512_set1_ps(sin * x[n]));
                for part in 0..PARTS {
                    let ([re, im], sums) = (odd[n][part], &mut sums[n][part]);
                    sums[0] = _mm512_fnmadd_ps(im, sin, sums[0]);
                    sums[1] = _mm512_fmadd_ps(re, sin, sums[1]);
                    sums[2] = _mm512_fmadd_ps(re, cos, sums[2]);
                    sums[3] = _mm512_fmadd_ps(im, cos, sums[3]);
                }
            }
        }
        for (n, sums) in sums.iter().enumerate() {
            let of_pair = columns.sums.as_mut_ptr().add(pair + n).cast::<f32>();
            for (part, sums) in sums.iter().enumerate() {
                for (k, &sum) in sums.iter().enumerate() {
                    _mm512_storeu_ps(of_pair.add(k * BLOCK + 16 * part), sum);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::elements::all_pairs;
    use super::*;

    #[test]
    fn the_avx512_kernel_matches_plain_arithmetic() {
        if !is_x86_feature_detected!("avx512f") || !is_x86_feature_detected!("avx512dq") {
            return;
        }
        let draw = |k: usize, step: f64| (2.0 * (k as f64 * step).fract() - 1.0) as f32;
        let (count, pairs, room) = (5, 7, 8);
        for powers in (0..20).filter(|&powers| takes(powers)) {
            let len = count * powers * BLOCK;
            let re: Vec<f32> = (0..len).map(|k| draw(k, 0.618)).collect();
            let im: Vec<f32> = (0..len).map(|k| draw(k, 0.755)).collect();
            let rotors: Vec<[f32; 2]> = (0..pairs * room)
                .map(|k| [draw(k, 0.57), draw(k, 0.33)])
                .collect();
            let x: Vec<f32> = (0..pairs).map(|k| draw(k, 0.41)).collect();
            let sums = |kernel: fn(Columns<f32>)| {
                let mut sums = vec![[[0.25f32; BLOCK]; 4]; pairs];
                kernel(Columns {
                    re: &re,
                    im: &im,
                    powers,
                    first: 2,
                    count,
                    rotors: &rotors,
                    room,
                    x: &x,
                    sums: &mut sums,
                });
                sums
            };
            // SAFETY: checked above; VL, AVX2 and FMA are implied.
            let got = sums(|columns| unsafe { add(columns) });
            let want = sums(all_pairs::<f32, false>);
            let pairs = got.as_flattened().as_flattened().iter();
            for (got, want) in pairs.zip(want.as_flattened().as_flattened()) {
                assert!((got - want).abs() < 2e-5, "{powers} powers: {got}, {want}");
            }
        }
    }
}
