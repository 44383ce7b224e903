"""Gymnasium's own checks and wrappers."""
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import vector as wrappers

from shadow_repose import Env, VectorEnv

SHORT = {"env.max_episode_seconds": 0.2}


def draws():
    """Whether pictures can be drawn here."""
    envs = VectorEnv(1, render_mode="rgb_array")
    envs.reset()
    try:
        return bool(envs.render())
    except RuntimeError as error:
        assert "EGL" in str(error)
        return False


DRAWS = draws()
drawn = pytest.mark.skipif(not DRAWS, reason="pictures cannot be drawn here")


@pytest.mark.filterwarnings("ignore:.*Box observation space.*", "ignore:.*not within.*")
def test_one_hand_passes_the_check_of_environments():
    check_env(gymnasium.make("ShadowRepose-v0", set=SHORT).unwrapped, skip_render_check=True)
    if DRAWS:
        check_env(gymnasium.make("ShadowRepose-v0", set=SHORT, render_mode="rgb_array").unwrapped)


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


def test_a_list_of_seeds_is_taken_as_by_gymnasiums_own_vector_environments():
    made = {"set": {"env.max_episode_seconds": 0.05, "env.fall_dist": 10.0}, "autoreset_mode": "NextStep"}
    ours, theirs = VectorEnv(3, **made), SyncVectorEnv([lambda: Env(set=made["set"])] * 3)
    for seeds in ([7, 3, 7], np.array([1, 2, 3]), (np.int64(5), 6, 2**64 - 1)):
        assert np.array_equal(ours.reset(seed=seeds)[0], theirs.reset(seed=[int(seed) for seed in seeds])[0])
        for step, given in enumerate(np.random.default_rng(0).uniform(-1, 1, (20, 3, 20)).astype(np.float32)):
            found, expected = ours.step(given), theirs.step(given)
            assert all(np.array_equal(one, other) for one, other in zip(found[:4], expected[:4], strict=True)), step
            if step == 8:
                again = VectorEnv(3, **made)
                assert np.array_equal(again.set_state(ours.get_state()), found[0])
    for given in np.zeros((12, 3, 20), np.float32):
        expected = theirs.step(given)[0]
        assert np.array_equal(ours.step(given)[0], expected)


def test_a_seed_for_some_environments_lets_the_others_go_on():
    envs, others = VectorEnv(3, seed=1), VectorEnv(3, seed=1)
    first, second = others.reset()[0], others.reset()[0]
    assert np.array_equal(envs.reset()[0], first)
    found = envs.reset(seed=[None, 4, None])[0]
    assert np.array_equal(found[[0, 2]], second[[0, 2]]) and np.array_equal(found[1], VectorEnv(1).reset(seed=4)[0][0])
    assert np.array_equal(envs.reset(seed=1)[0], first) and np.array_equal(envs.reset()[0], second)
    for wrong, error in [([1, 2], ValueError), ([1, 2, -1], ValueError), ([1, 2, 2.5], TypeError), ("abc", TypeError), ([[1], [2], [3]], TypeError)]:
        with pytest.raises(error, match="seed"):
            envs.reset(seed=wrong)
    with pytest.raises(ValueError, match="give no seed"):
        envs.reset(seed=[1, 2, 3], options={"reset_mask": np.array([True, False, False])})


@drawn
def test_pictures_show_each_environment_as_it_is():
    envs = VectorEnv(2, seed=3, render_mode="rgb_array")
    with pytest.raises(RuntimeError, match="reset the hands"):
        envs.render()
    envs.reset()
    one, other = envs.render()
    assert (one.shape, one.dtype) == ((480, 640, 3), np.uint8) and one.std() > 10 and (one != other).any()
    assert np.abs(one - envs.render()[0].astype(int)).max() <= 1
    for _ in range(10):
        envs.step(np.ones((2, 20)))
    assert (envs.render()[0] != one).any()
    assert VectorEnv(1).render() is None
    env = gymnasium.make("ShadowRepose-v0", render_mode="rgb_array")
    env.reset(seed=1)
    assert env.render().shape == (480, 640, 3) and env.metadata["render_fps"] == 100


@drawn
def test_a_drawing_does_not_change_what_comes():
    seen, unseen = VectorEnv(2, seed=3, render_mode="rgb_array"), VectorEnv(2, seed=3)
    seen.reset(), unseen.reset()
    for given in np.random.default_rng(1).uniform(-1, 1, (5, 2, 20)):
        seen.render()
        assert np.array_equal(seen.step(given)[0], unseen.step(given)[0])


@drawn
def test_environments_that_were_drawn_and_closed_are_freed():
    def resident():
        with open("/proc/self/status") as status:
            return int(next(line for line in status if line.startswith("VmRSS")).split()[1]) / 1024

    def draw():
        envs = VectorEnv(1, threads=1, render_mode="rgb_array")
        envs.reset()
        envs.render()
        envs.close()

    draw()
    draw()
    before = resident()
    for _ in range(12):
        draw()
    assert resident() - before < 120, "MiB; each drawing takes 24"


@drawn
def test_a_fork_of_a_process_that_has_drawn_says_that_it_cannot():
    program = """if True:
        import os, sys
        from shadow_repose import VectorEnv
        envs = VectorEnv(1, render_mode="rgb_array")
        envs.reset()
        envs.render()
        if os.fork() == 0:
            try:
                envs.render()
            except RuntimeError as error:
                os._exit(7 if "a fork of a process" in str(error) else 1)
        sys.exit(os.waitstatus_to_exitcode(os.wait()[1]))
    """
    assert subprocess.run([sys.executable, "-c", program], timeout=60).returncode == 7


@drawn
def test_gymnasium_records_a_film(tmp_path):
    pytest.importorskip("moviepy")
    env = gymnasium.make("ShadowRepose-v0", render_mode="rgb_array", set=SHORT)
    film = gymnasium.wrappers.RecordVideo(env, str(tmp_path / "films"), episode_trigger=lambda episode: True)
    film.reset(seed=1)
    while not any(film.step(np.ones(20))[2:4]):
        pass
    film.close()
    [file] = (tmp_path / "films").iterdir()
    from moviepy import VideoFileClip

    with VideoFileClip(str(file)) as clip:
        assert clip.size == [640, 480] and clip.fps == 100 and abs(clip.duration - 0.21) < 0.03


@drawn
def test_gymnasium_collects_the_pictures_of_an_episode():
    env = gymnasium.wrappers.RenderCollection(gymnasium.make("ShadowRepose-v0", render_mode="rgb_array", set=SHORT))
    env.reset(seed=1)
    for _ in range(4):
        env.step(np.ones(20))
    pictures = env.render()
    assert len(pictures) == 5 and all((one != other).any() for one, other in zip(pictures, pictures[1:]))


def test_a_gymnasium_that_is_too_old_is_named_with_the_version_that_is_needed():
    code = "import gymnasium.vector; del gymnasium.vector.AutoresetMode; gymnasium.__version__ = '1.0.0'; import shadow_repose.envs"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert found.stderr.splitlines()[-1] == "ImportError: shadow_repose needs Gymnasium 1.1 or newer, this is 1.0.0"
