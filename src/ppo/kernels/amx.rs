//! Products of bf16 matrices on the tiles of x86-64 processors (AMX), with sums in f32.
//!
//! Stable Rust has no intrinsics for these instructions, so this file, and only this one, uses assembly.
//! [`super::bf16`] packs the operands into tiles; [`Tiles::product`] is safe. Instructions: Intel 64 and IA-32
//! Architectures Software Developer's Manual, volume 1, chapter 18. Permission: Linux,
//! Documentation/arch/x86/xstate.rst.

#![expect(unsafe_code, reason = "assembly")]

use std::sync::OnceLock;

use anyhow::Result;

use super::bf16::{LINES, Packed, Side, TILE};
use super::product::Matrix;

/// Rows and columns of the product that are computed together: two by two tiles.
const BLOCK: usize = 2 * LINES;

/// The permission to use the tiles.
#[derive(Clone, Copy, Debug)]
pub struct Tiles(());

impl Tiles {
    /// Requests the tiles from the processor and the kernel, once per process.
    ///
    /// # Errors
    /// Fails if the tiles are missing, may not be used, or multiply wrongly; the message says which.
    pub fn request() -> Result<Self> {
        static ANSWER: OnceLock<Result<(), &'static str>> = OnceLock::new();
        let answer = ANSWER.get_or_init(|| {
            machine::request()?;
            if Tiles(()).multiply_rightly() { Ok(()) } else { Err("this processor's tiles compute wrong products") }
        });
        answer.map(|()| Self(())).map_err(anyhow::Error::msg)
    }

    /// Writes the product of packed matrices to `out` `[rows, columns]`, by rows, or adds it if `add` is set.
    ///
    /// # Panics
    /// Panics if the sizes do not match.
    pub fn product(self, out: &mut [f32], columns: usize, lhs: &Packed, rhs: &Packed, add: bool) {
        let (rows, depth) = (out.len() / columns, lhs.depth());
        assert_eq!(out.len(), rows * columns, "elements of the product");
        assert_eq!(depth, rhs.depth(), "tiles along the lines of both matrices");
        let pair = 2 * depth * TILE;
        assert_eq!(lhs.tiles().len(), rows.div_ceil(BLOCK) * pair, "tiles of the left matrix");
        assert_eq!(rhs.tiles().len(), columns.div_ceil(BLOCK) * pair, "tiles of the right matrix");
        let session = machine::TileSession::begin();
        // The tiles of the right matrix in use stay in the cache while those of the left one stream past.
        for (j, rhs) in rhs.tiles().chunks_exact(pair).enumerate() {
            for (i, lhs) in lhs.tiles().chunks_exact(pair).enumerate() {
                let (height, width) = ((rows - i * BLOCK).min(BLOCK), (columns - j * BLOCK).min(BLOCK));
                let first = i * BLOCK * columns + j * BLOCK;
                if (height, width) == (BLOCK, BLOCK) {
                    session.multiply(&mut out[first..], columns, lhs, rhs, add);
                    continue;
                }
                // A block that extends beyond the edge is computed in a separate buffer.
                let mut whole = [0.0; BLOCK * BLOCK];
                session.multiply(&mut whole, BLOCK, lhs, rhs, false);
                for (row, whole) in whole.chunks_exact(BLOCK).take(height).enumerate() {
                    let out = &mut out[first + row * columns..][..width];
                    for (out, x) in out.iter_mut().zip(whole) {
                        *out = if add { *out + x } else { *x };
                    }
                }
            }
        }
    }

    /// Returns whether a product of whole numbers, which needs no rounding, is exact.
    fn multiply_rightly(self) -> bool {
        let (rows, depth, columns) = (37, 70, 50);
        let numbers =
            |count: usize, step: usize| (0..count).map(|i| (i * step % 17) as f32 - 8.0).collect::<Vec<f32>>();
        let (a, b) = (numbers(rows * depth, 5), numbers(depth * columns, 3));
        let (mut lhs, mut rhs) = (Packed::default(), Packed::default());
        lhs.pack(Matrix::new(&a, rows, depth), Side::Left);
        rhs.pack(Matrix::new(&b, depth, columns), Side::Right);
        let mut out = vec![1.0; rows * columns];
        self.product(&mut out, columns, &lhs, &rhs, true);
        (0..rows * columns).all(|i| {
            let (row, column) = (i / columns, i % columns);
            let sum: f32 = (0..depth).map(|k| a[row * depth + k] * b[k * columns + column]).sum();
            out[i] == 1.0 + sum
        })
    }
}

#[cfg(all(target_arch = "x86_64", target_os = "linux"))]
mod machine {
    use std::arch::asm;
    use std::arch::x86_64::{__cpuid, __cpuid_count};
    use std::marker::PhantomData;

