//! Products of bf16 matrices on the tiles of x86-64 processors (AMX), with sums in f32.
//!
//! Stable Rust has no intrinsics for these instructions, so this file, and only this one, uses assembly.
//! Instructions: Intel 64 and IA-32 Architectures Software Developer's Manual, volume 1, chapter 18. Permission: Linux,
//! Documentation/arch/x86/xstate.rst.

#![expect(unsafe_code, reason = "assembly")]

use std::arch::asm;
use std::arch::x86_64::{__cpuid, __cpuid_count};

use super::bf16::{DEPTH, LINES, Packed, Tile, Unit, in_blocks};

/// Bytes in a row of a tile, both in memory and in the processor.
const ROW_BYTES: usize = 64;

/// The permission to use the tiles.
struct Tiles(());

/// Checks that there are tiles for bf16, and requests the kernel's permission for this process to use them.
///
/// # Errors
/// Fails if the tiles are missing or may not be used. The message says which.
pub fn request() -> Result<&'static dyn Unit, &'static str> {
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
    // SAFETY: OSXSAVE guarantees that the instruction exists. It only reads.
    unsafe {
        asm!("xgetbv", in("ecx") 0, out("eax") low, out("edx") high, options(nomem, nostack))
    };
    if (u64::from(high) << 32 | u64::from(low)) & TILE_STATE != TILE_STATE {
        return Err("the kernel does not save the processor's tiles (AMX)");
    }
    let answer: i64;
    // SAFETY: this call does not change memory of the process. The kernel allocates the state in its own memory.
    unsafe {
        asm!("syscall", inlateout("rax") ARCH_PRCTL => answer, in("rdi") ARCH_REQ_XCOMP_PERM,
            in("rsi") XFEATURE_XTILEDATA, lateout("rcx") _, lateout("r11") _, options(nostack));
    }
    if answer == 0 {
        Ok(&Tiles(()))
    } else {
        Err("the kernel does not permit the use of tiles (AMX)")
    }
}

/// The configuration of tiles: layout ("palette"), reserved bytes, and for each tile the bytes in a row and the rows.
#[repr(C, align(64))]
struct Setup(u8, [u8; 15], [[u16; 8]; 2], [[u8; 8]; 2]);

/// Eight tiles of sixteen rows of 64 bytes.
const SETUP: Setup = Setup(
    1,
    [0; 15],
    [[ROW_BYTES as u16; 8], [0; 8]],
    [[LINES as u8; 8], [0; 8]],
);

/// The configured tiles of this thread, released on drop.
struct Configured;

impl Drop for Configured {
    fn drop(&mut self) {
        // SAFETY: `product` alone creates one, after such an instruction. The tiles hold nothing that is still needed.
        unsafe { asm!("tilerelease", options(nomem, nostack)) };
    }
}

impl Unit for Tiles {
    fn product(&self, out: &mut [f32], columns: usize, operands: [&Packed; 2], add: bool) {
        // SAFETY: `request` alone creates `Tiles`, and only where the processor has these instructions and the kernel permits
        // them. The compiler uses no tiles itself, so the configuration stays loaded until `_configured` is dropped.
        unsafe { asm!("ldtilecfg [{}]", in(reg) &SETUP, options(readonly, nostack)) };
        let _configured = Configured;
        // SAFETY: the tiles are configured. `in_blocks` ensures the rest.
        in_blocks(
            out,
            columns,
            operands,
            add,
            |out, columns, tiles, add| unsafe { multiply(out, columns, tiles, add) },
        );
    }
}

/// Writes a block of a product, or adds it if `add` is set (see [`in_blocks`]).
///
/// # Safety
/// The tiles of this thread must be configured. `out` must have room for a block. Each operand must have twice as many tiles as
/// there are along a line, at least two, and both equally many.
unsafe fn multiply(out: &mut [f32], columns: usize, [lhs, rhs]: [&[Tile]; 2], add: bool) {
    let depth = lhs.len() / 2;
    const {
        assert!(
            size_of::<Tile>() == LINES * ROW_BYTES
                && DEPTH * 2 == ROW_BYTES
                && size_of::<Setup>() == 64
        )
    };
    // SAFETY: the caller has configured the tiles. Each operand is 2 × `depth` consecutive tiles of 1024 bytes, and each of
    // the `depth` iterations of the loop reads one tile of each half. `out` has 32 rows of 32 values at that distance.
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
            a1 = inout(reg) lhs.as_ptr().add(depth) => _,
            b0 = inout(reg) rhs.as_ptr() => _,
            b1 = inout(reg) rhs.as_ptr().add(depth) => _,
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
