"""Trained policies, and their scores."""
from __future__ import annotations

import json
import os
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from . import _native
from ._settings import flat, floats, number, pairs

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


_native.prepare(np.zeros(1, np.float32))  # which Python could not do while it ends

BUILT_IN = ("builtin", "robust")
"""The policies that come with the package."""

ACTIVATIONS = ("elu", "relu", "tanh")
"""What may follow a hidden layer."""


def task_of(envs: Any) -> _native.Hands:
    """Returns the extension module's part of environments."""
    vector = getattr(envs, "unwrapped", envs)
    vector = getattr(vector, "vector", vector)
    if not hasattr(vector, "_open"):
        raise TypeError(f"expected a VectorEnv or an Env of shadow_repose, not {envs!r}")
    return vector._open()


def _parts(module: Any) -> Iterator[Any]:
    """Yields the innermost modules in order, also those that occur more than once, but for modules that change nothing."""
    children = list(module._modules.values())
    for child in children:
        yield from _parts(child)
    if not children and type(module).__name__ not in ("Identity", "Flatten", "Dropout", "Sequential"):
        yield module


def array(tensor: Any) -> np.ndarray:
    """Returns the numbers of a tensor of PyTorch."""
    return np.asarray(tensor.detach().cpu().numpy())


class Normalizer(NamedTuple):
    """How a policy normalises observations: `clip((x - mean) / sqrt(variance + epsilon))`, within ± `clip`, or unclipped for None."""

    mean: ArrayLike
    """`[O]`"""
    variance: ArrayLike
    """`[O]`"""
    epsilon: float = 1e-8
    clip: float | None = None


