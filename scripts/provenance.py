"""Writes into the metadata of a policy how it was made, before it is published. The text is called `provenance`.

usage: python3 scripts/provenance.py POLICY.safetensors OUT.safetensors < FACTS.json
FACTS.json: {"commands": [...], "seed": 0, "commit": "...", "machine": "...", "minutes": 0}
"""

import json
import struct
import sys
import zlib

FACTS = {"commands": list, "seed": int, "commit": str, "machine": str, "minutes": int}


def checksum(texts, arrays, data):
    """Returns the CRC-32 of all names, texts, types, shapes and values, as src/ppo/format.rs defines it."""
    crc = 0

    def take(part):
        nonlocal crc
        crc = zlib.crc32(part, zlib.crc32(struct.pack("<Q", len(part)), crc))

    for key in sorted(texts):
        take(key.encode())
        take(texts[key].encode())
    for name in sorted(arrays):
        array = arrays[name]
        take(name.encode())
        take(array["dtype"].encode())
        for size in array["shape"]:
            take(struct.pack("<Q", size))
        begin, end = array["data_offsets"]
        take(data[begin:end])
    return f"{crc:08x}"


def read(path):
    """Returns the texts, the arrays and the data of a file."""
    with open(path, "rb") as file:
        whole = file.read()
    length = struct.unpack("<Q", whole[:8])[0]
    arrays, data = json.loads(whole[8 : 8 + length]), whole[8 + length :]
    texts = arrays.pop("__metadata__")
    if texts.pop("checksum") != checksum(texts, arrays, data):
        sys.exit(f"{path}: damaged, or not a policy of this program")
    return texts, arrays, data


def write(path, texts, arrays, data):
    """Writes a file with these texts and arrays, and their checksum."""
    texts = {**texts, "checksum": checksum(texts, arrays, data)}
    header = json.dumps({"__metadata__": dict(sorted(texts.items())), **arrays}, separators=(",", ":")).encode()
    header += b" " * (-len(header) % 8)
    with open(path, "wb") as file:
        file.write(struct.pack("<Q", len(header)) + header + data)


def main():
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    facts = json.load(sys.stdin)
    if {key: type(value) for key, value in facts.items()} != FACTS:
        sys.exit(f"expected exactly {', '.join(FACTS)}")
    texts, arrays, data = read(sys.argv[1])
    write(sys.argv[2], {**texts, "provenance": json.dumps(facts)}, arrays, data)


if __name__ == "__main__":
    main()
