"""Copies and states: they hold what they belong to, and need no file."""
import copy
import os
import pathlib
import pickle
import shutil
import subprocess
import sys

import numpy as np
import pytest

from shadow_repose import Policy, VectorEnv, evaluate

ROOT = pathlib.Path(__file__).parent.parent.parent
HAND = (ROOT / "tests/suite/three_fingers.xml").read_text()
HERE = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
TETRAHEDRON = "v 0 0 0\nv .02 0 0\nv 0 .02 0\nv 0 0 .02\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"


def written(folder):
    """Writes a scene with an included file and a mesh, and a settings file, and returns the scene."""
    (folder / "meshes").mkdir(parents=True)
    (folder / "meshes/part.obj").write_text(TETRAHEDRON)
    asset = '<compiler meshdir="meshes"/><asset><mesh name="part" file="part.obj"/></asset><worldbody>'
    (folder / "all.xml").write_text(HAND.replace("<worldbody>", asset + '<geom type="mesh" mesh="part" pos=".3 0 .1"/>', 1))
    (folder / "scene.xml").write_text('<mujoco model="a hand"><include file="all.xml"/></mujoco>')
    (folder / "task.toml").write_text("[env]\nfriction_scale = 0.5\nmax_episode_seconds = 0.1\n")
    return folder / "scene.xml"


def future(envs, steps=30):
    """Returns all that a number of steps returns."""
    actions = np.random.default_rng(5).uniform(-1, 1, (steps, envs.num_envs, *envs.single_action_space.shape))
    return [part for given in actions for part in envs.step(given)[:4]]


def same(one, other):
    return all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


@pytest.mark.parametrize("reset", [True, False])
@pytest.mark.parametrize("training", [True, False])
def test_a_copy_needs_no_file_and_is_the_task_of_its_original_whatever_has_happened_to_the_files(tmp_path, monkeypatch, reset, training):
    scene = written(tmp_path / "a")
    monkeypatch.chdir(tmp_path)
    varied = {"randomization.share": 1.0, "randomization.cube_size": [0.8, 1.2]} if training else {"env.prediction": 2}
    envs = VectorEnv(4, config="a/task.toml", set={"env.model": "a/scene.xml", **varied}, training=training, world={"env.gains_scale": 0.9})
    assert envs.settings["env.model"] == str(scene)
    if reset:
        envs.reset()
        future(envs, 3)
    (tmp_path / "a/task.toml").write_text("[env]\nfriction_scale = 2\nctrl_dt = 0.02\n")
    (tmp_path / "a/all.xml").write_text(HAND.replace('timestep="0.005"', 'timestep="0.005" gravity="0 0 9"'))
    pickled = pickle.dumps(envs)
    copies = [copy.deepcopy(envs), pickle.loads(pickled)]
    shutil.rmtree(tmp_path / "a")
    monkeypatch.chdir("/")
    copies.append(pickle.loads(pickled))
    copies.append(copy.deepcopy(copies[0]))
    if not reset:
        assert same([one.reset()[0] for one in copies], [envs.reset()[0]] * 4)
    expected = future(envs)
    assert all(same(future(one), expected) for one in copies)
    assert all(one.settings == envs.settings for one in copies)


def test_a_copy_in_another_process_is_its_original(tmp_path):
    envs = VectorEnv(3, set={"env": {"model": written(tmp_path / "a")}}, seed=4)
    envs.reset()
    (tmp_path / "pickled").write_bytes(pickle.dumps(envs))
    shutil.rmtree(tmp_path / "a")
    code = """
import pickle, sys, numpy as np
envs = pickle.load(open("pickled", "rb"))
sys.stdout.buffer.write(np.array([envs.step(np.full((3, 6), .3))[0] for _ in range(9)]).tobytes())
"""
    found = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, check=True, env=HERE).stdout
    assert found == np.array([envs.step(np.full((3, 6), 0.3))[0] for _ in range(9)]).tobytes()


OTHERS = {
    "another task": {"env.success_tolerance": 0.2},
    "another reward": {"env.fall_penalty": -3.0},
    "another physics": {"env.friction_scale": 0.3},
    "another timing": {"env.ctrl_dt": 0.02},
    "a delay": {"env.action_delay": 1},
    "a prediction": {"env.prediction": 1},
    "noise": {"env.noise": {"joint_pos": 0.01}},
    "another start": {"env.reset_dof_pos_noise": 0.0},
    "another randomisation": {"randomization.friction": [0.9, 1.0]},
    "another share": {"randomization.share": 0.5},
    "another lesson": {"training.hold": 3},
    "another scene": {"env.model": str(ROOT / "tests/suite/three_fingers.xml")},
}


@pytest.mark.parametrize("other", OTHERS)
def test_a_state_of_another_task_randomisation_or_timing_is_refused(other):
    one, others = VectorEnv(2, training=True), VectorEnv(2, training=True, set=OTHERS[other])
    one.reset(), others.reset()
    for taker, giver in [(one, others), (others, one)]:
        before = taker.get_state()
        with pytest.raises(ValueError, match="not a state of such hands: it belongs to other settings or to another scene"):
            taker.set_state(giver.get_state())
        assert same(before.values(), taker.get_state().values())


