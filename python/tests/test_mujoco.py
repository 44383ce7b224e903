"""A user's own `import mujoco` beside ours: neither affects the other.

Other versions are looked for in the folders that SHADOW_REPOSE_MUJOCOS lists, separated by colons (`pip install --target`).
"""
import importlib.util
import os
import subprocess
import sys

import pytest

FOLDERS = [folder for folder in os.environ.get("SHADOW_REPOSE_MUJOCOS", "").split(":") if folder]
if importlib.util.find_spec("mujoco"):
    FOLDERS.append("")
if not FOLDERS:
    pytest.skip("there is no mujoco to import beside ours", allow_module_level=True)

OURS = """
def ours(envs=None):
    import hashlib, numpy as np
    from shadow_repose import VectorEnv
    envs = VectorEnv(8, threads=2, seed=3)
    found = hashlib.sha256(envs.reset()[0].tobytes())
    for given in np.random.default_rng(0).uniform(-1, 1, (20, 8, 20)):
        found.update(envs.step(given)[0].tobytes())
    return found.hexdigest()
"""

THEIRS = """
def theirs():
    import mujoco
    text = '<mujoco><worldbody><body pos="0 0 1"><freejoint/><geom size=".1"/></body><geom type="plane" size="1 1 .1"/></worldbody></mujoco>'
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    for _ in range(500):
        mujoco.mj_step(model, data)
    assert mujoco.mj_versionString() == mujoco.__version__
    try:
        mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom/></worldbody></mujoco>")
    except ValueError as error:
        return mujoco.__version__, float(data.qpos[2]), str(error)
"""


def run(code, folder="", path=None):
    places = [folder, *sys.path] if folder else sys.path
    found = subprocess.run(
        [sys.executable, "-c", OURS + THEIRS + code], capture_output=True, text=True, cwd=path,
        env={**os.environ, "PYTHONPATH": ":".join(places)},
    )  # fmt: skip
    assert found.returncode == 0, found.stderr
    return found.stdout


ALONE = {}


def alone(code, folder=""):
    return ALONE.setdefault((code, folder), run(code, folder))


@pytest.mark.parametrize("folder", FOLDERS)
def test_both_do_the_same_as_alone_in_either_order(folder):
    expected = alone("print(ours())") + alone("print(theirs())", folder)
    assert run("print(ours()); print(theirs())", folder) == expected
    backwards = run("print(theirs()); print(ours())", folder)
    assert sorted(backwards.splitlines()) == sorted(expected.splitlines())


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_library_of_theirs_whose_symbols_are_global_does_nothing_to_ours(folder):
    code = """
import ctypes, glob, importlib.util, os
place = os.path.dirname(importlib.util.find_spec("mujoco").origin)
ctypes.CDLL(glob.glob(place + "/libmujoco.so.*")[0], ctypes.RTLD_GLOBAL)
print(ours())
"""
    assert run(code, folder) == alone("print(ours())")


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_callback_of_theirs_is_not_called_for_our_hands(folder):
    code = """
import mujoco
called = []
mujoco.set_mjcb_control(lambda model, data: called.append(1))
print(ours())
assert not called
"""
    assert run(code, folder) == alone("print(ours())")


@pytest.mark.parametrize("folder", FOLDERS)
def test_their_warnings_go_to_their_log_although_ours_are_silent(folder, tmp_path):
    code = """
print(ours())
import mujoco
model = mujoco.MjModel.from_xml_string('<mujoco><worldbody><body><freejoint/><geom size=".1"/></body></worldbody></mujoco>')
data = mujoco.MjData(model)
data.qpos[0] = float("nan")
mujoco.mj_step(model, data)
"""
    run(code, folder, tmp_path)
    assert (tmp_path / "MUJOCO_LOG.TXT").exists()
