//! Reports a processor that MuJoCo cannot run on. The library uses AVX from its first instructions on. They run before `main`
//! and would end the program by SIGILL.

#![expect(
    unsafe_code,
    reason = "only the linker can place a function before those of the libraries"
)]

use std::io::Write;

use signal_hook::low_level::exit;

/// The functions that the dynamic linker calls before it initializes any library.
// SAFETY: the section holds pointers to functions that take what `main` takes and return nothing. The C library is not yet
// initialized, so `named` only asks the processor, writes and exits.
#[used]
#[unsafe(link_section = ".preinit_array")]
static BEFORE_LIBRARIES: extern "C" fn() = named;

extern "C" fn named() {
    if !std::arch::is_x86_feature_detected!("avx") {
        let sentence = b"error: this processor has no AVX, which MuJoCo needs (Intel and AMD have it since 2011)\n";
        let _ = std::io::stderr().write_all(sentence);
        exit(1);
    }
}
