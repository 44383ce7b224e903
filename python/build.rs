//! Lets the extension module find MuJoCo's library in the folder `lib` beside it.

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rustc-link-arg=-Wl,-rpath,$ORIGIN/lib");
}
