//! Matrix products on one thread, over slices with strides.

/// A matrix in a slice: entry (r, c) at `r · row + c · column`.
#[derive(Clone, Copy)]
pub(super) struct Matrix<'a> {
    pub values: &'a [f32],
    pub row: usize,
    pub column: usize,
}

impl<'a> Matrix<'a> {
    /// Rows of `width` values one after the other.
    pub fn rows(values: &'a [f32], width: usize) -> Self {
        Self { values, row: width, column: 1 }
    }

    pub fn transposed(self) -> Self {
        Self { row: self.column, column: self.row, ..self }
    }

    fn holds(&self, rows: usize, columns: usize) -> bool {
        rows * columns == 0 || (rows - 1) * self.row + (columns - 1) * self.column < self.values.len()
    }
}

/// `out = left · right`, or `out += …`, with `out` of `rows` × `columns`, row by row.
pub(super) fn product(sizes: [usize; 3], left: Matrix, right: Matrix, out: &mut [f32], accumulate: bool) {
    product_with_stride(sizes, left, right, out, sizes[2], accumulate);
}

/// The same with rows of `out` that start `stride` values apart.
pub(super) fn product_with_stride(
    [rows, inner, columns]: [usize; 3],
    left: Matrix,
    right: Matrix,
    out: &mut [f32],
    stride: usize,
    accumulate: bool,
) {
    assert!(left.holds(rows, inner) && right.holds(inner, columns) && columns <= stride);
    assert!(rows == 0 || out.len() >= (rows - 1) * stride + columns);
    if rows == 0 {
        return;
    }
    let panel = panel(columns);
    for first in (0..columns).step_by(panel) {
        // SAFETY: all entries lie in their slices, as asserted, of which the panel has a part; `out` is borrowed alone.
        unsafe {
            gemm::gemm(
                rows,
                panel.min(columns - first),
                inner,
                out.as_mut_ptr().add(first),
                1,
                stride as isize,
                accumulate,
                left.values.as_ptr(),
                left.column as isize,
                left.row as isize,
                right.values.as_ptr().wrapping_add(first * right.column),
                right.column as isize,
                right.row as isize,
                if accumulate { 1.0 } else { 0.0 },
                1.0_f32,
                false,
                false,
                false,
                gemm::Parallelism::None,
            );
        }
    }
}

/// Columns that are computed together. With AVX-512 the kernel of 32 keeps its sums in registers, and takes two fifths of
/// the time of the wider one that would be chosen for more.
fn panel(columns: usize) -> usize {
    #[cfg(target_arch = "x86_64")]
    if std::is_x86_feature_detected!("avx512f") {
        return 32;
    }
    columns.max(1)
}
