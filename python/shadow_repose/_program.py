"""The program that comes with the package."""
from __future__ import annotations

import os
import shutil
import sys

_INSIDE = os.path.join(os.path.dirname(os.path.abspath(__file__)), "bin", "shadow-repose")


def program() -> str:
    """Returns the path of the program `shadow-repose`, to train with: `subprocess.run([program(), "train", ...])`.

    Raises FileNotFoundError if this package came without it and the PATH has none.
    """
    if os.path.exists(_INSIDE):
        return _INSIDE
    found = shutil.which("shadow-repose")
    if found is None:
        raise FileNotFoundError("the program shadow-repose is neither in this package nor on the PATH")
    return found


def main() -> None:
    """Becomes the program: the command `shadow-repose`, and `python -m shadow_repose`."""
    if not os.path.exists(_INSIDE):
        sys.exit("error: this package came without the program shadow-repose")
    os.execv(_INSIDE, ["shadow-repose", *sys.argv[1:]])
