"""Policies and their scores."""
import json
import pathlib
import pickle
import subprocess
import time

import numpy as np
import pytest

import shadow_repose
from shadow_repose import Policy, VectorEnv, evaluate, program


SIZE = VectorEnv(1).single_observation_space.shape[0]


def observations(rows):
    envs = VectorEnv(rows, policy="builtin", seed=5)
    return envs.reset()[0]


def test_the_actions_of_a_row_are_the_same_bits_whatever_the_other_rows_are():
    policy, seen = Policy.load("builtin"), observations(150)
    actions, values = policy(seen), policy.values(seen)
    assert (actions.shape, actions.dtype, values.shape) == ((150, 20), np.float32, (150,))
    for rows in (1, 2, 64, 65):
        assert np.array_equal(policy(seen[:rows]), actions[:rows]) and np.array_equal(policy.values(seen[:rows]), values[:rows])
    assert np.array_equal(policy(seen[7]), actions[7]) and policy.values(seen[7]) == values[7]
    assert policy(seen[:0]).shape == (0, 20) and policy.values(seen[:0]).shape == (0,)


def test_drawn_actions_spread_around_the_means_and_follow_the_generator():
    policy, seen = Policy.load("builtin"), observations(200)
    means, drawn = policy(seen), policy(seen, deterministic=False, rng=np.random.default_rng(1))
    assert abs((drawn - means).std() / policy.std[0] - 1) < 0.05 and abs((drawn - means).mean()) < 0.02
    assert np.array_equal(drawn, policy(seen, deterministic=False, rng=np.random.default_rng(1)))
    assert policy.std.shape == (20,)


