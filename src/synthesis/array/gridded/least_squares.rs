//! Least squares by orthogonalisation, for small dense problems solved once per plan.
//!
//! The input is a matrix with more rows than columns. The result is its pseudo-inverse. The method
//! is modified Gram-Schmidt with two passes per column, followed by back substitution. Two passes
//! give a basis that is orthogonal to rounding (Giraud, Langou and Rozloznik 2005).

/// A dense matrix, row-major.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Matrix {
    pub rows: usize,
    pub columns: usize,
    values: Vec<f64>,
}

impl Matrix {
    pub(super) fn from_fn(
        rows: usize,
        columns: usize,
        value: impl Fn(usize, usize) -> f64,
    ) -> Self {
        let values = (0..rows * columns)
            .map(|i| value(i / columns, i % columns))
            .collect();
        Self {
            rows,
            columns,
            values,
        }
    }

    pub(super) fn at(&self, row: usize, column: usize) -> f64 {
        self.values[row * self.columns + column]
    }

    pub(super) fn row(&self, row: usize) -> &[f64] {
        &self.values[row * self.columns..(row + 1) * self.columns]
    }

    /// The matrix P for which P b minimises |A x - b|. A must have full column rank.
    pub(crate) fn pseudo_inverse(&self) -> Self {
        let (rows, columns) = (self.rows, self.columns);
        assert!(
            rows >= columns,
            "{rows} equations for {columns} unknowns are too few"
        );
        // Consecutive columns of Q, and R with Q R = A.
        let mut q: Vec<Vec<f64>> = (0..columns)
            .map(|j| (0..rows).map(|i| self.at(i, j)).collect())
            .collect();
        let mut r = vec![0.0; columns * columns];
        for j in 0..columns {
            let (done, rest) = q.split_at_mut(j);
            let column = &mut rest[0];
            for _ in 0..2 {
                for (i, unit) in done.iter().enumerate() {
                    let along: f64 = unit.iter().zip(&*column).map(|(a, b)| a * b).sum();
                    column
                        .iter_mut()
                        .zip(unit)
                        .for_each(|(b, a)| *b -= along * a);
                    r[i * columns + j] += along;
                }
            }
            let norm = column.iter().map(|a| a * a).sum::<f64>().sqrt();
            assert!(norm > 0.0, "column {j} depends on those before it");
            column.iter_mut().for_each(|a| *a /= norm);
            r[j * columns + j] = norm;
        }
        // R P = Q^T is solved from the last row up.
        let mut values = vec![0.0; columns * rows];
        for k in (0..columns).rev() {
            for i in 0..rows {
                let known: f64 = (k + 1..columns)
                    .map(|l| r[k * columns + l] * values[l * rows + i])
                    .sum();
                values[k * rows + i] = (q[k][i] - known) / r[k * columns + k];
            }
        }
        Self {
            rows: columns,
            columns: rows,
            values,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_pseudo_inverse_fits_a_cubic_through_noise_free_samples_to_1e_12() {
        let a = Matrix::from_fn(20, 4, |i, j| (i as f64 / 19.0).powi(j as i32));
        let p = a.pseudo_inverse();
        let want = [0.3, -1.0, 2.0, 5.0];
        for k in 0..4 {
            let got: f64 = (0..20)
                .map(|i| p.at(k, i) * (0..4).map(|j| a.at(i, j) * want[j]).sum::<f64>())
                .sum();
            assert!((got - want[k]).abs() < 1e-12, "{k}: {got} {}", want[k]);
        }
    }

    #[test]
    fn the_residual_is_orthogonal_to_every_column() {
        let a = Matrix::from_fn(12, 3, |i, j| libm::cos((i * (j + 1)) as f64 * 0.3));
        let b: Vec<f64> = (0..12).map(|i| libm::sin(0.7 * i as f64)).collect();
        let p = a.pseudo_inverse();
        let x: Vec<f64> = (0..3)
            .map(|k| p.row(k).iter().zip(&b).map(|(p, b)| p * b).sum())
            .collect();
        for j in 0..3 {
            let along: f64 = (0..12)
                .map(|i| {
                    a.at(i, j) * (b[i] - a.row(i).iter().zip(&x).map(|(a, x)| a * x).sum::<f64>())
                })
                .sum();
            assert!(along.abs() < 1e-14, "column {j}: {along:e}");
        }
    }
}
