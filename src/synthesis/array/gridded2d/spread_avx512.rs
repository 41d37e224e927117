//! AVX-512 kernel that spreads echoes of up to sixteen channels. The scalar version is
//! `Spread::add`.

use std::arch::x86_64::*;

use super::panel::{PANEL, Row};
use super::smooth::GAIN_TERMS;
use super::spread::Wide;
use super::task::{Kind, MAX_CHANNELS, MAX_CURVATURE_TERMS, MAX_DILATION, MAX_RATE_GRADIENT_TERMS};
use super::weights::Taps;

/// Maximum number of vectors in the row of one echo: sixteen channels in fourteen columns, and the
/// offset of the first.
const MAX_REACH: usize = 15;
/// Prefetch distance of rows, in echoes.
const AHEAD: usize = 4;

/// Sum of powers of `x`, each multiplied by the lanes of its table.
#[inline]
#[target_feature(enable = "avx512f")]
fn weights(tables: &[Taps<f32>], x: f32) -> __m512 {
    let x = _mm512_set1_ps(x);
    let mut sum = _mm512_setzero_ps();
    for table in tables.iter().rev() {
        // SAFETY: a table is sixteen numbers.
        let table = unsafe { _mm512_loadu_ps(table.as_ptr()) };
        sum = _mm512_fmadd_ps(sum, x, table);
    }
    sum
}

/// T_0(x) ... T_(terms-1)(x).
#[inline]
#[target_feature(enable = "avx512f")]
fn chebyshev<const MOST: usize>(x: __m512, terms: usize) -> [__m512; MOST] {
    let one = _mm512_set1_ps(1.0);
    let mut values = [one; MOST];
    let twice = _mm512_add_ps(x, x);
    let (mut before, mut now) = (one, x);
    for value in &mut values[1..terms.max(1)] {
        *value = now;
        (before, now) = (now, _mm512_fmsub_ps(twice, now, before));
    }
    values
}

/// Products of the sixteen echoes from `start` on, `[product][echo]`.
#[target_feature(enable = "avx512f")]
fn products(wide: &Wide<f32>, start: usize, to: &mut [[f32; PANEL]; MAX_CHANNELS]) {
    let p = wide.prepared;
    // SAFETY: chunks are whole multiples of sixteen long.
    let load = |values: &[f32]| unsafe { _mm512_loadu_ps(values[start..][..PANEL].as_ptr()) };
    let orders = wide.orders;
    let dilation = chebyshev::<MAX_DILATION>(load(&p.dilation), orders.dilation);
    let curvature = chebyshev::<MAX_CURVATURE_TERMS>(load(&p.curvature), orders.curvature);
    let rate_gradient =
        chebyshev::<MAX_RATE_GRADIENT_TERMS>(load(&p.rate_gradient), orders.rate_gradient);
    let mut rows = to.iter_mut();
    for kept in wide.kept {
        let mut share = _mm512_mul_ps(curvature[kept.curvature], rate_gradient[kept.rate_gradient]);
        match wide.kinds[kept.kind] {
            Kind::Whole => {}
            Kind::Gain(order) => share = _mm512_mul_ps(share, load(&p.kinds[order])),
            Kind::Acceleration => share = _mm512_mul_ps(share, load(&p.kinds[GAIN_TERMS])),
        }
        for (&r, row) in dilation[..kept.dilation].iter().zip(&mut rows) {
            // SAFETY: a row is sixteen numbers.
            unsafe { _mm512_storeu_ps(row.as_mut_ptr(), _mm512_mul_ps(share, r)) };
        }
    }
}

/// Adds a line of values, times real and imaginary parts, to a row.
#[inline]
#[target_feature(enable = "avx512f")]
fn add_line(sum: &mut Row<f32>, line: __m512, [re, im]: [__m512; 2]) {
    let (to_re, to_im) = (sum.re.as_mut_ptr(), sum.im.as_mut_ptr());
    // SAFETY: both parts of a row are sixteen numbers, aligned to 64 bytes as the row is.
    unsafe {
        let now = _mm512_load_ps(to_re);
        _mm512_store_ps(to_re, _mm512_fmadd_ps(line, re, now));
        let now = _mm512_load_ps(to_im);
        _mm512_store_ps(to_im, _mm512_fmadd_ps(line, im, now));
    }
}

