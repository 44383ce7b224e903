"""An episode in a notebook."""
from __future__ import annotations

import html
import os
import pathlib
import subprocess
import tempfile
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from ._policy import Policy, evaluate
from ._program import program
from ._settings import pairs

if TYPE_CHECKING:
    from IPython.display import HTML


def show(
    what: Policy | str | os.PathLike[str] = "builtin",
    *,
    seed: int = 0,
    height: int = 600,
    plain: bool = True,
    set: Mapping[str, Any] | None = None,
) -> HTML:
    """Returns a page that a notebook displays: an episode that can be turned, paused and wound back.

    Args:
        what: a policy or a place that `Policy.load` takes, which plays an episode of `seed`, or a trace (`.jsonl`, `.jsonl.gz`).
        height: the height of the page in pixels.
        plain: whether the hand is drawn as its simple shapes. With False, the built-in hand wears its meshes, which are fetched once.
        set: settings that replace those of its task. A trace has its own settings, but names no scene: give `env.model` for a hand of
            your own, and `hand.*` if the hand needs them.

    Raises ValueError with the program's message if it cannot show this, and ImportError without IPython.
    """
    from IPython.display import HTML

    with tempfile.TemporaryDirectory(prefix="shadow-repose-") as folder:
        page, words = pathlib.Path(folder, "page.html"), ["--plain"] if plain else []
        said = pairs(set)
        trace = "" if isinstance(what, Policy) else os.fsdecode(what)
        if not trace.endswith((".jsonl", ".jsonl.gz")):
            policy = what if isinstance(what, Policy) else Policy.load(what, set=set)
            trace = str(pathlib.Path(folder, "trace.jsonl"))
            evaluate(policy, episodes=1, seed=seed, set=set, trace=trace)
            known = pairs({key: value for key, value in policy.settings.items() if _of_hand(key)})
            own = [] if policy.settings["env.model"] == "builtin" else known
            said = [*own, *((key, text) for key, text in said if _of_hand(key))]
        words += [word for key, text in said for word in ("--set", f"{key}={text}")]
        command = [program(), "play", "--from-trace", trace, "--out", str(page), *words]
        made = subprocess.run(command, capture_output=True, text=True)
        if made.returncode != 0:
            raise ValueError(made.stderr.strip())
        text = html.escape(page.read_text(encoding="utf-8"))
    return HTML(f'<div><iframe srcdoc="{text}" sandbox="allow-scripts" width="100%" height="{height}" style="border: 0"></iframe></div>')


def _of_hand(key: str) -> bool:
    """Returns whether a setting says which hand it is."""
    return key == "env.model" or key.startswith("hand.")
