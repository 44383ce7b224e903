"""Trained policies, and their scores."""
from __future__ import annotations

import json
import os
import warnings
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from . import _native
from ._settings import flat, floats, number, pairs

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


_native.prepare(np.zeros(1, np.float32))  # which Python could not do while it ends

BUILT_IN = ("builtin", "robust")
"""The policies that come with the package."""


class Policy:
    """A trained policy: it maps raw observations to actions. Create one by `Policy.load`.

    A policy belongs to the settings of its task, above all `env.act_moving_average`. In environments with other settings it scores
    worse. Create them by `VectorEnv(policy=policy)`.
    """

    def __init__(self, native: _native.Policy) -> None:
        if not isinstance(native, _native.Policy):
            raise TypeError("create a policy by Policy.load(place)")
        self._native = native
        self._set: list[tuple[str, str]] = []

    @classmethod
    def load(cls, place: str | os.PathLike[str] = "builtin", *, set: Mapping[str, Any] | None = None) -> Policy:
        """Loads a policy.

        Args:
            place: `"builtin"` or `"robust"`, a checkpoint or policy file, or the folder of a run, for its best checkpoint.
            set: settings of its task that replace the stored ones. A scene of your own must be named again by `env.model`.

        Raises:
            FileNotFoundError, PermissionError: there is no such file, or it cannot be read.
            ValueError: the file is damaged or does not come from the program, or a setting is invalid.

        A warning says where the policy does not fit its task well.
        """
        policy = cls._loaded(place, set)
        for warning in policy._native.warnings:
            warnings.warn(warning, stacklevel=2)
        return policy

    @classmethod
    def _loaded(cls, place: str | os.PathLike[str], set: Mapping[str, Any] | None) -> Policy:
        """Loads a policy without a warning."""
        place = os.fsdecode(os.fspath(place))
        if place not in BUILT_IN:
            if not os.path.exists(place):
                raise FileNotFoundError(f"{place}: no such checkpoint or run folder; built in are {' and '.join(BUILT_IN)}")
            place = os.path.abspath(place)
        return cls._of(pairs(set), place)

    @classmethod
    def _of(cls, set: list[tuple[str, str]], *parts: Any) -> Policy:
        """Loads a policy from a place, or from the parts of another."""
        policy = cls(_native.Policy(parts[0], set, *parts[1:]))
        policy._set = set
        return policy

    def __call__(
        self, observations: ArrayLike, *, deterministic: bool = True, rng: np.random.Generator | None = None
    ) -> np.ndarray:
        """Returns actions `[B, A]`, float32, for raw observations `[B, O]`, or `[A]` for `[O]`.

        They are the means, or with `deterministic=False` drawn around them with `std`. They are not clipped, because an environment
        does that. A row's actions are the same bits whatever the other rows are.
        """
        rows, is_one = self._rows(observations)
        actions = self._native.actions(rows)
        if not deterministic:
            noise = (rng or np.random.default_rng()).standard_normal(actions.shape, np.float32)
            actions += np.float32(self._native.std) * noise
        return np.asarray(actions[0] if is_one else actions)

    def values(self, observations: ArrayLike) -> np.ndarray:
        """Returns the critic's values `[B]`, float32, of raw observations `[B, O]`, or one without dimensions for `[O]`.

        A value is the discounted sum of the rewards in training, times `ppo.reward_scale`.
        """
        rows, is_one = self._rows(observations)
        values = self._native.values(rows)
        return np.asarray(values[0] if is_one else values)

    def _rows(self, observations: ArrayLike) -> tuple[np.ndarray, bool]:
        rows = floats("observations", observations)
        if rows.ndim not in (1, 2):
            raise ValueError(f"observations have the shape {rows.shape}, expected (B, O) or (O,)")
        return np.atleast_2d(rows), rows.ndim == 1

    @property
    def settings(self) -> dict[str, Any]:
        """The settings of the task that it was trained for, by dotted key: `{"env.act_moving_average": 0.7, ...}`."""
        return flat(self._native.settings())

    @property
    def std(self) -> np.ndarray:
        """The standard deviation `[A]` of its actions in training, float32."""
        return np.full(self._native.sizes()[1], self._native.std, np.float32)

    def __reduce__(self) -> Any:
        return self._of, (self._set, *self._native.parts())

    def __copy__(self) -> Policy:
        return self  # it never changes

    def __deepcopy__(self, memo: Any) -> Policy:
        return self

    def __repr__(self) -> str:
        return f"<Policy: {self._native.name}>"


def evaluate(
    policy: Policy | str | os.PathLike[str] | Callable[[np.ndarray], ArrayLike] = "builtin",
    *,
    episodes: int = 256,
    seed: int = 0,
    set: Mapping[str, Any] | None = None,
    threads: int = 0,
    trace: str | os.PathLike[str] | None = None,
) -> dict[str, Any]:
    """Returns the score of a policy over whole episodes by mean actions: the object that `shadow-repose play --json` prints.

    Args:
        policy: a policy, a place that `Policy.load` takes, or a function of your own. The function gets observations `[N, O]`, float32,
            of up to 64 episodes, and returns actions `[N, A]`. It is called from another thread.
        episodes: how many episodes are played.
        seed: the seed from which they are drawn.
        set: settings that replace those of its task, e.g. `{"env.friction_scale": 0.8}`. The task of a function has the default settings.
        threads: worker threads. 0 means one per core.
        trace: a file for the steps of the first episodes. `shadow-repose play --from-trace TRACE --out FILE.html` shows them in a browser.

    Ctrl-C interrupts it, after the present call of a function. Raises ValueError as `Policy.load` does, and for actions of another shape
    or that are NaN; others are clipped to [-1, 1], as in an environment. Raises TypeError for actions that are not numbers, and whatever
    the function raises. Warns where a policy does not fit the task well, and of episodes whose physics has diverged.
    """
    counts = number("episodes", episodes, 1, 2**20), number("seed", seed), number("threads", threads, most=65536)
    if callable(policy) and not isinstance(policy, Policy):
        scored: Any = _acting(policy)
    else:
        if not isinstance(policy, Policy):
            policy, set = Policy._loaded(policy, set), None
        scored = policy._native
    text, said = _native.evaluate(scored, pairs(set), *counts, None if trace is None else os.path.abspath(trace))
    for warning in said:
        warnings.warn(warning, stacklevel=2)
    return dict(json.loads(text))


def _acting(act: Callable[[np.ndarray], ArrayLike]) -> Callable[[np.ndarray], np.ndarray]:
    """Returns the function with its actions as float32."""

    def acting(observations: np.ndarray) -> np.ndarray:
        actions = floats("actions", act(observations))
        most = np.finfo(np.float32).max
        return np.clip(actions, -most, most)  # the environment clips further

    return acting
