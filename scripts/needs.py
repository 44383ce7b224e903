"""Prints what programs and libraries need of the system that they will run on, and fails unless it is what we promise.

usage: python3 scripts/needs.py linux|macos FILE…

On Linux this is the newest version of glibc. On macOS it is the oldest version of the system, the libraries, and the folders in which
they are looked for.
"""
import re
import struct
import sys

GLIBC = (2, 28)
MACOS = (11, 0)
# Where a library may lie on macOS: with the system, or in the folders that are looked through (@rpath).
PLACES = ("/usr/lib/", "/System/Library/", "@rpath/")

# The commands of a Mach-O file (mach-o/loader.h).
LOAD_DYLIB, LOAD_WEAK_DYLIB, RPATH, BUILD_VERSION = 0xC, 0x80000018, 0x8000001C, 0x32
FAT, MACHO_64 = 0xCAFEBABE, 0xFEEDFACF


def of_linux(content):
    """Returns the newest version of glibc whose symbols this ELF file names, as text, and whether that is promised."""
    found = [tuple(map(int, version.split(b"."))) for version in re.findall(rb"\0GLIBC_(\d+\.\d+)", content)]
    newest = max(found, default=(0, 0))
    return f"glibc {newest[0]}.{newest[1]}", bool(found) and newest <= GLIBC


def slices(content):
    """Returns the parts of a Mach-O file, one for each processor."""
    magic, count = struct.unpack_from(">II", content)
    if magic != FAT:
        return [content]
    places = [struct.unpack_from(">II", content, 16 + 20 * number) for number in range(count)]
    return [content[start:start + size] for start, size in places]


def of_macos(content):
    """Returns the oldest system, the libraries and the folders of a Mach-O file, as text, and whether they are as promised."""
    said, kept = [], True
    for part in slices(content):
        magic, _, _, _, commands = struct.unpack_from("<5I", part)
        if magic != MACHO_64:
            raise SystemExit("this is no program or library of macOS")
        at = 32
        for _ in range(commands):
            command, size = struct.unpack_from("<II", part, at)
            text = part[at + struct.unpack_from("<I", part, at + 8)[0]:at + size].split(b"\0")[0].decode(errors="replace")
            if command == BUILD_VERSION:
                version, = struct.unpack_from("<I", part, at + 12)
                said.append(f"macOS {version >> 16}.{version >> 8 & 255}")
                kept &= (version >> 16, version >> 8 & 255) <= MACOS
            elif command in (LOAD_DYLIB, LOAD_WEAK_DYLIB):
                said.append(text)
                kept &= text.startswith(PLACES)
            elif command == RPATH:
                said.append(f"looks in {text}")
                kept &= text.startswith("@loader_path")
            at += size
    return ", ".join(said), kept and bool(said)


def main():
    system, *files = sys.argv[1:]
    for name in files:
        with open(name, "rb") as file:
            said, kept = {"linux": of_linux, "macos": of_macos}[system](file.read())
        print(f"{name.rsplit('/', 1)[-1]} needs {said}")
        if not kept:
            raise SystemExit(f"error: {name} needs more than is promised")


if __name__ == "__main__":
    main()
