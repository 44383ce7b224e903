"""The environments for Stable-Baselines3.

    from stable_baselines3 import PPO
    from shadow_repose import VectorEnv
    from shadow_repose.sb3 import Sb3VecEnv, policy

    envs = Sb3VecEnv(VectorEnv(256, training=True, goal_change="truncate", random_age=True))
    model = PPO("MlpPolicy", envs, n_steps=16, batch_size=1024).learn(1_000_000)
    policy(model).save("sb3.safetensors")                    # what `play`, `export` and `Policy.load` take
"""
from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from ._policy import Normalizer, Policy, array
from .envs import Env, VectorEnv


class Sb3VecEnv(VecEnv):
    """A `VectorEnv` as a `VecEnv` of Stable-Baselines3.

    Give it environments with `goal_change="truncate"`: where a goal is replaced, SB3 then adds the value of the last observation under
    the old goal. `info["episode"]` is there only at the end of an episode. Besides `r`, `l` and `t` it holds `goals`, `dropped` and the
    rest of `final_info`. Raises ValueError for environments that do not reset in the same step.
    """

    def __init__(self, envs: VectorEnv) -> None:
        if envs.metadata["autoreset_mode"] is not AutoresetMode.SAME_STEP:
            raise ValueError("Stable-Baselines3 needs hands with autoreset_mode = SAME_STEP")
        self.envs, self.metadata, self._began = envs, envs.metadata, time.time()
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> np.ndarray:
        """Starts an episode in each environment, from the seed that `seed` has set, if any. Returns the observations `[N, O]`."""
        seed = self._seeds[0]
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = [{} for _ in range(self.num_envs)]
        return self.envs.reset(seed=seed)[0]

    def step_async(self, actions: np.ndarray) -> None:
        """Stores the actions `[N, A]` for the step that `step_wait` takes."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Steps all environments once."""
        observations, rewards, terminated, truncated, info = self.envs.step(self._actions)
        dones = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(dones):
            infos[i] = {"terminal_observation": info["final_obs"][i], "TimeLimit.truncated": bool(truncated[i])}
            if "final_info" in info and info["_final_info"][i]:
                episode = info["final_info"]["episode"]
                known = {name: column[i].item() for name, column in episode.items() if name[0] != "_" and name != "reward"}
                infos[i]["episode"] = {**known, "t": round(time.time() - self._began, 6)}
        return observations, rewards, dones, infos

    def close(self) -> None:
        """Frees the environments."""
        self.envs.close()

    def _count(self, indices: None | int | Iterable[int]) -> int:
        return len(list(self._get_indices(indices)))

    def get_attr(self, attr_name: str, indices: None | int | Iterable[int] = None) -> list[Any]:
        """Returns an attribute of the `VectorEnv` for each index: all environments share it."""
        return [getattr(self.envs, attr_name)] * self._count(indices)

    def set_attr(self, attr_name: str, value: Any, indices: None | int | Iterable[int] = None) -> None:
        """Sets an attribute of the `VectorEnv`, e.g. `env_steps`, for all environments."""
        setattr(self.envs, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: None | int | Iterable[int] = None, **kwargs: Any) -> list[Any]:
        """Calls a method of the `VectorEnv` once, and returns its result for each index."""
        return [getattr(self.envs, method_name)(*args, **kwargs)] * self._count(indices)

    def env_is_wrapped(self, wrapper_class: type, indices: None | int | Iterable[int] = None) -> list[bool]:
        """Returns False for each index."""
        return [False] * self._count(indices)

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Returns a picture of each environment, if they were made with `render_mode="rgb_array"`."""
        return self.envs.render() or [None] * self.num_envs


def policy(model: Any, *, task: VectorEnv | Env | None = None) -> Policy:
    """Returns the policy of a model with a `MlpPolicy` and Gaussian actions, such as PPO's or A2C's, and with its `VecNormalize`.

    Args:
        model: the model. Where it was loaded without environments, give it some by `set_env`, so that its `VecNormalize` is found.
        task: the environments in which it was learnt, by default its own.

    Raises ValueError for a policy that is no MLP, or whose actions are squashed or drawn from another distribution.
    """
    net, log_std = getattr(model.policy, "mlp_extractor", None), getattr(model.policy, "log_std", None)
    if net is None or log_std is None or log_std.ndim != 1 or getattr(model.policy, "squash_output", False):
        raise ValueError(f"only the MLP of a Gaussian policy (PPO, A2C) can be taken over, not {type(model).__name__} with this policy")
    envs, statistics = model.get_env(), model.get_vec_normalize_env()
    while task is None:
        if not hasattr(envs, "venv") and not isinstance(envs, Sb3VecEnv):
            raise ValueError("the model has no Sb3VecEnv: give the task in which it was learnt")
        task, envs = (envs.envs, None) if isinstance(envs, Sb3VecEnv) else (None, envs.venv)
    normalizer = None
    if statistics is not None and statistics.norm_obs:
        normalizer = Normalizer(statistics.obs_rms.mean, statistics.obs_rms.var, statistics.epsilon, statistics.clip_obs)
    layers = torch.nn.Sequential(model.policy.features_extractor, net.policy_net, model.policy.action_net)
    return Policy.from_torch(layers, task=task, normalizer=normalizer, std=np.exp(array(log_std)))
