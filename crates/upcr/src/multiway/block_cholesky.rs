//! Symmetric positive definite systems of 6×6 blocks, most of them zero: one block row a pose, one block a pair.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::{DMatrix, DVector, Matrix6, Vector6};

/// Columns of a full matrix that are eliminated together.
const PANEL: usize = 48;

/// Which blocks the factor L of P H Pᵀ = L Lᵀ has, for every H with the same blocks.
#[derive(Debug)]
pub(super) struct Pattern {
    /// The block row that is eliminated in each step.
    order: Vec<usize>,
    /// The step in which each block row is eliminated.
    step: Vec<usize>,
    /// Later steps, ascending, whose block row meets the step's column.
    below: Vec<Vec<usize>>,
    /// From this step on every block row meets all later ones.
    full: usize,
}

impl Pattern {
    /// Of `rows` block rows, of which `pairs` meet off the diagonal. Rows with few neighbours go first: they fill in least.
    pub fn new(rows: usize, pairs: impl IntoIterator<Item = (usize, usize)>) -> Self {
        let mut neighbors = vec![BTreeSet::new(); rows];
        for (a, b) in pairs {
            if a != b {
                neighbors[a].insert(b);
                neighbors[b].insert(a);
            }
        }
        let mut queue: BTreeSet<(usize, usize)> = (0..rows).map(|i| (neighbors[i].len(), i)).collect();
        let mut order = Vec::with_capacity(rows);
        let mut left = Vec::with_capacity(rows);
        while let Some(&(count, row)) = queue.first() {
            // Who has the fewest neighbours has all: so have the others.
            if count + 1 == queue.len() {
                break;
            }
            queue.pop_first();
            order.push(row);
            let met = std::mem::take(&mut neighbors[row]);
            for &a in &met {
                queue.remove(&(neighbors[a].len(), a));
                neighbors[a].remove(&row);
                neighbors[a].extend(met.iter().filter(|&&b| b != a));
                queue.insert((neighbors[a].len(), a));
            }
            left.push(met);
        }
        let full = order.len();
        order.extend(queue.into_iter().map(|(_, row)| row));
        let mut step = vec![0; rows];
        for (k, &row) in order.iter().enumerate() {
            step[row] = k;
        }
        let mut below: Vec<Vec<usize>> = left
            .into_iter()
            .map(|met| {
                let mut steps: Vec<usize> = met.into_iter().map(|row| step[row]).collect();
                steps.sort_unstable();
                steps
            })
            .collect();
        below.extend((full..rows).map(|k| (k + 1..rows).collect()));
        Self { order, step, below, full }
    }

    /// The x of H x = b, H given by its diagonal and by the blocks (row, column) above it, each once; `None` where H is not
    /// positive definite.
    pub fn solve(
        &self,
        diagonal: &[Matrix6<f64>],
        above: &BTreeMap<(usize, usize), Matrix6<f64>>,
        b: &[Vector6<f64>],
    ) -> Option<Vec<Vector6<f64>>> {
        let mut pivots: Vec<Matrix6<f64>> = self.order.iter().map(|&row| diagonal[row]).collect();
        let mut columns: Vec<Vec<Matrix6<f64>>> =
            self.below.iter().map(|below| vec![Matrix6::zeros(); below.len()]).collect();
        for (&(row, column), block) in above {
            let (i, j) = (self.step[row], self.step[column]);
            // Below the diagonal of the permuted matrix.
            let (column, row, block) = if i < j { (i, j, block.transpose()) } else { (j, i, *block) };
            columns[column][self.below[column].binary_search(&row).ok()?] += block;
        }
        let mut x: Vec<Vector6<f64>> = self.order.iter().map(|&row| b[row]).collect();
        for k in 0..self.full {
            let pivot = pivots[k].cholesky()?.unpack();
            pivots[k] = pivot;
            let mut column = std::mem::take(&mut columns[k]);
            for block in &mut column {
                // L_ik = A_ik L_kk⁻ᵀ
                *block = pivot.solve_lower_triangular(&block.transpose())?.transpose();
            }
            x[k] = pivot.solve_lower_triangular(&x[k])?;
            let below = &self.below[k];
            for (a, &i) in below.iter().enumerate() {
                let transposed = column[a].transpose();
                pivots[i] -= column[a] * transposed;
                let update = column[a] * x[k];
                x[i] -= update;
                // What the step's column has, that of a later step has too: elimination has filled it in.
                let mut into = columns[i].iter_mut().zip(&self.below[i]);
                for (block, row) in column.iter().zip(below).skip(a + 1) {
                    let (into, _) = into.find(|(_, all)| *all == row)?;
                    *into -= block * transposed;
                }
            }
            columns[k] = column;
        }
        self.solve_full(&pivots, &columns, &mut x)?;
        for k in (0..self.full).rev() {
            let mut rest = x[k];
            for (block, &i) in columns[k].iter().zip(&self.below[k]) {
                rest -= block.transpose() * x[i];
            }
            x[k] = pivots[k].transpose().solve_upper_triangular(&rest)?;
        }
        Some(self.step.iter().map(|&step| x[step]).collect())
    }

