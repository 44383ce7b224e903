"""Gymnasium's own checks and wrappers."""
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import vector as wrappers

from shadow_repose import VectorEnv

SHORT = {"env.max_episode_seconds": 0.2}


@pytest.mark.filterwarnings("ignore:.*Box observation space.*", "ignore:.*not within.*")
def test_one_hand_passes_the_check_of_environments():
    check_env(gymnasium.make("ShadowRepose-v0", set=SHORT).unwrapped, skip_render_check=True)


def test_many_hands_are_made_by_name():
    envs = gymnasium.make_vec("ShadowRepose-v0", num_envs=4, policy="builtin")
    assert isinstance(envs, VectorEnv) and envs.num_envs == 4 and envs.settings["env.act_moving_average"] == 0.7
    env = gymnasium.make("ShadowRepose-v0", seed=3)
    assert np.array_equal(env.reset(seed=1)[0], VectorEnv(1).reset(seed=1)[0][0])


ANY = [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP]
# Gymnasium's wrappers of observations refuse SAME_STEP.
OBSERVERS = [
    wrappers.NormalizeObservation,
    lambda envs: wrappers.TransformObservation(envs, lambda rows: rows * 2),
    lambda envs: wrappers.DtypeObservation(envs, np.float64),
]
OTHERS = [
    wrappers.RecordEpisodeStatistics,
    wrappers.NormalizeReward,
    wrappers.ClipAction,
    wrappers.DictInfoToList,
    lambda envs: wrappers.ClipReward(envs, -1, 1),
    lambda envs: wrappers.RescaleAction(envs, np.float32(-0.5), np.float32(0.5)),
]


def test_wrappers_of_one_hand_work_unchanged():
    one = gymnasium.wrappers.RecordEpisodeStatistics(gymnasium.make("ShadowRepose-v0", set=SHORT))
    one.reset()
    for _ in range(20):
        *_, info = one.step(np.zeros(20))
    assert info["episode"]["l"] == info["final_info"]["episode"]["l"] == 20
    made = gymnasium.make_vec("ShadowRepose-v0", num_envs=2, vectorization_mode="sync", set=SHORT)
    several = wrappers.RecordEpisodeStatistics(made)
    several.reset()
    for _ in range(45):
        *_, info = several.step(np.zeros((2, 20)))


@pytest.mark.parametrize(
    "imports", ["import gymnasium, shadow_repose", "import shadow_repose.envs, gymnasium", "import gymnasium; name = 'shadow_repose:' + name"]
)
def test_the_name_is_known_after_an_import(imports):
    code = f"name = 'ShadowRepose-v0'; {imports}; print(gymnasium.make(name).reset()[0].shape, gymnasium.make_vec(name, 2))"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout == f"{VectorEnv(1).single_observation_space.shape} <shadow_repose.VectorEnv of 2 hands>\n"


@pytest.mark.parametrize(
    ("wrap", "mode"), [(wrap, mode) for wrap in OTHERS for mode in ANY] + [(wrap, AutoresetMode.NEXT_STEP) for wrap in OBSERVERS]
)
def test_wrappers_of_vector_environments_work_unchanged(wrap, mode):
    envs = wrap(VectorEnv(8, set=SHORT, seed=2, autoreset_mode=mode))
    envs.reset(seed=1)
    envs.action_space.seed(1)
    for _ in range(60):
        observations, *_ = envs.step(envs.action_space.sample())
    assert observations.shape == envs.observation_space.shape


@pytest.mark.parametrize("mode", ANY)
def test_the_statistics_of_gymnasium_are_ours(mode):
    envs = wrappers.RecordEpisodeStatistics(VectorEnv(8, set=SHORT, seed=2, autoreset_mode=mode, random_age=True))
    envs.reset()
    compared = 0
    for _ in range(70):
        *_, info = envs.step(envs.action_space.sample())
        if "episode" in info:
            over, ours = info["_episode"], info["final_info"]["episode"]
            assert np.array_equal(ours["_r"], over) and np.array_equal(info["episode"]["l"][over], ours["l"][over])
            assert np.allclose(info["episode"]["r"][over], ours["r"][over], atol=1e-4)
            compared += over.sum()
    assert compared > 20


def test_infos_become_lists_with_the_episode_of_each_hand():
    envs = wrappers.DictInfoToList(VectorEnv(3, set={"env.max_episode_seconds": 0.03, "env.fall_dist": 10.0}))
    envs.reset()
    for _ in range(3):
        *_, infos = envs.step(np.zeros((3, 20)))
    assert infos[1]["final_info"]["episode"]["l"] == 3 and infos[2]["final_obs"].shape == envs.single_observation_space.shape
