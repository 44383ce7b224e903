//! bf16, the upper half of an f32: rounding, packing of operands into tiles, and products of tiles block by block.

use super::product::Matrix;
use super::widest::widest;

/// Lines in a tile. The lines of an operand are the rows of the left matrix or the columns of the right one.
pub const LINES: usize = 16;

/// Values of each line in a tile.
pub const DEPTH: usize = 32;

/// A tile, at the start of a cache line.
#[derive(Clone)]
#[repr(C, align(64))]
pub struct Tile(pub [u16; LINES * DEPTH]);

/// Rounds to the nearest bf16, ties to even. NaN stays NaN.
#[inline(always)]
pub fn round(x: f32) -> u16 {
    let bits = x.to_bits();
    let rounded = bits.wrapping_add(0x7fff + ((bits >> 16) & 1)) >> 16;
    if x.is_nan() { 0x7fc0 } else { rounded as u16 }
}

/// Rounds to the nearest bf16, returned as f32.
#[inline(always)]
pub fn rounded(x: f32) -> f32 {
    f32::from_bits(u32::from(round(x)) << 16)
}

/// Rows and columns of a product that are computed together: two by two tiles.
#[cfg(target_arch = "x86_64")]
pub const BLOCK: usize = 2 * LINES;

/// A unit of the processor that multiplies bf16 matrices. A value proves that the unit is there and may be used.
pub trait Unit: Sync {
    /// The order in which it reads this left operand best. The right operand is always in pairs.
    fn order_of_left(&self, _lhs: Matrix) -> Order {
        Order::Lines
    }

    /// Writes the product of packed matrices to `out` `[rows, columns]`, by rows, or adds it if `add` is set.
    ///
    /// # Panics
    /// Panics if the sizes do not match.
    fn product(&self, out: &mut [f32], columns: usize, operands: [&Packed; 2], add: bool);
}

/// Computes a product block by block. `multiply` writes [`BLOCK`] × [`BLOCK`] values, whose rows are as far apart as its second
/// argument says, or adds them if its last argument is set. There is room for them. Its operands are two rows of tiles each: lines
/// 0-15, then 16-31. Each row has as many tiles, at least one.
///
/// # Panics
/// Panics if the sizes do not match.
#[cfg(target_arch = "x86_64")]
pub fn in_blocks<F>(
    out: &mut [f32],
    columns: usize,
    [lhs, rhs]: [&Packed; 2],
    add: bool,
    multiply: F,
) where
    F: Fn(&mut [f32], usize, [&[Tile]; 2], bool),
{
    let rows = out.len() / columns;
    let depth = lhs.depth;
    assert_eq!(out.len(), rows * columns, "elements of the product");
    assert!(
        depth > 0 && depth == rhs.depth,
        "tiles along the lines of both matrices"
    );
    assert_eq!(rhs.order, Order::Pairs, "order of the right matrix");
    let pair = 2 * depth;
    assert_eq!(
        lhs.tiles.len(),
        rows.div_ceil(BLOCK) * pair,
        "tiles of the left matrix"
    );
    assert_eq!(
        rhs.tiles.len(),
        columns.div_ceil(BLOCK) * pair,
        "tiles of the right matrix"
    );
    // The tiles of the right matrix in use stay in the cache while the tiles of the left one stream past.
    for (j, rhs) in rhs.tiles.chunks_exact(pair).enumerate() {
        for (i, lhs) in lhs.tiles.chunks_exact(pair).enumerate() {
            let height = (rows - i * BLOCK).min(BLOCK);
            let width = (columns - j * BLOCK).min(BLOCK);
            let first = i * BLOCK * columns + j * BLOCK;
            if (height, width) == (BLOCK, BLOCK) {
                multiply(&mut out[first..], columns, [lhs, rhs], add);
                continue;
            }
            // A block that extends beyond the edge is computed in a separate buffer.
            let mut whole = [0.0; BLOCK * BLOCK];
            multiply(&mut whole, BLOCK, [lhs, rhs], false);
            for (row, whole) in whole.chunks_exact(BLOCK).take(height).enumerate() {
                let out = &mut out[first + row * columns..][..width];
                for (out, x) in out.iter_mut().zip(whole) {
                    *out = if add { *out + x } else { *x };
                }
            }
        }
    }
}

/// The order of the values in a tile.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Order {
    /// 16 lines of 32 values.
    #[default]
    Lines,
    /// 16 rows, each with one pair of values from each of 16 lines.
    Pairs,
}

/// A matrix in tiles, padded with zeros. First come all tiles along the first sixteen lines, then along the next
/// sixteen, up to an even number of such groups.
#[derive(Default)]
pub struct Packed {
    tiles: Vec<Tile>,
    /// The number of tiles along a line.
    depth: usize,
    /// The order of the values in a tile.
    pub order: Order,
}

impl Packed {
    /// Packs the lines of an operand, which are the rows of `matrix`, reusing the memory of the previous one.
    pub fn pack(&mut self, matrix: Matrix, order: Order) {
        self.jobs(matrix, order).for_each(|pack| pack());
    }

