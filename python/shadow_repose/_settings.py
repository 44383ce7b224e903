"""Settings between Python and the program: `{"env.friction_scale": 0.8}` is `--set env.friction_scale=0.8`."""
from __future__ import annotations

import json
import operator
import os
from collections.abc import Mapping
from typing import Any


def number(name: str, value: Any, least: int = 0, most: int = 2**64 - 1) -> int:
    """Returns `value` as a whole number from `least` to `most`."""
    try:
        found = operator.index(value)
    except TypeError:
        raise TypeError(f"{name} must be a whole number, not {value!r}") from None
    if not least <= found <= most:
        raise ValueError(f"{name} = {found}: must lie in [{least}, {most}]")
    return found


def _toml(value: Any, inside: bool) -> str:
    if hasattr(value, "tolist"):  # of NumPy
        value = value.tolist()
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (int, float)):
        return repr(value)
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False) if inside else value
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_toml(item, True) for item in value) + "]"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{json.dumps(str(key))} = {_toml(item, True)}" for key, item in value.items()) + "}"
    if hasattr(value, "__fspath__"):
        return _toml(value.__fspath__(), inside)
    raise TypeError(f"a setting cannot be {value!r}: give a number, a string, a bool, a list or a dict")


def pairs(settings: Mapping[str, Any] | None) -> list[tuple[str, str]]:
    """Returns the settings as pairs of texts, as the program takes them."""
    if settings is None:
        return []
    if not isinstance(settings, Mapping):
        raise TypeError(f"set must be a dict of settings, not {settings!r}")
    for key in settings:
        if not isinstance(key, str):
            raise TypeError(f"the name of a setting must be a string, not {key!r}")
    return [(key, _toml(value, False)) for key, value in settings.items()]


def absolute(settings: Mapping[str, Any] | None) -> dict[str, Any]:
    """Returns the settings with the absolute path of the scene, for pickles."""
    known = dict(settings or {})
    model = known.get("env.model")
    if model is not None and model != "builtin":
        known["env.model"] = os.path.abspath(model)
    return known


def flat(text: str) -> dict[str, Any]:
    """Returns the settings in a JSON object of sections, by dotted key."""
    sections = json.loads(text)
    settings = {f"{section}.{key}": value for section, keys in sections.items() for key, value in keys.items()}
    del settings["env.num_envs"]  # it does not belong to the task
    return settings