    use super::super::bf16::{DEPTH, LINES, TILE};
    use super::BLOCK;

    /// Bytes in a row of a tile, both in memory and in the processor.
    const ROW_BYTES: usize = 64;

    /// Checks that there are tiles for bf16, and requests the kernel's permission for this process to use them.
    pub(super) fn request() -> Result<(), &'static str> {
        const OSXSAVE: u32 = 1 << 27;
        const BF16_AND_TILE: u32 = 1 << 22 | 1 << 24;
        const TILE_STATE: u64 = 0b11 << 17;
        const ARCH_PRCTL: i64 = 158;
        const ARCH_REQ_XCOMP_PERM: u64 = 0x1023;
        const XFEATURE_XTILEDATA: u64 = 18;
        if __cpuid(0).eax < 7 || __cpuid_count(7, 0).edx & BF16_AND_TILE != BF16_AND_TILE {
            return Err("this processor has no bf16 tiles (AMX)");
        }
        if __cpuid(1).ecx & OSXSAVE == 0 {
            return Err("the kernel does not save the processor's tiles (AMX)");
        }
        let (low, high): (u32, u32);
        // SAFETY: OSXSAVE guarantees that the instruction exists; it only reads.
        unsafe { asm!("xgetbv", in("ecx") 0, out("eax") low, out("edx") high, options(nomem, nostack)) };
        if (u64::from(high) << 32 | u64::from(low)) & TILE_STATE != TILE_STATE {
            return Err("the kernel does not save the processor's tiles (AMX)");
        }
        let answer: i64;
        // SAFETY: this call does not change memory of the process; the kernel allocates the state in its own memory.
        unsafe {
            asm!("syscall", inlateout("rax") ARCH_PRCTL => answer, in("rdi") ARCH_REQ_XCOMP_PERM,
                in("rsi") XFEATURE_XTILEDATA, lateout("rcx") _, lateout("r11") _, options(nostack));
        }
        if answer == 0 { Ok(()) } else { Err("the kernel does not permit the use of tiles (AMX)") }
    }

    /// The configured tiles of this thread, released on drop.
    pub(super) struct TileSession(PhantomData<*const ()>);

    #[repr(align(64))]
    struct Setup([u8; 64]);

    /// The configuration: eight tiles of sixteen rows of 64 bytes (layout "palette 1").
    const SETUP: Setup = {
        let mut bytes = [0; 64];
        bytes[0] = 1;
        let mut tile = 0;
        while tile < 8 {
            bytes[16 + 2 * tile] = ROW_BYTES as u8;
            bytes[48 + tile] = LINES as u8;
            tile += 1;
        }
        Setup(bytes)
    };

    impl TileSession {
        pub(super) fn begin() -> Self {
            // SAFETY: `Tiles` exists only where the processor has these instructions and the kernel permits them. The
            // configuration stays loaded until `drop`: only `multiply` and plain copies run in between, and the
            // compiler uses no tiles itself.
            unsafe { asm!("ldtilecfg [{}]", in(reg) &SETUP.0, options(readonly, nostack)) };
            Self(PhantomData)
        }

        /// Computes 32 × 32 values of a product, whose rows are `columns` values apart in `out`.
        pub(super) fn multiply(&self, out: &mut [f32], columns: usize, lhs: &[u16], rhs: &[u16], add: bool) {
            let depth = lhs.len() / (2 * TILE);
            assert!(depth > 0 && lhs.len() == 2 * depth * TILE && rhs.len() == lhs.len());
            assert!(columns >= BLOCK && out.len() >= (BLOCK - 1) * columns + BLOCK);
            const { assert!(TILE * 2 == LINES * ROW_BYTES && DEPTH * 2 == ROW_BYTES) };
            // SAFETY: each operand is 2 × `depth` consecutive tiles of 1024 bytes, and each of the `depth` iterations
            // of the loop reads one tile of each half. `out` has 32 rows of 32 values at that distance.
            unsafe {
                let second_rows = out.as_mut_ptr().add(LINES * columns);
                asm!(
                    "tilezero tmm0",
                    "tilezero tmm1",
                    "tilezero tmm2",
                    "tilezero tmm3",
                    "test {add:e}, {add:e}",
                    "jz 2f",
                    "tileloadd tmm0, [{c0} + {apart}*1]",
                    "tileloadd tmm1, [{c0} + {apart}*1 + 64]",
                    "tileloadd tmm2, [{c1} + {apart}*1]",
                    "tileloadd tmm3, [{c1} + {apart}*1 + 64]",
                    "2:",
                    "tileloadd tmm4, [{a0} + {row}*1]",
                    "tileloadd tmm6, [{b0} + {row}*1]",
                    "tdpbf16ps tmm0, tmm4, tmm6",
                    "tileloadd tmm7, [{b1} + {row}*1]",
                    "tdpbf16ps tmm1, tmm4, tmm7",
                    "tileloadd tmm5, [{a1} + {row}*1]",
                    "tdpbf16ps tmm2, tmm5, tmm6",
                    "tdpbf16ps tmm3, tmm5, tmm7",
                    "add {a0}, 1024",
                    "add {a1}, 1024",
                    "add {b0}, 1024",
                    "add {b1}, 1024",
                    "dec {depth}",
                    "jnz 2b",
                    "tilestored [{c0} + {apart}*1], tmm0",
                    "tilestored [{c0} + {apart}*1 + 64], tmm1",
                    "tilestored [{c1} + {apart}*1], tmm2",
                    "tilestored [{c1} + {apart}*1 + 64], tmm3",
                    a0 = inout(reg) lhs.as_ptr() => _,
                    a1 = inout(reg) lhs.as_ptr().add(depth * TILE) => _,
                    b0 = inout(reg) rhs.as_ptr() => _,
                    b1 = inout(reg) rhs.as_ptr().add(depth * TILE) => _,
                    c0 = in(reg) out.as_mut_ptr(),
                    c1 = in(reg) second_rows,
                    depth = inout(reg) depth => _,
                    add = in(reg) u32::from(add),
                    apart = in(reg) columns * size_of::<f32>(),
                    row = in(reg) ROW_BYTES,
                    out("tmm0") _, out("tmm1") _, out("tmm2") _, out("tmm3") _,
                    out("tmm4") _, out("tmm5") _, out("tmm6") _, out("tmm7") _,
                    options(nostack),
                );
            }
        }
    }

    impl Drop for TileSession {
        fn drop(&mut self) {
            // SAFETY: as in `begin`; the tiles hold nothing that is still needed.
            unsafe { asm!("tilerelease", options(nomem, nostack)) };
        }
    }
}

