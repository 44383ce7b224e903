"""The process around the environments: forks, threads, signals, panics, memory."""
import gc
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv

import shadow_repose
from shadow_repose import Env, Policy, VectorEnv, evaluate

ZEROS = np.zeros((16, 20), np.float32)


def started(**options):
    envs = VectorEnv(16, **{"threads": 2, "seed": 1, **options})
    envs.reset()
    return envs


def stepped_in_a_child(queue, envs):
    queue.put(envs.step(ZEROS)[0].tobytes())
    queue.put(Policy.load("builtin")(np.zeros((200, *envs.single_observation_space.shape))).tobytes())


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_a_child_process_goes_on_with_the_same_bits_on_threads_of_its_own(method):
    envs = started()
    envs.step(ZEROS)
    actions = Policy.load("builtin")(np.zeros((200, *envs.single_observation_space.shape)))
    context = multiprocessing.get_context(method)
    queue = context.Queue()
    child = context.Process(target=stepped_in_a_child, args=(queue, envs))
    child.start()
    found = [queue.get(timeout=60), queue.get(timeout=60)]
    child.join(60)
    assert child.exitcode == 0
    assert found == [envs.step(ZEROS)[0].tobytes(), actions.tobytes()]


def test_a_child_that_is_forked_in_a_step_gets_an_exception_and_does_not_hang():
    envs = VectorEnv(1024, threads=1)
    envs.reset()
    stepping = threading.Thread(target=lambda: [envs.step(np.zeros((1024, 20))) for _ in range(5)])
    stepping.start()
    time.sleep(0.02)
    child = os.fork()
    if child == 0:
        try:
            envs.step(np.zeros((1024, 20)))
        except RuntimeError:
            os._exit(7)
        os._exit(1)
    for _ in range(600):
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            break
        time.sleep(0.05)
    else:
        os.kill(child, signal.SIGKILL)
    stepping.join()
    assert done and os.waitstatus_to_exitcode(status) == 7


def test_two_threads_that_step_the_same_hands_get_results_or_a_sentence():
    envs, errors, done = started(set={"env.max_episode_seconds": 0.05}, reward_terms=True), [], []

    def step(value):
        for _ in range(100):
            try:
                done.append((value, envs.step(np.full((16, 20), value))))
            except RuntimeError as error:
                errors.append(str(error))

    threads = [threading.Thread(target=step, args=(0.2 * i,)) for i in range(1, 4)]
    [thread.start() for thread in threads]
    [thread.join() for thread in threads]
    assert len(done) + len(errors) == 300 and envs.env_steps == 16 * len(done)
    assert set(errors) == {"another thread is using these hands"}
    finals = [(value, info["final_obs"][info["_final_obs"]]) for value, (*_, info) in done if "final_obs" in info]
    assert len(finals) > 5 and all((rows[:, envs.observation_layout["previous_action"]] == np.float32(value)).all() for value, rows in finals)


def test_two_threads_step_hands_of_their_own_with_the_bits_that_each_has_alone():
    expected = started().step(ZEROS)[0]
    found = []
    threads = [threading.Thread(target=lambda: found.append(started().step(ZEROS)[0])) for _ in range(4)]
    [thread.start() for thread in threads]
    [thread.join() for thread in threads]
    assert len(found) == 4 and all(np.array_equal(one, expected) for one in found)


def test_python_runs_while_the_hands_step():
    envs = VectorEnv(1024, threads=1)
    envs.reset()
    counted, stop = [0], threading.Event()

    def count():
        while not stop.is_set():
            counted[0] += 1

    thread = threading.Thread(target=count)
    thread.start()
    before = counted[0]
    for _ in range(3):
        envs.step(np.zeros((1024, 20)))
    stop.set()
    thread.join()
    assert counted[0] - before > 10_000


def test_ctrl_c_interrupts_a_long_evaluation_soon_and_python_keeps_its_handler():
    handler = signal.default_int_handler
    # A background job of some shells begins with the signal ignored.
    signal.signal(signal.SIGINT, handler)
    timer = threading.Timer(0.5, lambda: os.kill(os.getpid(), signal.SIGINT))
    began = time.monotonic()
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        evaluate("builtin", episodes=100_000)
    assert time.monotonic() - began < 20 and signal.getsignal(signal.SIGINT) is handler


