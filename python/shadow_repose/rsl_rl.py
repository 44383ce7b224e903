"""The environments for rsl_rl, the learner of Isaac Lab and mjlab.

    from rsl_rl.runners import OnPolicyRunner
    from shadow_repose import VectorEnv
    from shadow_repose.rsl_rl import RslRlVecEnv, policy

    envs = RslRlVecEnv(VectorEnv(1024, training=True, goal_change="truncate", random_age=True), device="cuda")
    runner = OnPolicyRunner(envs, train_cfg, log_dir="logs", device="cuda")
    runner.learn(1000)
    policy(runner).save("rsl_rl.safetensors")   # what `play`, `export` and `Policy.load` take

`train_cfg` is a configuration of rsl_rl. The observations are the group `policy`: `"obs_groups": {"actor": ["policy"], "critic": ["policy"]}`.
"""
from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from rsl_rl.env import VecEnv
from tensordict import TensorDict

from ._policy import Normalizer, Policy, array
from .envs import Env, VectorEnv


class _Settings(dict[str, Any]):
    """The settings of the task, as rsl_rl's loggers read them."""

    def to_dict(self) -> dict[str, Any]:
        return dict(self)


class RslRlVecEnv(VecEnv):
    """A `VectorEnv` as a `VecEnv` of rsl_rl, whose tensors lie on `device`. The environments themselves step on the CPU.

    Give it environments with `goal_change="truncate"`: where a goal is replaced, rsl_rl then adds the value of the state before. The
    runner's `init_at_random_ep_len` assigns to `episode_length_buf`. All environments then start again at random ages of their own
    choice. Raises ValueError for environments that do not reset in the same step.
    """

    def __init__(self, envs: VectorEnv, *, device: torch.device | str = "cpu") -> None:
        if envs.metadata["autoreset_mode"] is not AutoresetMode.SAME_STEP:
            raise ValueError("rsl_rl needs hands with autoreset_mode = SAME_STEP")
        self.envs, self.device, self.cfg = envs, device, _Settings(envs.settings)
        self.num_envs, self.num_actions = envs.num_envs, len(envs.settings["hand.actuators"])
        self.max_episode_length = envs.max_episode_steps
        self._start(envs.reset()[0])

    def _start(self, observations: np.ndarray) -> None:
        self._observations = observations
        self._lengths = torch.zeros(self.num_envs, dtype=torch.long, device=self.device)

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """The steps since the last end of each environment."""
        return self._lengths

    @episode_length_buf.setter
    def episode_length_buf(self, lengths: torch.Tensor) -> None:
        """Starts all environments again at random ages of their own choice, whatever the given lengths."""
        self._start(self.envs._open().reset(None, None, None, True))

    def _tensor(self, array: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(array).to(self.device)

    def get_observations(self) -> TensorDict:
        """Returns the observations `[N, O]` to act on."""
        observations = torch.tensor(self._observations, device=self.device)  # a copy
        return TensorDict({"policy": observations}, batch_size=[self.num_envs], device=self.device)

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Steps all environments once with `actions` `[N, A]`. Returns observations, rewards `[N]`, ends `[N]`, and what to log."""
        self._observations, rewards, terminated, truncated, info = self.envs.step(actions.detach().cpu().numpy())
        dones = self._tensor(terminated | truncated).long()
        self._lengths = torch.where(dones.bool(), 0, self._lengths + 1)
        extras: dict[str, Any] = {"time_outs": self._tensor(truncated)}
        if "final_info" in info:
            episode, over = info["final_info"]["episode"], info["_final_info"]
            names = ("goals", "dropped", "rot_dist", "l", "r")
            extras["log"] = {f"/episode/{name}": float(np.mean(episode[name][over])) for name in names}
        return self.get_observations(), self._tensor(rewards), dones, extras

    def close(self) -> None:
        """Frees the environments."""
        self.envs.close()


def policy(runner: Any, *, task: VectorEnv | Env | None = None) -> Policy:
    """Returns the policy of a runner with an `MLPModel` and Gaussian actions, and with its normaliser. It needs rsl_rl 5.

    Args:
        runner: the runner.
        task: the environments in which it was learnt, by default the runner's.

    Raises ValueError for another model or distribution, and for observations of more than one group.
    """
    model = runner.alg.get_policy()
    kinds = type(model).__name__, type(model.distribution).__name__
    if kinds != ("MLPModel", "GaussianDistribution") or len(model.obs_groups) != 1:
        raise ValueError(f"only an MLPModel with a GaussianDistribution and one group can be taken over, not {kinds}, {model.obs_groups}")
    distribution, normalizer = model.distribution, None
    if model.obs_normalization:
        seen = model.obs_normalizer
        normalizer = Normalizer(array(seen.mean), (array(seen.std).astype(np.float64) + seen.eps) ** 2, 0.0)
    std = distribution.std_param if distribution.std_type == "scalar" else distribution.log_std_param.exp()
    drawn = array(std).clip(*distribution.std_range)
    return Policy.from_torch(model.mlp, task=task or runner.env.envs, normalizer=normalizer, std=drawn)
