//! bf16, the upper half of an f32: rounding, and packing of operands into the tiles that [`super::amx`] multiplies.

use pulp::Arch;

use super::product::Matrix;

/// Lines in a tile: rows of the left matrix or columns of the right one.
pub(super) const LINES: usize = 16;

/// Values of each line in a tile.
pub(super) const DEPTH: usize = 32;

/// Values in a tile.
pub(super) const TILE: usize = LINES * DEPTH;

/// Rounds to the nearest bf16, ties to even; NaN stays NaN.
#[inline(always)]
pub(super) fn round(x: f32) -> u16 {
    let bits = x.to_bits();
    let rounded = bits.wrapping_add(0x7fff + ((bits >> 16) & 1)) >> 16;
    if x.is_nan() { 0x7fc0 } else { rounded as u16 }
}

/// Rounds to the nearest bf16, returned as f32.
#[inline(always)]
pub(super) fn rounded(x: f32) -> f32 {
    f32::from_bits(u32::from(round(x)) << 16)
}

/// The position of a matrix in a product.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Side {
    /// The left operand: lines are rows. A tile has 16 lines of 32 values.
    Left,
    /// The right operand: lines are columns. A tile has 16 rows, each with one pair of values from each of 16 lines.
    Right,
}

/// A matrix in tiles, padded with zeros: first all tiles along the first sixteen lines, then along the next sixteen, up
/// to an even number of such groups.
#[derive(Default)]
pub struct Packed {
    tiles: Vec<u16>,
    depth: usize,
}

impl Packed {
    /// Returns the tiles.
    pub fn tiles(&self) -> &[u16] {
        &self.tiles
    }

    /// Returns the number of tiles along a line.
    pub fn depth(&self) -> usize {
        self.depth
    }

    /// Packs a matrix as the left or right operand, reusing the memory of the previous one.
    pub fn pack(&mut self, matrix: Matrix, side: Side) {
        // From here on, either operand is `lines` lines of `numbers` values.
        let matrix = if side == Side::Left { matrix } else { matrix.transposed() };
        let [lines, numbers] = matrix.size();
        self.depth = numbers.div_ceil(DEPTH);
        let groups = lines.div_ceil(2 * LINES) * 2;
        self.tiles.resize(groups * self.depth * TILE, 0);
        Arch::new().dispatch(
            #[inline(always)]
            || {
                for (i, tile) in self.tiles.chunks_exact_mut(TILE).enumerate() {
                    let (line, number) = (i / self.depth * LINES, i % self.depth * DEPTH);
                    pack_tile(tile, matrix, [line, number], side);
                }
            },
        );
    }
}

/// Fills a tile, starting at this line and this position in the line.
#[inline(always)]
fn pack_tile(tile: &mut [u16], matrix: Matrix, [line, number]: [usize; 2], side: Side) {
    let ([lines, numbers], data) = (matrix.size(), matrix.data());
    let (lines, numbers) = (lines.saturating_sub(line).min(LINES), (numbers - number).min(DEPTH));
    // One of the strides is 1. Values along it are rounded as whole vectors, then moved into place.
    let [across, along] = matrix.strides().map(|stride| stride as usize);
    let place = |line: usize, number: usize| match side {
        Side::Left => line * DEPTH + number,
        Side::Right => number / 2 * DEPTH + 2 * line + number % 2,
    };
    if (lines, numbers) != (LINES, DEPTH) {
        tile.fill(0);
    }
    if lines == 0 {
        return;
    }
    if along == 1 {
        for i in 0..lines {
            let from = &data[(line + i) * across + number..][..numbers];
            let mut row = [0; DEPTH];
            row.iter_mut().zip(from).for_each(|(to, &x)| *to = round(x));
            for (j, &x) in row.iter().enumerate() {
                tile[place(i, j)] = x;
            }
        }
    } else {
        for j in 0..numbers {
            let from = &data[(number + j) * along + line..][..lines];
            let mut column = [0; LINES];
            column.iter_mut().zip(from).for_each(|(to, &x)| *to = round(x));
            for (i, &x) in column.iter().enumerate() {
                tile[place(i, j)] = x;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rounding_goes_to_the_nearest_and_of_two_to_the_even() {
        for (x, expected) in [
            (1.0, 1.0),
            (-1.0, -1.0),
            (1.0 + 1.0 / 256.0, 1.0),
            (1.0 + 3.0 / 256.0, 1.0 + 4.0 / 256.0),
            (1.0 + 1.1 / 256.0, 1.0 + 2.0 / 256.0),
            (0.0, 0.0),
            (f32::INFINITY, f32::INFINITY),
            (f32::MAX, f32::INFINITY),
        ] {
            assert_eq!(rounded(x), expected, "{x}");
        }
        assert!(rounded(f32::NAN).is_nan());
        assert!(rounded(f32::from_bits(0xff80_0001)).is_nan(), "a NaN whose upper half alone would be infinity");
    }

    #[test]
    fn every_number_of_a_matrix_is_in_its_tile_whichever_way_it_lies_in_memory() {
        let (rows, columns) = (37, 70);
        let number = |row: usize, column: usize| ((row * columns + column) % 251) as f32;
        let by_rows: Vec<f32> = (0..rows * columns).map(|i| number(i / columns, i % columns)).collect();
        let by_columns: Vec<f32> = (0..rows * columns).map(|i| number(i % rows, i / rows)).collect();
        for matrix in [Matrix::new(&by_rows, rows, columns), Matrix::new(&by_columns, columns, rows).transposed()] {
            for side in [Side::Left, Side::Right] {
                let mut packed = Packed { tiles: vec![7; 9999], depth: 3 }; // left from a previous matrix
                packed.pack(matrix, side);
                let [lines, numbers] = if side == Side::Left { [rows, columns] } else { [columns, rows] };
                assert_eq!(packed.depth(), numbers.div_ceil(DEPTH));
                let groups = lines.div_ceil(2 * LINES) * 2;
                assert_eq!(packed.tiles().len(), groups * packed.depth() * TILE);
                for (i, &x) in packed.tiles().iter().enumerate() {
                    let (tile, row, cell) = (i / TILE, i % TILE / DEPTH, i % DEPTH);
                    let (line, along) = match side {
                        Side::Left => (row, cell),
                        Side::Right => (cell / 2, 2 * row + cell % 2),
                    };
                    let (line, along) = (tile / packed.depth() * LINES + line, tile % packed.depth() * DEPTH + along);
                    let inside = line < lines && along < numbers;
                    let (row, column) = if side == Side::Left { (line, along) } else { (along, line) };
                    let expected = if inside { number(row, column) } else { 0.0 };
                    assert_eq!(x, round(expected), "{side:?}: {row}, {column}");
                }
            }
        }
    }
}