def test_a_panic_is_an_exception_and_the_hands_go_on(capfd):
    envs = started()
    with pytest.raises(RuntimeError, match="internal error"):
        envs._hands._panic_for_a_test()
    assert envs.step(ZEROS)[0].shape == envs.observation_space.shape


def test_hands_that_are_made_and_closed_a_thousand_times_leave_nothing():
    def resident():
        gc.collect()
        with open("/proc/self/statm", encoding="ascii") as statm:
            return int(statm.read().split()[1]) * 4096 / 2**20

    def turn(times):
        for _ in range(times):
            envs = VectorEnv(2, threads=2)
            envs.reset()
            envs.step(np.zeros((2, 20)))
            envs.close()

    turn(100)
    before, threads = resident(), threading.active_count()
    turn(900)
    assert resident() - before < 40, "MiB"
    assert len(os.listdir("/proc/self/task")) < 20 and threading.active_count() == threads


def test_hands_that_are_forgotten_are_freed():
    tasks = len(os.listdir("/proc/self/task"))
    for _ in range(5):
        started()
    gc.collect()
    time.sleep(0.2)
    assert len(os.listdir("/proc/self/task")) <= tasks + 2


def test_one_hand_steps_in_processes_of_gymnasium():
    envs = AsyncVectorEnv([Env] * 2)
    observations, _ = envs.reset(seed=3)
    assert observations.shape == envs.observation_space.shape and envs.step(np.zeros((2, 20)))[0].shape == observations.shape
    envs.close()


def test_hands_that_are_not_reset_are_as_new_in_a_copy_and_busy_ones_are_not_copied():
    envs = VectorEnv(3, seed=9)
    again = pickle.loads(pickle.dumps(envs))
    assert np.array_equal(again.reset()[0], envs.reset()[0])
    busy = VectorEnv(1024, threads=1)
    busy.reset()
    stepping = threading.Thread(target=lambda: [busy.step(np.zeros((1024, 20))) for _ in range(3)])
    stepping.start()
    time.sleep(0.02)
    with pytest.raises(RuntimeError, match="another thread"):
        pickle.dumps(busy)
    stepping.join()


def test_the_module_is_imported_without_gymnasium_and_numpy():
    code = "import sys, shadow_repose; print([name for name in ('gymnasium', 'numpy', 'torch') if name in sys.modules])"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout == "[]\n"


def test_a_processor_without_avx_is_named_in_a_sentence(tmp_path):
    facts = tmp_path / "cpuinfo"
    facts.write_text("processor : 0\nflags : fpu sse2 ssse3\n")
    with pytest.raises(ImportError, match="no AVX"):
        shadow_repose._expect_avx(str(facts))
    facts.write_text("processor : 0\nflags : fpu sse2 avx avx2\n")
    shadow_repose._expect_avx(str(facts))
    shadow_repose._expect_avx(str(tmp_path / "nowhere"))


@pytest.mark.parametrize(
    "call",
    [
        "envs.step(zeros)", "envs.reset()", "envs.get_state()", "envs.set_state(state)", "policy(seen)", "policy(seen[:1])", "policy.values(seen)",
        "evaluate(policy, episodes=1)", "evaluate(lambda seen: seen[:, :20], episodes=1)", "VectorEnv(2)", "Policy.load()",
        "pickle.loads(pickle.dumps(policy))", "copy.deepcopy(envs)", "envs.render()", "envs.close()",
    ],
)  # fmt: skip
@pytest.mark.parametrize("used", [False, True])
def test_a_call_while_python_ends_is_answered_or_an_ordinary_exception(call, used):
    code = f"""
import copy, pickle, numpy as np
from shadow_repose import Policy, VectorEnv, evaluate
envs, policy = VectorEnv(2, render_mode="rgb_array"), Policy.load()
zeros, seen = np.zeros((2, 20), np.float32), np.zeros((200, *envs.single_observation_space.shape), np.float32)
envs.reset()
state = envs.get_state()

class Late:
    def __del__(self):
        try:
            {call}
        except Exception:
            pass

if {used}:
    Late().__del__()
late = Late()
"""
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert (found.returncode, found.stdout) == (0, "") and "panicked" not in found.stderr, found.stderr
    assert not found.stderr or "note:" in found.stderr, found.stderr
