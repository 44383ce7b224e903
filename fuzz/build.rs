//! Lets the fuzz targets find MuJoCo's library where the build of the program puts it.

use std::env;

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    let of = |name| env::var(name).expect("cargo sets it");
    let root = of("CARGO_MANIFEST_DIR");
    let platform = [of("CARGO_CFG_TARGET_OS"), of("CARGO_CFG_TARGET_ARCH")].join("-");
    println!("cargo::rustc-link-arg=-Wl,-rpath,{root}/../third_party/mujoco/lib/{platform}");
}
