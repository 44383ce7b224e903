"""Policies and their scores."""
import json
import pathlib
import pickle
import subprocess
import time

import numpy as np
import pytest

import shadow_repose
from shadow_repose import Normalizer, Policy, VectorEnv, evaluate, program


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


def net(*sizes, seed=0):
    """Returns the layers of an MLP with random numbers."""
    random = np.random.default_rng(seed)
    pairs = zip(sizes, sizes[1:], strict=False)
    return [(random.normal(0, 1 / inputs**0.5, (outputs, inputs)), random.normal(0, 0.1, outputs)) for inputs, outputs in pairs]


def computed(layers, activation, rows):
    """Returns what an MLP computes, in f64."""
    for weights, biases in layers[:-1]:
        rows = activation(rows @ weights.T + biases)
    weights, biases = layers[-1]
    return rows @ weights.T + biases


FUNCTIONS = {"elu": lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, 0))), "relu": lambda x: np.maximum(x, 0), "tanh": np.tanh}


@pytest.mark.parametrize("activation", FUNCTIONS)
def test_a_net_that_was_learnt_elsewhere_is_a_policy_with_its_own_normaliser_and_spread(tmp_path, activation):
    envs, layers, random = VectorEnv(64, set={"env.act_moving_average": 0.5}), net(SIZE, 24, 16, 20), np.random.default_rng(1)
    own = Normalizer(random.normal(size=SIZE), random.uniform(0, 2, SIZE), epsilon=1e-3, clip=1.5)
    policy = Policy.from_layers(layers, activation, task=envs, normalizer=own, std=np.linspace(0.1, 2, 20))
    seen = np.concatenate([envs.reset(seed=seed)[0] for seed in range(4)])
    normal = np.clip((seen - own.mean) / np.sqrt(own.variance + own.epsilon), -own.clip, own.clip)
    assert np.abs(policy(seen) - computed(layers, FUNCTIONS[activation], normal)).max() < 1e-5
    file = tmp_path / "x.safetensors"
    policy.save(file)
    again = Policy.load(file)
    assert np.array_equal(again(seen), policy(seen)) and np.allclose(again.std, np.linspace(0.1, 2, 20))
    assert again.settings["env.act_moving_average"] == 0.5
    with pytest.raises(ValueError, match="no critic"):
        policy.values(seen)
    drawn = policy(seen, deterministic=False, rng=np.random.default_rng(2)) - policy(seen)
    assert np.allclose(drawn.std(0), policy.std, rtol=0.25)
    played = subprocess.run([program(), "play", "--ckpt", file, "--headless", "--episodes", "3", "--json"], capture_output=True)
    score = evaluate(again, episodes=3)
    assert json.loads(played.stdout) == score
    by_net = evaluate(lambda seen: policy(seen), envs=envs, episodes=3)
    assert {**by_net, "checkpoint": score["checkpoint"]} == score
    assert evaluate(lambda seen: policy(seen), episodes=3) != by_net


def test_environments_for_one_policy_score_another():
    own, others = (VectorEnv(1, policy=policy, set={"env.max_episode_seconds": 0.5}) for policy in ("builtin", "robust"))
    for policy in ("builtin", "robust"):
        assert evaluate(policy, envs=own, episodes=2) == evaluate(policy, envs=others, episodes=2)


def test_what_does_not_fit_the_task_is_no_policy():
    envs = VectorEnv(1)
    for wrong, layers, how in (
        ("values in", net(SIZE - 1, 8, 20), {}),
        ("20 out", net(SIZE, 8, 19), {}),
        ("a hidden layer", net(SIZE, 20), {}),
        ("sizes", net(SIZE, 8, 20)[:1] + net(9, 20), {}),
        ("none of elu", net(SIZE, 8, 20), {"activation": "gelu"}),
        ("std", net(SIZE, 8, 20), {"std": 0.0}),
        ("not finite", [(weights * np.nan, biases) for weights, biases in net(SIZE, 8, 20)], {}),
        ("divided or clipped", net(SIZE, 8, 20), {"normalizer": Normalizer(0.0, 0.0, 0.0)}),
    ):
        with pytest.raises(ValueError, match=wrong):
            Policy.from_layers(layers, how.pop("activation", "elu"), task=envs, **how)
    with pytest.raises(TypeError, match="VectorEnv"):
        Policy.from_layers(net(SIZE, 8, 20), "elu", task="builtin")
    with pytest.raises(ValueError, match="not both"):
        evaluate("builtin", envs=envs, set={"env.friction_scale": 0.5})