    /// Makes room for the same. Each of the jobs packs a part of it.
    pub fn jobs<'a>(
        &'a mut self,
        matrix: Matrix<'a>,
        order: Order,
    ) -> impl Iterator<Item = impl FnOnce() + Send + 'a> {
        let [lines, numbers] = matrix.size();
        self.depth = numbers.div_ceil(DEPTH);
        self.order = order;
        let groups = lines.div_ceil(2 * LINES) * 2;
        let depth = self.depth;
        self.tiles.resize(groups * depth, Tile([0; LINES * DEPTH]));
        self.tiles
            .chunks_mut(PART)
            .enumerate()
            .map(move |(part, tiles)| {
                move || {
                    widest!({
                        for (i, Tile(tile)) in (part * PART..).zip(tiles) {
                            let line = i / depth * LINES;
                            let number = i % depth * DEPTH;
                            pack_tile(tile, matrix, [line, number], order);
                        }
                    });
                }
            })
    }
}

/// The number of tiles that are packed together.
const PART: usize = 32;

/// Fills a tile, starting at this line and this position in the line.
#[inline(always)]
fn pack_tile(
    tile: &mut [u16; LINES * DEPTH],
    matrix: Matrix,
    [line, number]: [usize; 2],
    order: Order,
) {
    let [lines, numbers] = matrix.size();
    let lines = lines.saturating_sub(line).min(LINES);
    let numbers = (numbers - number).min(DEPTH);
    if (lines, numbers) != (LINES, DEPTH) {
        tile.fill(0);
    }
    if lines == 0 {
        return;
    }
    // One of the strides is 1. Values along it are rounded as whole vectors, then moved into place.
    let [across, along] = matrix.strides().map(|stride| stride as usize);
    if along == 1 {
        for i in 0..lines {
            let from = &matrix.data()[(line + i) * across + number..][..numbers];
            put_line(tile, i, from, order);
        }
    } else {
        let column = |j: usize| {
            let mut column = [0; LINES];
            if j < numbers {
                let from = &matrix.data()[(number + j) * along + line..][..lines];
                column
                    .iter_mut()
                    .zip(from)
                    .for_each(|(to, &x)| *to = round(x));
            }
            column
        };
        for j in (0..numbers).step_by(2) {
            put_columns(tile, j, [column(j), column(j + 1)], order);
        }
    }
}

/// Rounds line `i` of a tile and puts it in its place.
#[inline(always)]
fn put_line(tile: &mut [u16; LINES * DEPTH], i: usize, from: &[f32], order: Order) {
    match order {
        Order::Lines => tile[i * DEPTH..]
            .iter_mut()
            .zip(from)
            .for_each(|(to, &x)| *to = round(x)),
        Order::Pairs => {
            let mut row = [0; DEPTH];
            row.iter_mut().zip(from).for_each(|(to, &x)| *to = round(x));
            let (pairs, _) = row.as_chunks::<2>();
            for (to, pair) in tile[2 * i..].chunks_mut(DEPTH).zip(pairs) {
                to[..2].copy_from_slice(pair);
            }
        }
    }
}

/// Puts the values `j` and `j + 1` of all lines of a tile in their places.
#[inline(always)]
fn put_columns(
    tile: &mut [u16; LINES * DEPTH],
    j: usize,
    [even, odd]: [[u16; LINES]; 2],
    order: Order,
) {
    let pairs = even.into_iter().zip(odd);
    match order {
        Order::Pairs => {
            let (to, _) = tile[j * LINES..][..DEPTH].as_chunks_mut::<2>();
            to.iter_mut()
                .zip(pairs)
                .for_each(|(to, (even, odd))| *to = [even, odd]);
        }
        Order::Lines => {
            for (to, (even, odd)) in tile.chunks_mut(DEPTH).zip(pairs) {
                to[j..j + 2].copy_from_slice(&[even, odd]);
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
        assert!(
            rounded(f32::from_bits(0xff80_0001)).is_nan(),
            "a NaN whose upper half alone would be infinity"
        );
    }

    #[test]
    fn every_number_of_a_matrix_is_in_its_tile_whichever_way_it_lies_in_memory() {
        let rows = 37;
        let columns = 70;
        let number = |row: usize, column: usize| ((row * columns + column) % 251) as f32;
        let by_rows: Vec<f32> = (0..rows * columns)
            .map(|i| number(i / columns, i % columns))
            .collect();
        let by_columns: Vec<f32> = (0..rows * columns)
            .map(|i| number(i % rows, i / rows))
            .collect();
        for matrix in [
            Matrix::new(&by_rows, rows, columns),
            Matrix::new(&by_columns, columns, rows).transposed(),
        ] {
            for order in [Order::Lines, Order::Pairs] {
                // Left from a previous matrix.
                let mut packed = Packed {
                    tiles: vec![Tile([7; LINES * DEPTH]); 20],
                    depth: 3,
                    order,
                };
                packed.pack(matrix, order);
                assert_eq!(
                    (packed.depth, packed.order),
                    (columns.div_ceil(DEPTH), order)
                );
                let groups = rows.div_ceil(2 * LINES) * 2;
                assert_eq!(packed.tiles.len(), groups * packed.depth);
                for (i, &x) in packed.tiles.iter().flat_map(|Tile(tile)| tile).enumerate() {
                    let tile = i / (LINES * DEPTH);
                    let row = i % (LINES * DEPTH) / DEPTH;
                    let cell = i % DEPTH;
                    let (line, along) = match order {
                        Order::Lines => (row, cell),
                        Order::Pairs => (cell / 2, 2 * row + cell % 2),
                    };
                    let line = tile / packed.depth * LINES + line;
                    let along = tile % packed.depth * DEPTH + along;
                    let inside = line < rows && along < columns;
                    let expected = if inside { number(line, along) } else { 0.0 };
                    assert_eq!(x, round(expected), "{order:?}: {line}, {along}");
                }
            }
        }
    }
}