def test_a_policy_file_is_loaded_with_its_settings(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        Policy.load(tmp_path / "nowhere")
    file = tmp_path / "x.safetensors"
    file.write_bytes(b"\0" * 100)
    with pytest.raises(ValueError, match="x.safetensors"):
        Policy.load(file)
    with pytest.raises(TypeError, match="Policy.load"):
        Policy("builtin")
    slippery = Policy.load("builtin", set={"env.friction_scale": 0.5})
    both = VectorEnv(2, policy=slippery, set={"env.gains_scale": 0.9}).settings
    assert (both["env.friction_scale"], both["env.gains_scale"]) == (0.5, 0.9)
    assert pickle.loads(pickle.dumps(slippery)).settings == slippery.settings != Policy.load("builtin").settings
    short = {"episodes": 2, "set": {"env.max_episode_seconds": 0.1}}
    assert evaluate(slippery, **short) != evaluate("builtin", **short)


@pytest.mark.parametrize(
    "given",
    [
        np.zeros((3, SIZE - 1)), np.zeros((2, 3, SIZE)), "x", None, [[1], [2, 3]], 3.0, np.zeros((1, SIZE), complex), ["1"] * SIZE,
        np.zeros((1, SIZE), "M8[s]"), [None] * SIZE, np.zeros((1, SIZE), object), np.zeros((1, SIZE), "m8[s]"),
    ],
)  # fmt: skip
def test_what_is_no_observation_is_an_exception(given):
    with pytest.raises((TypeError, ValueError)):
        Policy.load("builtin")(given)


def test_a_row_that_is_not_finite_spoils_no_other_row():
    policy, seen = Policy.load("builtin"), observations(10)
    spoilt = seen.copy()
    spoilt[3] = np.nan
    assert np.array_equal(np.delete(policy(spoilt), 3, 0), np.delete(policy(seen), 3, 0))


def test_a_score_has_the_keys_of_the_program_and_follows_seed_and_settings():
    score = evaluate("builtin", episodes=4, seed=3, set={"env.max_episode_seconds": 0.2})
    assert {"episodes", "goals_per_episode", "goals_ci95", "drop_rate", "reward", "checkpoint"} <= set(score)
    assert (score["episodes"], score["seed"], score["checkpoint"]) == (4, 3, "built into the program")
    other = evaluate(Policy.load("builtin"), episodes=4, seed=3, set={"env.max_episode_seconds": 0.2}, threads=1)
    assert score == other != evaluate("builtin", episodes=4, seed=4, set={"env.max_episode_seconds": 0.2})
    for wrong in ({"episodes": 0}, {"episodes": 2**30}, {"seed": -1}, {"set": {"env.x": 1}}, {"threads": 10**6}):
        with pytest.raises(ValueError):
            evaluate("builtin", **wrong)


def test_a_function_of_the_user_is_scored_as_a_policy_and_its_steps_are_written(tmp_path):
    policy = Policy.load("builtin")
    short = {"episodes": 70, "seed": 3, "set": {"env.max_episode_seconds": 0.2, "env.act_moving_average": 0.5}}
    traces = [tmp_path / "own.jsonl", tmp_path / "builtin.jsonl"]
    sizes = []

    def act(observations):
        sizes.append(observations.shape)
        return policy(observations).tolist()

    own, built_in = evaluate(act, trace=traces[0], **short), evaluate(policy, trace=traces[1], **short)
    assert own.pop("checkpoint") is None and built_in.pop("checkpoint") is not None
    assert own == built_in and set(sizes) == {(64, SIZE)}
    header, *steps = traces[0].read_text().splitlines()
    assert json.loads(header)["actor"] == "policy" and steps == traces[1].read_text().splitlines()[1:]
    html = tmp_path / "own.html"
    subprocess.run([program(), "play", "--from-trace", traces[0], "--out", html], check=True)
    assert html.stat().st_size > 100_000


def test_what_goes_wrong_in_a_function_of_the_user_is_raised(tmp_path):
    def broken(observations):
        raise KeyError("mine")

    calls = []

    def slowly_broken_at_the_end(observations):
        calls.append(len(calls))
        if len(calls) >= 20:
            time.sleep(0.2)
            raise KeyError(f"call {len(calls)}")
        return observations[:, :20]

    trace = tmp_path / "x.jsonl"
    for act, error, text in [
        (broken, KeyError, "mine"),
        (lambda seen: seen[:, :19], ValueError, r"shape \[2, 19\], expected \[2, 20\]"),
        (lambda seen: np.full((2, 20), np.nan), ValueError, "not finite"),
        (lambda seen: [["x"] * 20] * 2, TypeError, "numbers"),
    ]:
        with pytest.raises(error, match=text):
            evaluate(act, episodes=2, trace=trace)
        assert not trace.exists()
    with pytest.raises(KeyError, match="call 20"):
        evaluate(slowly_broken_at_the_end, episodes=2, trace=trace, set={"env.max_episode_seconds": 0.2})
    assert len(calls) == 20 and not trace.exists()
    with pytest.raises(ValueError, match="nowhere does not exist"):
        evaluate(lambda seen: seen[:, :20], trace=tmp_path / "nowhere" / "x.jsonl")


def test_names_are_listed_and_unknown_ones_refused():
    assert set(shadow_repose.__all__) <= set(dir(shadow_repose))
    with pytest.raises(AttributeError, match="nonsense"):
        shadow_repose.nonsense


def test_actions_that_are_too_large_are_clipped_in_an_evaluation_as_in_a_step():
    short = {"episodes": 3, "set": {"env.max_episode_seconds": 0.1}}
    expected = evaluate(lambda seen: np.sign(seen[:, :20]), **short)
    for most in (np.inf, 1e300, 1e30):
        assert evaluate(lambda seen: np.select([seen[:, :20] > 0, seen[:, :20] < 0], [most, -most], 0.0), **short) == expected


@pytest.fixture
def other_ranges(tmp_path):
    """The built-in scene with another range of an actuator."""
    text = (pathlib.Path(__file__).parent.parent.parent / "assets/shadow_hand/scene.xml").read_text()
    before = '<position name="rh_A_THJ3"'
    assert before in text
    scene = tmp_path / "hand.xml"
    scene.write_text(text.replace(before, before + ' inheritrange="0" ctrlrange="-.1 .1"'))
    return {"env.model": scene, "env.max_episode_seconds": 0.05}


def test_a_warning_about_a_policy_is_said_at_every_door(other_ranges, tmp_path):
    said = "an action means another angle than in training.*rh_A_THJ3"
    loaded = Policy.load("builtin")
    for door in (
        lambda: Policy.load("builtin", set=other_ranges),
        lambda: VectorEnv(1, policy="builtin", set=other_ranges),
        lambda: VectorEnv(1, policy=loaded, set=other_ranges),
        lambda: evaluate("builtin", set=other_ranges, episodes=1),
        lambda: evaluate(loaded, set=other_ranges, episodes=1),
    ):
        with pytest.warns(UserWarning, match=said) as warnings:
            door()
        assert len(warnings) == 1 and warnings[0].filename == __file__
    sets = [f"--set={key}={value}" for key, value in other_ranges.items()]
    for command in (["export", "--out", "x.onnx"], ["play", "--json", "--episodes", "1"], ["play", "--plain", "--out", "x.html"]):
        found = subprocess.run([program(), *command, "--ckpt", "builtin", *sets], cwd=tmp_path, capture_output=True, text=True, check=True)
        assert "warning: an action means another angle than in training" in found.stderr
    assert "; warning: an action means another angle than in training" in (tmp_path / "x.html").read_text()
