"""Settings between Python and the program: `{"env.friction_scale": 0.8}` is `--set env.friction_scale=0.8`."""
from __future__ import annotations

import json
import operator
import os
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np


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


def _dotted(settings: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yields each setting by its dotted key. A section may be a dict: `{"env": {"friction_scale": 0.8}}`."""
    for key, value in settings.items():
        if not isinstance(key, str):
            raise TypeError(f"the name of a setting must be a string, not {key!r}")
        if isinstance(value, Mapping) and "." not in key:
            yield from _dotted({f"{key}.{name}": part for name, part in value.items()})
        else:
            yield key, value


def pairs(settings: Mapping[str, Any] | None) -> list[tuple[str, str]]:
    """Returns the settings as pairs of texts, as the program takes them. The path of a scene becomes absolute."""
    if settings is None:
        return []
    if not isinstance(settings, Mapping):
        raise TypeError(f"set must be a dict of settings, not {settings!r}")
    texts = {}
    for key, value in _dotted(settings):
        if key == "env.model" and value != "builtin" and isinstance(value, (str, os.PathLike)):
            value = os.path.abspath(os.fsdecode(value))
        texts[key] = text = _toml(value, False)
        try:
            (key + text).encode()
        except UnicodeEncodeError:
            raise ValueError(f"{ascii(key)} = {ascii(text)}: it must be UTF-8") from None
    return list(texts.items())


def floats(what: str, values: Any) -> np.ndarray:
    """Returns an array of numbers as float32. What is too large becomes infinite."""
    found = np.asarray(values)
    if found.dtype.kind not in "fiub":
        raise TypeError(f"{what} must be numbers, not {found.dtype}")
    with np.errstate(over="ignore"):
        return found.astype(np.float32, copy=False)


def flat(text: str) -> dict[str, Any]:
    """Returns the settings in a JSON object of sections, by dotted key."""
    sections = json.loads(text)
    settings = {f"{section}.{key}": value for section, keys in sections.items() for key, value in keys.items()}
    del settings["env.num_envs"]  # it does not belong to the task
    return settings