#[cfg(not(all(target_arch = "x86_64", target_os = "linux")))]
mod machine {
    pub fn request() -> Result<(), &'static str> {
        Err("bf16 tiles (AMX) are used only on x86-64 Linux")
    }

    pub struct TileSession;

    impl TileSession {
        pub fn begin() -> Self {
            unreachable!("there are no tiles here")
        }

        pub fn multiply(&self, _: &mut [f32], _: usize, _: &[u16], _: &[u16], _: bool) {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ppo::kernels::bf16::rounded;
    use crate::rng;

    /// On a machine without tiles, only the error message is tested.
    #[test]
    fn products_of_rounded_numbers_agree_with_doubles() {
        let tiles = match Tiles::request() {
            Ok(tiles) => tiles,
            Err(error) => return assert!(error.to_string().contains("AMX"), "{error}"),
        };
        let mut rng = rng::stream(0, "test", 0);
        for (rows, depth, columns) in
            [(32, 32, 32), (1, 1, 1), (256, 157, 256), (20, 256, 64), (100, 33, 17), (3, 70, 500)]
        {
            let mut random =
                |count: usize| -> Vec<f32> { (0..count).map(|_| rng::uniform(&mut rng, -2.0, 2.0) as f32).collect() };
            let (a, b, before) = (random(rows * depth), random(depth * columns), random(rows * columns));
            for add in [false, true] {
                // Both operands, once stored by rows and once by columns.
                for (lhs, rhs) in [
                    (Matrix::new(&a, rows, depth), Matrix::new(&b, depth, columns)),
                    (Matrix::new(&a, depth, rows).transposed(), Matrix::new(&b, columns, depth).transposed()),
                ] {
                    let (mut left, mut right) = (Packed::default(), Packed::default());
                    left.pack(lhs, Side::Left);
                    right.pack(rhs, Side::Right);
                    let mut out = before.clone();
                    tiles.product(&mut out, columns, &left, &right, add);
                    let at = |m: Matrix, i: usize, j: usize| {
                        f64::from(rounded(m.data()[i * m.strides()[0] as usize + j * m.strides()[1] as usize]))
                    };
                    for (i, &found) in out.iter().enumerate() {
                        let terms = (0..depth).map(|k| at(lhs, i / columns, k) * at(rhs, k, i % columns));
                        let start = if add { f64::from(before[i]) } else { 0.0 };
                        let (sum, size) = terms.fold((start, start.abs()), |(s, z), x| (s + x, z + x.abs()));
                        let error = (f64::from(found) - sum).abs();
                        assert!(error <= 1e-6 * size.max(1.0), "{rows}×{depth}×{columns}: {found} not {sum}");
                    }
                }
            }
        }
    }
}
