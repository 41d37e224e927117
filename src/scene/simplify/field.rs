//! A height field as scatterers with a triangulation, the input of `echotank scene simplify`.

use glam::DVec3;

use super::super::read::HeightField;
use super::super::targets::random::KeyedRandom;
use echotank_core::scene::{ScatterLaw, Scatterers};

/// Separates these random numbers from other uses of the seed.
const KEY_LABEL: &[u8; 24] = b"echotank height field v1";

/// One scatterer at the centre of each cell that is no hole, and two triangles between every four neighbours.
///
/// Each scatterer has Lambert's mu of `lambert_db` over the area of its cell, and a circular Gaussian reflectivity from `seed`.
pub fn scatterers(field: &HeightField, lambert_db: f64, seed: u64) -> (Scatterers, Vec<[u32; 3]>) {
    const HOLE: u32 = u32::MAX;
    let mu_area_m2 = libm::pow(10.0, lambert_db / 10.0) * field.cell_north_m * field.cell_east_m;
    let mut chance = KeyedRandom::new(seed, KEY_LABEL, 0);
    let mut points = Scatterers::default();
    let mut number = vec![HOLE; field.rows * field.cols];
    for row in 0..field.rows {
        for col in 0..field.cols {
            // Drawn for holes too, so that a hole does not change other cells' numbers.
            let reflectivity = chance.circular_gaussian();
            let down_m = field.cell_down_m(row, col);
            if down_m.is_nan() {
                continue;
            }
            let slope_north =
                slope(field.rows, row, |r| field.cell_down_m(r, col)) / field.cell_north_m;
            let slope_east =
                slope(field.cols, col, |c| field.cell_down_m(row, c)) / field.cell_east_m;
            let steepness = (1.0 + slope_north * slope_north + slope_east * slope_east).sqrt();
            let normal = [
                slope_north / steepness,
                slope_east / steepness,
                -1.0 / steepness,
            ];
            let position_m = DVec3::new(
                field.south_m + row as f64 * field.cell_north_m,
                field.west_m + col as f64 * field.cell_east_m,
                down_m,
            );
            number[row * field.cols + col] = points.len() as u32;
            points.push(
                position_m,
                normal.map(|x| x as f32),
                (mu_area_m2 * steepness).sqrt() * reflectivity,
                ScatterLaw::Lambert,
            );
        }
    }
    let mut triangles = Vec::new();
    for row in 0..field.rows - 1 {
        for col in 0..field.cols - 1 {
            let at = |r: usize, c: usize| number[(row + r) * field.cols + col + c];
            for triangle in [
                [at(0, 0), at(0, 1), at(1, 1)],
                [at(0, 0), at(1, 1), at(1, 0)],
            ] {
                if !triangle.contains(&HOLE) {
                    triangles.push(triangle);
                }
            }
        }
    }
    (points, triangles)
}

/// Central difference per cell; one-sided beside an edge or a hole; 0 without neighbours.
fn slope(count: usize, at: usize, down_m: impl Fn(usize) -> f64) -> f64 {
    let here = down_m(at);
    let neighbour = |k: usize| Some(down_m(k)).filter(|d| !d.is_nan());
    let before = at.checked_sub(1).and_then(neighbour);
    let after = Some(at + 1).filter(|k| *k < count).and_then(neighbour);
    match (before, after) {
        (Some(a), Some(b)) => (b - a) / 2.0,
        (Some(a), None) => here - a,
        (None, Some(b)) => b - here,
        (None, None) => 0.0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_become_points_with_the_slopes_normals_and_holes_neither_points_nor_triangles() {
        let mut field = HeightField {
            rows: 4,
            cols: 5,
            cell_north_m: 2.0,
            cell_east_m: 3.0,
            south_m: -3.0,
            west_m: -6.0,
            down_m: (0..20)
                .map(|k| 10.0 + 0.5 * (k / 5) as f32 - 0.75 * (k % 5) as f32)
                .collect(),
        };
        let (points, triangles) = scatterers(&field, 0.0, 1);
        assert_eq!((points.len(), triangles.len()), (20, 24));
        assert_eq!(points.position_m(7), DVec3::new(-1.0, 0.0, 9.0));
        let want = DVec3::new(0.25, -0.25, -1.0).normalize();
        for normal in &points.normal {
            assert!(DVec3::from_array(normal.map(f64::from)).distance(want) < 1e-6);
        }
        field.down_m[7] = f32::NAN;
        let (holed, triangles) = scatterers(&field, 0.0, 1);
        assert_eq!((holed.len(), triangles.len()), (19, 24 - 6));
        // Away from the hole nothing changes.
        assert_eq!(holed.strength[12..], points.strength[13..]);
    }
}
