"""Finds the program `shadow-repose`, and copies it."""
import os
import pathlib
import re
import shutil
import subprocess
import sys

BUILT = pathlib.Path(__file__).resolve().parents[2] / "target/release/shadow-repose"


def find(given):
    """Returns the path of the binary: the given program, or else the build of this checkout, or else the program on the PATH."""
    named = given or (BUILT if BUILT.is_file() else None) or shutil.which("shadow-repose")
    if named is None:
        sys.exit("there is no program shadow-repose: build it (cargo build --release), install it, or name it with --program")
    path = pathlib.Path(named).resolve()
    if not path.is_file():
        sys.exit(f"{path}: there is no such file")
    with path.open("rb") as file:
        first = file.readline()
    return inside_wheel(path, first[2:].decode(errors="replace").split()) if first.startswith(b"#!") else path


def inside_wheel(command, python):
    """Returns the binary that a wheel's command starts. The command is a script for this Python, which knows where the binary is."""
    where = "import shadow_repose; print(shadow_repose.program())"
    found = subprocess.run([*python, "-c", where], capture_output=True, text=True)
    if found.returncode != 0:
        sys.exit(f"{command} is a script; name the binary that it starts with --program")
    return pathlib.Path(found.stdout.strip())


def copy(program, to):
    """Copies the binary to the path `to`, and MuJoCo's library to `lib` beside it, where the copy looks for it."""
    loaded = subprocess.run([program], env=os.environ | {"LD_TRACE_LOADED_OBJECTS": "1"}, capture_output=True, text=True).stdout
    to.parent.mkdir(parents=True, exist_ok=True)
    for library in re.findall(r"libmuj\S* => (.+) \(0x", loaded):
        (to.parent / "lib").mkdir(exist_ok=True)
        copy_whole(pathlib.Path(library), to.parent / "lib" / pathlib.Path(library).name)
    copy_whole(program, to)


def copy_whole(file, to):
    """Copies a file under another name first. So a kill leaves no partial file under the final name."""
    partial = to.with_name(f"{to.name}.partial")
    shutil.copy2(file, partial)
    partial.rename(to)