/// Adds echoes to the grid. Returns the number of echoes outside, which are omitted.
#[target_feature(enable = "avx512f,avx512dq,avx512vl,avx2,fma")]
pub(super) fn add(wide: Wide<f32>) -> usize {
    match wide.time_width {
        3 => add_all::<3>(wide),
        4 => add_all::<4>(wide),
        5 => add_all::<5>(wide),
        6 => add_all::<6>(wide),
        7 => add_all::<7>(wide),
        8 => add_all::<8>(wide),
        _ => add_all::<0>(wide),
    }
}

/// The same for kernels over `ROWS` rows; 0 for any number.
#[target_feature(enable = "avx512f,avx512dq,avx512vl,avx2,fma")]
fn add_all<const ROWS: usize>(mut wide: Wide<f32>) -> usize {
    let grid = std::mem::take(&mut wide.grid);
    let &Wide {
        prepared: p,
        len,
        panel_rows,
        channels,
        mixing,
        time_taps,
        slope_taps,
        time_width,
        slope_width,
        last_row,
        last_column,
        ..
    } = &wide;
    let (lanes, reach) = (&mixing.lanes[..], mixing.reach);
    assert!(reach <= MAX_REACH && channels <= PANEL);
    let mut of_echoes = [[0.0f32; PANEL]; MAX_CHANNELS];
    let values = slope_width * channels;
    let mut outside = 0;
    for i in 0..len {
        if i % PANEL == 0 {
            products(&wide, i, &mut of_echoes);
        }
        let (row, column) = (p.row[i] as usize, p.column[i] as usize);
        if row > last_row || column > last_column {
            outside += 1;
            continue;
        }
        let next = (i + AHEAD).min(len - 1);
        let at = (p.column[next] as usize).wrapping_mul(channels) / PANEL;
        let at = at
            .wrapping_mul(panel_rows)
            .wrapping_add(p.row[next] as usize);
        if let Some(rows) = grid.get(at..).and_then(|rows| rows.get(..time_width)) {
            for row in rows {
                _mm_prefetch::<_MM_HINT_T0>(row.re.as_ptr().cast());
                _mm_prefetch::<_MM_HINT_T0>(row.im.as_ptr().cast());
            }
        }
        let of_slope = weights(slope_taps, p.in_column[i]);
        let of_time = weights(time_taps, p.in_row[i]);
        let re = _mm512_mul_ps(of_time, _mm512_set1_ps(p.re[i]));
        let im = _mm512_mul_ps(of_time, _mm512_set1_ps(p.im[i]));
        let each: [[__m512; 2]; ROWS] = std::array::from_fn(|k| {
            let k = _mm512_set1_epi32(k as i32);
            [_mm512_permutexvar_ps(k, re), _mm512_permutexvar_ps(k, im)]
        });
        let mut of_rows = [[0.0f32; PANEL]; 2];
        if ROWS == 0 {
            // SAFETY: both arrays are sixteen numbers.
            unsafe {
                _mm512_storeu_ps(of_rows[0].as_mut_ptr(), re);
                _mm512_storeu_ps(of_rows[1].as_mut_ptr(), im);
            }
        }
        let mut mixed = _mm512_setzero_ps();
        for (into, product) in mixing.into.iter().zip(&of_echoes) {
            // SAFETY: sixteen numbers.
            let into = unsafe { _mm512_loadu_ps(into.as_ptr()) };
            mixed = _mm512_fmadd_ps(into, _mm512_set1_ps(product[i % PANEL]), mixed);
        }
        let place = column * channels;
        let (first, before) = (place / PANEL, place % PANEL);
        let vectors = (before + values).div_ceil(PANEL);
        for (v, [channel, tap]) in lanes[before * reach..][..vectors].iter().enumerate() {
            // SAFETY: sixteen numbers each.
            let (channel, tap) = unsafe {
                (
                    _mm512_loadu_si512(channel.as_ptr().cast()),
                    _mm512_loadu_si512(tap.as_ptr().cast()),
                )
            };
            let line = _mm512_mul_ps(
                _mm512_permutexvar_ps(channel, mixed),
                _mm512_permutexvar_ps(tap, of_slope),
            );
            let rows = &mut grid[(first + v) * panel_rows + row..][..time_width];
            if ROWS > 0 {
                let rows: &mut [Row<f32>; ROWS] = rows.try_into().expect("so many rows");
                for (sum, &by) in rows.iter_mut().zip(&each) {
                    add_line(sum, line, by);
                }
            } else {
                let by = of_rows[0].iter().zip(&of_rows[1]);
                for (sum, (&re, &im)) in rows.iter_mut().zip(by) {
                    add_line(sum, line, [_mm512_set1_ps(re), _mm512_set1_ps(im)]);
                }
            }
        }
    }
    outside
}
