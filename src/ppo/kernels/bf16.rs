//! bf16, the upper half of a float: rounding, and the order in which the tiles of [`super::amx`] want their operands.

use pulp::Arch;

use super::product::Matrix;

/// Lines (rows of the left matrix, columns of the right one) in a tile.
pub const LINES: usize = 16;

/// Numbers of each line in a tile.
pub const DEPTH: usize = 32;

/// Numbers in a tile.
pub const TILE: usize = LINES * DEPTH;

/// The nearest bf16, of two as near the even one; what is not a number stays so.
#[inline(always)]
pub fn round(x: f32) -> u16 {
    let bits = x.to_bits();
    let rounded = bits.wrapping_add(0x7fff + ((bits >> 16) & 1)) >> 16;
    if x.is_nan() { 0x7fc0 } else { rounded as u16 }
}

/// The same as a float.
#[inline(always)]
pub fn rounded(x: f32) -> f32 {
    f32::from_bits(u32::from(round(x)) << 16)
}

/// On which side of a product a matrix stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Side {
    /// Lines are rows. A tile has 16 lines of 32 numbers.
    Left,
    /// Lines are columns. A tile has 16 pairs of numbers of 16 lines.
    Right,
}

/// A matrix in tiles, with zeros beyond its edges: all along the first sixteen lines, then all along the next, up to an even
/// number of sixteens.
#[derive(Default)]
pub struct Packed {
    tiles: Vec<u16>,
    depth: usize,
}

impl Packed {
    /// The tiles.
    pub fn tiles(&self) -> &[u16] {
        &self.tiles
    }

    /// Tiles along a line.
    pub fn depth(&self) -> usize {
        self.depth
    }

    /// Takes in the matrix that stands on that side, in the room of the one before.
    pub fn pack(&mut self, matrix: Matrix, side: Side) {
        // Seen from either side: so many lines of so many numbers.
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

/// Fills a tile with the lines and numbers from `first` on.
#[inline(always)]
fn pack_tile(tile: &mut [u16], matrix: Matrix, [line, number]: [usize; 2], side: Side) {
    let ([lines, numbers], data) = (matrix.size(), matrix.data());
    let (lines, numbers) = (lines.saturating_sub(line).min(LINES), (numbers - number).min(DEPTH));
    // One of the strides is 1: along it whole vectors are rounded, then put in their places.
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
        assert!(rounded(f32::from_bits(0xff80_0001)).is_nan(), "a NaN whose upper half alone would be infinite");
    }

    #[test]
    fn every_number_of_a_matrix_is_in_its_tile_whichever_way_it_lies_in_memory() {
        let (rows, columns) = (37, 70);
        let number = |row: usize, column: usize| ((row * columns + column) % 251) as f32;
        let by_rows: Vec<f32> = (0..rows * columns).map(|i| number(i / columns, i % columns)).collect();
        let by_columns: Vec<f32> = (0..rows * columns).map(|i| number(i % rows, i / rows)).collect();
        for matrix in [Matrix::new(&by_rows, rows, columns), Matrix::new(&by_columns, columns, rows).transposed()] {
            for side in [Side::Left, Side::Right] {
                let mut packed = Packed { tiles: vec![7; 9999], depth: 3 }; // of a matrix before
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
