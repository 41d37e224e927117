//! Columns of a grid behind their transform, each times its template, added to a spectrum.

use num_complex::Complex;

use crate::array::gridded::lanes::Lanes;
use echotank_core::simd::{Kind, SimdLevel};

#[cfg(target_arch = "x86_64")]
use std::arch::x86_64::{__m256, __m512};

use super::spread::{LANES, NARROW, QUARTER, Shape, cell_lanes, cell_rows};

/// Where a frequency lies.
#[derive(Clone, Copy, Debug)]
pub(super) struct Bin {
    /// Its cell in a transformed column with one row a cell, and with two.
    pub cell: u32,
    pub cell_of_two: u32,
    /// Factor on the second of two rows: the transform of all rows is that of the even ones plus this times that of the odd ones (Danielson and
    /// Lanczos 1942).
    pub turn: Complex<f32>,
    /// Its row in the spectrum.
    pub to: u32,
}

/// Adds some `columns`, each row times its template, to the rows of a spectrum, with real and imaginary parts exchanged. `templates`: `[column][bin]`.
pub(super) fn add_products(
    simd_level: SimdLevel,
    shape: &Shape,
    bins: &[Bin],
    templates: &[Complex<f32>],
    columns: &[f32],
    spectrum: &mut [f32],
) {
    match simd_level.kind() {
        // SAFETY (of all): a `SimdLevel` of this kind exists only on processors with the features.
        #[cfg(target_arch = "x86_64")]
        Kind::Avx512 if shape.lanes == LANES => unsafe {
            add_avx512(shape, bins, templates, columns, spectrum)
        },
        #[cfg(target_arch = "x86_64")]
        Kind::Avx512 | Kind::Avx2 => unsafe { add_avx2(shape, bins, templates, columns, spectrum) },
        _ => unsafe { add_on::<[f32; 8]>(shape, bins, templates, columns, spectrum) },
    }
}

// SAFETY (of both): the processor must have the features.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512dq,avx512vl,avx2,fma")]
unsafe fn add_avx512(
    shape: &Shape,
    bins: &[Bin],
    templates: &[Complex<f32>],
    columns: &[f32],
    spectrum: &mut [f32],
) {
    unsafe { add_as::<__m512, LANES>(shape, bins, templates, columns, spectrum) }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
unsafe fn add_avx2(
    shape: &Shape,
    bins: &[Bin],
    templates: &[Complex<f32>],
    columns: &[f32],
    spectrum: &mut [f32],
) {
    unsafe { add_on::<__m256>(shape, bins, templates, columns, spectrum) }
}

/// SAFETY: the processor must have V.
#[inline(always)]
unsafe fn add_on<V: Lanes<Number = f32>>(
    shape: &Shape,
    bins: &[Bin],
    templates: &[Complex<f32>],
    columns: &[f32],
    spectrum: &mut [f32],
) {
    // SAFETY: the caller guarantees V.
    unsafe {
        match shape.lanes {
            QUARTER => add_as::<V, QUARTER>(shape, bins, templates, columns, spectrum),
            NARROW => add_as::<V, NARROW>(shape, bins, templates, columns, spectrum),
            _ => add_as::<V, LANES>(shape, bins, templates, columns, spectrum),
        }
    }
}

/// `L`: lanes of the block.
///
/// SAFETY: the processor must have V.
#[inline(always)]
unsafe fn add_as<V: Lanes<Number = f32>, const L: usize>(
    shape: &Shape,
    bins: &[Bin],
    templates: &[Complex<f32>],
    columns: &[f32],
    spectrum: &mut [f32],
) {
    let (width, cell_rows) = (cell_lanes(L), cell_rows(L));
    let stride = shape.stride();
    for (number, bin) in bins.iter().enumerate() {
        let cell = match cell_rows {
            1 => bin.cell,
            _ => bin.cell_of_two,
        };
        let cells = columns[cell as usize * 2 * width..].chunks(stride);
        let to = &mut spectrum[bin.to as usize * 2 * width..][..2 * width];
        for part in (0..width).step_by(V::COUNT) {
            let templates = templates[number..].iter().step_by(bins.len());
            // SAFETY: the caller guarantees V; `part` + V's lanes <= `width`, and a cell has twice as many numbers.
            unsafe {
                let (mut re, mut im) = (V::splat(0.0), V::splat(0.0));
                for (template, cell) in templates.zip(cells.clone()) {
                    let cell = &cell[..2 * width];
                    let x = V::load(cell.as_ptr().add(part));
                    let y = V::load(cell.as_ptr().add(width + part));
                    let (a, b) = (V::splat(template.re), V::splat(template.im));
                    re = y.neg_mul_add(b, x.mul_add(a, re));
                    im = x.mul_add(b, y.mul_add(a, im));
                }
                if cell_rows == 1 {
                    let (at_im, at_re) =
                        (to.as_mut_ptr().add(part), to.as_mut_ptr().add(width + part));
                    V::load(at_im).add(im).store(at_im);
                    V::load(at_re).add(re).store(at_re);
                } else {
                    let mut parts = [[0.0f32; LANES]; 2];
                    re.store(parts[0].as_mut_ptr());
                    im.store(parts[1].as_mut_ptr());
                    let [re, im] = &parts;
                    let turn = bin.turn;
                    for lane in 0..L {
                        let (x, y) = (re[L + lane], im[L + lane]);
                        to[lane] += im[lane] + (turn.re * y + turn.im * x);
                        to[width + lane] += re[lane] + (turn.re * x - turn.im * y);
                    }
                }
            }
        }
    }
}
