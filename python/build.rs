//! Lets the extension module find MuJoCo's library in the folder `lib` beside it.

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    let is_macos = std::env::var("CARGO_CFG_TARGET_OS").is_ok_and(|os| os == "macos");
    let origin = if is_macos { "@loader_path" } else { "$ORIGIN" };
    println!("cargo::rustc-link-arg=-Wl,-rpath,{origin}/lib");
    if is_macos {
        // Python's functions are in the program that loads the module.
        println!("cargo::rustc-link-arg=-undefined");
        println!("cargo::rustc-link-arg=dynamic_lookup");
    }
}
