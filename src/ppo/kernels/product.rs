//! Matrix products of slices on the calling thread. Callers run many of them in parallel, each on data that stays in
//! the cache of one core. This is faster than one product on all threads.

#![expect(unsafe_code, reason = "the matrix product of gemm takes pointers")]

use gemm::{Parallelism, gemm};

/// A matrix stored in a slice.
#[derive(Clone, Copy)]
pub struct Matrix<'a> {
    data: &'a [f32],
    /// Rows and columns.
    size: [usize; 2],
    /// Distances in `data` between neighbours in a column and in a row.
    strides: [isize; 2],
}

impl<'a> Matrix<'a> {
    /// Creates a matrix stored by rows.
    ///
    /// # Panics
    /// Panics if `data` does not have `rows * columns` elements.
    pub fn new(data: &'a [f32], rows: usize, columns: usize) -> Self {
        assert_eq!(data.len(), rows * columns, "elements of a matrix");
        Self {
            data,
            size: [rows, columns],
            strides: [columns as isize, 1],
        }
    }

    /// The values in memory order.
    pub fn data(&self) -> &'a [f32] {
        self.data
    }

    /// The numbers of rows and columns.
    pub fn size(&self) -> [usize; 2] {
        self.size
    }

    /// The distances in the data between neighbours in a column and in a row. One of them is 1.
    pub fn strides(&self) -> [isize; 2] {
        self.strides
    }

    /// A matrix with the same layout, whose elements are `f` of these and lie in `room`.
    pub fn mapped<'b>(&self, room: &'b mut Vec<f32>, f: impl Fn(f32) -> f32) -> Matrix<'b> {
        room.clear();
        room.extend(self.data.iter().map(|&x| f(x)));
        Matrix {
            data: room,
            size: self.size,
            strides: self.strides,
        }
    }

    /// The transposed matrix, without copying.
    pub fn transposed(self) -> Self {
        let [rows, columns] = self.size;
        let [down, right] = self.strides;
        Self {
            size: [columns, rows],
            strides: [right, down],
            ..self
        }
    }
}

/// Writes the product to `out`, by rows, or adds it if `add` is set.
///
/// # Panics
/// Panics if the sizes do not match.
pub fn product(out: &mut [f32], lhs: Matrix, rhs: Matrix, add: bool) {
    let [m, k] = lhs.size;
    let [rhs_rows, n] = rhs.size;
    assert_eq!(
        k, rhs_rows,
        "columns of the first and rows of the second matrix"
    );
    assert_eq!(out.len(), m * n, "elements of the product");
    let [down, right] = lhs.strides;
    let [rhs_down, rhs_right] = rhs.strides;
    // SAFETY: the strides of `Matrix` stay within its slice, and `out` has m rows of n elements.
    unsafe {
        #[rustfmt::skip]
        gemm(
            m, n, k,
            out.as_mut_ptr(), 1, n as isize, add,
            lhs.data.as_ptr(), right, down,
            rhs.data.as_ptr(), rhs_right, rhs_down,
            1.0, 1.0, false, false, false, Parallelism::None,
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn products_are_those_worked_out_by_hand() {
        let a = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];
        let b = [1.0, -1.0, 2.0, 0.5, 0.0, 3.0];
        let mut out = [9.0; 4];
        product(
            &mut out,
            Matrix::new(&a, 2, 3),
            Matrix::new(&b, 3, 2),
            false,
        );
        assert_eq!(out, [5.0, 9.0, 14.0, 16.5]);
        product(
            &mut out,
            Matrix::new(&a, 2, 3),
            Matrix::new(&b, 2, 3).transposed(),
            true,
        );
        assert_eq!(out, [10.0, 18.5, 25.0, 36.5]);
    }
}