    /// The part of x from where on the matrix is full.
    fn solve_full(
        &self,
        pivots: &[Matrix6<f64>],
        columns: &[Vec<Matrix6<f64>>],
        x: &mut [Vector6<f64>],
    ) -> Option<()> {
        let steps = self.order.len() - self.full;
        let mut matrix = DMatrix::zeros(6 * steps, 6 * steps);
        for (j, (pivot, column)) in pivots.iter().zip(columns).skip(self.full).enumerate() {
            for (i, block) in std::iter::once(pivot).chain(column).enumerate() {
                matrix.fixed_view_mut::<6, 6>(6 * (i + j), 6 * j).copy_from(block);
            }
        }
        factorize(&mut matrix)?;
        let mut rest = DVector::from_iterator(6 * steps, x[self.full..].iter().flatten().copied());
        if !(matrix.solve_lower_triangular_mut(&mut rest) && matrix.tr_solve_lower_triangular_mut(&mut rest))
        {
            return None;
        }
        for (x, rest) in x[self.full..].iter_mut().zip(rest.as_slice().chunks_exact(6)) {
            x.copy_from_slice(rest);
        }
        Some(())
    }
}

/// The factor L of a full matrix A = L Lᵀ in place of its lower half; `None` where A is not positive definite.
fn factorize(matrix: &mut DMatrix<f64>) -> Option<()> {
    let rows = matrix.nrows();
    for start in (0..rows).step_by(PANEL) {
        let width = PANEL.min(rows - start);
        let next = start + width;
        let corner = matrix.view((start, start), (width, width)).clone_owned().cholesky()?.unpack();
        let mut across = matrix.view((next, start), (rows - next, width)).transpose();
        if !corner.solve_lower_triangular_mut(&mut across) {
            return None;
        }
        let down = across.transpose();
        matrix.view_mut((start, start), (width, width)).copy_from(&corner);
        matrix.view_mut((next, start), (rows - next, width)).copy_from(&down);
        // The lower half of what is left, by panels: products of large matrices are where the time goes, and fast.
        for at in (next..rows).step_by(PANEL) {
            let width = PANEL.min(rows - at);
            matrix.view_mut((at, at), (rows - at, width)).gemm(
                -1.0,
                &down.rows(at - next, rows - at),
                &across.columns(at - next, width),
                1.0,
            );
        }
    }
    Some(())
}

#[cfg(test)]
mod tests {
    use nalgebra::{DMatrix, DVector};
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    #[test]
    fn solves_as_the_dense_matrix_does() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for rows in [1, 2, 7, 30] {
            let mut pairs: Vec<(usize, usize)> =
                (1..rows).map(|i| (rng.random_range(0..i as u64) as usize, i)).collect();
            pairs.extend((0..rows).map(|_| {
                (rng.random_range(0..rows as u64) as usize, rng.random_range(0..rows as u64) as usize)
            }));
            let pairs: BTreeSet<_> = pairs.into_iter().filter(|(a, b)| a < b).collect();
            let mut block = || Matrix6::from_fn(|_, _| rng.random::<f64>() - 0.5);
            let above: BTreeMap<_, _> = pairs.iter().map(|&pair| (pair, block())).collect();
            let diagonal: Vec<_> = (0..rows)
                .map(|_| {
                    let b = block();
                    b * b.transpose() + Matrix6::identity() * 40.0
                })
                .collect();
            let b: Vec<_> = (0..rows).map(|_| block().column(0).into_owned()).collect();
            let mut dense = DMatrix::zeros(6 * rows, 6 * rows);
            for (i, block) in diagonal.iter().enumerate() {
                dense.view_mut((6 * i, 6 * i), (6, 6)).copy_from(block);
            }
            for (&(i, j), block) in &above {
                dense.view_mut((6 * i, 6 * j), (6, 6)).copy_from(block);
                dense.view_mut((6 * j, 6 * i), (6, 6)).copy_from(&block.transpose());
            }
            let right = DVector::from_iterator(6 * rows, b.iter().flatten().copied());
            let expected = dense.cholesky().unwrap().solve(&right);
            let found = Pattern::new(rows, above.keys().copied()).solve(&diagonal, &above, &b).unwrap();
            for (i, v) in found.iter().flatten().enumerate() {
                assert!((v - expected[i]).abs() < 1e-12, "{rows}: {i}");
            }
        }
    }

    #[test]
    fn a_chain_fills_in_nothing_and_what_is_not_positive_is_refused() {
        let chain = Pattern::new(100, (1..100).map(|i| (i - 1, i)));
        assert_eq!(chain.below.iter().map(Vec::len).sum::<usize>(), 99);
        let zero = [Matrix6::zeros()];
        assert!(Pattern::new(1, []).solve(&zero, &BTreeMap::new(), &[Vector6::zeros()]).is_none());
    }
}