class Policy:
    """A trained policy: it maps raw observations to actions. Create one by `Policy.load`, or from a net that was learnt elsewhere by
    `Policy.from_layers` or `Policy.from_torch`.

    A policy belongs to the settings of its task, above all `env.act_moving_average`. In environments with other settings it scores
    worse. Create them by `VectorEnv(policy=policy)`.
    """

    def __init__(self, native: _native.Policy) -> None:
        if not isinstance(native, _native.Policy):
            raise TypeError("create a policy by Policy.load(place), Policy.from_layers(…) or Policy.from_torch(…)")
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
    def from_layers(
        cls,
        layers: Sequence[tuple[ArrayLike, ArrayLike]],
        activation: str,
        *,
        task: Any,
        normalizer: Normalizer | None = None,
        std: ArrayLike = 1.0,
    ) -> Policy:
        """Returns a policy whose net was learnt elsewhere.

        Args:
            layers: weights `[outputs, inputs]` and biases `[outputs]` of each layer, from the observation to the mean actions. The last
                layer has no activation: environments clip actions to [-1, 1].
            activation: `"elu"`, `"relu"` or `"tanh"`, after each layer but the last.
            task: the environments in which it was learnt, a `VectorEnv` or an `Env`. Their settings, the
                steps so far, and a record of their hand and scene go into the file.
            normalizer: how it normalises observations. None: not at all.
            std: the standard deviation of its actions, or of each `[A]`, where actions are drawn.

        The policy has no critic, and none of the symmetry that `train` gives a policy. Raises ValueError for layers that do not fit the
        task, and for numbers that are not finite.
        """
        hands = task_of(task)
        nets = [(floats("weights", weights), floats("biases", biases)) for weights, biases in layers]
        for weights, biases in nets:
            if weights.ndim != 2 or biases.shape != weights.shape[:1]:
                raise ValueError(f"a layer has weights {weights.shape} and biases {biases.shape}, expected (outputs, inputs) and (outputs,)")
        sizes = [weights.shape[1] for weights, _ in nets] + [biases.size for _, biases in nets[-1:]]
        reads, acts = sum(length for _, _, length, _ in hands.layout()), hands.action_size
        if len(nets) < 2 or [sizes[0], sizes[-1]] != [reads, acts] or any(b.size != size for (_, b), size in zip(nets, sizes[1:])):
            raise ValueError(f"layers of the sizes {sizes}: the task needs {reads} values in, {acts} out, and a hidden layer between")
        if activation not in ACTIVATIONS:
            raise ValueError(f"the activation {activation!r} is none of {', '.join(ACTIVATIONS)}")
        own = normalizer or Normalizer(np.zeros(reads), np.ones(reads), 0.0)
        clip = float(np.finfo(np.float32).max) if own.clip is None else float(own.clip)
        mean, variance = (np.broadcast_to(np.asarray(values, np.float64), reads).tolist() for values in own[:2])
        stds = np.broadcast_to(floats("std", std), acts).tolist()
        if not all(value > 0 for value in stds):
            raise ValueError("std must be positive")
        content = _native.file_of(hands, nets, activation, (mean, variance, float(own.epsilon), clip), stds)
        _, model, _, _, files = hands.parts()
        return cls._of([] if model == "builtin" else [("env.model", model)], "layers", content, files)

    @classmethod
    def from_torch(
        cls, module: Any, *, task: Any, normalizer: Normalizer | None = None, std: ArrayLike = 1.0
    ) -> Policy:
        """Returns a policy from a module of PyTorch that maps observations to mean actions: linear layers and one kind of activation.

        The other arguments are those of `from_layers`. Raises ValueError for a module with anything else in it. For learners,
        `shadow_repose.sb3.policy` and `shadow_repose.rsl_rl.policy` find module, normaliser and standard deviations.
        """
        parts = list(_parts(module))
        kinds = [type(part).__name__ for part in parts]
        activations = {kind.lower() for kind in kinds[1::2]}
        if set(kinds[::2]) != {"Linear"} or len(kinds) % 2 == 0 or len(activations) != 1 or not activations <= {*ACTIVATIONS}:
            raise ValueError(f"a policy is an MLP: Linear layers, and one of {', '.join(ACTIVATIONS)} between them; this module has {kinds}")
        if any(getattr(part, "alpha", 1.0) != 1.0 for part in parts):
            raise ValueError("an ELU must have alpha = 1")
        linear = parts[::2]
        layers = [(array(part.weight), np.zeros(part.out_features) if part.bias is None else array(part.bias)) for part in linear]
        policy = cls.from_layers(layers, activations.pop(), task=task, normalizer=normalizer, std=std)
        # A module may compute something else with its parts.
        plain = cls.from_layers(layers, kinds[1].lower(), task=task)
        seen = np.random.default_rng(0).normal(size=(64, linear[0].in_features)).astype(np.float32)
        if not np.allclose(array(module(linear[0].weight.new_tensor(seen))), plain(seen), atol=1e-4):
            raise ValueError("the module computes something else than its layers do one after another")
        return policy

    def save(self, file: str | os.PathLike[str]) -> None:
        """Writes the policy to a file, which `play --ckpt`, `export` and `Policy.load` take.

        The file holds the settings that it was trained with, not those of `Policy.load(…, set=…)`, and no optimizer to resume with.
        """
        with open(file, "wb") as output:
            output.write(self._native.content())

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
            actions += self._native.std * noise
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
        return self._native.std

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
    envs: Any = None,
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
        envs: a `VectorEnv` or an `Env` whose task is played, by default the policy's own. It is not stepped.
        episodes: how many episodes are played.
        seed: the seed from which they are drawn.
        set: settings that replace those of its task, e.g. `{"env.friction_scale": 0.8}`. Without `envs`, the task
            of a function has the default settings.
        threads: worker threads. 0 means one per core.
        trace: a file for the steps of the first episodes. `shadow-repose play --from-trace TRACE --out FILE.html` shows them in a browser.

    Ctrl-C interrupts it, after the present call of a function. Raises ValueError as `Policy.load` does, and for actions of another shape
    or that are NaN; others are clipped to [-1, 1], as in an environment. Raises TypeError for actions that are not numbers, and whatever
    the function raises. Warns where a policy does not fit the task well, and of episodes whose physics has diverged.
    """
    hands = None if envs is None else task_of(envs)
    if hands is not None and set:
        raise ValueError("give envs or set, not both: environments bring the settings of their task")
    counts = number("episodes", episodes, 1, 2**20), number("seed", seed), number("threads", threads, most=65536)
    if callable(policy) and not isinstance(policy, Policy):
        scored: Any = _acting(policy)
    else:
        if not isinstance(policy, Policy):
            policy, set = Policy._loaded(policy, set), None
        scored = policy._native
    text, said = _native.evaluate(scored, hands, pairs(set), *counts, None if trace is None else os.path.abspath(trace))
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
