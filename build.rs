//! Makes MuJoCo available to the linker and, at run time, to the binary, with no manual step.
//!
//! `.cargo/config.toml` points mujoco-rs at `third_party/mujoco/link`. A text file there stands for MuJoCo's library and refers to the
//! name under which the program loads it. This script makes that file in a folder for each platform of `third_party/mujoco/lib`: it
//! fetches MuJoCo's library with pip, by package name and hash, and gives it the name.
//! It fetches nothing if the user sets `MUJOCO_DYNAMIC_LINK_DIR` or `MUJOCO_STATIC_LINK_DIR`.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::{env, fs};

#[path = "src/os/pip.rs"]
mod pip;

const VERSION: &str = "3.17.0";

/// What a build needs to know about a platform.
struct Platform {
    /// The operating system and the architecture, as the compiler names them.
    target: [&'static str; 2],
    /// The tag and the sha256 of the wheel of `mujoco`. The Python version in its name does not matter to the library in it.
    wheel: [&'static str; 2],
    /// The name of MuJoCo's library, and ours. In one process the dynamic linker takes libraries of the same name for the same one: a
    /// user's `import mujoco` in Python would then share its callbacks and its log with our extension module.
    library: [&'static str; 2],
}

/// The SONAME in the library is replaced: both names are equally long, so nothing else in the file changes.
const LINUX: [&str; 2] = ["libmujoco.so.3.17.0", "libmuj-sr.so.3.17.0"];

/// The library stays as it was signed. A library is found by its path there.
const MACOS: [&str; 2] = ["libmujoco.3.17.0.dylib", "libmuj-sr.3.17.0.dylib"];

/// The wheel for macOS holds a library for both architectures.
const MACOS_WHEEL: [&str; 2] = [
    "macosx_11_0_arm64",
    "6c324addca24a24a7b0beff2ec49300e9d4481fd8ccd611514ba7ea8e4a5e870",
];

const PLATFORMS: [Platform; 4] = [
    Platform {
        target: ["linux", "x86_64"],
        wheel: [
            "manylinux_2_28_x86_64",
            "d66928d86a2d1b601bbaa4dc11db50214d17d5301bb8afd84721313b67ff0874",
        ],
        library: LINUX,
    },
    Platform {
        target: ["linux", "aarch64"],
        wheel: [
            "manylinux_2_28_aarch64",
            "91a70ed9979c383ff1f5c03f25cc2e1280a8254c1a8e558d5dd7f4184f01efc9",
        ],
        library: LINUX,
    },
    Platform {
        target: ["macos", "aarch64"],
        wheel: MACOS_WHEEL,
        library: MACOS,
    },
    Platform {
        target: ["macos", "x86_64"],
        wheel: MACOS_WHEEL,
        library: MACOS,
    },
];

fn main() {
    let target = [
        variable("CARGO_CFG_TARGET_OS"),
        variable("CARGO_CFG_TARGET_ARCH"),
    ];
    if target[0] == "windows" {
        refuse(
            "shadow-repose does not build for Windows itself; build it there in WSL2, as for Linux",
        );
    }
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-changed=src/os/pip.rs");
    println!("cargo::rerun-if-env-changed=MUJOCO_DYNAMIC_LINK_DIR");
    println!("cargo::rerun-if-env-changed=MUJOCO_STATIC_LINK_DIR");
    println!("cargo::rerun-if-env-changed=SHADOW_REPOSE_PACKAGE");
    version_facts();
    if env::var_os("DOCS_RS").is_some() || env::var_os("MUJOCO_STATIC_LINK_DIR").is_some() {
        return;
    }
    let root = PathBuf::from(variable("CARGO_MANIFEST_DIR"));
    let linked = PathBuf::from(variable("MUJOCO_DYNAMIC_LINK_DIR"));
    let library_folder = if linked.starts_with(root.join("third_party")) {
        let Some(platform) = PLATFORMS.iter().find(|known| known.target == target) else {
            fail(&format!("no download is known for {}", target.join(" on ")));
        };
        let lib = root.join("third_party/mujoco/lib");
        let folder = lib.join(platform.target.join("-"));
        let library = folder.join(platform.library[1]);
        println!("cargo::rerun-if-changed={}", library.display());
        if !library.is_file()
            && let Err(reason) = fetch(platform, &library)
        {
            fail(&reason);
        }
        println!("cargo::rustc-link-search=native={}", folder.display());
        folder
    } else {
        linked
    };
    // A binary looks for the library beside itself, in a `lib` folder beside or above itself, and where it was built. That place
    // means nothing on the machine where a package is installed.
    let origin = if target[0] == "macos" {
        "@loader_path"
    } else {
        "$ORIGIN"
    };
    let places = [
        origin,
        &format!("{origin}/lib"),
        &format!("{origin}/../lib"),
        &library_folder.display().to_string(),
    ];
    let packaged = env::var_os("SHADOW_REPOSE_PACKAGE").is_some();
    for place in &places[..places.len() - usize::from(packaged)] {
        println!("cargo::rustc-link-arg=-Wl,-rpath,{place}");
    }
}

/// Passes to the compiler the facts about the build that `version.txt` of a run records.
fn version_facts() {
    for path in [".git/HEAD", ".git/logs/HEAD"] {
        if Path::new(path).exists() {
            println!("cargo::rerun-if-changed={path}");
        }
    }
    let output = |command: &mut Command| {
        let output = command.output().ok().filter(|o| o.status.success())?;
        Some(String::from_utf8_lossy(&output.stdout).trim().to_owned())
    };
    let commit =
        output(Command::new("git").args(["describe", "--always", "--dirty", "--abbrev=12"]));
    let rustc = output(Command::new(variable("RUSTC")).arg("--version"));
    println!(
        "cargo::rustc-env=SHADOW_REPOSE_COMMIT={}",
        commit.unwrap_or_else(|| "unknown".into())
    );
    println!(
        "cargo::rustc-env=SHADOW_REPOSE_RUSTC={}",
        rustc.unwrap_or_else(|| "unknown".into())
    );
    println!(
        "cargo::rustc-env=SHADOW_REPOSE_TARGET={}",
        variable("TARGET")
    );
}

/// Fetches the wheel and makes `library` of the one in it.
fn fetch(platform: &Platform, library: &Path) -> Result<(), String> {
    let work = PathBuf::from(variable("OUT_DIR")).join("mujoco-wheel");
    let [tag, hash] = platform.wheel;
    let selection = [
        "--python-version",
        "311",
        "--implementation",
        "cp",
        "--abi",
        "cp311",
        "--platform",
        tag,
    ];
    pip::unpack_wheel(&format!("mujoco=={VERSION}"), hash, &selection, &work)?;
    let told = |error: std::io::Error| error.to_string();
    let unpacked = work.join("mujoco").join(platform.library[0]);
    let mut content = fs::read(&unpacked).map_err(|e| format!("{}: {e}", unpacked.display()))?;
    if platform.library == LINUX {
        rename(&mut content).map_err(|reason| format!("{}: {reason}", unpacked.display()))?;
    }
    let folder = library
        .parent()
        .expect("the library path has a parent folder");
    fs::create_dir_all(folder).map_err(told)?;
    // Writes under another name, then renames: an interrupted build leaves no incomplete library behind.
    let partial = folder.join(format!("libmujoco.partial.{}", std::process::id()));
    fs::write(&partial, content).map_err(told)?;
    fs::rename(&partial, library).map_err(told)?;
    // As old as this script, so that the next build does not take it for something that has changed since this one.
    let written = fs::metadata("build.rs")
        .and_then(|facts| facts.modified())
        .map_err(told)?;
    fs::File::options()
        .write(true)
        .open(library)
        .and_then(|file| file.set_modified(written))
        .map_err(told)?;
    let _ = fs::remove_dir_all(&work);
    Ok(())
}

/// Replaces the name that a library for Linux has in itself (SONAME) by ours.
fn rename(content: &mut [u8]) -> Result<(), String> {
    let [name, own] = LINUX.map(|name| format!("\0{name}\0").into_bytes());
    let places: Vec<usize> = content
        .windows(name.len())
        .enumerate()
        .filter(|(_, part)| *part == name)
        .map(|(at, _)| at)
        .collect();
    let [place] = places[..] else {
        return Err(format!("it holds its name {} times", places.len()));
    };
    content[place..place + own.len()].copy_from_slice(&own);
    Ok(())
}

fn fail(reason: &str) -> ! {
    refuse(&format!(
        "MuJoCo {VERSION} is missing and could not be fetched: {reason}\n\
         Two ways to fix this:\n  \
         1. make `python3 -I -m pip download mujoco=={VERSION}` work (python3, pip, a reachable package index) and rebuild;\n  \
         2. unpack a MuJoCo {VERSION} release yourself and build with MUJOCO_DYNAMIC_LINK_DIR=/absolute/path/to/its/lib\n"
    ))
}

/// Ends the build with this message.
fn refuse(reason: &str) -> ! {
    eprintln!("\n{reason}");
    std::process::exit(1);
}

fn variable(name: &str) -> String {
    env::var(name).unwrap_or_else(|_| fail(&format!("the build variable {name} is not set")))
}
