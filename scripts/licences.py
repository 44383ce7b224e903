"""Prints the licences of everything in a package: each crate in the binary, MuJoCo's library, and the C++ library.

usage: python3 scripts/licences.py TARGET
"""

import json
import pathlib
import re
import subprocess
import sys
import tempfile
import zipfile

LICENCE = re.compile(r".*licen[cs]e|copying|copyright|notice|ofl|ufl|hack-regular\.txt", re.IGNORECASE)
RULE = "=" * 100


def crates(target):
    """Returns (name, version, licence, repository, folder) of each crate in the binary and the extension module."""
    tree = ["cargo", "tree", "--locked", "--edges=normal", "--prefix=none", "--no-dedupe", "--workspace", f"--target={target}", "--format={p}"]
    lines = subprocess.run(tree, check=True, capture_output=True, text=True).stdout.splitlines()
    inside = {tuple(line.split()[:2]) for line in lines if line}
    facts = subprocess.run(["cargo", "metadata", "--locked", "--format-version=1", f"--filter-platform={target}"],
                           check=True, capture_output=True, text=True).stdout
    for package in json.loads(facts)["packages"]:
        name, version = package["name"], package["version"]
        if (name, f"v{version}") in inside and package["source"]:
            licence = package["license"] or f"see {package['license_file']}"
            yield name, version, licence, package["repository"] or "", pathlib.Path(package["manifest_path"]).parent


def texts(folder):
    """Returns the licence texts in a crate's folder, by name."""
    files = [file for file in sorted(folder.rglob("*")) if LICENCE.match(file.name) and file.is_file()]
    return {str(file.relative_to(folder)): file.read_text(errors="replace").strip() for file in files
            if file.suffix.lower() in ("", ".md", ".txt", ".mit", ".apache", ".apache-2.0", ".bsd")}


def of_mujoco():
    """Returns the licence texts in MuJoCo's wheel, by name."""
    wheel = re.search(r'const VERSION: &str = "(.*?)"', pathlib.Path("build.rs").read_text())[1]
    with tempfile.TemporaryDirectory() as folder:
        pip = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--only-binary=:all:", f"mujoco=={wheel}",
               "--python-version=311", "--implementation=cp", "--abi=cp311", "--platform=manylinux_2_28_x86_64", "-d", folder]
        subprocess.run(pip, check=True)
        with zipfile.ZipFile(next(pathlib.Path(folder).glob("*.whl"))) as archive:
            return {pathlib.Path(name).name: archive.read(name).decode().strip() for name in archive.namelist()
                    if "/licenses/" in name and not name.endswith("/")}


def main():
    target, = sys.argv[1:]
    found = {}  # licence text: the crates that come with it
    without = []
    print("What is in this package, and its licences. shadow-repose itself: LICENSE, NOTICE.\n")
    for name, version, licence, repository, folder in sorted(crates(target)):
        print(f"{name} {version}: {licence} {repository}")
        own = texts(folder)
        for text in own.values():
            found.setdefault(text, []).append(f"{name} {version}")
        if not own:
            without.append(f"{name} {version} ({licence})")
    print("Rust's standard library: MIT OR Apache-2.0 https://github.com/rust-lang/rust")
    if "linux" in target:
        print("LLVM's libc++, libc++abi and libunwind: Apache-2.0 WITH LLVM-exception https://llvm.org")
    print("MuJoCo, lib/libmuj-sr.*, its library under a name of our own: Apache-2.0 https://github.com/google-deepmind/mujoco\n")
    print("No licence text comes with the source of these; the texts of their licences are among those below:")
    print("  " + ", ".join(without))
    for title, text in of_mujoco().items():
        print(f"{RULE}\nMuJoCo: {title}\n{RULE}\n{text}\n")
    for text, names in found.items():
        print(f"{RULE}\n{', '.join(dict.fromkeys(names))}\n{RULE}\n{text}\n")


if __name__ == "__main__":
    main()