def test_a_state_belongs_to_a_policy_to_the_world_and_to_training_but_not_to_a_place_or_a_learner(tmp_path):
    plain = VectorEnv(2)
    plain.reset()
    for other in ({"policy": "builtin"}, {"world": {"env.gravity": [0.0, 0.0, 3.0]}}, {"training": True}):
        with pytest.raises(ValueError, match="other settings"):
            VectorEnv(2, **other).set_state(plain.get_state())
    (tmp_path / "x.toml").write_text("[env]\nnum_envs = 4\n[ppo]\nminibatches = 4\nhorizon = 8\n[run]\nseed = 3\n")
    envs = [VectorEnv(2, set={"env.model": written(tmp_path / name)}) for name in "ab"]
    envs.append(VectorEnv(2, set={"env.model": tmp_path / "a/scene.xml"}, config=tmp_path / "x.toml", autoreset_mode="NextStep", seed=9))
    envs[0].reset()
    for other in envs[1:]:
        other.set_state(envs[0].get_state())
        assert same(future(other, 5), future(envs[0], 5)) or other is not envs[1]


def test_a_state_is_saved_by_numpy(tmp_path):
    envs = VectorEnv(2, seed=3)
    envs.reset(seed=[5, 7])
    np.savez(tmp_path / "state.npz", **envs.get_state())
    again = VectorEnv(2)
    with np.load(tmp_path / "state.npz") as state:
        again.set_state(state)
        with pytest.raises(ValueError, match="lacks 'task'"):
            again.set_state({name: state[name] for name in state if name != "task"})
    assert same(future(again), future(envs))


def test_a_policy_is_copied_with_its_content(tmp_path, monkeypatch):
    seen = VectorEnv(3, policy="robust", seed=5).reset()[0]
    built_in = pickle.loads(pickle.dumps(Policy.load("robust")))
    assert np.array_equal(built_in(seen), Policy.load("robust")(seen)) and "robust" in repr(built_in)
    assert copy.deepcopy(built_in) is built_in
    shutil.copy(ROOT / "assets/policies/robust.safetensors", tmp_path / "policy.safetensors")
    monkeypatch.chdir(tmp_path)
    policy = Policy.load("policy.safetensors", set={"env": {"friction_scale": 0.5}})
    (tmp_path / "policy.safetensors").write_bytes(b"something else")
    pickled = pickle.dumps(policy)
    monkeypatch.chdir("/")
    shutil.rmtree(tmp_path)
    again = pickle.loads(pickle.dumps(pickle.loads(pickled)))
    assert np.array_equal(again(seen), policy(seen)) and again.settings == policy.settings and repr(again) == repr(policy)
    one, other = (VectorEnv(2, policy=one, set={"env.gains_scale": 0.9}) for one in (policy, again))
    one.reset(), other.reset()
    assert same(future(one), future(other))
    short = {"episodes": 2, "set": {"env.max_episode_seconds": 0.1}}
    assert evaluate(again, **short) == evaluate(policy, **short)


def test_paths_are_absolute_when_they_are_given(tmp_path, monkeypatch):
    written(tmp_path / "here")
    written(tmp_path / "there")
    (tmp_path / "there/all.xml").write_text(HAND.replace('name="cupped"', 'name="hollow"'))
    monkeypatch.chdir(tmp_path / "here")
    for set in ({"env.model": "scene.xml"}, {"env": {"model": pathlib.Path("scene.xml")}}):
        envs = VectorEnv(2, set=set)
        assert envs.settings["env.model"] == str(tmp_path / "here/scene.xml")
        monkeypatch.chdir(tmp_path / "there")
        assert copy.deepcopy(envs).settings == envs.settings
        assert not np.array_equal(VectorEnv(2, set=set).get_state, envs.get_state)
        monkeypatch.chdir(tmp_path / "here")


def test_a_trace_goes_where_it_was_named_even_if_the_function_changes_the_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def act(observations):
        monkeypatch.chdir("/")
        return observations[:, :20]

    evaluate(act, episodes=1, set={"env.max_episode_seconds": 0.1}, trace="x.jsonl")
    assert [file.name for file in tmp_path.iterdir()] == ["x.jsonl"]


@pytest.mark.parametrize("value", ["/h\udce9nd.xml", "h\udce9nd.xml", b"h\xe9nd.xml"])
def test_a_path_that_is_not_utf_8_is_refused_in_a_sentence(value):
    given = value if isinstance(value, str) else pathlib.Path(value.decode("utf-8", "surrogateescape"))
    for set in ({"env.model": given}, {"env": {"model": given}}):
        with pytest.raises(ValueError, match="must be UTF-8"):
            VectorEnv(1, set=set)


@pytest.mark.parametrize("name", ["α tip", "α turns", "block", "cupped", "α end"])
def test_a_name_that_is_not_utf_8_is_refused_in_a_sentence(tmp_path, name):
    assert f'"{name}"' in HAND
    scene = tmp_path / "hand.xml"
    scene.write_bytes(HAND.replace(f'"{name}"', '"\udce9"').encode(errors="surrogateescape"))
    with pytest.raises(ValueError, match="UTF-8"):
        VectorEnv(1, set={"env.model": scene})


def test_a_copy_on_a_machine_with_fewer_cores_takes_as_many_threads_as_it_has(monkeypatch):
    envs = VectorEnv(2, threads=17)
    envs.reset(seed=1)
    pickled, given = pickle.dumps(envs), np.zeros((2, 20))
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    assert np.array_equal(pickle.loads(pickled).step(given)[0], envs.step(given)[0])
    assert pickle.loads(pickled)._made["threads"] == 0
