"""Compares two training runs: their weights and their metrics, but for times.

usage: python3 scripts/compare-runs.py RUN RUN LARGEST

Fails if a number differs by more than LARGEST, relative to its size or to 1 if that is larger. With 0, all bits must be equal.
"""
import csv
import json
import pathlib
import struct
import sys


def weights(run):
    """Returns the numbers of each tensor of the policy, by name."""
    content = (pathlib.Path(run) / "policy.safetensors").read_bytes()
    size, = struct.unpack_from("<Q", content)
    header = json.loads(content[8:8 + size])
    header.pop("__metadata__", None)
    letters = {"F32": "f", "F64": "d"}
    return {name: struct.unpack_from(f"<{(entry['data_offsets'][1] - entry['data_offsets'][0]) // struct.calcsize(letters[entry['dtype']])}"
                                     f"{letters[entry['dtype']]}", content, 8 + size + entry["data_offsets"][0])
            for name, entry in header.items() if entry["dtype"] in letters}


def metrics(run):
    """Returns the columns of metrics.csv that do not depend on the machine's speed."""
    with open(pathlib.Path(run) / "metrics.csv", newline="") as table:
        rows = list(csv.DictReader(table))
    return {name: [float(row[name] or "nan") for row in rows] for name in rows[0] if not name.startswith("time/")}


def difference(ours, theirs):
    """Returns how much two numbers differ. Two that are missing are equal."""
    if ours == theirs or (ours != ours and theirs != theirs):
        return 0.0
    distance = abs(ours - theirs) / max(1.0, abs(ours), abs(theirs))
    return distance if distance == distance else float("inf")


def main():
    first, second, largest = sys.argv[1:]
    worst = {}
    for kind in (weights, metrics):
        ours, theirs = kind(first), kind(second)
        if ours.keys() != theirs.keys() or any(len(ours[name]) != len(theirs[name]) for name in ours):
            sys.exit(f"error: {first} and {second} have other {kind.__name__}")
        worst[kind.__name__] = max((difference(*pair), name) for name in ours for pair in zip(ours[name], theirs[name], strict=True))
    for kind, (found, name) in worst.items():
        print(f"{kind} differ by at most {found:.2g} ({name})")
    if any(not found <= float(largest) for found, _ in worst.values()):
        sys.exit(f"error: that is more than {largest}")


if __name__ == "__main__":
    main()
