"""Gymnasium environments of the task: N that step together, or one."""
from __future__ import annotations

import hashlib
import os
import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector.utils import batch_space

try:
    from gymnasium.vector import AutoresetMode
except ImportError:
    raise ImportError(f"shadow_repose needs Gymnasium 1.1 or newer, this is {gymnasium.__version__}") from None

from . import _native
from ._policy import Policy
from ._registration import register
from ._settings import flat, floats, number, pairs

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

# The numbers by which the extension module reports an end.
_TERMINATED, _TRUNCATED, _REDIRECTED = 1, 2, 3

# The parts of a state, with their types and dimensions.
_STATE = {
    "numbers": (np.float64, 2), "counters": (np.uint64, 2), "ends": (np.uint8, 1), "returns": (np.float64, 1), "seeds": (np.uint64, 2),
    "times": (np.uint64, 1),
}  # fmt: skip


class VectorEnv(gymnasium.vector.VectorEnv):
    """N environments that step together. The same seed gives the same bits on any number of threads.

    Args:
        num_envs: the number N of environments.
        threads: worker threads. 0 means one per core.
        seed: the seed of the episodes until `reset` names another. Environment i plays the episodes i, i + N, i + 2 N, …
        config: a settings file of the program. Of its `[ppo]` and `[run]`, only `ppo.horizon` is used, with `training=True`.
        set: single settings, as `--set`: `{"env.friction_scale": 0.8}`.
        world: settings that change how the hand and the object move, but are unknown to the model that predicts (`env.prediction`).
        policy: a policy, or a place that `Policy.load` takes. The task is then the policy's training task.
        training: the task as `train` teaches it at `env_steps`: shaping rewards, tolerance, hold, randomisation.
        goal_change: what a new goal means to a learner. `"continue"`: nothing ends, the next observation shows it. `"truncate"`:
            `truncated` is set, and `final_obs` shows the old goal. `info["redirected"]` distinguishes this from an end by time.
            `train` learns that way, and so can any learner that adds the value of `final_obs` where `truncated` is set.
        random_age: the first episodes after a reset of all environments end early, at different times, as in `train`.
        autoreset_mode: when an environment starts its next episode (see Gymnasium). `"truncate"` needs SAME_STEP.
        reward_terms: `info["reward"]` holds the terms of each step's reward, which add up to it.
        render_mode: `"rgb_array"` lets `render` draw pictures.

    Raises:
        ValueError: a setting is unknown or invalid, or the scene cannot be used. The message lists everything that is wrong.
        FileNotFoundError, PermissionError: the settings file or the policy does not exist, or cannot be read.

    Observations are float32 `[N, O]`. `observation_layout` names their groups. Actions `[N, A]` are moves within the range of each
    actuator, and are clipped to [-1, 1]. Quaternions are w, x, y, z, and units are SI.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 100, "autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(
        self,
        num_envs: int = 1024,
        *,
        threads: int = 0,
        seed: int = 0,
        config: str | os.PathLike[str] | None = None,
        set: Mapping[str, Any] | None = None,
        world: Mapping[str, Any] | None = None,
        policy: Policy | str | os.PathLike[str] | None = None,
        training: bool = False,
        goal_change: Literal["continue", "truncate"] = "continue",
        random_age: bool = False,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        reward_terms: bool = False,
        render_mode: Literal["rgb_array"] | None = None,
    ) -> None:
        self._hands: _native.Hands | None = None
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f'render_mode = {render_mode!r}: must be "rgb_array"; evaluate(…, trace=…) writes what a page shows')
        if goal_change not in ("continue", "truncate"):
            raise ValueError(f'goal_change = {goal_change!r}: must be "continue" or "truncate"')
        modes = {name: mode for mode in AutoresetMode for name in (mode.name, mode.value)}
        mode = modes.get(autoreset_mode) if isinstance(autoreset_mode, str) else autoreset_mode
        if not isinstance(mode, AutoresetMode):
            raise ValueError(f"autoreset_mode = {autoreset_mode!r}: must be one of {', '.join(AutoresetMode.__members__)}")
        if goal_change == "truncate" and mode is not AutoresetMode.SAME_STEP:
            raise ValueError('goal_change = "truncate" needs autoreset_mode = SAME_STEP: the hand goes on under the new goal at once')
        said = pairs(set), pairs(world)  # report wrong settings before anything is loaded
        if policy is not None and not isinstance(policy, Policy):
            of_task = {key: value for key, value in (set or {}).items() if key.split(".")[0] in ("env", "hand")}
            policy = Policy._loaded(policy, of_task)
        self._made: dict[str, Any] = {
            "threads": number("threads", threads, most=65536), "seed": number("seed", seed), "training": bool(training),
            "mode": mode.value, "truncates": goal_change == "truncate", "terms": bool(reward_terms),
        }  # fmt: skip
        self.num_envs = number("num_envs", num_envs, 1, 65536)
        native = None if policy is None else policy._native
        hands = self._create((None if config is None else os.fspath(config), native, *said), None)
        self._parts, self._task = hands.parts(), _identity(hands)
        for warning in hands.warnings:
            warnings.warn(warning, stacklevel=2)
        self.render_mode = render_mode
        self._aged, self.step_dt = bool(random_age), float(self.settings["env.ctrl_dt"])
        self.metadata = {**self.metadata, "render_fps": round(1 / self.step_dt), "autoreset_mode": mode}
        layout = hands.layout()
        size = sum(length for _, _, length, _ in layout)
        self.observation_layout = {name: slice(first, first + length) for name, first, length, _ in layout}
        self.observation_units = {name: unit for name, _, _, unit in layout}
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (hands.action_size,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def _create(self, said: tuple[Any, ...], parts: tuple[Any, ...] | None) -> _native.Hands:
        """Creates the environments from what the user says, or from the parts of others."""
        made = self._made
        how = made["training"], made["mode"], made["truncates"], made["terms"]
        self._hands = _native.Hands(self.num_envs, made["threads"], made["seed"], said, parts, *how)
        return self._hands

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode in each environment, and returns the observations `[N, O]` and an empty dict.

        Args:
            seed: the episodes begin with the first one of this seed. Without a seed, the next episodes follow. With a list of N seeds,
                environment i plays what `Env` plays after `reset(seed=seed[i])`; where the list has None, the next episode follows.
            options: `{"reset_mask": mask}` with a bool array `[N]` restarts only the environments that it marks.

        Raises ValueError for a seed that is negative or comes with a mask, and for a mask of another shape.
        """
        hands = self._open()
        if options is not None and not isinstance(options, Mapping):
            raise TypeError(f"options must be a dict, not {options!r}")
        seeds = None
        if np.ndim(seed) > 0:
            seed, seeds = None, [None if one is None else number("seed", one) for one in seed]
            if len(seeds) != self.num_envs:
                raise ValueError(f"seed has {len(seeds)} seeds for {self.num_envs} hands")
        elif seed is not None:
            seed = number("seed", seed)
            super().reset(seed=seed)
        mask = None if options is None else options.get("reset_mask")
        if mask is not None:
            mask = np.asarray(mask)
            if mask.dtype != np.bool_:
                raise TypeError(f"reset_mask must be an array of bool, not of {mask.dtype}")
            if mask.shape != (self.num_envs,):
                raise ValueError(f"reset_mask has the shape {mask.shape}, expected ({self.num_envs},)")
            if not mask.any():
                raise ValueError("reset_mask marks no hand")
        return hands.reset(seed, seeds, mask, self._aged), {}

    def step(self, actions: ArrayLike) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Steps all environments once with `actions` `[N, A]`, which are clipped to [-1, 1].

        Returns observations `[N, O]`, rewards `[N]` (float32), terminated `[N]`, truncated `[N]` and info, all in new memory. Info
        holds, each with a mask `[N]` under the same name with a `_` before it:
            final_obs `[N, O]`: the last observations of the environments where `terminated` or `truncated` is set (SAME_STEP only);
            final_info: `episode` describes the episodes that ended: `r` the sum of rewards, `l` steps, `goals` reached, `dropped`,
                `diverged`, `randomized`, `rot_dist` mean rotation error (rad), `reward` the sums of the task's terms;
            redirected `[N]`: where the goal was replaced;
            reward, rot_dist (with `reward_terms`): the terms of this step's reward, weighted as in it, and the rotation errors (rad)
                after it.

        Raises ValueError (shape, NaN) and RuntimeError (not reset, closed, in use by another thread, or an environment failed: reset).
        """
        hands, given = self._open(), _numbers(actions, self.action_space.shape)
        observations, rewards, ends, episodes, finals, terms = hands.step(given)
        terminated, truncated = ends == _TERMINATED, ends == _TRUNCATED
        info: dict[str, Any] = {}
        if ends.any():
            over, redirected = terminated | truncated, ends == _REDIRECTED
            if self._made["truncates"]:
                truncated |= redirected
            if finals is not None:
                info.update(_masked({"final_obs": finals}, terminated | truncated))
            if episodes is not None:
                info.update(_masked({"final_info": {"episode": episodes}}, over))
            if redirected.any():
                info.update(_masked({"redirected": redirected}, redirected))
        if terms is not None:
            info.update(_masked({"reward": terms[0], "rot_dist": terms[1]}, np.ones(self.num_envs, np.bool_)))
        return observations, rewards, terminated, truncated, info

    def _open(self) -> _native.Hands:
        if self._hands is None:
            raise RuntimeError("these hands are closed")
        return self._hands

    @property
    def env_steps(self) -> int:
        """Control steps so far, over all environments. With `training=True` they determine the lesson, which applies for `ppo.horizon`
        steps of all environments, as in `train`. Set them to continue from a later point.
        """
        return self._open().env_steps

    @env_steps.setter
    def env_steps(self, steps: int) -> None:
        self._open().env_steps = number("env_steps", steps, most=2**60)

    @property
    def max_episode_steps(self) -> int:
        """The steps of an episode that does not end with a drop."""
        return self._open().max_episode_steps

    @property
    def settings(self) -> dict[str, Any]:
        """The settings of the task and the names of the hand's parts, by dotted key. `hand.actuators` names the actions."""
        return flat(self._open().settings())

    @property
    def notes(self) -> list[str]:
        """What the settings replace in a scene of your own, and what was found in it."""
        return self._open().notes

    def get_state(self) -> dict[str, np.ndarray]:
        """Returns the complete state of the environments, for `set_state` of environments with the same settings."""
        return {"task": self._task, **dict(zip(_STATE, self._open().state(), strict=True))}

    def set_state(self, state: Mapping[str, np.ndarray]) -> np.ndarray:
        """Continues from what `get_state` returned, bit for bit, and returns the observations `[N, O]` to act on.

        Raises ValueError if it is the state of other environments: of another number of them, another scene, or other settings.
        """
        try:
            parts = [np.asarray(state[name]) for name in _STATE]
            task = state["task"]
        except KeyError as missing:
            raise ValueError(f"the state lacks {missing}") from None
        found = [(part.dtype.str, part.ndim) for part in parts]
        expected = [(np.dtype(kind).str, dimensions) for kind, dimensions in _STATE.values()]
        if found != expected:
            raise ValueError(f"the parts of the state have the types and dimensions {found}, expected {expected}")
        if len(parts[0]) == self.num_envs and not np.array_equal(task, self._task):
            raise ValueError("not a state of such hands: it belongs to other settings or to another scene")
        return self._open().set_state(*parts)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Returns a picture `[480, 640, 3]`, uint8, of each environment, or None without `render_mode="rgb_array"`.

        It is drawn with EGL, as the films of the program. A randomised object is shown with the size that the task gives it. Raises
        RuntimeError before a reset, and without EGL.
        """
        return None if self.render_mode is None else tuple(self._open().render())

    def close_extras(self, **kwargs: Any) -> None:
        """Frees the environments and their threads."""
        if self._hands is not None:
            self._hands.close()
        self._hands = None

    def __len__(self) -> int:
        return self.num_envs

    def __getstate__(self) -> dict[str, Any]:
        """Everything but the threads. Environments that are not reset are as new in the copy."""
        state = self.get_state() if self._open().can_step else None
        return {**self.__dict__, "_hands": state}

    def __setstate__(self, pickled: dict[str, Any]) -> None:
        self.__dict__.update({**pickled, "_hands": None})
        state = pickled["_hands"]
        if self._made["threads"] > 16 * (os.cpu_count() or 1):  # the program refuses so many
            self._made = {**self._made, "threads": 0}
        hands = self._create((None, None, [], []), self._parts)
        if not np.array_equal(_identity(hands), self._task):
            raise ValueError("the copy would be another task: another MuJoCo, or a scene that reads a file which has changed")
        if state is not None:
            self.set_state(state)

    def __repr__(self) -> str:
        return f"<shadow_repose.VectorEnv of {self.num_envs} hands>"


def _identity(hands: _native.Hands) -> np.ndarray:
    """Returns a checksum, uint8 `[32]`, of all settings and of the scene."""
    found = hashlib.sha256(repr(hands.facts()).encode())
    for _, content in hands.parts()[-1]:
        found.update(hashlib.sha256(content).digest())
    return np.frombuffer(found.digest(), np.uint8)


def _numbers(actions: ArrayLike, shape: tuple[int, ...] | None) -> np.ndarray:
    """Returns the actions as float32."""
    found = floats("actions", actions)
    if found.shape != shape:
        raise ValueError(f"actions have the shape {found.shape}, expected {shape}")
    return found


def _masked(values: dict[str, Any], mask: np.ndarray) -> dict[str, Any]:
    """Adds its mask to each value and to the values within it, as Gymnasium does."""
    result: dict[str, Any] = {}
    for name, value in values.items():
        result[name] = _masked(value, mask) if isinstance(value, dict) else value
        result[f"_{name}"] = mask.copy()
    return result


class Env(gymnasium.Env):
    """One environment, `gymnasium.make("ShadowRepose-v0")`: observations `[O]`, actions `[A]`.

    It takes the options of `VectorEnv` that make sense for one environment. At the end of an episode, `info["final_info"]` holds the
    same as in `VectorEnv`. The attribute `vector` gives access to its settings, its layout and its state.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 100}

    def __init__(
        self,
        *,
        seed: int = 0,
        config: str | os.PathLike[str] | None = None,
        set: Mapping[str, Any] | None = None,
        world: Mapping[str, Any] | None = None,
        policy: Policy | str | os.PathLike[str] | None = None,
        training: bool = False,
        reward_terms: bool = False,
        render_mode: Literal["rgb_array"] | None = None,
    ) -> None:
        self.vector = VectorEnv(
            1, threads=1, seed=seed, config=config, set=set, world=world, policy=policy, training=training,
            reward_terms=reward_terms, render_mode=render_mode, autoreset_mode=AutoresetMode.DISABLED,
        )  # fmt: skip
        """The hand as a `VectorEnv` of one."""
        self.observation_space, self.action_space = self.vector.single_observation_space, self.vector.single_action_space
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": self.vector.metadata["render_fps"]}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode: the first one of `seed`, or the next one. Returns its observation `[O]`."""
        super().reset(seed=seed)
        observations, info = self.vector.reset(seed=seed)
        return observations[0], info

    def step(self, action: ArrayLike) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Steps once with an action `[A]`, which is clipped to [-1, 1]. Raises ResetNeeded after the end of an episode."""
        if self.vector._open().needs_reset:
            raise ResetNeeded("the episode is over: reset the hand before it steps")
        observations, rewards, terminated, truncated, info = self.vector.step(_numbers(action, self.action_space.shape)[None])
        return observations[0], float(rewards[0]), bool(terminated[0]), bool(truncated[0]), _first(info)

    def render(self) -> np.ndarray | None:
        """Returns a picture `[480, 640, 3]`, uint8, or None without `render_mode="rgb_array"`."""
        pictures = self.vector.render()
        return None if pictures is None else pictures[0]

    def close(self) -> None:
        """Frees the environment."""
        self.vector.close()


def _first(info: dict[str, Any]) -> dict[str, Any]:
    """Returns the values of the first environment, without masks."""
    one = {name: value for name, value in info.items() if not name.startswith("_")}
    return {name: _first(value) if isinstance(value, dict) else value[0] for name, value in one.items()}


register()