def test_a_module_of_torch_is_a_policy_if_it_is_an_mlp():
    torch = pytest.importorskip("torch")
    nn, envs, shared = torch.nn, VectorEnv(64), torch.nn.ELU()
    module = nn.Sequential(nn.Linear(SIZE, 16), shared, nn.Sequential(nn.Linear(16, 8, bias=False), shared), nn.Linear(8, 20))
    seen, _ = envs.reset(seed=0)
    assert np.abs(Policy.from_torch(module, task=envs)(seen) - module(torch.as_tensor(seen)).detach().numpy()).max() < 1e-5

    class Reversed(nn.Module):
        def __init__(self):
            super().__init__()
            self.layers = nn.Sequential(nn.Linear(SIZE, 8), nn.ReLU(), nn.Linear(8, 20))

        def forward(self, rows):
            return -self.layers(rows)

    for wrong, other in (
        ("something else", Reversed()),
        ("alpha", nn.Sequential(nn.Linear(SIZE, 8), nn.ELU(0.5), nn.Linear(8, 20))),
        ("Tanh", nn.Sequential(nn.Linear(SIZE, 8), nn.ELU(), nn.Linear(8, 20), nn.Tanh())),
        ("LSTM", nn.LSTM(SIZE, 20)),
    ):
        with pytest.raises(ValueError, match=wrong):
            Policy.from_torch(other, task=envs)


def test_a_policy_that_was_learnt_elsewhere_is_exported_drawn_and_trained_on(tmp_path):
    envs, file = VectorEnv(8, set={"env.max_episode_seconds": 0.2}), tmp_path / "x.safetensors"
    Policy.from_layers(net(SIZE, 8, 20), "tanh", task=envs).save(file)
    before = Policy.load(file)

    def run(*words):
        return subprocess.run([program(), *map(str, words)], check=True, capture_output=True, text=True, cwd=tmp_path)

    run("export", "--ckpt", file, "--out", "x.onnx")
    run("play", "--ckpt", file, "--episodes", 1, "--headless", "--out", "t.jsonl.gz")
    run("play", "--from-trace", "t.jsonl.gz", "--plain", "--out", "y.html")
    assert (tmp_path / "t.jsonl.gz").read_bytes()[:2] == b"\x1f\x8b" and (tmp_path / "y.html").stat().st_size > 50_000
    small = ["--set", "env.num_envs=8", "--set", "ppo.hidden=[8]", "--set", "ppo.activation=tanh", "--set", "ppo.symmetry=none"]
    run("train", "--init", file, *small, "--total-steps", 128, "--run-dir", "run", "--quiet")
    after = Policy.load(tmp_path / "run")
    seen, _ = VectorEnv(8).reset(seed=1)
    assert after.values(seen).std() > 0 and 0 < np.abs(after(seen) - before(seen)).max() < 1


def test_an_episode_is_shown_in_a_notebook(tmp_path):
    pytest.importorskip("IPython")
    trace, short = tmp_path / "t.jsonl.gz", {"env.max_episode_seconds": 0.2}
    evaluate("builtin", episodes=1, set=short, trace=trace)
    for what in ("builtin", Policy.load("builtin", set=short), trace):
        assert "<iframe srcdoc=" in shadow_repose.show(what).data
    with pytest.raises(ValueError, match="No such file"):
        shadow_repose.show(tmp_path / "none.jsonl")


@pytest.mark.filterwarnings("ignore:an action means another angle")
def test_an_episode_of_a_hand_of_your_own_is_shown_by_its_policy_and_by_its_trace(other_ranges, tmp_path):
    pytest.importorskip("IPython")
    trace = tmp_path / "own.jsonl"
    evaluate("builtin", episodes=1, set=other_ranges, trace=trace)
    with pytest.raises(ValueError, match="env.model"):
        shadow_repose.show(trace)
    named = {"hand.object": "cube"}
    for what, set in ((trace, {"env": {"model": other_ranges["env.model"]}}), ("builtin", {**other_ranges, **named})):
        assert "<iframe srcdoc=" in shadow_repose.show(what, set=set).data
