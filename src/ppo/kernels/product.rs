//! Matrix products of slices, on the calling thread: the callers run many of them at once, each on numbers that stay in the
//! cache of one core, which is faster than one product on all threads.

use gemm::{Parallelism, gemm};

/// A matrix in a slice.
#[derive(Clone, Copy)]
pub struct Matrix<'a> {
    data: &'a [f32],
    /// Rows and columns.
    size: [usize; 2],
    /// Distance in `data` between neighbours in a column and in a row.
    strides: [isize; 2],
}

impl<'a> Matrix<'a> {
    /// Row after row.
    ///
    /// # Panics
    /// If `data` has another number of elements.
    pub fn new(data: &'a [f32], rows: usize, columns: usize) -> Self {
        assert_eq!(data.len(), rows * columns, "elements of a matrix");
        Self { data, size: [rows, columns], strides: [columns as isize, 1] }
    }

    /// The numbers as they lie in memory.
    pub fn data(&self) -> &'a [f32] {
        self.data
    }

    /// Rows and columns.
    pub fn size(&self) -> [usize; 2] {
        self.size
    }

    /// Distance in the data between neighbours in a column and in a row; one of them is 1.
    pub fn strides(&self) -> [isize; 2] {
        self.strides
    }

    /// Other numbers that lie in the same way.
    pub fn of<'b>(&self, data: &'b [f32]) -> Matrix<'b> {
        assert_eq!(data.len(), self.data.len(), "elements of a matrix");
        Matrix { data, size: self.size, strides: self.strides }
    }

    /// The same numbers with rows and columns exchanged.
    pub fn transposed(self) -> Self {
        let ([rows, columns], [down, right]) = (self.size, self.strides);
        Self { data: self.data, size: [columns, rows], strides: [right, down] }
    }
}

/// Writes the product into `out`, row after row, or adds it to what is there.
///
/// # Panics
/// Sizes that do not fit.
pub fn product(out: &mut [f32], lhs: Matrix, rhs: Matrix, add: bool) {
    let ([m, k], [rhs_rows, n]) = (lhs.size, rhs.size);
    assert_eq!(k, rhs_rows, "columns of the first and rows of the second matrix");
    assert_eq!(out.len(), m * n, "elements of the product");
    // SAFETY: the strides of `Matrix` stay within its slice, and `out` has m rows of n elements.
    unsafe {
        gemm(
            m,
            n,
            k,
            out.as_mut_ptr(),
            1,
            n as isize,
            add,
            lhs.data.as_ptr(),
            lhs.strides[1],
            lhs.strides[0],
            rhs.data.as_ptr(),
            rhs.strides[1],
            rhs.strides[0],
            1.0,
            1.0,
            false,
            false,
            false,
            Parallelism::None,
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn products_are_those_worked_out_by_hand() {
        let (a, b) = ([1.0, 2.0, 3.0, 4.0, 5.0, 6.0], [1.0, -1.0, 2.0, 0.5, 0.0, 3.0]);
        let mut out = [9.0; 4];
        product(&mut out, Matrix::new(&a, 2, 3), Matrix::new(&b, 3, 2), false);
        assert_eq!(out, [5.0, 9.0, 14.0, 16.5]);
        product(&mut out, Matrix::new(&a, 2, 3), Matrix::new(&b, 2, 3).transposed(), true);
        assert_eq!(out, [10.0, 18.5, 25.0, 36.5]);
    }
}
