"""An episode in a notebook."""
from __future__ import annotations

import html
import os
import pathlib
import subprocess
import tempfile
from typing import TYPE_CHECKING, Any

from ._policy import Policy, evaluate
from ._program import program

if TYPE_CHECKING:
    from IPython.display import HTML


def show(what: Policy | str | os.PathLike[str] = "builtin", *, seed: int = 0, height: int = 600, plain: bool = True) -> HTML:
    """Returns a page that a notebook displays: an episode that can be turned, paused and wound back.

    Args:
        what: a policy or a place that `Policy.load` takes, which plays an episode of `seed`, or a trace (`.jsonl`, `.jsonl.gz`).
        height: the height of the page in pixels.
        plain: whether the hand is drawn as its simple shapes. With False, the built-in hand wears its meshes, which are fetched once.

    Raises ValueError with the program's message if it cannot show this, and ImportError without IPython.
    """
    from IPython.display import HTML

    with tempfile.TemporaryDirectory(prefix="shadow-repose-") as folder:
        page, scene = pathlib.Path(folder, "page.html"), "builtin"
        trace = "" if isinstance(what, Policy) else os.fsdecode(what)
        if not trace.endswith((".jsonl", ".jsonl.gz")):
            policy = what if isinstance(what, Policy) else Policy.load(what)
            scene, trace = policy.settings["env.model"], str(pathlib.Path(folder, "trace.jsonl"))
            evaluate(policy, episodes=1, seed=seed, trace=trace)
        words = ["--from-trace", trace, "--out", str(page)]
        words += ["--plain"] if plain else []
        words += [] if scene == "builtin" else ["--set", f"env.model={scene}"]
        made = subprocess.run([program(), "play", *words], capture_output=True, text=True)
        if made.returncode != 0:
            raise ValueError(made.stderr.strip())
        text = html.escape(page.read_text(encoding="utf-8"))
    return HTML(f'<div><iframe srcdoc="{text}" sandbox="allow-scripts" width="100%" height="{height}" style="border: 0"></iframe></div>')
